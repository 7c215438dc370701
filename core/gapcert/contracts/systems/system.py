"""The one contract of everything that steps: nominal models f and high-fidelity simulators f̂."""

from __future__ import annotations

import types
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, final

import numpy as np

from gapcert.contracts.systems.extension import Extension as Extension
from gapcert.contracts.systems.extension import Parameter as Parameter
from gapcert.contracts.systems.scene import Scene as Scene
from gapcert.numerics import circle
from gapcert.numerics.arrays import Array, Bools
from gapcert.numerics.digest import digest
from gapcert.numerics.errors import UsageError
from gapcert.numerics.intervals import Interval


@final
@dataclass(frozen=True)
class StateSpec:
    """Name, unit and kind of one state, input or output.

    `angle` lives on the circle (period 2π); `quaternion` occupies four columns (w, x, y, z) and its differences three
    (a rotation vector).
    """

    name: str
    unit: str = "1"
    kind: Literal["real", "angle", "quaternion"] = "real"

    @property
    def size(self) -> int:
        return 4 if self.kind == "quaternion" else 1

    def difference(self, a: Array, b: Array) -> Array:
        """a − b in this state's geometry: real a − b; angle in [−π, π]; quaternion (…, 4) → rotation vector (…, 3)."""
        if self.kind == "quaternion":
            return _rotation_vector(a, b)
        d = np.asarray(a - b, dtype=np.float64)
        return circle.near(d) if self.kind == "angle" else d


def _rotation_vector(a: Array, b: Array) -> Array:
    """log(a ⊗ b⁻¹) of unit quaternions, shape (…, 4) → (…, 3)."""
    aw, av, bw, bv = a[..., :1], a[..., 1:], b[..., :1], -b[..., 1:]
    w = aw * bw - np.sum(av * bv, axis=-1, keepdims=True)
    v = aw * bv + bw * av + cross(av, bv)
    v = np.where(w < 0, -v, v)
    norm = np.linalg.norm(v, axis=-1, keepdims=True)
    angle = 2 * np.arctan2(norm, np.abs(w))
    scale = np.divide(angle, norm, out=np.full_like(norm, 2.0), where=norm > 0)
    return np.asarray(v * scale)


def cross(a: Array, b: Array) -> Array:
    """a × b of vectors (…, 3); numpy's own takes five times as long for few of them."""
    (ax, ay, az), (bx, by, bz) = ([v[..., k] for k in range(3)] for v in (a, b))
    out = np.empty(np.shape(a))
    out[..., 0], out[..., 1], out[..., 2] = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    return out


def rotated(q: Array, rotation: Array) -> Array:
    """exp(rotation) ⊗ q for quaternions (n, 4) and rotation vectors (n, 3)."""
    angle = np.linalg.norm(rotation, axis=1, keepdims=True)
    w, v = np.cos(angle / 2), np.sinc(angle / (2 * np.pi)) * rotation / 2
    qw, qv = q[:, :1], q[:, 1:]
    out = np.hstack([w * qw - (v * qv).sum(axis=1, keepdims=True), w * qv + qw * v + cross(v, qv)])
    return np.asarray(out / np.linalg.norm(out, axis=1, keepdims=True))


def difference(specs: Sequence[StateSpec], a: Array, b: Array) -> Array:
    """a − b column by column, each in its own geometry; a, b (…, Σ size)."""
    kinds = {s.kind for s in specs}
    if "quaternion" not in kinds:
        d = np.asarray(a - b, dtype=np.float64)
        # Nearly always no angle has gone around.
        if "angle" in kinds and not np.abs(d).max(initial=0.0) < np.pi:
            angles = [i for i, s in enumerate(specs) if s.kind == "angle"]
            d[..., angles] = specs[angles[0]].difference(d[..., angles], np.zeros(()))
        return d
    parts, column = [], 0
    for s in specs:
        part = slice(column, column + s.size)
        d = s.difference(a[..., part], b[..., part])
        parts.append(d)
        column += s.size
    return np.concatenate(parts, axis=-1)


Capability = Literal["hidden", "parameters", "forces", "seed"]
Values = Mapping[str, Array | float]
"""Of parameters by name: one each, or one per row (n,)."""


