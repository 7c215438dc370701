"""A physics engine as the simulation: the equations of its robot, checked against its own steps, with effects written in."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partialmethod
from typing import TYPE_CHECKING, Any, final

import numpy as np

from gapcert import Array, Context, Model, Parameter, StateSpec, UsageError, registry
from gapcert.plugin import Extension, Scene, Variant, difference, site_units
from gapcert_engines.thresholds import THRESHOLDS

from .backend import EngineBackend
from .config import EngineConfig
from .contract import Engine, Law
from .native_model import NativeModel, in_contact, refuse_driven
from .settings import changed, declared, flat, short
from .wiring import UNITS, hint

if TYPE_CHECKING:
    from .model_config import EngineModelConfig

DAMPING = "implicit_damping"
"""Of a model, instead of the engine's: whether damping that a diagnosis finds is solved with the step."""
DOUBTED = ("mass", "armature")
"""Native parameters that may be wrong though no tolerance is stated; of gravity, the components that are not zero."""
BESIDE = "not_in_the_file.txt"
PHYSICAL = {"joint_damping", "coulomb_friction", "frictionloss", "armature", "gravity", "friction", "restitution"}
"""Options that are native parameters of joints and contacts: causes of their own."""
SCHEMES = ("semi_implicit", "euler", "rk4")
POINT = 2e-6 / 3
"""m²: inertia per mass that Bullet gives a link without shapes, a box of 2 mm."""
DRAG = 0.04
"""1/s: by which Bullet damps every link, linearly and by the square, where nothing is said."""
IMPEDANCE, STIFFEST, CONSTANT = 0.9, 0.95, 0.02
"""Of MuJoCo's constraints where nothing is said: at rest, at most, and their time constant in s."""


