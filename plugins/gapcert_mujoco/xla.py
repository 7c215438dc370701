"""The third way to advance rows: MuJoCo XLA (MJX), compiled by JAX, where each row has native parameters of its own."""

from __future__ import annotations

import contextlib
import functools
import importlib.metadata
import importlib.util
import io
import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any, final

import mujoco
import numpy as np
import numpy.typing as npt

from gapcert import Array, MissingDependency, UsageError

from .parameters import Natives
from .robot import binary, restored, touches, unconstrained
from .stepping import HUGE, Broken

Indices = npt.NDArray[np.intp]
FIELDS = (
    "dof_damping",
    "dof_frictionloss",
    "dof_armature",
    "dof_invweight0",
    "body_mass",
    "body_subtreemass",
    "body_inertia",
    "body_ipos",
    "body_invweight0",
)
"""What native parameters change in a model, besides gravity, and MJX reads."""
_FAINT = 1e-100
"""Dry friction in the place of none: MJX takes a friction of zero in a row that has one for a brake that never slips."""
_STAGES = ("concatenate", "gather", "scatter", "cholesky")
_DISABLE = mujoco.mjtDisableBit


def check(model: Any, path: object) -> None:
    """MissingDependency where a package is absent; UsageError where MJX would answer otherwise than the C code."""
    absent = [
        name for name, module in (("jax", "jax"), ("mujoco-mjx", "mujoco.mjx")) if importlib.util.find_spec(module) is None
    ]
    if absent:
        raise MissingDependency(
            f"backend.implementation: mjx needs {', '.join(absent)}, which is not installed; run: pip install 'gapcert[mjx]'"
        )
    option = model.opt
    passive = option.disableflags & int(_DISABLE.mjDSBL_SPRING | _DISABLE.mjDSBL_DAMPER)
    polynomials = (model.jnt_stiffnesspoly, model.dof_dampingpoly)
    integrators = (mujoco.mjtIntegrator.mjINT_EULER, mujoco.mjtIntegrator.mjINT_RK4, mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
    other = {
        "bodies that may touch": touches(model),
        "a motor at a site": model.nu,
        "an equality constraint": model.neq,
        "a tendon": model.ntendon,
        "a spring or damper that is not linear": any(np.any(part) for part in polynomials),
        "a medium (density, viscosity or wind)": option.density or option.viscosity or np.any(option.wind),
        "gravity compensation by actuators": np.any(model.jnt_actgravcomp),
        "springs without dampers, or the reverse, by <flag>": passive
        not in (0, int(_DISABLE.mjDSBL_SPRING | _DISABLE.mjDSBL_DAMPER)),
        f"integrator {_word(mujoco.mjtIntegrator, option.integrator)}": option.integrator not in map(int, integrators),
        f"solver {_word(mujoco.mjtSolver, option.solver)}": option.solver != mujoco.mjtSolver.mjSOL_NEWTON,
        "iterations without slip": option.noslip_iterations,
        "a base that floats, with RK4": option.integrator == integrators[1]
        and (model.jnt_type == mujoco.mjtJoint.mjJNT_FREE).any(),
    }
    if found := [what for what, there in other.items() if there]:
        raise UsageError(
            f"backend.implementation: {path} has {found[0]}, where MJX differs from the C code; expected joints with linear "
            f"springs and dampers, dry friction and ends, without contacts, stepped by Euler, RK4 or implicitfast with the "
            f"Newton solver; set implementation: c{', or contact: false' if touches(model) else ''}"
        )


def versions() -> list[str]:
    """What decides the last bits."""
    device = _jax().devices()[0]
    packages = [f"{name} {importlib.metadata.version(name)}" for name in ("mujoco-mjx", "jax", "jaxlib")]
    return [*packages, f"{device.platform} {device.device_kind}"]


def _jax() -> Any:
    """JAX, which takes memory of a GPU as it needs it.

    Unless it is told otherwise it takes three quarters before it does anything, and a worker process that comes next gets none.
    """
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    import jax

    return jax


@final
class Compiled:
    """Rows of a model, `block` at a time: a query is cut into blocks, and the last one filled up with its last row.

    Every call has the same shape, so that one compilation serves all, and a row's bits do not depend on how many are asked at
    once. A second program has dry friction at all joints; whether a row takes it, that row's own parameters decide.
    """

    def __init__(self, model: Any, natives: Natives, block: int) -> None:
        self._model, self._natives, self._block = model, natives, block
        self._structures = [self._structure(dry) for dry in (False, True)]
        self._fields: dict[str, Array] = {}
        self._common: dict[str, Any] = {}
        self._dry: npt.NDArray[np.bool_] = np.zeros(0, dtype=bool)
        self._rows: Indices | None = None
        self._given: object = None

    def load(self, values: Sequence[Mapping[str, float]], rows: Indices | None = None) -> None:
        """Native parameters: row k of the next queries has values[rows[k]], or all have values[0]."""
        given = list(values), None if rows is None else rows.tolist()
        if given == self._given:
            return
        models = [self._natives.varied(self._model, v) for v in values]
        self._dry = np.array([bool(m.dof_frictionloss.any()) for m in models])
        for model, dry in zip(models, self._dry, strict=True):
            if dry:
                model.dof_frictionloss[:] = np.maximum(model.dof_frictionloss, _FAINT)
        self._fields = {name: np.stack([getattr(m, name) for m in models]) for name in FIELDS}
        self._fields["gravity"] = np.stack([m.opt.gravity for m in models])
        self._rows, self._given = rows, given
        self._common.clear()

    def advance(self, state: Array, force: Array, steps: int, command: Array | None = None) -> Array:
        """As `Rollouts.advance`."""
        n = len(state)
        sets = np.zeros(n, dtype=np.intp) if self._rows is None else self._rows
        after = np.empty_like(state)
        for dry in (False, True):
            chosen = np.flatnonzero(self._dry[sets] == dry)
            for k in range(0, len(chosen), self._block):
                rows = chosen[k : k + self._block]
                after[rows], good = self._call(dry, state[rows], force[rows], sets[rows], steps)
                if not good.all():
                    raise Broken(int(rows[np.flatnonzero(~good)[0]]), "a number became huge or undefined")
        return after

    def _call(self, dry: bool, state: Array, force: Array, sets: Indices, steps: int) -> tuple[Array, npt.NDArray[np.bool_]]:
        n = len(state)
        filled = np.minimum(np.arange(self._block), n - 1)
        if force.shape[1] != steps:
            force = np.repeat(force, steps, axis=1)
        with _jax().enable_x64(True):
            fields = self._handed(sets[filled])
            after, good = program(self._structures[dry])(fields, state[filled], force[filled])
        return np.asarray(after)[:n], np.asarray(good)[:n]

    def _handed(self, sets: Indices) -> dict[str, Any]:
        """The parameters of each row of a block; those that all rows have are handed to the device once."""
        if self._rows is not None:
            return {name: part[sets] for name, part in self._fields.items()}
        if not self._common:
            self._common = {name: _jax().numpy.asarray(part[sets]) for name, part in self._fields.items()}
        return self._common

    def _structure(self, dry: bool) -> bytes:
        """The model, without what `fields` say."""
        model = restored(binary(self._model))
        model.dof_frictionloss[:] = float(dry)
        if not dry and unconstrained(model):
            model.opt.disableflags |= int(_DISABLE.mjDSBL_CONSTRAINT | _DISABLE.mjDSBL_CONTACT)
        return binary(model)

    def close(self) -> None:
        self._fields.clear()
        self._common.clear()
        self._given = None


@functools.lru_cache(maxsize=16)
def program(structure: bytes) -> Callable[..., Any]:
    """(fields, states, forces (n, steps, nv)) → (states, have all numbers stayed numbers?); one per model and process."""
    jax = _jax()
    # MJX says by print() that it goes without its variant for Warp.
    with contextlib.redirect_stdout(io.StringIO()):
        import mujoco.mjx as mjx

    model = restored(structure)
    nq, nv = model.nq, model.nv
    try:
        base = mjx.put_model(model, impl="jax")
        blank = mjx.make_data(base, impl="jax")
    except RuntimeError as error:  # of which kind are those for what a library has not implemented
        raise UsageError(
            f"backend.implementation: MJX says '{error}'; expected what it implements; set implementation: c"
        ) from None

    def advance(fields: dict[str, Any], state: Any, forces: Any) -> tuple[Any, Any]:
        fields = dict(fields)
        own = base.replace(opt=base.opt.replace(gravity=fields.pop("gravity")), **fields)

        def step(carry: Any, force: Any) -> tuple[Any, None]:
            q, v, warm, good = carry
            data = mjx.step(own, blank.replace(qpos=q, qvel=v, qacc_warmstart=warm, qfrc_applied=force))
            for numbers in (data.qpos, data.qvel, data.qacc):
                good &= (abs(numbers) < HUGE).all()
            return (data.qpos, data.qvel, data.qacc_warmstart, good), None

        start = (state[1 : 1 + nq], state[1 + nq :], jax.numpy.zeros(nv), jax.numpy.array(True))
        once = jax.make_jaxpr(step)(start, forces[0])
        (q, v, _, good), _ = jax.lax.scan(lambda c, force: (tuple(_staged(once, [*c, force])), None), start, forces)
        return jax.numpy.concatenate([state[:1], q, v]), good

    # Else what multiplies on a GPU is chosen by what it takes in a trial, and two processes may round otherwise.
    options = {"xla_gpu_deterministic_ops": True} if jax.devices()[0].platform == "gpu" else None
    compiled: Callable[..., Any] = jax.jit(jax.vmap(advance), compiler_options=options)
    return compiled


def _staged(closed: Any, arguments: Sequence[Any]) -> list[Any]:
    """What a traced function gives, in stages: XLA may not merge what stands before a `_STAGES` with what comes after.

    Left alone, on a CPU, it merges the poses along a chain of bodies into one loop, in which each body computes again all those
    before it: with seven joints a step took a hundred times as long. Sums over the children of a body are taken one by one: a
    GPU adds them in the order in which its threads arrive, so that the same question would have two answers.
    """
    import jax
    from jax.extend.core import Literal

    jaxpr = closed.jaxpr
    barrier: Any = jax.lax.optimization_barrier
    known = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*closed.consts, *arguments], strict=True))

    def value(variable: Any) -> Any:
        return variable.val if isinstance(variable, Literal) else known[variable]

    for equation in jaxpr.eqns:
        name, parameters, inputs = equation.primitive.name, equation.params, [value(v) for v in equation.invars]
        if name == "jit":
            outputs = _staged(parameters["jaxpr"], inputs)
        else:
            if name == "scan":
                inner = parameters["jaxpr"]
                staged = jax.make_jaxpr(lambda *a, inner=inner: _staged(inner, a))(*inner.in_avals)
                parameters = parameters | {"jaxpr": staged}
            segments = name == "scatter-add" and _segments(equation)
            outputs = _summed(*inputs) if segments else equation.primitive.bind(*inputs, **parameters)
            outputs = outputs if equation.primitive.multiple_results else [outputs]
            if name in _STAGES:
                outputs = barrier(outputs)
        known.update(zip(equation.outvars, outputs, strict=True))
    return [value(v) for v in jaxpr.outvars]


def _segments(equation: Any) -> bool:
    """Does it add floating numbers (k, …) to the rows that k indices name?"""
    into, indices, _ = (v.aval for v in equation.invars)
    numbers = equation.params["dimension_numbers"]
    shapes = (indices.shape[1:], numbers.update_window_dims, numbers.inserted_window_dims, numbers.operand_batching_dims)
    return np.issubdtype(into.dtype, np.floating) and shapes == ((1,), tuple(range(1, into.ndim)), (0,), ())


def _summed(into: Any, indices: Any, added: Any) -> Any:
    """What scatter-add gives where it goes from the first to the last."""
    import jax

    rows = jax.numpy.arange(into.shape[0]).reshape(-1, *[1] * (into.ndim - 1))
    for k in range(indices.shape[0]):
        into = jax.numpy.where(rows == indices[k, 0], into + added[k], into)
    return into


def _word(kinds: Any, value: int) -> str:
    return str(kinds(value).name).partition("_")[2]