class System(ABC):
    """x⁺ = step(x, u): batched, float64, pure in all its arguments.

    A subclass sets the attributes below in `__init__` and implements `_step`. Every optional argument of `step` is a
    capability that must be declared. Purity: equal arguments give equal bits, in any order and in any process. Instances
    are picklable (workers receive them).
    """

    states: tuple[StateSpec, ...]
    inputs: tuple[StateSpec, ...]
    period: float
    substeps: int = 1
    capabilities: frozenset[Capability] = frozenset()
    hidden: tuple[StateSpec, ...] = ()
    hidden_default: tuple[float, ...] = ()
    parameters: tuple[Parameter, ...] = ()
    coordinates: tuple[str, ...] = ()

    @abstractmethod
    def _step(self, x: Array, u: Array, **options: Any) -> Step | Array:
        """One period from x (n, nx) under u (n, nu); options only as declared in `capabilities`."""

    def resolution(self, magnitude: Array) -> Array:
        """e (nx,): bound on the arithmetic error of one step, by default 4 ulp of `magnitude` = max |x⁺| (nx,).

        It is stated, not proved: claims name it as an assumption. For a Model, see `rounding_over`.
        """
        return np.asarray(4 * np.spacing(np.maximum(np.abs(magnitude), np.finfo(float).tiny)))

    def rounding(self, magnitude: Array) -> Array:
        """The part of `resolution` (nx,) that is arithmetic, without what a solver that iterates may leave (default: all)."""
        return self.resolution(magnitude)

    def repeats(self, angle: str) -> str | None:
        """Why f(x + 2π, u) = f(x, u) along this state, up to whole turns of angles, is not true (of what is remembered too);
        empty where it is proved to be, and None where nothing is known: it is probed then.
        """
        return None

    def scene(self, x: Array, hidden: Array | None = None) -> Scene | None:
        """What x (n, nx) looks like, with hidden (n, nh) or its default; None without a body, or where x does not say."""
        return None

    def digest(self) -> str:
        """SHA-256 of everything that determines the answers, equal in every process.

        By default of the class and the attributes, not of code: override it where the physics is in code that changes. A
        System among the attributes counts by its own digest, if it overrides this one.
        """
        return digest(self, lambda part: isinstance(part, System) and type(part).digest is not System.digest)

    @property
    def nx(self) -> int:
        return sum(s.size for s in self.states)

    @property
    def nu(self) -> int:
        return len(self.inputs)

    @final
    def step(
        self,
        x: Array,
        u: Array,
        *,
        hidden: Array | None = None,
        parameters: Values | None = None,
        forces: Array | None = None,
        seed: int | None = None,
    ) -> Step:
        """One period for a batch. x (n, nx), u (n, nu), hidden (n, nh), forces (n, substeps, nq).

        `hidden=None` starts from the declared default. Raises UsageError on a wrong shape, a non-finite number or an
        undeclared option.
        """
        x, u = self._batch("x", x, self.nx), self._batch("u", u, self.nu)
        if len(x) != len(u):
            raise UsageError(f"{type(self).__name__}.step: x has {len(x)} rows and u has {len(u)}; give one input per state")
        options = self._options(len(x), {"hidden": hidden, "parameters": parameters, "forces": forces, "seed": seed})
        if len(x) == 0:
            return Step(np.empty((0, self.nx)), options.get("hidden"))
        try:
            out = self._step(x, u, **options)
        except TypeError as error:
            # Raised by the call itself, and not within it.
            if error.__traceback__ is not None and error.__traceback__.tb_next is None:
                raise UsageError(f"{type(self).__name__}: {error}; expected _step(self, x, u, **options)") from error
            raise
        return self._answered(out if isinstance(out, Step) else Step(out), len(x))

    @final
    def rollout(
        self,
        x0: Array,
        u_sequence: Array,
        *,
        hidden: Array | None = None,
        parameters: Values | None = None,
        forces: Array | None = None,
        seed: int | None = None,
    ) -> Step:
        """Repeated steps with `hidden` handed on: x (n, T + 1, nx) from x0 (n, nx), under u_sequence (n, T, nu).

        forces (n, T, substeps, nq). Step k of a rollout with `seed` uses `step_seed(seed, k)`.
        """
        x0 = self._batch("x0", x0, self.nx)
        u_sequence = np.asarray(u_sequence, dtype=np.float64)
        if u_sequence.ndim != 3 or u_sequence.shape[0] != len(x0) or u_sequence.shape[2] != self.nu:
            raise UsageError(
                f"{type(self).__name__}.rollout: u_sequence has shape {u_sequence.shape}; expected ({len(x0)}, T, {self.nu})"
            )
        if not np.isfinite(u_sequence).all():
            raise UsageError(f"{type(self).__name__}.rollout: u_sequence has a number that is not finite")
        if forces is not None:
            forces = np.asarray(forces, dtype=np.float64)
            if forces.shape[:2] != u_sequence.shape[:2]:
                expected = (*u_sequence.shape[:2], self.substeps, len(self.coordinates))
                raise UsageError(f"{type(self).__name__}.rollout: forces has shape {forces.shape}; expected {expected}")
        return self._rollout(x0, u_sequence, hidden=hidden, parameters=parameters, forces=forces, seed=seed)

    def _rollout(self, x0: Array, u_sequence: Array, **options: Any) -> Step:
        """Override for speed; must equal repeated `step` calls bit for bit."""
        out = np.empty((len(x0), u_sequence.shape[1] + 1, self.nx))
        out[:, 0] = x0
        hidden, forces, seed = options["hidden"], options["forces"], options["seed"]
        for k in range(u_sequence.shape[1]):
            result = self.step(
                out[:, k],
                u_sequence[:, k],
                hidden=hidden,
                parameters=options["parameters"],
                forces=None if forces is None else forces[:, k],
                seed=None if seed is None else step_seed(seed, k),
            )
            out[:, k + 1], hidden = result.x, result.hidden
        return Step(out, hidden)

    def _answered(self, out: Step, n: int) -> Step:
        """What `_step` returned; UsageError where that is not one row per sample of float64."""
        nx = self.nx
        if out.hidden is None and type(out.x) is np.ndarray and out.x.dtype == np.float64 and out.x.shape == (n, nx):
            return out
        told = [("", out.x, nx, "state")]
        if self.hidden and out.hidden is not None:
            told.append(("hidden ", out.hidden, sum(s.size for s in self.hidden), "hidden state"))
        for what, value, columns, of in told:
            if (shape := np.shape(value)) != (n, columns):
                raise UsageError(
                    f"{type(self).__name__}._step returned {what}{shape}; expected {(n, columns)}: one row per sample, one "
                    f"column per {of} (four of a quaternion)"
                )
            if (kind := getattr(value, "dtype", type(value).__name__)) != np.float64:
                raise UsageError(f"{type(self).__name__}._step returned {what}numbers of type {kind}; expected float64 arrays")
        return out

    def _batch(self, name: str, value: Array, columns: int) -> Array:
        value = np.ascontiguousarray(value, dtype=np.float64)
        if value.ndim != 2 or value.shape[1] != columns:
            raise UsageError(f"{type(self).__name__}: {name} has shape {value.shape}; expected (n, {columns})")
        if not np.isfinite(value).all():
            row = int(np.flatnonzero(~np.isfinite(value).all(axis=1))[0])
            raise UsageError(f"{type(self).__name__}: {name}[{row}] = {value[row].tolist()} is not finite")
        return value

    def _options(self, n: int, given: Mapping[str, Any]) -> dict[str, Any]:
        """The options of `step` that are given, checked, and the hidden state by default."""
        options = {k: v for k, v in given.items() if v is not None}
        if not options and "hidden" not in self.capabilities:
            return options
        if undeclared := [k for k in options if k not in self.capabilities]:
            can = ", ".join(sorted(self.capabilities)) or "none"
            raise UsageError(f"{type(self).__name__}: option '{undeclared[0]}' is not declared (capabilities: {can})")
        hidden, parameters, forces = (options.get(k) for k in ("hidden", "parameters", "forces"))
        if "hidden" in self.capabilities and hidden is None:
            hidden = np.tile(np.asarray(self.hidden_default, dtype=np.float64), (n, 1))
        if hidden is not None:
            options["hidden"] = self._batch("hidden", hidden, sum(s.size for s in self.hidden))
            if len(options["hidden"]) != n:
                raise UsageError(
                    f"{type(self).__name__}: hidden has {len(options['hidden'])} rows and x has {n}; give one per row"
                )
        if forces is not None:
            shape = (n, self.substeps, len(self.coordinates))
            forces = np.asarray(forces, dtype=np.float64)
            if forces.shape != shape or not np.isfinite(forces).all():
                raise UsageError(f"{type(self).__name__}: forces of shape {forces.shape}; expected finite {shape}")
            options["forces"] = forces
        if parameters is not None:
            known = {p.name for p in self.parameters}
            if unknown := sorted(set(parameters) - known):
                raise UsageError(f"{type(self).__name__}: no parameter {unknown[0]!r}; it has {sorted(known)}")
            options["parameters"] = {k: self._per_row(k, v, n) for k, v in parameters.items()}
        return options

    def _per_row(self, name: str, value: Array | float, n: int) -> Array:
        value = np.asarray(value, dtype=np.float64)
        if value.shape not in ((), (n,)) or not np.isfinite(value).all():
            found = f"parameter {name} of shape {value.shape}"
            raise UsageError(f"{type(self).__name__}: {found}; expected a finite number, or one per row ({n},)")
        return np.broadcast_to(value, (n,))


