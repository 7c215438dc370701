"""Engine `pybullet`: what a URDF file becomes in Bullet, and the worlds that step it."""

from __future__ import annotations

import importlib.metadata
import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, final

from gapcert import Array, Parameter, UsageError
from gapcert.plugin import Scene
from gapcert_engines import Drive, Engine, Link, as_backend, file_shapes, patched_file, setting_code

from .client import JOINTS_AT_MOST, Client, inverse, product, pybullet, rotated
from .config import PyBulletConfig
from .urdf import RobotFile
from .world import PyBulletWorld

_UNIT = 1e-10  # between an axis that was written in decimals and a unit vector; chosen, not measured


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
        client.close()

    from_config = classmethod(as_backend)

    def open(self, copies: int, period: float, drive: Drive | None) -> PyBulletWorld:
        return PyBulletWorld(self.robot, self.config, copies, period, drive)

    def digest_data(self) -> list[object]:
        shapes = self.config.touches or not self.config.use_inertia_from_file
        return [importlib.metadata.version("pybullet"), self.robot.digest(shapes=shapes)]

    def section(
        self, coordinates: Sequence[str], period: float, free: Mapping[str, str], values: Mapping[str, float]
    ) -> dict[str, Any]:
        """See Engine.section; with Bullet's drag.

        Bullet takes damping from the velocity at the beginning of a step. Its drag holds every link back by m v k (1 + |v|) at
        its centre of mass, and by I ω l (1 + |ω|), with k its linear and l its angular damping (btMultiBody).
        """
        out, drag = super().section(coordinates, period, free, values), {}
        for what, square in (("linear", "second/metre"), ("angular", "second")):
            name, number = free.get(f"{what}_damping"), self.stated[f"{what}_damping"]
            if name is not None:
                out["parameters"] |= {"metre": "1 m", "second": "1 s"}
                drag[what] = [name, f"{name}*{square}"]
            elif number:
                drag[what] = [repr(number)] * 2
        for body in out["bodies"].values() if drag else ():
            body["drag"] = drag
        return out

    def beyond(self) -> tuple[str, ...]:
        return (*super().beyond(), *(["shapes that may touch"] if self.config.touches else []))

    def links(self, coordinates: Mapping[str, str], period: float, values: Mapping[str, float]) -> list[Link]:
        client = Client(self.robot, self.config, 1)
        try:
            return _links(client, coordinates, self.stated)
        finally:
            client.close()

    def accuracy(self, values: Mapping[str, float]) -> float:
        """Bullet sweeps over motors, which dry friction is, until little changes: enough for 1 % of a step."""
        several = len([j for j in self.joints if j.movable]) > 1
        swept = several and self.config.solver_residual > 0 and not self.tileable(values)
        return 1e-2 if swept else super().accuracy(values)

    def patched(self, values: Mapping[str, float]) -> dict[str, str]:
        # Bullet passes over the friction of a file's joints.
        words, given = {"damping": "damping"}, {"damping": self.config.joint_damping}
        patched, unsaid = patched_file(self.robot.content.decode(), values, self.stated, words, given)
        return patched | ({"extended.py": self._code(unsaid, self.stated | dict(values))} if unsaid else {})

    def _code(self, unsaid: Mapping[str, float], values: Mapping[str, float]) -> str:
        """Code that loads the file as a client of this package does, and sets what the file cannot say."""
        config = self.config
        code = _LOADED.format(
            fixed=config.fixed_base,
            flags=", flags=pybullet.URDF_USE_INERTIA_FROM_FILE" if config.use_inertia_from_file else "",
            gravity=", ".join(repr(float(values[f"gravity_{a}"])) for a in "xyz"),
            drag=", ".join(f"{w}Damping={float(values[f'{w}_damping'])!r}" for w in ("linear", "angular")),
        )
        if any(name.startswith("coulomb_friction.") for name in unsaid):
            code += _STRENGTH
        setters = _SETTERS
        if time := float(unsaid.get("contact_time", 0.0)):
            mass = sum(v for n, v in self.stated.items() if n.startswith("mass."))
            spring = f"contactStiffness={mass / time**2!r}, contactDamping={2 * mass / time!r}"
            setters = _SETTERS | {"contact_time": _EVERY % spring}
        return "\n".join([code, *setting_code(setters, unsaid), ""])

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


