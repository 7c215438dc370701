"""Why two backends differ: the robot of one is the simulation, and the motion of the other the recording of a diagnosis."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, final

import numpy as np

from gapcert.plugin import (
    Array,
    Context,
    Effect,
    MissingDependency,
    Parameter,
    Recording,
    System,
    UsageError,
    registry,
    stored,
    write_atomic,
)
from gapcert_compare.thresholds import THRESHOLDS
from gapcert_diagnosis import Cause, Diagnosis
from gapcert_engines import PHYSICAL, EngineBackend, EngineModel, Options, changed, declared, flat, plain, short
from gapcert_recordings import play

from .laboratory import Laboratory, Peer
from .settings import Change, candidates

Judge = Callable[[Array], tuple[float, bool]]
"""x⁺ of one of the two → the mean difference that is left, and whether it closes."""
Rebuild = Callable[[Peer, Options], System | None]
"""A backend with changed options, or None where it refuses them."""


@final
@dataclass(frozen=True)
class Answer:
    """What a diagnosis names on one of two backends.

    alternatives: the same causes with rounded numbers and with fitted ones; made: whether the backend can be told all of them;
    left: mean and whether it closes, of the equations of its bodies with the causes written in.
    """

    alternatives: tuple[tuple[Change, ...], ...] = ()
    made: bool = False
    left: tuple[float, bool] | None = None


def answer(simulation: Peer, reality: Peer, laboratory: Laboratory, judge: Judge, rebuild: Rebuild) -> Answer:
    """What separates a robot's engine from another backend; nothing where none can be named. Kept beside the shards."""
    if not isinstance(simulation.system, EngineBackend):
        return Answer()
    name = f"causes-{_question(simulation, reality, laboratory)[:32]}.json"
    kept: Any = stored(laboratory.folder, name)
    if kept is None or not {"alternatives", "made", "left"} <= set(kept):
        kept = plain(asdict(_found(simulation, reality, laboratory, judge, rebuild)))
        write_atomic(laboratory.folder / name, json.dumps(kept, indent=1).encode())
    alternatives = tuple(tuple(Change(**c) for c in changes) for changes in kept["alternatives"])
    return Answer(alternatives, kept["made"], kept["left"] and (kept["left"][0], kept["left"][1]))


def _question(simulation: Peer, reality: Peer, laboratory: Laboratory) -> str:
    """SHA-256 of all that decides the answer."""
    domain = laboratory.domain
    data = [
        [p.name, p.system.digest()] for p in (simulation, reality)
    ] + [repr(domain), laboratory.seed, hashlib.sha256(laboratory.z.tobytes()).hexdigest()]  # fmt: skip
    return hashlib.sha256(json.dumps(data).encode()).hexdigest()


def _found(simulation: Peer, reality: Peer, laboratory: Laboratory, judge: Judge, rebuild: Rebuild) -> Answer:
    from gapcert_diagnosis import diagnose

    seconds = max(THRESHOLDS.played_steps * simulation.system.period, THRESHOLDS.played_seconds)
    axes, domain = laboratory.domain.axes, laboratory.domain
    ranges = {s.name: (float(low), float(high)) for s, low, high in zip(axes, domain.low, domain.high, strict=True)}
    try:
        model, names = _model(simulation)
        log = play(
            reality.system,
            ranges,
            seconds=seconds,
            trajectories=THRESHOLDS.played_trajectories,
            relations=domain.relations,
            seed=laboratory.seed,
        )
        found = diagnose(
            model,
            _renamed(log, names),
            _effects(),
            window=seconds / THRESHOLDS.played_window,
            horizons=[seconds / THRESHOLDS.played_horizon],
            seed=laboratory.seed,
        )
        left = judge(_after(found, names, simulation.system, laboratory))
    except (UsageError, MissingDependency):
        # More than a tree of bodies, a motion that leaves what the engine follows: the settings are tried one by one.
        return Answer()
    if not found.causes:
        return Answer()
    stated = {p.name: p.value for p in model.parameters}
    naming = _Naming(simulation, reality, found, {new: old for old, new in names.items()}, stated, rebuild)
    several = [naming.changes(digits) for digits in (THRESHOLDS.native_digits, None)]
    return Answer(tuple(several), all(c.options or c.natives for c in several[0]), left)


def _effects() -> list[Effect]:
    """Those that a backend may have: its answer is its state, without sensors, and knows no time at which it is pushed."""
    known = registry()
    every: list[Effect] = [known.build("effect", name) for name in known.names("effect")]
    return [e for e in every if e.site != "output" and e.name != "external-push"]


def _model(peer: Peer) -> tuple[EngineModel, dict[str, str]]:
    """A backend as a simulation, and what it calls the states: the velocity of `q` is `q_dot`."""
    backend = peer.system
    assert isinstance(backend, EngineBackend)
    config: Any = backend.config
    names = dict[str, str]()
    called = {target: name for name, target in config.states.items()}
    for name, target in config.states.items():
        owner, _, field = target.rpartition(".")
        at = called.get(f"{owner}.position")
        names[name] = f"{at}_dot" if at and field == "velocity" else name
    states = {names[n]: target for n, target in config.states.items()}
    here: dict[str, Any] = {"robot": backend.engine.file, "period": f"{backend.period!r} s", "states": states, "tiles": 1}
    if "joint_limits" in type(config).model_fields:
        # Away from its ends a joint moves as one without.
        here["joint_limits"] = False
    built = registry().build("backend", config.kind, changed(config, here), Context())
    return EngineModel(built), names