def step_seed(seed: int, k: int) -> int:
    """The seed of step k of a rollout that was given `seed`."""
    return int(np.random.SeedSequence([seed, k]).generate_state(1)[0])


@final
@dataclass(frozen=True)
class Variant:
    """A model with one setting changed: its name, its value, what it was, and its name in this engine, if it has one."""

    setting: str
    value: Any
    was: Any
    model: Model
    native: str | None = None


class Extendable(ABC):
    """A model as text, and the sites at which effects can be written into it; by default it has none."""

    @abstractmethod
    def equations(self) -> str:
        """The model as readable text, one equation per line."""

    def sites(self, kind: str) -> tuple[str, ...]:
        """Names of the sites of a kind: `coordinate`, `input`, `output`, `parameter` or `contact`."""
        return ()

    def extend(self, extensions: Sequence[Extension]) -> Model:
        """This model with the given effects acting at their sites; UsageError where a site does not exist."""
        raise UsageError(f"{type(self).__name__}: it has no sites for effects; use an equations model")

    @abstractmethod
    def to_spec(self) -> dict[str, Any]:
        """The `model:` section that builds this model again."""

    def text(self) -> dict[str, Any]:
        """The section in which effects are written; by default the model's own."""
        return self.to_spec()

    def force_unit(self, site: str) -> str | None:
        """Of a force at a coordinate, where it is not energy per coordinate."""
        return None


