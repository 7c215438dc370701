"""A physics engine as the simulation: the equations of its robot, checked against its own steps, with effects written in."""

from __future__ import annotations

import difflib
import hashlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, final

import numpy as np
import numpy.typing as npt

from gapcert.components import Context, registry
from gapcert.effect import site_units
from gapcert.engine.backend import EngineBackend
from gapcert.errors import UsageError
from gapcert.extension import Extension, Parameter
from gapcert.intervals import Interval
from gapcert.system import Model, Step, Variant, difference

if TYPE_CHECKING:
    from gapcert.spec.engine import EngineModelConfig

Array = npt.NDArray[np.float64]
BESIDE = "not_in_the_file.txt"
PROBES = 64
DOUBTED = ("mass", "armature")
"""Native parameters that may be wrong though no tolerance is stated; of gravity, the components that are not zero."""


@final
class EngineModel(Model):
    """x⁺ of a robot in a physics engine, by the equations of its bodies, checked by one step from PROBES random states.

    An effect that the engine realises at a joint is written as the engine solves it (damping implicitly with the step).
    `backend` is the engine; `native` says what it calls a parameter or an effect. States are positions and velocities of all
    joints; the velocity of `q` is called `q_dot`. otherwise: keys of the equations' section that are not as the engine has
    them; such a model is checked by no step.
    """

    def __init__(
        self, backend: EngineBackend, parameters: Sequence[Parameter] = (), *, otherwise: Mapping[str, Any] | None = None
    ) -> None:
        self.backend, self.otherwise = backend, dict(otherwise or {})
        given = {p.name for p in parameters}
        doubted = [p for p in backend.parameters if p.name not in given and _doubted(p)]
        self._stated = {_name(p): p.name for p in (*parameters, *doubted)}
        self._added: dict[str, str] = {}
        self._others: tuple[Extension, ...] = ()
        free = {native: name for name, native in self._stated.items()}
        self._adopt(_written(backend, free, (*parameters, *doubted), self.otherwise))
        self.doubts = _scales(self.inner, doubted, {j.name: q for j, q in backend.moved()})
        if not otherwise:
            self._confirm()

    @classmethod
    def from_config(cls, config: EngineModelConfig, context: Context) -> EngineModel:
        """The engine's section is that of a backend."""
        of = config.of
        if context.period is not None and getattr(of, "period", "") is None:
            of = of.model_copy(update={"period": f"{context.period:.9g} s"})
        backend: EngineBackend = registry().build("backend", of.kind, of, replace(context, model=None))
        if not isinstance(backend, EngineBackend):
            raise UsageError(f"model.of: '{config.of.kind}' is no physics engine on its own; expected an engine's section")
        stated = {p.name: p for p in backend.parameters}
        return cls(backend, _toleranced(config.parameters, stated))

    def _adopt(self, inner: Model) -> None:
        self.inner, self.period = inner, self.backend.period
        for name in ("states", "inputs", "outputs", "substeps", "capabilities", "hidden", "hidden_default"):
            setattr(self, name, getattr(inner, name))
        self.parameters, self.coordinates, self.remembers = inner.parameters, inner.coordinates, inner.remembers

    def _confirm(self) -> None:
        """UsageError where the engine steps otherwise than the equations."""
        rng = np.random.default_rng(0)
        x, u = rng.normal(size=(PROBES, self.nx)), rng.normal(size=(PROBES, self.nu))
        order = [[s.name for s in self.backend.states].index(s.name) for s in self.states]
        at = np.empty_like(x)
        at[:, order] = x
        given = {n: np.full(PROBES, v) for n, v in self.natives().items()} or None
        engine, own = self.backend.step(at, u, parameters=given).x[:, order], self.inner.step(x, u).x
        moved = np.abs(difference(self.states, engine, x)).max(axis=0)
        missed = np.abs(difference(self.states, engine, own)).max(axis=0)
        if (missed > self.backend.engine.accuracy(self.natives()) * np.maximum(moved, 1e-12)).any():
            worst = int(np.argmax(missed / np.maximum(moved, 1e-12)))
            name = self.states[worst].name
            raise UsageError(
                f"model.of: the engine's step differs from that of its bodies by {missed[worst]:.3g} in {name} "
                f"(it moves by {moved[worst]:.3g}); expected a robot of hinges and slides that touches nothing"
            )

    def _step(self, x: Array, u: Array, **options: Any) -> Step | Array:
        return self.inner._step(x, u, **options)

    def _rollout(self, x0: Array, u_sequence: Array, **options: Any) -> Step:
        return self.inner._rollout(x0, u_sequence, **options)

    def fast_rollout(self, x0: Array, u: Array, **options: Any) -> Step:
        return self.inner.fast_rollout(x0, u, **options)

    def along(self, x: Array, u: Array, **options: Any) -> Array:
        return self.inner.along(x, u, **options)

    def fast_memories(self, *given: Any) -> Array | None:
        return self.inner.fast_memories(*given)

    def jacobian(self, x: Array, u: Array) -> Array:
        return self.inner.jacobian(x, u)

    def enclosure(self, z: Interval) -> Interval:
        return self.inner.enclosure(z)

    def jacobian_enclosure(self, z: Interval) -> Interval:
        return self.inner.jacobian_enclosure(z)

    def output(self, x: Array, u: Array, parameters: Mapping[str, Array | float] | None = None) -> Array:
        return self.inner.output(x, u, parameters)

    def output_delays(self, parameters: Mapping[str, Array | float] | None = None) -> Array:
        return self.inner.output_delays(parameters)

    def resolution(self, magnitude: Array) -> Array:
        return self.inner.resolution(magnitude)

    def digest(self) -> str:
        """Of the equations and of the engine; what the engine keeps from one query to the next has no part in it."""
        return hashlib.sha256(f"{self.inner.digest()} {self.backend.digest()}".encode()).hexdigest()

    def extend(self, extensions: Sequence[Extension]) -> EngineModel:
        new: EngineModel = object.__new__(EngineModel)
        new.__dict__.update(self.__dict__)
        new._added = self._added | {
            e.parameters[0].name: name for e in extensions if (name := self.native(e.effect, e.site)) and e.parameters
        }
        new._others = self._others + tuple(e for e in extensions if not self.native(e.effect, e.site))
        new._adopt(self.inner.extend([self._realised(e) for e in extensions]))
        return new

    def _realised(self, e: Extension) -> Extension:
        """Damping as the engine solves it: (M + h c) a = forces − c v."""
        if e.effect != "viscous-friction" or self.native(e.effect, e.site) is None or not self.backend.engine.implicit():
            return e
        return e if self.otherwise.get("integrator") == "rk4" else replace(e, implicit=e.parameters[0].name)

    def restated(self, values: Mapping[str, float]) -> EngineModel:
        stated = {p.name: p for p in self.backend.parameters}
        own = {p.name: p for p in self.parameters}
        parameters = [
            replace(stated[native], value=values.get(n, own[n].value), tolerance=own[n].tolerance)
            for n, native in self._stated.items()
            if own[n].tolerance or n in values
        ]
        return EngineModel(self.backend, parameters, otherwise=self.otherwise)

    def variants(self) -> Sequence[Variant]:
        from gapcert.engine.variants import variants

        return variants(self)

    def stated(self) -> list[Parameter]:
        """Native parameters that a spec has given a value or a tolerance, as the engine calls them."""
        stated, own = {p.name: p for p in self.backend.parameters}, {p.name: p for p in self.parameters}
        return [
            replace(stated[native], value=own[n].value, tolerance=own[n].tolerance)
            for n, native in self._stated.items()
            if own[n].tolerance or own[n].value != stated[native].value
        ]

    def native(self, effect: str, site: str) -> str | None:
        return self._stated.get(site) if effect == "parameter" else self.backend.realises(effect, site)

    def natives(self) -> dict[str, float]:
        """Native parameters that differ from the robot file's, with what realises effects added."""
        stated = {p.name: p.value for p in self.backend.parameters}
        now, values = dict(stated), {p.name: p.value for p in self.parameters}
        for name, native in self._stated.items():
            now[native] = values[name]
        for name, native in self._added.items():
            now[native] += values[name]
        return {n: v for n, v in now.items() if v != stated[n]}

    def files(self) -> dict[str, str]:
        """The robot file with the native parameters of this model, code for what it cannot say, and a list of the rest."""
        values = self.natives()
        out = self.backend.engine.patched(values) if values else {}
        if self._others:
            texts = ("force", "dry_friction", "input", "output", "delay", "output_delay")
            out[BESIDE] = "".join(
                f"{e.effect} at {e.site}: {', '.join(f'{k} {t}' for k in texts if (t := getattr(e, k)) is not None)}; with "
                f"{', '.join(f'{p.name} = {p.value!r} {p.unit}' for p in e.parameters)}\n"
                for e in self._others
            )
        return out

    def sites(self, kind: str) -> tuple[str, ...]:
        return self.inner.sites(kind)

    def force_unit(self, site: str) -> str | None:
        return self.inner.force_unit(site)

    def equations(self) -> str:
        return self.inner.equations()

    def text(self) -> dict[str, Any]:
        return self.inner.text()

    def to_spec(self) -> dict[str, Any]:
        return self.inner.to_spec()


