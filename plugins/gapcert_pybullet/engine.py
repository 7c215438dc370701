"""Engine `pybullet`: what a URDF file becomes in Bullet, and the worlds that step it."""

from __future__ import annotations

import importlib.metadata
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, final

from gapcert import Array, Parameter, UsageError
from gapcert.plugin import Scene
from gapcert_engines import Drive, Engine, as_backend, file_shapes

from .client import JOINTS_AT_MOST, Client
from .config import PyBulletConfig
from .patch import files
from .section import section
from .urdf import RobotFile
from .world import PyBulletWorld


@final
class PyBulletEngine(Engine):
    """Native parameters: `linear_damping`, `angular_damping` (Bullet's drag on every link, k·(v + v|v|)), `gravity_x`, `_y`,
    `_z`, `damping.JOINT`, `coulomb_friction.JOINT` (a motor that holds the joint with at most this; zero at first, since Bullet
    passes over the file's), `mass.LINK` with the inertia in proportion, `inertia.LINK` (the largest principal moment, with the
    others in proportion, where the file's are used) and, where the robot can touch something,
    `friction`, `spinning_friction`, `rolling_friction`, `restitution` of its links, and the `contact_time` of contacts (s):
    0 for Bullet's own, else that of a critically damped spring under the mass of the robot.
    """

    def __init__(self, config: PyBulletConfig, folder: Path | None = None) -> None:
        self.config: PyBulletConfig = config
        self.robot = RobotFile((folder or Path()) / config.robot, limits=config.joint_limits)
        self.file = str(self.robot.path)
        client = Client(self.robot, config, 1)
        self.joints = tuple(client.joints)
        if not config.fixed_base and not self.robot.root_has_inertia:
            raise UsageError(
                f"robot: {self.file}: its root link has no <inertial>, so it cannot float; give it one or set fixed_base: true"
            )
        if (count := len(self.joints)) > JOINTS_AT_MOST:
            raise UsageError(f"robot: {self.file} has {count} joints; PyBullet is right up to {JOINTS_AT_MOST}")
        self.base = () if config.fixed_base else tuple(client.base())
        self.parameters = self._native(client)
        # A contact starts from what one that was nearly the same has found; no restored state forgets all of that.
        self.forgets = not config.touches
        client.close()

    from_config = classmethod(as_backend)

    def open(self, copies: int, period: float, drive: Drive | None) -> PyBulletWorld:
        return PyBulletWorld(self.robot, self.config, copies, period, drive)

    def digest_data(self) -> list[object]:
        shapes = self.config.touches or not self.config.use_inertia_from_file
        return [importlib.metadata.version("pybullet"), self.robot.digest(shapes=shapes)]

    def section(
        self, coordinates: Sequence[str], period: float, free: Mapping[str, str], values: Mapping[str, float]
    ) -> dict[str, Any] | None:
        if self.base or self.config.drive or self.config.touches:
            return None
        client = Client(self.robot, self.config, 1)
        try:
            return section(client, coordinates, {p.name: p.value for p in self.parameters}, free)
        finally:
            client.close()

    def accuracy(self, values: Mapping[str, float]) -> float:
        """Bullet sweeps over motors, which dry friction is, until little changes: enough for 1 % of a step."""
        several = len([j for j in self.joints if j.movable]) > 1
        swept = several and self.config.solver_residual > 0 and not self.tileable(values)
        return 1e-2 if swept else super().accuracy(values)

    def patched(self, values: Mapping[str, float]) -> dict[str, str]:
        return files(self.robot.content.decode(), self.config, values, {p.name: p.value for p in self.parameters})

    def scene(self, position: Array, base: Array | None) -> Scene:
        client = Client(self.robot, self.config, 1)
        try:
            names, poses = client.poses(position, base)
        finally:
            client.close()
        shapes = file_shapes(ET.fromstring(self.robot.content), self.robot.path.parent, names)
        found = Scene(tuple(names), shapes, poses)
        return found if self.config.ground is None else found.with_ground()

    def tiles(self) -> tuple[int, str]:
        count = len(self.joints)
        limited = next((j.name for j in self.joints if j.limited and j.movable), None)
        if not self.config.fixed_base or len(self.robot.roots) != 1:
            return 1, "untiled: copies share a fixed root link"
        if self.config.touches or not self.config.use_inertia_from_file:
            return 1, "untiled: collision shapes take part in the physics"
        if limited is not None:
            return 1, f"untiled: joint '{limited}' has limits, whose constraints copies would solve together"
        return max(1, JOINTS_AT_MOST // max(1, count)), f"untiled: {count} joints fill a body"

    def tileable(self, values: Mapping[str, float]) -> bool:
        return not self.rubs(values)

    def _native(self, client: Client) -> tuple[Parameter, ...]:
        """What PyBullet can change at run time."""
        config, movable = self.config, [j for j in self.joints if j.movable]
        bodies = client.masses()
        if not config.use_inertia_from_file:
            bodies = [replace(b, moment=0.0) for b in bodies]
        # Bullet's own rate motor takes the place of the one that dry friction is.
        motors = config.drive.elements if config.drive is not None and config.drive.gain is None else ()
        friction = client.friction() if config.friction is None else config.friction
        return (
            Parameter("linear_damping", config.linear_damping, "1/s", low=0.0),
            Parameter("angular_damping", config.angular_damping, "1/s", low=0.0),
            *self.gravity_parameters(config.gravity),
            *(self.joint_parameter("damping", j, j.damping, config.joint_damping) for j in movable),
            *(self.joint_parameter("coulomb_friction", j, 0.0) for j in movable if j.name not in motors),
            *(p for b in bodies for p in b.parameters(lightest=None)),
            *((Parameter("friction", friction, low=0.0), *client.contact()) if config.touches else ()),
        )
