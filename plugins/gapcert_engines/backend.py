"""The Backend that every engine becomes: pure in all its arguments, and tiled where that changes no bit."""

from __future__ import annotations

import hashlib
import json
import threading
from collections.abc import Callable, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any, final

import numpy as np
import numpy.typing as npt

from gapcert.plugin import Array, Backend, Capability, Context, Parameter, Scene, Step, System, UsageError
from gapcert_engines.thresholds import THRESHOLDS

from .config import EngineConfig
from .contract import ENDLESS, Engine, EngineWorld, Joint, Law
from .wiring import Lever, check_ranges, from_columns, step_period, to_columns, wire


@final
class EngineBackend(Backend):
    """x⁺ of the numbers that `states` names, under one effort per joint, or control per actuator, and period.

    Every number of the robot that no state names is hidden state; its default is the file's pose at rest. `parameters` are the
    engine's native ones.
    """

    def __init__(self, engine: Engine, *, model: System | None = None) -> None:
        self.engine, self.config = engine, engine.config
        self._lock = threading.Lock()
        self._worlds: dict[int, EngineWorld] = {}
        self.period, self.substeps = step_period(engine.config.period, model), engine.config.substeps
        self._joints = [j for j in engine.joints if j.movable]
        if not self._joints and not engine.loose:
            raise UsageError(
                f"robot: {engine.file} has no movable joint; expected one that turns or slides, or a base that floats"
            )
        self._wiring = w = wire(engine, model)
        self.states, self.inputs, self.coordinates = w.states, w.inputs, w.coordinates
        self.hidden, self.hidden_default = w.hidden, w.hidden_default
        gears = [Parameter(lever.native, lever.motor.gear) for lever in w.levers if lever is not None]
        self.parameters = (*engine.parameters, *gears)
        able: dict[Capability, object] = {"parameters": self.parameters, "hidden": self.hidden, "forces": self.coordinates}
        self.capabilities = frozenset(name for name, what in able.items() if what)
        self._nominal = self._asked = engine.stated

    @property
    def tiling(self) -> str:
        """How many copies are stepped at once, and why no more."""
        with self._lock:
            return self._tiles[1]

    def close(self) -> None:
        """Disconnects from the engine; the next query connects again."""
        with self._lock:
            for world in self._worlds.values():
                world.close()
            self._worlds.clear()

    def digest(self) -> str:
        physics = self.config.model_dump(mode="json", exclude={"robot", "tiles", "threads", "period"} | self.config.unsaid())
        axes = [[s.name, s.unit, s.kind] for s in (*self.states, *self.inputs)]
        data = [type(self.engine).__qualname__, physics, self.period, axes, self.engine.digest_data()]
        # Where inputs are efforts, the file's gear is none of their business.
        data += [[m.gear, *m.controls] for lever in self._wiring.levers if lever and lever.control for m in (lever.motor,)]
        return hashlib.sha256(json.dumps(data).encode()).hexdigest()

    def resolution(self, magnitude: Array) -> Array:
        return np.maximum(self.rounding(magnitude), self.period * self.engine.unsolved)

    def rounding(self, magnitude: Array) -> Array:
        return self.engine.resolution(magnitude)

    def __getstate__(self) -> dict[str, Any]:
        return {k: v for k, v in self.__dict__.items() if k not in ("_worlds", "_lock")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._lock, self._worlds = threading.Lock(), {}

    def realises(self, effect: str, site: str) -> str | None:
        """See Engine.realises; site: a coordinate, or an input, whose gain is a motor's gear."""
        if effect == "input-gain" and (lever := self.lever(site)) is not None:
            return lever.native
        if site not in self.coordinates:
            return None
        return self.engine.realises(effect, self._joints[self.coordinates.index(site)].name)

    def moved(self) -> list[tuple[Joint, str]]:
        """The joints that move, and their coordinates."""
        return list(zip(self._joints, self.coordinates, strict=True))

    def driven(self, name: str) -> str | None:
        """The coordinate at which an input is an effort; None where it goes to the drive or to an actuator."""
        joint = int(self._wiring.driven[[u.name for u in self.inputs].index(name)])
        return self.coordinates[joint] if 0 <= joint < len(self.coordinates) else None

    def law(self, name: str) -> Law | None:
        """Of the actuator at an input that stays in the engine."""
        place = int(self._wiring.driven[[u.name for u in self.inputs].index(name)]) - len(self.coordinates)
        return self.engine.actuators[place].law if place >= 0 else None

    def lever(self, name: str) -> Lever | None:
        """The motor at an input."""
        return next((lever for s, lever in zip(self.inputs, self._wiring.levers, strict=True) if s.name == name), None)

    def ranges(self) -> dict[str, tuple[float, float]]:
        """Positions q, velocities q_dot and inputs that the engine bounds → between what."""
        found = dict[str, tuple[float, float]]()
        for joint, q in self.moved():
            found |= {q: joint.ends, f"{q}_dot": joint.speeds}
            found |= {u.name: joint.efforts for u in self.inputs if self.driven(u.name) == q}
        for u in self.inputs:
            if (lever := self.lever(u.name)) is not None and lever.control:
                found[u.name] = lever.motor.controls
        return {name: ends for name, ends in found.items() if ends != ENDLESS}

    def scene(self, x: Array, hidden: Array | None = None) -> Scene | None:
        joints, base = self._robot(x, np.asarray(self.hidden_default) if hidden is None else hidden)
        # Velocities place nothing, so that they need not be known.
        placed = [joints[:, :, 0], *([] if base is None else [base[:, :7]])]
        if not len(x) or not all(np.isfinite(part).all() for part in placed):
            return None
        with self._lock:
            return self.engine.scene(joints[:, :, 0], base)

    # Stepping

    def _step(self, x: Array, u: Array, **options: Any) -> Step:
        w, n, nj = self._wiring, len(x), len(self._joints)
        joints, base = self._robot(x, options.get("hidden", 0.0))
        command = None if w.drive is None else w.drive.commands(u[:, w.commanded])
        forces = options.get("forces")
        effort = np.zeros((n, 1 if forces is None else self.substeps, nj + len(self.engine.actuators)))
        given = dict(options.get("parameters", {}))
        effort[:, :, w.driven[w.driven >= 0]] = self._levered(u, given)[:, None, w.driven >= 0]
        if forces is not None:
            effort[:, :, :nj] += forces
        with self._lock:
            after, after_base = self._answer(given, joints, effort, base, command)
        numbers = after.reshape(n, 2 * nj)
        if after_base is not None:
            numbers = np.concatenate([numbers, to_columns(after_base, self.config)], axis=1)
        if w.straight:
            return Step(numbers)
        return Step(numbers[:, w.seen], numbers[:, w.unseen] if w.hidden else None)

    def _robot(self, x: Array, hidden: Array | float) -> tuple[Array, Array | None]:
        """Joints (n, nj, 2) and what is loose (n, ·)."""
        w, n, nj, full = self._wiring, len(x), len(self._joints), x
        if not w.straight:
            full = np.empty((n, len(w.seen) + len(w.unseen)))
            full[:, w.seen] = x
            full[:, w.unseen] = hidden
        base = from_columns(full[:, 2 * nj :], self.config) if self.engine.loose else None
        return full[:, : 2 * nj].reshape(n, nj, 2), base

    def _levered(self, u: Array, parameters: dict[str, Array]) -> Array:
        """Inputs as efforts at their joints; takes the gears out of the parameters."""
        out = u
        for k, lever in enumerate(self._wiring.levers):
            if lever is None:
                continue
            factor = lever.factor(parameters.pop(lever.native, lever.motor.gear))
            if lever.control or np.any(factor != 1):
                out = out.copy()
                out[:, k] = factor * (np.clip(out[:, k], *lever.motor.controls) if lever.control else out[:, k])
        return out

    def _answer(
        self, parameters: Mapping[str, Array], joints: Array, effort: Array, base: Array | None, command: Array | None
    ) -> tuple[Array, Array | None]:
        """(joints, base) afterwards, group by group of rows with common native parameters."""
        if not parameters:
            return self._advance(self._nominal, joints, effort, base, command)
        sets, group = self._sets(parameters)
        if len(sets) == 1:
            return self._advance(sets[0], joints, effort, base, command)
        if self.engine.rowwise:
            world = self._world(1)
            world.set_rows(sets, group)
            return world.advance(joints, effort, base, command)
        after, after_base = np.empty_like(joints), None if base is None else np.empty_like(base)
        for k, values in enumerate(sets):
            rows = np.flatnonzero(group == k)
            parts = (None if a is None else a[rows] for a in (base, command))
            after[rows], moved = self._advance(values, joints[rows], effort[rows], *parts)
            if after_base is not None and moved is not None:
                after_base[rows] = moved
        return after, after_base

    def _sets(self, parameters: Mapping[str, Array]) -> tuple[list[dict[str, float]], npt.NDArray[np.intp]]:
        """The sets of parameter values that differ, and which of them each row has."""
        check_ranges(type(self.engine).__name__, self.parameters, parameters)
        table = np.stack(list(parameters.values()), axis=1)
        if len(table) and (table == table[0]).all():
            rows, group = table[:1], np.zeros(len(table), dtype=np.intp)
        else:
            rows, group = np.unique(table, axis=0, return_inverse=True)
        return [self._nominal | dict(zip(parameters, row, strict=True)) for row in rows.tolist()], group.reshape(-1)

    def _advance(
        self, values: Mapping[str, float], joints: Array, effort: Array, base: Array | None, command: Array | None
    ) -> tuple[Array, Array | None]:
        """Full blocks tiled, a large remainder as one block filled up with copies of its last row, the rest singly."""
        n = len(joints)
        copies = self._tiles[0] if n >= THRESHOLDS.small_remainder and self.engine.tileable(values) else 1
        if n < copies and values != self._asked:
            # To set all copies to new values costs more than to step a few rows, until they are asked for again.
            copies, self._asked = 1, dict(values)
        whole = n - n % copies
        if copies == 1 or not whole < n:
            return self._ready(copies, values).advance(joints, effort, base, command)
        out = np.empty_like(joints)
        if whole:
            out[:whole] = self._ready(copies, values).advance(joints[:whole], effort[:whole])[0]
        rest, forces = joints[whole:], effort[whole:]
        if n - whole >= max(THRESHOLDS.small_remainder, copies // 12):
            filled = np.minimum(np.arange(copies), n - whole - 1)
            out[whole:] = self._ready(copies, values).advance(rest[filled], forces[filled])[0][: n - whole]
        else:
            out[whole:] = self._ready(1, values).advance(rest, forces)[0]
        return out, None

    def _ready(self, copies: int, values: Mapping[str, float]) -> EngineWorld:
        world = self._world(copies)
        world.set(values)
        return world

    def _world(self, copies: int) -> EngineWorld:
        if copies not in self._worlds:
            self._worlds[copies] = self.engine.open(copies, self.period, self._wiring.drive)
        return self._worlds[copies]

    # Tiling

    @cached_property
    def _tiles(self) -> tuple[int, str]:
        """(copies, the reason): as many as asked and possible, if they give a single robot's bits.

        Found when the first query comes that is large enough: to compile the copies and to try them takes longer than most do.
        """
        most, reason = self.engine.tiles()
        copies = min(self.config.tiles, most)
        if copies < 2:
            return 1, "untiled: one copy was asked for" if self.config.tiles < 2 else reason
        if self.engine.loose or self._wiring.drive is not None:
            return 1, "untiled: copies share a fixed base without a drive"
        if self._same_bits(copies):
            return copies, f"{copies} copies, bit-equal to one robot"
        return 1, f"untiled: {copies} copies differed from one robot"

    def _same_bits(self, copies: int) -> bool:
        """Whether three blocks of random states end the same, tiled and one by one, under held and under changing efforts."""
        rng = np.random.default_rng(0)
        n, nj = 3 * copies, len(self._joints)
        joints = rng.uniform(-1, 1, (n, nj, 2)) * [np.pi, 10]
        effort = rng.uniform(-10, 10, (n, self.substeps, nj + len(self.engine.actuators)))
        for given in (effort[:, :1], effort)[: 1 + (self.substeps > 1)]:
            worlds = self._ready(1, self._nominal), self._ready(copies, self._nominal)
            try:
                one, many = (world.advance(joints, given)[0] for world in worlds)
            except UsageError:  # an engine that cannot follow so wild a motion has not shown that copies agree
                return False
            if one.tobytes() != many.tobytes():
                return False
        return True


def as_backend(engine: Callable[[Any, Path], Engine], config: EngineConfig, context: Context) -> EngineBackend:
    """`from_config` of an engine: the backend of a spec's section, with the axes of the model that there is."""
    return EngineBackend(engine(config, context.folder), model=context.model)