def _renamed(log: Recording, names: Mapping[str, str]) -> Recording:
    def by(values: Mapping[str, Any]) -> dict[str, Any]:
        return {names.get(n, n): v for n, v in values.items()}

    trajectories = tuple(replace(t, channels=by(t.channels)) for t in log.trajectories)
    return replace(log, trajectories=trajectories, units=by(log.units), noise=by(log.noise))


def _after(found: Diagnosis, names: Mapping[str, str], system: System, laboratory: Laboratory) -> Array:
    """x⁺ (n, nx) of the equations with the causes, at the common points."""
    x, u = laboratory.domain.split(laboratory.z)
    model, own = found.extended_model, [names[s.name] for s in system.states]
    order = [own.index(s.name) for s in model.states]
    out = np.empty_like(x)
    out[:, order] = model.step(x[:, order], u).x
    return out


@final
@dataclass(frozen=True)
class _Naming:
    """Causes as changes of the simulation's backend.

    back: its names of states → those of the comparison; stated: its equations' parameters.
    """

    simulation: Peer
    reality: Peer
    found: Diagnosis
    back: Mapping[str, str]
    stated: Mapping[str, float]
    rebuild: Rebuild

    def changes(self, digits: int | None) -> tuple[Change, ...]:
        """All of them; native parameters with so many digits of their size, or as they were fitted."""
        return tuple(self._setting(c) if c.setting is not None else self._physical(c, digits) for c in self.found.causes)

    def _setting(self, cause: Cause) -> Change:
        """A setting with the options that make it, if the engine has any."""
        assert cause.setting is not None
        name, have, value = self.simulation.name, flat(self.simulation.config), cause.setting["value"]
        known = declared(self.simulation.config)
        if cause.site in have:
            known = [*known, (cause.site, {cause.site: value})]
        options = next((o for setting, o in known if setting == cause.site and short(o) == value), None)
        if options is not None:
            return Change(name, cause.site, options, {k: have.get(k) for k in options})
        return Change(name, cause.site, {}, {}, told={"value": value, "was": cause.setting["was"]})

    def _physical(self, cause: Cause, digits: int | None) -> Change:
        """An effect: as the option that gives the engine its native parameter, as that parameter, or as a law beside it."""
        known = {p.name: p for p in self.simulation.system.parameters}
        told: dict[str, Any] = {"effect": cause.effect, "site": self.back.get(cause.site, cause.site)}
        told |= {} if cause.native is None else {"native": cause.native}
        told["parameters"] = {n: asdict(p) for n, p in cause.parameters.items()}
        if len(self.found.causes) == 1 and self.found.ambiguous_with:
            groups = self.found.ambiguous_with
            told["ambiguous_with"] = [[{"effect": e, "site": self.back.get(s, s)} for e, s in g] for g in groups]
        if cause.native in known and (native := self._native(known[cause.native], told, digits)) is not None:
            return native
        numbers = {n: p.value for n, p in cause.parameters.items()}
        value = next(iter(numbers.values())) if len(numbers) == 1 else numbers
        law = cause.effect != "parameter"
        told |= {"value": value, "was": None if law else self.stated.get(cause.site)}
        return Change(self.simulation.name, cause.effect if law else cause.site, {}, {}, told=told)

    def _native(self, native: Parameter, told: dict[str, Any], digits: int | None) -> Change | None:
        """None where its bounds leave no room for what was fitted."""
        extended = self.found.extended_model
        assert isinstance(extended, EngineModel)
        value = extended.natives().get(native.name, native.value)
        size = max(abs(value), abs(native.value))
        if not native.low - THRESHOLDS.same_native * size <= value <= native.high + THRESHOLDS.same_native * size:
            return None
        if digits is not None:
            value = round(value, digits - 1 - math.floor(math.log10(size))) if size else 0.0
        # No −0.
        value = min(max(value, native.low), native.high) + 0.0
        option = _option(self.simulation, self.reality, {native.name: value}, self.rebuild)
        if option is not None:
            return replace(option, told=told)
        told |= {"value": value, "was": native.value}
        return Change(self.simulation.name, native.name, {}, {}, natives={native.name: value}, told=told)


def _option(peer: Peer, other: Peer, wanted: Mapping[str, float], rebuild: Rebuild) -> Change | None:
    """An option of the backend that sets these native parameters and no others."""
    now = {p.name: p.value for p in peer.system.parameters}
    for c in candidates(peer, other):
        if not {path.partition(".")[0] for path in c.options} <= PHYSICAL:
            continue
        system = rebuild(peer, c.options)
        if system is not None and _sets({**now, **wanted}, now, {p.name: p.value for p in system.parameters}):
            return c
    return None


def _sets(wanted: Mapping[str, float], now: Mapping[str, float], after: Mapping[str, float]) -> bool:
    """Are all where they should be, within a small part of what they were or are to be?"""
    return after.keys() == wanted.keys() and all(
        abs(after[n] - v) <= THRESHOLDS.same_native * max(abs(v), abs(now[n])) for n, v in wanted.items()
    )