def _links(client: Client, coordinates: Mapping[str, str], stated: Mapping[str, float]) -> list[Link]:
    """Bullet has the frame of a link in its centre of mass, along the axes of its inertia, and says there where joints are."""
    found: list[Link] = []
    body, number = client.body, client.id
    base = pybullet.getBasePositionAndOrientation(body, number)
    for at, joint in enumerate(client.joints):
        info, dynamics = pybullet.getJointInfo(body, at, number), pybullet.getDynamicsInfo(body, at, number)
        mass, inertia, centre, axes = dynamics[0], dynamics[2], dynamics[3], dynamics[4]
        parent = None if info[16] < 0 else found[info[16]]
        # What Bullet calls the joint's rotation turns the parent's vectors into the link's.
        place, turn = info[14], inverse(info[15])
        if parent is None:
            place, turn = rotated(base[1], place), product(base[1], turn)
        x, y, z = (a + b for a, b in zip(place, base[0] if parent is None else parent.com, strict=True))
        i, j, k, w = turn
        link = Link(
            info[12].decode(),
            None if parent is None else parent.name,
            (x, y, z),
            (w, i, j, k),
            mass=mass,
            com=rotated(inverse(axes), centre),
            inertia=(*inertia, 0.0, 0.0, 0.0),
            moment=max(inertia),
        )
        if joint.movable:
            if abs(1 - (length := math.hypot(*info[13]))) > _UNIT:
                raise UsageError(
                    f"robot: the axis of joint '{joint.name}' is {length:.9g} long, and Bullet moves it by that much faster; "
                    f"expected a unit vector; write it with all its digits"
                )
            name, slides = joint.name, joint.type == "prismatic"
            link = replace(
                link,
                coordinate=coordinates[name],
                joint=name,
                straight=slides,
                axis=info[13],
                damping=stated[f"damping.{name}"],
                dry=stated[f"coulomb_friction.{name}"],
            )
        found.append(link)
    return found


_LOADED = """import pybullet

pybullet.connect(pybullet.DIRECT)
robot = pybullet.loadURDF("extended.urdf", useFixedBase={fixed}{flags})
pybullet.setGravity({gravity})
pybullet.changeDynamics(robot, -1, {drag})
names = [pybullet.getJointInfo(robot, k) for k in range(pybullet.getNumJoints(robot))]
joints, links = ({{info[i].decode(): info[0] for info in names}} for i in (1, 12))
for joint in joints.values():
    pybullet.setJointMotorControl2(robot, joint, pybullet.VELOCITY_CONTROL, force=0)"""
_STRENGTH = """
# Bullet turns a motor's strength into an impulse now, with the time step that is set: setTimeStep comes before."""
_EVERY = """for link in (-1, *links.values()):
    pybullet.changeDynamics(robot, link, %s)"""
_MASS = """link = links.get("{element}", -1)
mass, _, inertia, *_ = pybullet.getDynamicsInfo(robot, link)
pybullet.changeDynamics(robot, link, mass={number}, localInertiaDiagonal=[i * {number} / mass for i in inertia])"""
_INERTIA = """link = links.get("{element}", -1)
inertia = [i * {number} for i in pybullet.getDynamicsInfo(robot, link)[2]]
pybullet.changeDynamics(robot, link, localInertiaDiagonal=inertia)"""
_SETTERS = {
    "damping": 'pybullet.changeDynamics(robot, joints["{element}"], jointDamping={number})',
    "coulomb_friction": 'pybullet.setJointMotorControl2(robot, joints["{element}"], pybullet.VELOCITY_CONTROL, '
    "targetVelocity=0, force={number})",
    "mass": _MASS,
    "inertia": _INERTIA,
    "friction": _EVERY % "lateralFriction={number}",
    "rolling_friction": _EVERY % "rollingFriction={number}",
    "spinning_friction": _EVERY % "spinningFriction={number}",
    "restitution": _EVERY % "restitution={number}",
}