def _name(p: Parameter) -> str:
    return re.sub(r"\W", "_", p.name)


def _doubted(p: Parameter) -> bool:
    what = p.name.partition(".")[0]
    return what in DOUBTED or (what.startswith("gravity_") and p.value != 0)


def _scales(model: Model, doubted: Sequence[Parameter], coordinates: Mapping[str, str]) -> dict[str, float]:
    """What change of a native parameter matters: its value, or the inertia that its joint feels where that is zero."""
    out = {}
    for p in doubted:
        what, _, joint = p.name.partition(".")
        out[_name(p)] = abs(p.value) or (_felt(model, coordinates[joint]) if what == "armature" else 1.0)
    return out


def _felt(model: Model, q: str) -> float:
    """M⁻¹ of a coordinate at rest in zero, inverted."""
    push = Parameter("probe_force", 0.0, site_units(model, "coordinate", q)["force"])
    pushed = model.extend([Extension("probe", q, (push,), force=push.name)])
    x, u = np.zeros((1, model.nx)), np.zeros((1, model.nu))
    column = [s.name for s in model.states].index(f"{q}_dot")
    on, off = (pushed.step(x, u, parameters={push.name: np.array([f])}).x[0, column] for f in (1.0, 0.0))
    return float(model.period / abs(on - off))


