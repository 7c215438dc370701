"""Engine `drake`: what a URDF, SDF or MJCF file becomes in Drake, and the worlds that step it."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, final

import numpy as np

from gapcert import Array, Context, Parameter, UsageError
from gapcert_engines import Drive, Engine, EngineBackend, as_section

from .config import FIXED_STEP, DrakeConfig
from .loader import Loaded, described, load
from .patch import files
from .robot import RobotFile
from .section import armature, links
from .world import DrakeWorld, numbers, state_of

_COORDINATES_AT_MOST = 128
"""Of all copies: beyond, a step costs no less per copy."""
_LIGHTEST = 1e-9
"""kg; a body without any mass makes its joint's acceleration undefined."""
_SOLVED = 1e-6
"""Relative tolerance of Drake's solvers of constraints."""


@final
class DrakeEngine(Engine):
    """Native parameters: `gravity_x`, `_y`, `_z`, `damping.JOINT`, `armature.JOINT` (the rotor's inertia as the joint feels
    it), `mass.BODY` (which scales its inertia along), `inertia.BODY` (the largest principal moment, the others in proportion),
    `com_x.BODY`, `_y`, `_z` (where its frame is along that of its joint) and friction `ground` of the ground.
    """

    def __init__(self, config: DrakeConfig, folder: Path | None = None) -> None:
        self.config: DrakeConfig = config
        self.robot = RobotFile((folder or Path()) / config.robot, model=config.model, shapes=config.touches)
        self.file = str(self.robot.path)
        loaded = load(self.robot, config, 1, 1e-3 if config.discrete else 0.0, config.gravity, config.ground)
        self.joints = tuple(described(j) for j in loaded.joints())
        self.limited = tuple(j.name for j in self.joints if j.limited)
        self.base = state_of(loaded)
        self.parameters = self._native(loaded)
        if config.touches or self.limited:
            self.unsolved = _SOLVED * max(1.0, float(np.linalg.norm([p.value for p in self.parameters[:3]])))
        self._check_mass(loaded)

    @classmethod
    def from_config(cls, config: DrakeConfig, context: Context) -> EngineBackend:
        return EngineBackend(cls(config, context.folder), model=context.model)

    def open(self, copies: int, period: float, drive: Drive | None) -> DrakeWorld:
        return DrakeWorld(self.robot, self.config, copies, period, drive)

    def digest_data(self) -> list[object]:
        return [importlib.metadata.version("drake"), self.robot.digest()]

    def section(
        self, coordinates: Sequence[str], period: float, free: Mapping[str, str], values: Mapping[str, float]
    ) -> dict[str, Any] | None:
        config = self.config
        if self.base or config.drive or config.touches or not config.discrete:
            return None
        loaded = load(self.robot, config, 1, 1e-3, config.gravity, None)
        if loaded.plant.num_force_elements() > 1:  # besides gravity: springs
            return None
        named = dict(zip((j.name for j in self.joints if j.movable), coordinates, strict=True))
        stated = {p.name: p.value for p in self.parameters}
        moments = {n.removeprefix("inertia."): v for n, v in stated.items() if n.startswith("inertia.")}
        x, y, z = (p.value for p in self.parameters[:3])
        return as_section(links(loaded, named, config.joint_damping, moments), (x, y, z), free, implicit=True)

    def implicit(self) -> bool:
        return self.config.discrete

    def resolution(self, magnitude: Array) -> Array:
        """4 ulp, and one more for every further sub-step; what an integrator's accuracy leaves, where it has one."""
        ulp = np.spacing(np.maximum(np.abs(magnitude), np.finfo(float).tiny))
        rounding = np.asarray((3 + self.config.substeps) * ulp)
        if self.config.discrete or self.config.integrator in FIXED_STEP:
            return rounding
        return np.asarray(np.maximum(rounding, self.config.accuracy * np.maximum(np.abs(magnitude), 1.0)))

    def patched(self, values: Mapping[str, float]) -> dict[str, str]:
        return files(self.robot, self.config, values, {p.name: p.value for p in self.parameters})

    def tiles(self) -> tuple[int, str]:
        if self.base:
            return 1, "untiled: copies share a fixed base"
        if self.config.touches:
            return 1, "untiled: collision shapes take part in the physics"
        if not self.config.discrete:
            return 1, "untiled: an integrator that looks at its error would look at all copies"
        if self.limited:
            return 1, f"untiled: joint '{self.limited[0]}' has limits, whose constraints copies would solve together"
        count = sum(j.movable for j in self.joints)
        return max(1, _COORDINATES_AT_MOST // max(1, count)), f"untiled: {count} joints fill a plant"

    def _native(self, loaded: Loaded) -> tuple[Parameter, ...]:
        """What can change from query to query."""
        config = self.config
        gravity = loaded.plant.gravity_field().gravity_vector().tolist()
        out = [Parameter(f"gravity_{a}", g, "m/s^2") for a, g in zip("xyz", gravity, strict=True)]
        for joint in loaded.movable():
            turns = joint.type_name() == "revolute"
            damping = float(joint.default_damping_vector()[0]) if config.joint_damping is None else config.joint_damping
            out.append(Parameter(f"damping.{joint.name()}", damping, "N*m*s/rad" if turns else "N*s/m", low=0.0))
            rotor = armature(loaded, joint)
            out.append(Parameter(f"armature.{joint.name()}", rotor, "kg*m^2" if turns else "kg", low=0.0))
        aligned = {
            int(j.child_body().index()): j.frame_on_child().GetFixedPoseInBodyFrame().rotation().IsExactlyIdentity()
            for j in loaded.joints()
        }
        for body in loaded.heavy():
            out += _body(body.name(), body.default_spatial_inertia(), aligned.get(int(body.index()), True))
        if config.ground is not None:
            out.append(Parameter("ground", config.ground, low=0.0))
        return tuple(out)

    def _check_mass(self, loaded: Loaded) -> None:
        plant = loaded.plant
        context = plant.GetMyMutableContextFromRoot(loaded.system.CreateDefaultContext())
        matrix = np.asarray(plant.CalcMassMatrix(context))
        if matrix.size and not (np.isfinite(matrix).all() and np.linalg.eigvalsh(matrix)[0] > 0):
            at = int(np.argmin(np.diag(matrix)))
            joint = next((j for j in loaded.movable() if j.velocity_start() == at), None)
            where = "the base" if joint is None else f"joint '{joint.name()}'"
            raise UsageError(f"robot: {self.file}: {where} moves no mass; expected <inertial> in a link that moves with it")


def _body(name: str, spatial: Any, aligned: bool) -> list[Parameter]:
    """Mass, moment and centre of mass."""
    mass, moment, *centre = numbers(name, spatial).items()
    out = [Parameter(mass[0], mass[1], "kg", low=_LIGHTEST)]
    if moment[1] > 0:
        out.append(Parameter(moment[0], moment[1], "kg*m^2", low=1e-3 * moment[1], high=1e3 * moment[1]))
    return out + [Parameter(n, v, "m") for n, v in centre if aligned]
