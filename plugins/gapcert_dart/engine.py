"""Engine `dart`: what a URDF or SDF file becomes in DART, and the worlds that step it."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, final

import numpy as np

from gapcert import Array, Context, Parameter, UsageError
from gapcert.plugin import Scene
from gapcert_engines import Drive, Engine, EngineBackend, Joint, as_section

from .config import DartConfig
from .drawn import scene
from .loader import joints, load
from .patch import files
from .robot import RobotFile
from .section import links
from .world import GRAVITY, DartWorld, largest, moving_bodies, restitution

_COORDINATES_AT_MOST = 256
"""Of all copies: beyond, a step costs more per copy, and a skeleton takes seconds to build."""
_LIGHTEST = 1e-9
"""kg; a body without any mass makes its joint's acceleration undefined."""


@final
class DartEngine(Engine):
    """Native parameters: `gravity_x`, `_y`, `_z`, `damping.JOINT`, `coulomb_friction.JOINT`, `mass.BODY` (which scales its
    inertia along), `inertia.BODY` (the largest principal moment, the others in proportion), `com_x.BODY`, `_y`, `_z` (where its
    frame is along that of its joint) and, where the robot can touch something, `friction` and `restitution` of its shapes (the
    latter where all have the same) and friction `ground` of the ground.
    """

    def __init__(self, config: DartConfig, folder: Path | None = None) -> None:
        self.config: DartConfig = config
        self.robot = RobotFile((folder or Path()) / config.robot, model=config.model, shapes=config.touches)
        self.file = str(self.robot.path)
        skeleton = load(self.robot, fixed_base=config.fixed_base)
        found = joints(self.robot, skeleton)
        self.joints = tuple(_ended(config, joint, native) for joint, native in found)
        self.limited = tuple(j.name for j, native in found if j.limited and enforced(config, native))
        self.base = () if config.fixed_base else _base(skeleton)
        self.parameters = self._native(skeleton, found)
        self._check_mass(skeleton)

    @classmethod
    def from_config(cls, config: DartConfig, context: Context) -> EngineBackend:
        return EngineBackend(cls(config, context.folder), model=context.model)

    def open(self, copies: int, period: float, drive: Drive | None) -> DartWorld:
        return DartWorld(self.robot, self.config, copies, period, drive)

    def digest_data(self) -> list[object]:
        return [importlib.metadata.version("dartpy"), self.robot.digest()]

    def section(
        self, coordinates: Sequence[str], period: float, free: Mapping[str, str], values: Mapping[str, float]
    ) -> dict[str, Any] | None:
        config = self.config
        skeleton = load(self.robot, fixed_base=config.fixed_base)
        if self.base or config.drive or config.touches:
            return None
        named = dict(zip((j.name for j in self.joints if j.movable), coordinates, strict=True))
        found = links(skeleton, named, config.joint_damping, config.coulomb_friction)
        stated = {p.name: p.value for p in self.parameters}
        found = [replace(link, moment=stated.get(f"inertia.{link.name}")) for link in found]
        x, y, z = (p.value for p in self.parameters[:3])
        return as_section(found, (x, y, z), free, implicit=True, after=True)

    def implicit(self) -> bool:
        return True

    def accuracy(self, values: Mapping[str, float]) -> float:
        """DART's constraints, of which dry friction is one, give way by 1e-9 of their impulse, and joints share impulses."""
        return 1e-7 if self.rubs(values) else super().accuracy(values)

    def patched(self, values: Mapping[str, float]) -> dict[str, str]:
        return files(self.robot, self.config, values, {p.name: p.value for p in self.parameters})

    def scene(self, position: Array, base: Array | None) -> Scene:
        return scene(self.robot, self.config, position, base)

    def tiles(self) -> tuple[int, str]:
        if not self.config.fixed_base:
            return 1, "untiled: copies share a fixed base"
        if self.config.touches:
            return 1, "untiled: collision shapes take part in the physics"
        if self.limited:
            return 1, f"untiled: joint '{self.limited[0]}' has limits, whose constraints copies would solve together"
        if not self.tileable({p.name: p.value for p in self.parameters}):
            return 1, "untiled: joints have dry friction, whose constraints copies would solve together"
        count = sum(j.movable for j in self.joints)
        return max(1, _COORDINATES_AT_MOST // max(1, count)), f"untiled: {count} joints fill a skeleton"

    def tileable(self, values: Mapping[str, float]) -> bool:
        return not any(value for name, value in values.items() if name.startswith("coulomb_friction."))

    def _native(self, skeleton: Any, found: list[tuple[Joint, Any]]) -> tuple[Parameter, ...]:
        """What DART can change at run time."""
        config, movable = self.config, [(j, native) for j, native in found if j.movable]
        default = self.robot.gravity or GRAVITY

        def damping(j: Joint) -> Parameter:
            value = j.damping if config.joint_damping is None else config.joint_damping
            return Parameter(f"damping.{j.name}", value, "N*m*s/rad" if j.type == "revolute" else "N*s/m", low=0.0)

        def friction(j: Joint, native: Any) -> Parameter:
            value = float(native.getCoulombFriction(0)) if config.coulomb_friction is None else config.coulomb_friction
            return Parameter(f"coulomb_friction.{j.name}", value, "N*m" if j.type == "revolute" else "N", low=0.0)

        contact = [Parameter("friction", 1.0 if config.friction is None else config.friction, low=0.0)]
        if config.ground is not None:
            contact.append(Parameter("ground", config.ground, low=0.0))
        if (bounce := restitution(config, skeleton)) is not None:
            contact.append(Parameter("restitution", bounce, low=0.0, high=1.0))
        gravity = default if config.gravity is None else config.gravity
        return (
            *(Parameter(f"gravity_{a}", g, "m/s^2") for a, g in zip("xyz", gravity, strict=True)),
            *(damping(j) for j, _ in movable),
            *(friction(j, native) for j, native in movable),
            *(p for b in moving_bodies(skeleton) for p in _body(b)),
            *(contact if config.touches else ()),
        )

    def _check_mass(self, skeleton: Any) -> None:
        matrix = np.asarray(skeleton.getMassMatrix())
        weakest = None if not matrix.size else int(np.argmin(np.diag(matrix)))
        if weakest is None or (np.isfinite(matrix).all() and np.linalg.eigvalsh(matrix)[0] > 0):
            return
        where = "the base" if self.base and weakest < 6 else f"joint '{skeleton.getDof(weakest).getName()}'"
        raise UsageError(f"robot: {self.file}: {where} moves no mass; expected <inertial> in a link that moves with it")


def _body(body: Any) -> list[Parameter]:
    """Mass, moment and centre of mass."""
    name, inertia = body.getName(), body.getInertia()
    out = [Parameter(f"mass.{name}", float(body.getMass()), "kg", low=_LIGHTEST)]
    if (moment := largest(np.asarray(inertia.getMoment()))) > 0:
        out.append(Parameter(f"inertia.{name}", moment, "kg*m^2", low=1e-3 * moment, high=1e3 * moment))
    turn = np.asarray(body.getParentJoint().getTransformFromChildBodyNode().rotation())
    if (turn == np.eye(3)).all():
        out += [Parameter(f"com_{a}.{name}", float(c), "m") for a, c in zip("xyz", inertia.getLocalCOM(), strict=True)]
    return out


def enforced(config: DartConfig, native: Any) -> bool:
    """Does this joint stop at its limits?"""
    return bool(native.areLimitsEnforced()) if config.joint_limits is None else config.joint_limits


def _ended(config: DartConfig, joint: Joint, native: Any) -> Joint:
    """With the ends and the speeds that DART holds it to."""
    if not (joint.movable and enforced(config, native)):
        return joint
    ends = native.getPositionLowerLimit(0), native.getPositionUpperLimit(0)
    speeds = native.getVelocityLowerLimit(0), native.getVelocityUpperLimit(0)
    return replace(joint, ends=(float(ends[0]), float(ends[1])), speeds=(float(speeds[0]), float(speeds[1])))


def _base(skeleton: Any) -> tuple[float, ...]:
    place = skeleton.getRootBodyNode(0).getWorldTransform()
    return (*place.translation().tolist(), *place.quaternion().wxyz().tolist(), *(0.0,) * 6)