def _written(
    backend: EngineBackend, free: Mapping[str, str], parameters: Sequence[Parameter], otherwise: Mapping[str, Any]
) -> Model:
    """The equations model of a robot."""
    names, units = backend.coordinates, {s.name: s for s in backend.states}
    if backend.hidden:
        left = ", ".join(s.name for s in backend.hidden)
        raise UsageError(f"model.of.states: {left} are in no state; a diagnosis needs all of the robot's; name them")
    if lost := [q for q in names if f"{q}_dot" not in units]:
        raise UsageError(f"model.of.states: the velocity of '{lost[0]}' has another name; call it {lost[0]}_dot")
    robot = backend.engine.section(names, backend.period, free, {p.name: p.value for p in parameters})
    if robot is None:
        raise UsageError(f"model.of: {backend.engine.file} is more than a tree of bodies on hinges and slides")
    driven = {backend.driven(u.name): u.name for u in backend.inputs}
    forces = {q: " ".join(t for t in (driven.get(q, ""), robot["forces"].get(q, "")) if t) for q in names}
    section = {
        **robot,
        "kind": "equations",
        "coordinates": {q: {"unit": units[q].unit, "kind": units[q].kind} for q in names},
        "inputs": {u.name: u.unit for u in backend.inputs},
        "parameters": robot["parameters"] | {free[p.name]: _quantity(p) for p in parameters},
        "forces": {q: text for q, text in forces.items() if text},
        "substeps": backend.substeps,
        "period": f"{backend.period!r} s",
    } | dict(otherwise)
    if section["integrator"] == "rk4":
        section.pop("implicit", None)
    known = registry()
    config: Any = known.config("model", "equations")
    model: Model = known.build("model", "equations", config.model_validate(section))
    return model


def _quantity(p: Parameter) -> dict[str, Any]:
    def text(value: float) -> str:
        return f"{value!r} {p.unit}" if p.unit != "1" else repr(value)

    bounds = {k: text(v) for k, v in (("low", p.low), ("high", p.high)) if np.isfinite(v)}
    return {"value": text(p.value), "tolerance": text(p.tolerance), **bounds}


def _toleranced(given: Mapping[str, Any], stated: Mapping[str, Parameter]) -> list[Parameter]:
    """Native parameters with the values and tolerances of a spec."""
    out = []
    for name, config in given.items():
        if name not in stated:
            near = difflib.get_close_matches(name, stated, 1)
            hint = f"did you mean '{near[0]}'?" if near else f"it has {', '.join(stated)}"
            raise UsageError(f"model.parameters: the engine has no '{name}'; {hint}")
        p = stated[name]
        value = p.value if config.value is None else config.value
        out.append(replace(p, value=value, tolerance=config.absolute(value)))
    return out