@final
class EngineModel(Model):
    """x⁺ of a robot in a physics engine, by the equations of its bodies, checked by one step from `engine_probes` random
    states.

    An effect that the engine realises at a joint is written as the engine solves it (damping implicitly with the step).
    `backend` is the engine; `native` says what it calls a parameter or an effect. States are positions and velocities of all
    joints, `within` their ends; the velocity of `q` is called `q_dot`. otherwise: keys of the equations' section that are not
    as the engine has them; such a model is checked by no step. changed: (setting, value, what it was) of what this is a
    variant of.
    """

    changed: tuple[tuple[str, Any, Any], ...] = ()

    def __init__(
        self, backend: EngineBackend, parameters: Sequence[Parameter] = (), *, otherwise: Mapping[str, Any] | None = None
    ) -> None:
        self._write(backend, parameters, otherwise, None)
        self.confirm()

    def _write(
        self,
        backend: EngineBackend,
        parameters: Sequence[Parameter],
        otherwise: Mapping[str, Any] | None,
        like: Model | None,
    ) -> None:
        self.backend, self.otherwise = backend, dict(otherwise or {})
        given, every = {p.name for p in parameters}, _native_parameters(backend)
        loose = [p for p in every.values() if p.name not in given and _doubted(p)]
        there = {p.name for p in backend.parameters}
        self._stated = {_plain_name(p): p.name for p in (*parameters, *loose)}
        self._lacking = {name: native for name, native in self._stated.items() if native not in there}
        self._added: dict[str, str] = {}
        self._others: tuple[Extension, ...] = ()
        free = {native: name for name, native in self._stated.items()}
        self._adopt(_written(backend, free, (*parameters, *loose), self.otherwise, like))
        self.within = backend.ranges()
        self.doubts = _scales(self.inner, loose, {j.name: q for j, q in backend.moved()})

    def beside(
        self, backend: EngineBackend, parameters: Sequence[Parameter], otherwise: Mapping[str, Any] | None = None
    ) -> EngineModel:
        """Another model of this robot, with `otherwise` as here; it shares what was recorded here, and is not confirmed yet."""
        new: EngineModel = object.__new__(EngineModel)
        new._write(backend, parameters, self.otherwise if otherwise is None else otherwise, self.inner)
        return new

    @classmethod
    def from_config(cls, config: EngineModelConfig, context: Context) -> EngineModel | NativeModel:
        """The engine's section is that of a backend. A robot that is more than bodies on joints is rolled out itself."""
        of = config.of
        if context.period is not None and getattr(of, "period", "") is None:
            of = of.model_copy(update={"period": f"{context.period:.9g} s"})
        if isinstance(of, EngineConfig) and in_contact(of):
            return _rolled(config, of, context)
        backend: EngineBackend = registry().build("backend", of.kind, of, replace(context, model=None))
        if not isinstance(backend, EngineBackend):
            raise UsageError(f"model.of: '{config.of.kind}' is no physics engine on its own; expected an engine's section")
        if backend.engine.beyond():
            refuse_driven(backend.config)
            return _rolled(config, of, context, backend)
        stated = {p.name: p for p in backend.parameters}
        return cls(backend, _toleranced(config.parameters, stated))

    def _adopt(self, inner: Model) -> None:
        self.inner, self.period = inner, self.backend.period
        for name in ("states", "inputs", "outputs", "substeps", "capabilities", "hidden", "hidden_default"):
            setattr(self, name, getattr(inner, name))
        self.parameters, self.coordinates, self.remembers = inner.parameters, inner.coordinates, inner.remembers

    def scene(self, x: Array, hidden: Array | None = None) -> Scene | None:
        names = [s.name for s in self.states]
        return self.backend.scene(x[:, [names.index(s.name) for s in self.backend.states]])

    def confirm(self) -> None:
        """UsageError where the engine steps otherwise than the equations, unless these are meant to be otherwise."""
        if self.otherwise:
            return
        without = dict.fromkeys(self._lacking, np.zeros(THRESHOLDS.engine_probes))
        x, u, own = _probes(self.inner, self.within, THRESHOLDS.engine_probes, without or None)
        order = [[s.name for s in self.backend.states].index(s.name) for s in self.states]
        at = np.empty_like(x)
        at[:, order] = x
        given = {n: np.full(THRESHOLDS.engine_probes, v) for n, v in self.natives().items()} or None
        engine = self.backend.step(at, u, parameters=given).x[:, order]
        moved = np.abs(difference(self.states, engine, x)).max(axis=0)
        # What friction stops would have moved on.
        moved[: self.nx // 2] = np.maximum(moved[: self.nx // 2], self.period * np.abs(x[:, self.nx // 2 :]).max(axis=0))
        missed = np.abs(difference(self.states, engine, own)).max(axis=0)
        if (missed > self.backend.engine.accuracy(self.natives()) * np.maximum(moved, 1e-12)).any():
            worst = int(np.argmax(missed / np.maximum(moved, 1e-12)))
            name = self.states[worst].name
            raise UsageError(
                f"model.of: the engine's step differs from that of its bodies by {missed[worst]:.3g} in {name} "
                f"(it moves by {moved[worst]:.3g}); expected a robot of hinges and slides that touches nothing"
            )

    def _asked(self, name: str, *given: Any, **options: Any) -> Any:
        """What the equations answer."""
        return getattr(self.inner, name)(*given, **options)

    _step: Any = partialmethod(_asked, "_step")
    _rollout: Any = partialmethod(_asked, "_rollout")
    fast_rollout: Any = partialmethod(_asked, "fast_rollout")
    along: Any = partialmethod(_asked, "along")
    fast_memories: Any = partialmethod(_asked, "fast_memories")
    held_memories: Any = partialmethod(_asked, "held_memories")
    jacobian: Any = partialmethod(_asked, "jacobian")
    enclosure: Any = partialmethod(_asked, "enclosure")
    jacobian_enclosure: Any = partialmethod(_asked, "jacobian_enclosure")
    curvature_enclosure: Any = partialmethod(_asked, "curvature_enclosure")
    output: Any = partialmethod(_asked, "output")
    output_delays: Any = partialmethod(_asked, "output_delays")
    input_delays: Any = partialmethod(_asked, "input_delays")
    resolution: Any = partialmethod(_asked, "resolution")
    rounding_over: Any = partialmethod(_asked, "rounding_over")
    rounding_terms: Any = partialmethod(_asked, "rounding_terms")
    sites: Any = partialmethod(_asked, "sites")
    force_unit: Any = partialmethod(_asked, "force_unit")
    equations: Any = partialmethod(_asked, "equations")
    text: Any = partialmethod(_asked, "text")
    to_spec: Any = partialmethod(_asked, "to_spec")

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
        held = e.effect == "viscous-friction" and self.backend.realises(e.effect, e.site) is not None and self.implicit()
        return replace(e, implicit=e.parameters[0].name) if held else e

    def implicit(self) -> bool:
        """Is damping that is found solved with the step?"""
        own = self.backend.engine.implicit() and self.otherwise.get("integrator") != "rk4"
        return bool(self.otherwise.get(DAMPING, own))

    def restated(self, values: Mapping[str, float]) -> EngineModel:
        stated, own = _native_parameters(self.backend), {p.name: p for p in self.parameters}
        parameters = [
            replace(stated[native], value=values.get(n, own[n].value), tolerance=own[n].tolerance)
            for n, native in self._stated.items()
            if own[n].tolerance or n in values
        ]
        out = self.beside(self.backend, parameters)
        out.confirm()
        out.changed = self.changed
        return out

    def variants(self) -> Sequence[Variant]:
        """Each declared option of the engine's that changes its motion, the sub-steps, and what no option of it says.

        Those are other integrators, a step of another length taken for the period, drag of links, and dry friction that gives
        way or holds.
        """
        return [*_options(self), *_otherwise(self)]

    def stated(self) -> list[Parameter]:
        """Native parameters that a spec has given a value or a tolerance, as the engine calls them."""
        stated, own = _native_parameters(self.backend), {p.name: p for p in self.parameters}
        return [
            replace(stated[native], value=own[n].value, tolerance=own[n].tolerance)
            for n, native in self._stated.items()
            if own[n].tolerance or own[n].value != stated[native].value
        ]

    def native(self, effect: str, site: str) -> str | None:
        if effect == "parameter":
            return None if site in self._lacking else self._stated.get(site)
        return self.backend.realises(effect, site)

    def natives(self) -> dict[str, float]:
        """Native parameters that differ from the robot file's, with what realises effects added."""
        stated = {p.name: p.value for p in self.backend.parameters}
        now, values = dict(stated), {p.name: p.value for p in self.parameters}
        gears = {lever.native for u in self.inputs if (lever := self.backend.lever(u.name)) is not None}
        for name, native in self._stated.items():
            if name not in self._lacking:
                now[native] = values[name]
        for name, native in self._added.items():
            now[native] = now[native] * values[name] if native in gears else now[native] + values[name]
        return {n: v for n, v in now.items() if v != stated[n]}

    def files(self) -> dict[str, str]:
        """The robot file with the native parameters of this model, code for what it cannot say, and a list of the rest."""
        values = self.natives()
        out = self.backend.engine.patched(values) if values else {}
        if lines := [*self._settings(), *map(_told, self._others)]:
            out[BESIDE] = "\n".join([*lines, ""])
        return out

    def _settings(self) -> list[str]:
        """What was changed of the engine, and of the equations that stand for it."""
        shown = {name: "what the file says" if was is None else was for name, _, was in self.changed}
        lines = [f"setting {name}: {value} instead of {shown[name]}" for name, value, _ in self.changed]
        own = {p.name: p for p in self.parameters}
        return lines + [
            f"{native}: {own[n].value!r} {own[n].unit}, of which the engine has no parameter"
            for n, native in self._lacking.items()
            if own[n].value
        ]


def _rolled(config: EngineModelConfig, of: EngineConfig, context: Context, backend: EngineBackend | None = None) -> NativeModel:
    model = NativeModel(of, context, backend=backend)
    known = _toleranced(config.parameters, {p.name: p for p in model.backend.parameters})
    return NativeModel(of, context, known, backend=model.backend) if known else model


def _native_parameters(backend: EngineBackend) -> dict[str, Parameter]:
    """The engine's native parameters, and inertia of joints that it has none of: only the equations know that."""
    out = {p.name: p for p in backend.parameters}
    for joint, _ in backend.moved():
        none = Engine.joint_parameter("armature", joint, 0.0)
        out.setdefault(none.name, none)
    return out


def _plain_name(p: Parameter) -> str:
    return re.sub(r"\W", "_", p.name)


def _doubted(p: Parameter) -> bool:
    what = p.name.partition(".")[0]
    return what in DOUBTED or (what.startswith("gravity_") and p.value != 0)


def _scales(model: Model, parameters: Sequence[Parameter], coordinates: Mapping[str, str]) -> dict[str, float]:
    """What change of a native parameter matters: its value, or the inertia that its joint feels where that is zero."""
    out = {}
    for p in parameters:
        what, _, joint = p.name.partition(".")
        out[_plain_name(p)] = abs(p.value) or (_felt(model, coordinates[joint]) if what == "armature" else 1.0)
    return out


def _felt(model: Model, q: str) -> float:
    """M⁻¹ of a coordinate at rest in zero, inverted."""
    push = Parameter("probe_force", 0.0, site_units(model, "coordinate", q)["force"])
    pushed = model.extend([Extension("probe", q, (push,), force=push.name)])
    x, u = np.zeros((1, model.nx)), np.zeros((1, model.nu))
    column = [s.name for s in model.states].index(f"{q}_dot")
    # Far more than dry friction holds.
    on, off = (
        pushed.step(x, u, parameters={push.name: np.array([f])}).x[0, column]
        for f in (2 * THRESHOLDS.strong_push, THRESHOLDS.strong_push)
    )
    return float(model.period * THRESHOLDS.strong_push / abs(on - off))


def _probes(
    model: Model, within: Mapping[str, tuple[float, float]], n: int, parameters: Mapping[str, Array] | None
) -> tuple[Array, Array, Array]:
    """x (n, nx), positions before velocities, and u (n, nu): normal, and in the middle of a range where there is one; and x⁺.

    UsageError where steps leave the ranges from however slow a motion.
    """
    rng = np.random.default_rng(0)
    (low, high), ends = _ends(model.states, within), _ends(model.inputs, within)
    x, u = _inside(rng.normal(size=(n, model.nx)), low, high), _inside(rng.normal(size=(n, model.nu)), *ends)
    for _ in range(THRESHOLDS.probe_tries):
        after = model.step(x, u, parameters=parameters).x
        gone = (after <= low) | (after >= high)
        if not gone.any():
            return x, u, after
        x[gone.any(axis=1), model.nx // 2 :] *= THRESHOLDS.probe_calmer
        u[gone.any(axis=1)] *= THRESHOLDS.probe_calmer
    name = model.states[int(np.argmax(gone.sum(axis=0)))].name
    raise UsageError(
        f"model.of: one step takes {name} out of {within[name][0]:.6g} to {within[name][1]:.6g}, from wherever it starts at "
        f"rest; expected a joint with room to move; fix it in the file, or take its limits out"
    )


def _ends(specs: Sequence[StateSpec], within: Mapping[str, tuple[float, float]]) -> tuple[Array, Array]:
    pairs = np.array([within.get(s.name, (-np.inf, np.inf)) for s in specs]).reshape(-1, 2)
    return pairs[:, 0], pairs[:, 1]


def _inside(z: Array, low: Array, high: Array) -> Array:
    """Standard normal numbers, squeezed into the middle four fifths of at most `probe_range` of a range, as near zero as it
    goes."""
    width = np.minimum(high - low, THRESHOLDS.probe_range)
    bounded = np.isfinite(low) | np.isfinite(high)
    return np.where(bounded, np.clip(0.0, low + width / 2, high - width / 2) + 0.4 * width * np.tanh(z), z)


def _told(e: Extension) -> str:
    texts = ("force", "dry_friction", "input", "output", "delay", "output_delay")
    laws = ", ".join(f"{k} {t}" for k in texts if (t := getattr(e, k)) is not None)
    return f"{e.effect} at {e.site}: {laws}; with {', '.join(f'{p.name} = {p.value!r} {p.unit}' for p in e.parameters)}"


def _written(
    backend: EngineBackend,
    free: Mapping[str, str],
    parameters: Sequence[Parameter],
    otherwise: Mapping[str, Any],
    like: Model | None,
) -> Model:
    """The equations model of a robot; it shares what `like` has recorded."""
    names, units = backend.coordinates, {s.name: s for s in backend.states}
    if backend.hidden:
        left = ", ".join(s.name for s in backend.hidden)
        raise UsageError(f"model.of.states: {left} are in no state; a diagnosis needs all of the robot's; name them")
    if lost := [q for q in names if f"{q}_dot" not in units]:
        raise UsageError(f"model.of.states: the velocity of '{lost[0]}' has another name; call it {lost[0]}_dot")
    there = {p.name for p in backend.parameters}
    if more := backend.engine.beyond():
        raise UsageError(
            f"model.of: {backend.engine.file} is more than a tree of bodies on hinges and slides: {', '.join(more)}"
        )
    robot = backend.engine.section(names, backend.period, free, {p.name: p.value for p in parameters if p.name in there})
    driven: dict[str, list[str]] = {q: [] for q in names}
    for u in backend.inputs:
        if (law := backend.law(u.name)) is not None:
            q = names[[j.name for j, _ in backend.moved()].index(law.joint)]
            driven[q].append(_served(law, u, q, robot, units[q].unit))
        elif (at := backend.driven(u.name)) is not None:
            driven[at].append(_effort(backend, u.name, free))
    pushes = {q: " + ".join(texts) for q, texts in driven.items()}
    forces = {q: " ".join(t for t in (pushes[q], robot["forces"].get(q, "")) if t) for q in names}
    section = {
        **robot,
        "kind": "equations",
        "coordinates": {q: {"unit": units[q].unit, "kind": units[q].kind} for q in names},
        "inputs": {u.name: u.unit for u in backend.inputs},
        "parameters": robot["parameters"] | {free[p.name]: _quantity(p) for p in parameters},
        "forces": {q: text for q, text in forces.items() if text},
        "substeps": backend.substeps,
        "period": f"{backend.period!r} s",
    } | {k: v for k, v in otherwise.items() if k != DAMPING}
    if section["integrator"] == "rk4":
        section.pop("implicit", None)
    known = registry()
    config: Any = known.config("model", "equations")
    model: Model = known.build("model", "equations", config.model_validate(section), Context(model=like))
    return model


def _effort(backend: EngineBackend, name: str, free: Mapping[str, str]) -> str:
    """What an input is at its joint."""
    lever = backend.lever(name)
    if lever is None:
        return name
    if (gear := free.get(lever.native)) is not None:
        return f"{lever.factor(1.0)!r}*{gear}*{name}"
    return f"{lever.factor(lever.motor.gear)!r}*{name}" if lever.control else name


def _served(law: Law, control: StateSpec, q: str, robot: dict[str, Any], unit: str) -> str:
    """The effort of an actuator at its joint; its numbers become parameters, and its damping that of the step."""
    force = UNITS["prismatic" if unit == "m" else "revolute"][2]
    taken: dict[str, str] = robot["parameters"]

    def number(name: str, value: float, per: str) -> str:
        key = f"{name}_{control.name}"
        taken[key] = f"{value!r} {force}{per}"
        return key

    def cut(text: str, low: str | None, high: str | None) -> str:
        text = text if low is None else f"max({text}, {low})"
        return text if high is None else f"min({text}, {high})"

    gear = "" if law.gear == 1 else f"{law.gear!r}*"
    command = cut(control.name, *(None if np.isinf(end) else repr(end) for end in law.controls))
    at, rate = f"{gear}{q}", f"{gear}{q}_dot"
    damping = number("damping", -law.velocity, f"/({unit}/s)") if law.velocity else ""
    if law.commands == "position":
        text = f"{number('stiffness', law.gain, f'/{unit}')}*({command} - {at})"
    elif law.commands == "velocity":
        text = f"{damping}*({command} - {rate})"
    else:
        text = f"{number('gain', law.gain, '')}*{command}"
        text += f" + {number('stiffness', law.position, f'/{unit}')}*{at}" if law.position else ""
    text += f" - {damping}*{rate}" if damping and law.commands != "velocity" else ""
    text += f" + {number('offset', law.offset, '')}" if law.offset else ""
    low, high = (
        None if np.isinf(end) else number(name, end, "") for name, end in zip(("low", "high"), law.forces, strict=True)
    )
    if law.held and damping:
        free = [f"max(sign({high} - ({text})), 0)"] if high else []
        free += [f"max(sign({text} - {low}), 0)"] if low else []
        held = "*".join([repr(law.gear**2), damping, *free])
        late: dict[str, str] = robot.setdefault("implicit", {})
        late[q] = f"{late[q]} + {held}" if q in late else held
    return f"{gear}{cut(f'({text})' if gear and low is high is None else text, low, high)}"


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
            raise UsageError(f"model.parameters: the engine has no '{name}'; {hint(name, stated)}")
        p = stated[name]
        value = p.value if config.value is None else config.value
        out.append(replace(p, value=value, tolerance=config.absolute(value)))
    return out


def _options(model: EngineModel) -> Iterator[Variant]:
    config: Any = model.backend.config
    have, own = flat(config), model.text()
    options = [(name, o) for name, o in declared(config) if name not in PHYSICAL | {"substeps"}]
    options += [("substeps", {"substeps": k}) for k in THRESHOLDS.tried_substeps if k != config.substeps]
    here = {"robot": model.backend.engine.file, "period": f"{model.period!r} s"}
    for name, new in options:
        try:
            # One copy: to see whether more would give the same bits costs more than they would gain here.
            section = changed(config, {**new, **here, "tiles": 1})
            backend = registry().build("backend", config.kind, section, Context())
            there = _native_parameters(backend)
            # What an option sets anew is not what the spec has stated of it.
            other = model.beside(backend, [p for p in model.stated() if p.name in there])
            different = other.text() != own
            if different:
                other.confirm()
        except UsageError:
            continue
        if different:
            yield _variant(model, name, short(new), short({k: have.get(k) for k in new}), other, name)


def _otherwise(model: EngineModel) -> Iterator[Variant]:
    config: Any = model.backend.config
    now = model.text()
    for name, value, was, otherwise in [*_stepped(model, now), *_held(model, now)]:
        if name not in type(config).model_fields and not otherwise.keys() & model.otherwise.keys():
            other = model.beside(model.backend, model.stated(), {**model.otherwise, **otherwise})
            yield _variant(model, name, value, was, other)


def _variant(model: EngineModel, name: str, value: Any, was: Any, other: EngineModel, native: str | None = None) -> Variant:
    other.changed = (*model.changed, (name, value, was))
    return Variant(name, value, was, other, native)


def _stepped(model: EngineModel, now: Mapping[str, Any]) -> Iterator[tuple[str, Any, Any, dict[str, Any]]]:
    substeps, was = model.backend.substeps, now["integrator"]
    yield from (("integrator", s, was, {"integrator": s}) for s in SCHEMES if s != was)
    step = model.period / substeps
    yield from (
        ("time_step", s, step, {"period": f"{s * substeps!r} s"}) for s in THRESHOLDS.tried_steps if abs(s - step) > 1e-9 * step
    )


def _held(model: EngineModel, now: Mapping[str, Any]) -> Iterator[tuple[str, Any, Any, dict[str, Any]]]:
    """Bullet's drag of links, and friction solved as a soft constraint, as MuJoCo does, or as a hard one."""
    bodies = now["bodies"]
    fields = type(model.backend.config).model_fields
    if not any(b.get("drag") for b in bodies.values()) and "linear_damping" not in fields:
        drag = {"linear": [DRAG, DRAG], "angular": [DRAG, DRAG]}
        yield "damping", DRAG, 0.0, {"bodies": {name: {**b, "drag": drag} for name, b in bodies.items()}}
    if "use_inertia_from_file" not in fields:
        # The masses are parameters, or nothing.
        points = {n: {**b, "inertia": [f"{POINT!r}*{b['mass']}*metre**2"] * 3} for n, b in bodies.items() if _heavy(b)}
        yield "use_inertia_from_file", False, True, {"bodies": bodies | points}
    if not any("_dot" in text for text in now.get("forces", {}).values()):
        # Of damping that a diagnosis finds; what the file states is solved as the engine does it.
        yield DAMPING, not model.implicit(), model.implicit(), {DAMPING: not model.implicit()}
    if now.get("soft_friction"):
        yield "dry_friction", "hard", "soft", {"soft_friction": {}}
    else:
        rate = 2 / (STIFFEST * CONSTANT)
        soft = {
            q: {"compliance": (1 - IMPEDANCE) / IMPEDANCE / _felt(model.inner, q), "rate": rate}
            for q in model.backend.coordinates
        }
        yield "dry_friction", "soft", "hard", {"soft_friction": soft}


def _heavy(body: Mapping[str, Any]) -> bool:
    """Is its mass a parameter? Of what moves it is."""
    return str(body.get("mass", "0")).isidentifier()