class EngineHints:
    """What a model knows of the physics engine whose motion it writes as equations; by default there is none."""

    doubts: Mapping[str, float] = types.MappingProxyType({})
    """Parameters without a tolerance that may be wrong all the same: name → a change that matters."""
    within: Mapping[str, tuple[float, float]] = types.MappingProxyType({})
    """States and inputs → between what this model holds, where that is not everywhere."""

    def native(self, effect: str, site: str) -> str | None:
        """What an engine calls the parameter that realises an effect at a site, or the parameter `site`."""
        return None

    def restated(self, values: Mapping[str, float]) -> Model | None:
        """This model with other values of its own parameters; None: its spec says how."""
        return None

    def variants(self) -> Sequence[Variant]:
        """This model under other settings of its engine, each of which may be what a recording shows."""
        return ()

    def files(self) -> dict[str, str]:
        """Files in which this model can be used elsewhere: name → text."""
        return {}


class Model(System, Extendable, EngineHints):
    """A white-box System f: equations whose derivatives and range over boxes are known.

    `z` is the concatenation (x, u); boxes are Intervals of shape (n, nx + nu).
    """

    outputs: tuple[StateSpec, ...]
    remembers: bool = False
    """Do hidden states depend on more of the past than late inputs do?"""

    @abstractmethod
    def jacobian(self, x: Array, u: Array) -> Array:
        """∂x⁺/∂(x, u), shape (n, nx, nx + nu)."""

    @abstractmethod
    def enclosure(self, z: Interval) -> Interval:
        """Contains {f(x, u) : (x, u) ∈ z}, shape (n, nx), rounded outwards; angles are not wrapped."""

    @abstractmethod
    def jacobian_enclosure(self, z: Interval) -> Interval:
        """Contains {∂f/∂z : z ∈ box}, shape (n, nx, nx + nu), rounded outwards."""

    def constant_slopes(self, u: Array | None = None) -> Array | None:
        """∂x⁺/∂(x, u) up to rounding, (nx, nx + nu), NaN where it may vary, at all u or at one (nu,); None: not known."""
        return None

    def unmoved(self, u: Array) -> Bools:
        """(n, nx): states that inputs u (n, nu) leave exactly where they are, whatever the states; False where not known."""
        return np.zeros((len(u), self.nx), dtype=bool)

    def curvature_enclosure(self, z: Interval, axis: int) -> Interval:
        """Contains {∂²f/∂z_axis² : z ∈ box}, shape (n, nx), rounded outwards; [−∞, ∞] where a slope may jump, or by default."""
        return Interval(np.full((len(z), self.nx), -np.inf), np.full((len(z), self.nx), np.inf))

    def rounding_over(self, z: Interval) -> Array | None:
        """(n, nx): proved bound on |computed x⁺ − x⁺| over each box, intermediate results included, whatever evaluates the
        step and in whatever batch; ∞ where nothing bounds it. None (default): `resolution` is what is assumed."""
        return None

    def rounding_terms(self, z: Interval) -> tuple[str, ...]:
        """Per state, the term whose rounding has the largest share in that bound, over all of the boxes."""
        return ("",) * self.nx

    def output(self, x: Array, u: Array, parameters: Values | None = None, hidden: Array | None = None) -> Array:
        """y = h(x, u, hidden), shape (n, ny), late inputs as they arrive; by default the state itself, and nothing hidden."""
        return x

    def input_delays(self, parameters: Values | None = None) -> Array:
        """Seconds by which what outputs show of each input is late, (nu,), or (n, nu)."""
        return np.zeros(self.nu)

    def fast_rollout(
        self, x0: Array, u: Array, *, parameters: Values | None = None, hidden: Array | None = None, every: int = 1
    ) -> Step:
        """`rollout` within rounding: x (n, T // every + 1, nx) from x0 (n, nx), row i under u[i mod w] of u (w, T, nu).

        w divides n. Override for speed. A row that blows up is not finite from there on, and disturbs no other.
        """
        u = np.tile(u, (len(x0) // len(u), 1, 1))
        try:
            result = self.rollout(x0, u, parameters=parameters, hidden=hidden)
        except UsageError:
            # A System refuses non-finite states: without the rows that blow up, another reason shows again.
            result = self._survivors(x0, u, dict(parameters or {}), hidden)
        return Step(result.x[:, ::every], result.hidden)

    def _survivors(self, x0: Array, u: Array, parameters: dict[str, Array | float], hidden: Array | None) -> Step:
        n, steps, _ = u.shape
        out = np.full((n, steps + 1, self.nx), np.nan)
        out[:, 0] = x0
        for k in range(steps):
            rows = np.isfinite(out[:, k]).all(axis=1)
            given = {name: np.broadcast_to(v, (n,))[rows] for name, v in parameters.items()} or None
            new = self.step(out[rows, k], u[rows, k], parameters=given, hidden=None if hidden is None else hidden[rows])
            out[rows, k + 1] = new.x
            if new.hidden is not None:
                hidden = np.full((n, new.hidden.shape[1]), np.nan)
                hidden[rows] = new.hidden
        return Step(out, hidden)

    def along(self, x: Array, u: Array, *, parameters: Values | None = None, hidden: Array | None = None) -> Array:
        """One step from every state x (n, T, nx) under u (n, T, nu): x⁺ (n, T, nx), hidden state handed on, parameters (n,)."""
        n, steps, _ = x.shape
        if not self.hidden:
            rows = {k: np.repeat(np.broadcast_to(v, (n,)), steps) for k, v in (parameters or {}).items()} or None
            return self.step(x.reshape(n * steps, -1), u.reshape(n * steps, -1), parameters=rows).x.reshape(x.shape)
        out = np.empty(x.shape)
        for k in range(steps):
            result = self.step(x[:, k], u[:, k], parameters=parameters, hidden=hidden)
            out[:, k], hidden = result.x, result.hidden
        return out

    def fast_memories(self, path: Array, u: Array, stops: Sequence[int], parameters: Values, hidden: Array) -> Array | None:
        """Hidden states (n, stops, nh) before steps `stops` of motions under u (w, T, nu), from hidden (n, nh), w dividing n.

        They go on from path (w, T, nx) where that is finite, else from where they are. None: nothing is faster than rollouts.
        """
        return None

    def held_memories(self, x: Array, u: Array, steps: int, parameters: Values, hidden: Array) -> Array | None:
        """Hidden states (n, nh) after `steps` under inputs u (w, nu) at states x (w, nx), from hidden (n, nh), w dividing n.

        States that are not finite go on from zero. What moves without an input as well, or blows up, is what it was. None: see
        `fast_memories`.
        """
        return None

    def output_delays(self, parameters: Values | None = None) -> Array:
        """Seconds by which each output shows the past, (ny,), or (n, ny) for parameters (n,); `output` does not apply them."""
        return np.zeros((*np.broadcast_shapes(*(np.shape(v) for v in (parameters or {}).values())), len(self.outputs)))


class Backend(System):
    """A black-box System f̂: a physics engine, or anything that only answers queries."""


@final
@dataclass(frozen=True)
class Step:
    """Result of a step or rollout: x (n, nx) or (n, steps + 1, nx), and the hidden state (n, nh) to hand on, if any."""

    x: Array
    hidden: Array | None = None
