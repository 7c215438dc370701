"""Engine `drake`: what a URDF, SDF or MJCF file becomes in Drake, and the worlds that step it."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, final

import numpy as np

from gapcert import Array, Parameter
from gapcert_engines import Drive, Engine, as_backend, as_section

from .config import FIXED_STEP, DrakeConfig
from .loader import Loaded, described, load
from .patch import files
from .robot import RobotFile
from .section import armature, links
from .world import DrakeWorld, body_inertia, state_of

_COORDINATES_AT_MOST = 128
"""Of all copies: beyond, a step costs no less per copy."""
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

    from_config = classmethod(as_backend)

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
        out = list(self.gravity_parameters(loaded.plant.gravity_field().gravity_vector().tolist()))
        for joint in loaded.movable():
            one = described(joint)
            out.append(self.joint_parameter("damping", one, one.damping, config.joint_damping))
            out.append(self.joint_parameter("armature", one, armature(loaded, joint)))
        aligned = {
            int(j.child_body().index()): j.frame_on_child().GetFixedPoseInBodyFrame().rotation().IsExactlyIdentity()
            for j in loaded.joints()
        }
        for body in loaded.heavy():
            own = body_inertia(body)
            out += (own if aligned.get(int(body.index()), True) else replace(own, centre=())).parameters()
        if config.ground is not None:
            out.append(Parameter("ground", config.ground, low=0.0))
        return tuple(out)

    def _check_mass(self, loaded: Loaded) -> None:
        plant = loaded.plant
        context = plant.GetMyMutableContextFromRoot(loaded.system.CreateDefaultContext())
        movers = {j.velocity_start(): f"joint '{j.name()}'" for j in loaded.movable()}
        self.check_mass(np.asarray(plant.CalcMassMatrix(context)), lambda k: movers.get(k, "the base"))
