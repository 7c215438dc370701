"""Backend `pybullet`: a robot file stepped by Bullet's articulated-body algorithm, as a pure function of (x, u)."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, final

import numpy as np
import numpy.typing as npt

from gapcert import Backend, Context, Step, System, UsageError
from gapcert_pybullet.config import PyBulletConfig
from gapcert_pybullet.mapping import BASE, fuses, native_parameters, step_period, wire
from gapcert_pybullet.urdf import RobotFile
from gapcert_pybullet.world import JOINTS_AT_MOST, World

Array = npt.NDArray[np.float64]
_SMALL_REMAINDER = 4
"""Fewer rows than this are stepped one by one: a block costs about as much as four single rows."""


@final
class PyBulletBackend(Backend):
    """x⁺ of the joints that `states` names, from rest of everything else, under one torque per period.

    Joint numbers that no state names, and a floating base, are hidden state with the file's pose as default. Parameters:
    `linear_damping`, `angular_damping` (Bullet's drag on every link, k·(v + v|v|)), `gravity_x`, `_y`, `_z`, and
    `damping.JOINT`. `tiling` says how many copies are stepped at once, and why no more.
    """

    def __init__(self, config: PyBulletConfig, *, model: System | None = None, folder: Path | None = None) -> None:
        self.config = config
        self.file = RobotFile((folder or Path()) / config.robot)
        self._lock = threading.Lock()
        self._worlds: dict[tuple[int, bool], World] = {}
        self.period, self.substeps = step_period(config, model), config.substeps
        self._fusible = fuses(self.period, self.substeps)
        single = self._world(1, False)
        self._joints = [j for j in single.joints if j.movable]
        self._check_robot(len(single.joints))
        self._wiring = wire(config, str(self.file.path), single.joints, model)
        self.states, self.inputs, self.coordinates = self._wiring.states, self._wiring.inputs, self._wiring.coordinates
        self.parameters = native_parameters(config, single.joints)
        self.hidden = self._wiring.hidden if config.fixed_base else self._wiring.hidden + BASE
        self.hidden_default = (0.0,) * len(self._wiring.hidden) + (() if config.fixed_base else tuple(single.base()))
        self.capabilities = frozenset({"parameters", "forces", "hidden"} if self.hidden else {"parameters", "forces"})
        self._nominal = {p.name: p.value for p in self.parameters}
        self._copies, self.tiling = self._choose_tiling(len(single.joints))

    @classmethod
    def from_config(cls, config: PyBulletConfig, context: Context) -> PyBulletBackend:
        return cls(config, model=context.model, folder=context.folder)

    def close(self) -> None:
        """Disconnects from the engine; the next query connects again."""
        with self._lock:
            for world in self._worlds.values():
                world.close()
            self._worlds.clear()

    def digest(self) -> str:
        physics = self.config.model_dump(mode="json", exclude={"robot", "tiles", "period"})
        shapes = self.config.self_collision or not self.config.use_inertia_from_file
        axes = [[s.name, s.unit, s.kind] for s in (*self.states, *self.inputs)]
        version = importlib.metadata.version("pybullet")
        data = [type(self).__qualname__, version, physics, self.period, axes, self.file.digest(shapes=shapes)]
        return hashlib.sha256(json.dumps(data).encode()).hexdigest()

    def __getstate__(self) -> dict[str, Any]:
        return {k: v for k, v in self.__dict__.items() if k not in ("_worlds", "_lock")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._lock, self._worlds = threading.Lock(), {}

    # What the robot is

    def _check_robot(self, joints: int) -> None:
        where = f"robot: {self.file.path}"
        if not self._joints:
            raise UsageError(f"{where} has no movable joint; expected at least one of type revolute, continuous or prismatic")
        if joints > JOINTS_AT_MOST:
            raise UsageError(f"{where} has {joints} joints; PyBullet is right up to {JOINTS_AT_MOST}, use a smaller robot")
        if not self.config.fixed_base and not self.file.root_has_inertia:
            raise UsageError(
                f"{where}: its root link has no <inertial>, so it cannot float; give it one or set fixed_base: true"
            )

    # Stepping

    def _step(self, x: Array, u: Array, **options: Any) -> Step:
        hidden, forces = options.get("hidden"), options.get("forces")
        wiring, floats = self._wiring, not self.config.fixed_base
        seen, unseen, nh = tuple(wiring.seen), tuple(wiring.unseen), len(wiring.hidden)
        joints = np.zeros((len(x), len(self._joints), 2))
        joints[:, *seen] = x
        base = None
        if hidden is not None:
            joints[:, *unseen] = hidden[:, :nh]
            base = hidden[:, nh:].copy() if floats else None
        torque = np.zeros((len(x), self.substeps, len(self._joints)))
        torque[:, :, wiring.driven] = u[:, None, :]
        if forces is not None:
            torque += forces
        with self._lock:
            for rows, values in self._groups(len(x), options.get("parameters", {})):
                fused = self._may_fuse(values) and forces is None
                block = None if base is None else base[rows]
                drive = torque[rows, :1] if fused else torque[rows]
                joints[rows], block = self._advance(joints[rows], drive, block, values, fused)
                if base is not None and block is not None:
                    base[rows] = block
        if not self.hidden:
            return Step(joints[:, *seen])
        after = joints[:, *unseen]
        return Step(joints[:, *seen], after if base is None else np.concatenate([after, base], axis=1))

    def _may_fuse(self, values: Mapping[str, float]) -> bool:
        """Bullet adds joint damping once per call, so only undamped joints get it right inside one fused call."""
        return self._fusible and not any(values[f"damping.{j.name}"] for j in self._joints)

    def _groups(self, n: int, parameters: Mapping[str, Array]) -> Iterator[tuple[Any, dict[str, float]]]:
        """Rows that share their parameter values, and the values."""
        for p in self.parameters:
            value = parameters.get(p.name)
            if value is not None and (value < p.low).any():
                raise UsageError(f"PyBulletBackend: parameter {p.name} = {value.min()}; expected a number ≥ {p.low}")
        if not parameters:
            yield slice(None), self._nominal
            return
        rows, group = np.unique(np.stack(list(parameters.values()), axis=1), axis=0, return_inverse=True)
        for k, row in enumerate(rows.tolist()):
            yield np.flatnonzero(group == k), self._nominal | dict(zip(parameters, row, strict=True))

    def _advance(
        self, joints: Array, torque: Array, base: Array | None, values: Mapping[str, float], fused: bool
    ) -> tuple[Array, Array | None]:
        """Full blocks tiled, a large remainder as one block filled up with copies of its last row, the rest singly."""
        n, out = len(joints), np.empty_like(joints)
        tiled = n - n % self._copies
        if self._copies > 1 and n - tiled >= _SMALL_REMAINDER:
            tiled = n
        if self._copies > 1 and tiled:
            world = self._world(self._copies, fused)
            world.set(values)
            full = np.minimum(np.arange(-(-tiled // self._copies) * self._copies), n - 1)
            out[:tiled] = world.advance(joints[full], torque[full])[0][:tiled]
            if tiled == n:
                return out, None
        else:
            tiled = 0
        world = self._world(1, fused)
        world.set(values)
        out[tiled:], base = world.advance(joints[tiled:], torque[tiled:], base)
        return out, base

    def _world(self, copies: int, fused: bool) -> World:
        key = copies, fused
        if key not in self._worlds:
            period = self.period if fused else self.period / self.substeps
            self._worlds[key] = World(self.file, self.config, copies, period, self.substeps if fused else 1)
        return self._worlds[key]

    # Tiling

    def _choose_tiling(self, joints: int) -> tuple[int, str]:
        """(copies, the reason): as many as asked and possible, if they give a single robot's bits."""
        copies = min(self.config.tiles, JOINTS_AT_MOST // joints)
        limited = [j.name for j in self._joints if j.limited]
        if copies < 2:
            return 1, "untiled: one copy was asked for" if self.config.tiles < 2 else f"untiled: {joints} joints fill a body"
        if not self.config.fixed_base or len(self.file.roots) != 1:
            return 1, "untiled: copies share a fixed root link"
        if self.config.self_collision or not self.config.use_inertia_from_file:
            return 1, "untiled: collision shapes take part in the physics"
        if limited:
            return 1, f"untiled: joint '{limited[0]}' has limits, whose constraints copies would solve together"
        modes = (False, True) if self._may_fuse(self._nominal) else (False,)
        if all(self._same_bits(copies, fused) for fused in modes):
            return copies, f"{copies} copies, bit-equal to one robot"
        return 1, f"untiled: {copies} copies differed from one robot"

    def _same_bits(self, copies: int, fused: bool) -> bool:
        """Whether three blocks of random states and torques end the same, tiled and one by one."""
        rng = np.random.default_rng(0)
        n, nj = 3 * copies, len(self._joints)
        joints = rng.uniform(-1, 1, (n, nj, 2)) * [np.pi, 10]
        torque = rng.uniform(-10, 10, (n, 1 if fused else self.substeps, nj))
        ends = []
        for k in (1, copies):
            world = self._world(k, fused)
            world.set(self._nominal)
            ends.append(world.advance(joints, torque)[0])
        return ends[0].tobytes() == ends[1].tobytes()
