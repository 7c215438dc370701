"""Engine `mujoco`: a robot file described by plain data, and the worlds that step it."""

from __future__ import annotations

import hashlib
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, final

import mujoco
import numpy as np

from gapcert import Array, UsageError
from gapcert.plugin import Scene
from gapcert_engines import Drive, Engine, EngineWorld, Joint, as_backend

from .actuators import motors
from .config import MuJoCoConfig
from .drawn import scene
from .parameters import Natives, joint_name
from .patch import patched, wrapper
from .robot import binary, compiled, left_over, restored, thrusters, unconstrained
from .section import implicit, section
from .world import MuJoCoWorld
from .xla import check, versions

_KINDS = {
    mujoco.mjtJoint.mjJNT_HINGE: "revolute",
    mujoco.mjtJoint.mjJNT_SLIDE: "prismatic",
    mujoco.mjtJoint.mjJNT_BALL: "ball",
    mujoco.mjtJoint.mjJNT_FREE: "free",
}
_ITERATED = 1e-4  # relative: what MuJoCo's solver leaves at its default tolerance; chosen, not measured
_COORDINATES_AT_MOST = 2048
"""Of all copies together."""


@final
class MuJoCoEngine(Engine):
    """A robot in MuJoCo, compiled once; its native parameters are those of `Natives`.

    The file's actuators, sensors and keyframes are left out: an input is the effort at a joint, or the control of a motor,
    times its gear, at a joint or at a site. `base` is the frame of the body that floats, not its centre of mass.
    """

    def __init__(self, config: MuJoCoConfig, folder: Path | None = None) -> None:
        self.config: MuJoCoConfig = config
        self._path = (folder or Path()) / config.robot
        self.file = str(self._path)
        model = compiled(self._path, config)
        self._models = {1: zlib.compress(binary(model), 1)}
        kinds = [_KINDS[mujoco.mjtJoint(kind)] for kind in model.jnt_type]
        self._check(model, kinds)
        self.rowwise = config.implementation == "mjx"
        self.joints = tuple(_joint(model, k, kind) for k, kind in enumerate(kinds) if kind != "free")
        if "free" in kinds:
            start = int(model.jnt_qposadr[kinds.index("free")])
            self.base = (*model.qpos0[start : start + 7].tolist(), *[0.0] * 6)
        self.motors = motors(self._path)
        self.thrusters = () if config.drive else thrusters(model)
        natives = Natives(model)
        self.parameters = tuple(natives.parameters)
        self._unconstrained, self._implicit = unconstrained(model), implicit(model)
        # Newton's too: it stops as the others do, also where a constraint has just begun or ceased to act.
        self.unsolved = 0.0 if self._unconstrained else left_over(model)
        self._belts = tuple(model.geom(int(k)).name for k in np.flatnonzero(model.geom_surfacevel.any(axis=1)))

    from_config = classmethod(as_backend)

    def open(self, copies: int, period: float, drive: Drive | None) -> EngineWorld:
        if copies not in self._models:
            if binary(compiled(self._path, self.config)) != zlib.decompress(self._models[1]):
                raise UsageError(f"backend.robot: {self.file} has changed since it was read; run again")
            self._models[copies] = zlib.compress(binary(compiled(self._path, self.config, copies)), 1)
        one, many = (restored(zlib.decompress(self._models[k])) for k in (1, copies))
        one.opt.timestep = many.opt.timestep = period / self.config.substeps
        return MuJoCoWorld(one, many, copies, self.config, drive)

    def digest_data(self) -> list[object]:
        data: list[object] = [
            f"mujoco {mujoco.mj_versionString()}",
            hashlib.sha256(zlib.decompress(self._models[1])).hexdigest(),
        ]
        return [*data, self.config.tiles, *versions()] if self.rowwise else data

    def section(
        self, coordinates: Sequence[str], period: float, free: Mapping[str, str], values: Mapping[str, float]
    ) -> dict[str, Any] | None:
        model = restored(zlib.decompress(self._models[1]))
        every = {p.name: p.value for p in self.parameters} | dict(values)
        model = Natives(model).varied(model, every)
        model.opt.timestep = period / self.config.substeps
        return None if self.base or self.config.drive or self.thrusters else section(model, coordinates, free, every)

    def accuracy(self, values: Mapping[str, float]) -> float:
        """Dry friction is solved until an iteration gains less than the option `tolerance`."""
        return _ITERATED if self.rubs(values) else super().accuracy(values)

    def implicit(self) -> bool:
        return self._implicit

    def patched(self, values: Mapping[str, float]) -> dict[str, str]:
        gravity = restored(zlib.decompress(self._models[1])).opt.gravity.tolist()
        name = f"extended{self._path.suffix}"
        text, unsaid = patched(self._path.read_text(encoding="utf-8"), values, gravity)
        return {name: text} | ({"extended.py": wrapper(name, unsaid)} if unsaid else {})

    def scene(self, position: Array, base: Array | None) -> Scene:
        return scene(restored(zlib.decompress(self._models[1])), position, base)

    def tiles(self) -> tuple[int, str]:
        if self.rowwise:
            return 1, f"untiled: MJX takes {self.config.tiles} rows at once"
        if not self._unconstrained:
            return 1, "untiled: copies would solve their contacts, limits, dry friction or equalities together"
        most = _COORDINATES_AT_MOST // max(1, len(self.joints))
        return most, f"untiled: {len(self.joints)} joints fill a model"

    def resolution(self, magnitude: Array) -> Array:
        """4 ulp of max |x⁺|, and one for every further sub-step; where constraints act, of at least 1: forces balance."""
        size = np.maximum(np.abs(magnitude), np.finfo(float).tiny if self._unconstrained else 1.0)
        return np.asarray((3 + self.config.substeps) * np.spacing(size))

    def drivable(self) -> tuple[str, ...]:
        """The joints, and the geoms whose surface moves in the file: a target is a multiple of that velocity."""
        return (*super().drivable(), *(name for name in self._belts if name))

    def _check(self, model: Any, kinds: list[str]) -> None:
        where = f"backend.robot: {self.file}"
        if "ball" in kinds:
            name = joint_name(model, kinds.index("ball"))
            raise UsageError(f"{where}: joint '{name}' is a ball; expected hinges and slides; write it as a chain of hinges")
        if kinds.count("free") > 1:
            raise UsageError(f"{where} has {kinds.count('free')} free joints; expected at most one, the base")
        drive = self.config.drive
        if drive and any(kind == mujoco.mjtTrn.mjTRN_SITE for kind in model.actuator_trntype):
            raise UsageError(f"{where}: inputs go to motors at sites and to a drive; expected one of the two")
        if drive and (drive.gain or drive.limit) and not model.nu:
            raise UsageError("backend.drive: gain and limit are a motor's, and no element is a joint; leave them out")
        if self.config.implementation == "mjx":
            if drive:
                raise UsageError("backend.implementation: mjx has no drive; give efforts at joints, or set implementation: c")
            check(model, self._path)
        memory = {"a plugin": model.nplugin, "a plastic spring": model.nplastic, "a deformable body": model.nflex}
        if found := [what for what, count in memory.items() if count]:
            raise UsageError(f"{where} has {found[0]}, whose state is no joint's; expected rigid bodies, hinges and slides")


def _joint(model: Any, k: int, kind: Any) -> Joint:
    damping = float(model.dof_damping[model.jnt_dofadr[k]])
    rest = float(model.qpos0[model.jnt_qposadr[k]])
    joint = Joint(joint_name(model, k), kind, damping, rest=rest)
    # A constraint begins to act where the distance is below the margin.
    low, high, margin = float(model.jnt_range[k, 0]), float(model.jnt_range[k, 1]), float(model.jnt_margin[k])
    return replace(joint, limited=True, ends=(low + margin, high - margin)) if model.jnt_limited[k] else joint
