"""One PyBullet client that holds one robot, or copies of it in one body: loading, parameters, state in and out."""

from __future__ import annotations

import contextlib
import os
import tempfile
import weakref
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, final

import numpy as np

from gapcert import Array, Parameter, UsageError
from gapcert_engines import BodyInertia, Drive, Joint, muted

if TYPE_CHECKING:
    from .config import PyBulletConfig
    from .urdf import RobotFile


with muted():
    import pybullet as pybullet

JOINTS_AT_MOST = 120
"""Bullet's state arrays hold 128 numbers, seven of them for the base; beyond, it answers wrongly without a word."""

_STRONG = 1e9  # N or N·m: no limit
_CONTACT = {"rolling_friction": "rollingFriction", "spinning_friction": "spinningFriction", "restitution": "restitution"}
"""What PyBullet calls the parameters of contacts."""
_TYPES = {
    pybullet.JOINT_REVOLUTE: "revolute",
    pybullet.JOINT_PRISMATIC: "prismatic",
    pybullet.JOINT_SPHERICAL: "ball",
    pybullet.JOINT_PLANAR: "planar",
    pybullet.JOINT_FIXED: "fixed",
}
Vector = tuple[float, float, float]
Turn = tuple[float, float, float, float]


@final
class Client:
    """`copies` of a robot; `index` holds Bullet's numbers of the movable joints, copy by copy, `names` those of one copy."""

    def __init__(self, file: RobotFile, config: PyBulletConfig, copies: int) -> None:
        self.copies, self._touches, self._fixed = copies, config.touches, config.fixed_base
        self.id = pybullet.connect(pybullet.DIRECT)
        self.close = weakref.finalize(self, _disconnect, self.id)
        self.body = _load(file, config, copies, self.id)
        found = [_joint(pybullet.getJointInfo(self.body, k, self.id)) for k in range(pybullet.getNumJoints(self.body, self.id))]
        if many := next((j for j in found if j.type in ("ball", "planar")), None):
            # Its position is no single number, so it could be neither reset nor declared hidden: the answers would not be pure.
            kind = "spherical" if many.type == "ball" else many.type
            raise UsageError(
                f"backend.robot: joint '{many.name}' is {kind}; expected revolute, continuous, prismatic or fixed joints; "
                f"write it as a chain of those"
            )
        index = {j.name: k for k, j in enumerate(found)}
        self.joints = found if copies == 1 else [j for j in found if j.name.endswith("#0")]
        self.names = [j.name.removesuffix("#0") if copies > 1 else j.name for j in self.joints if j.movable]
        self.index = [index[n if copies == 1 else f"{n}#{k}"] for k in range(copies) for n in self.names]
        for j in self.index:
            # PyBullet starts with a velocity motor in every joint, strong enough to hold it.
            pybullet.setJointMotorControl2(self.body, j, pybullet.VELOCITY_CONTROL, force=0, physicsClientId=self.id)
        pybullet.setPhysicsEngineParameter(
            numSolverIterations=config.solver_iterations,
            solverResidualThreshold=config.solver_residual,
            deterministicOverlappingPairs=1,
            physicsClientId=self.id,
        )
        self._ground: int | None = None
        self._itself = config.self_collision
        if config.ground is not None:
            plane = pybullet.createCollisionShape(pybullet.GEOM_PLANE, physicsClientId=self.id)
            self._ground = pybullet.createMultiBody(0, plane, physicsClientId=self.id)
            pybullet.changeDynamics(self._ground, -1, lateralFriction=config.ground, physicsClientId=self.id)
        self._offset, self._turned = self._inertial()
        self._moving = self._bodies()
        self._stated = self._contact() if self._touches else {}
        self._values: Mapping[str, float] = {}
        self._snapshot = pybullet.saveState(self.id) if self._touches else None

    def forget(self) -> None:
        """Motors start from the last query until a state is restored. Contacts keep points, impulses and axes of one that was
        nearly the same until their pair parts, and are solved in the order in which pairs met, unless pairs are sorted.
        """
        if self._snapshot is None:
            return
        links = range(-1, pybullet.getNumJoints(self.body, self.id))
        for link in links:
            pybullet.setCollisionFilterGroupMask(self.body, link, 0, 0, self.id)
        pybullet.performCollisionDetection(self.id)
        for link in links:
            group, mask = (2, -3) if link < 0 and self._fixed else (1, -1)  # as Bullet has them: a fixed base meets what moves
            pybullet.setCollisionFilterGroupMask(self.body, link, group, mask, self.id)
        pybullet.restoreState(self._snapshot, physicsClientId=self.id)

    def set(self, values: Mapping[str, float]) -> None:
        """Gravity, damping, friction and masses, by the engine's parameter names."""
        if values == self._values:
            return
        old = self._values
        pybullet.setGravity(values["gravity_x"], values["gravity_y"], values["gravity_z"], self.id)
        pybullet.changeDynamics(
            self.body,
            -1,
            linearDamping=values["linear_damping"],
            angularDamping=values["angular_damping"],
            physicsClientId=self.id,
        )
        for index, name in zip(self.index, self.names * self.copies, strict=True):
            pybullet.changeDynamics(self.body, index, jointDamping=values[f"damping.{name}"], physicsClientId=self.id)
            if (dry := values.get(f"coulomb_friction.{name}", 0.0)) != old.get(f"coulomb_friction.{name}", 0.0):
                # A motor that wants rest and is this strong; how strong in impulse, Bullet works out now, of the time step.
                mode, joint = pybullet.VELOCITY_CONTROL, {"force": dry, "physicsClientId": self.id}
                pybullet.setJointMotorControl2(self.body, index, mode, targetVelocity=0, **joint)
        for index, own, moments in self._moving:
            if (new := own.under(values)) != own.under(old):
                scaled = {"mass": new.mass, "localInertiaDiagonal": [m * new.factor(own) for m in moments]}
                pybullet.changeDynamics(self.body, index, physicsClientId=self.id, **scaled)
        if "friction" in values and values["friction"] != self._values.get("friction", self.friction()):
            for link in range(-1, pybullet.getNumJoints(self.body, self.id)):
                pybullet.changeDynamics(self.body, link, lateralFriction=values["friction"], physicsClientId=self.id)
        for name, key in _CONTACT.items():
            if name in values and values[name] != self._values.get(name, self._stated[name]):
                self._touch(key, values[name])
        if (time := values.get("contact_time", 0.0)) != old.get("contact_time", 0.0):
            self._soften(time)
        self._values = dict(values)

    def masses(self) -> list[BodyInertia]:
        """Of the links that move, of all copies."""
        return [own for _, own, _ in self._moving]

    def _bodies(self) -> list[tuple[int, BodyInertia, tuple[float, ...]]]:
        """(number, inertia, moments about the inertia's axes) of links with mass that something moves."""
        moved, found = [not self._fixed], list[tuple[int, BodyInertia, tuple[float, ...]]]()
        for k in range(-1, pybullet.getNumJoints(self.body, self.id)):
            if k < 0:
                name = pybullet.getBodyInfo(self.body, self.id)[0]
            else:
                info = pybullet.getJointInfo(self.body, k, self.id)
                name = info[12]
                moved.append(moved[info[16] + 1] or info[2] != pybullet.JOINT_FIXED)
            mass, _, moments, *_ = pybullet.getDynamicsInfo(self.body, k, self.id)
            if moved[-1] and mass > 0:
                title = name.decode() if self.copies == 1 else name.decode().rpartition("#")[0]
                found.append((k, BodyInertia(title, mass, max(moments)), moments))
        return found

    def contact(self) -> list[Parameter]:
        """What decides contacts besides friction, as stated; rates of turning are braked by coefficient · normal force."""
        restitution = Parameter("restitution", 0.0, low=0.0, high=1.0)
        frictions = [Parameter(n, v, "m", low=0.0) for n, v in self._stated.items() if n != "restitution"]
        springs = [Parameter("contact_time", 0.0, "s", low=0.0)] if self._ground is not None else []
        return frictions + ([restitution] if "restitution" in self._stated else []) + springs

    def _contact(self) -> dict[str, float]:
        """Stated values. A contact has the product of both restitutions, and the ground's own is 0: so is that of contacts."""
        links = range(-1, pybullet.getNumJoints(self.body, self.id))
        known = [pybullet.getDynamicsInfo(self.body, k, self.id) for k in links]
        out = {n: float(known[0][place]) for n, place in (("rolling_friction", 6), ("spinning_friction", 7))}
        bounces = self._ground is not None and not (self._itself and any(k[5] for k in known))
        return out | ({"restitution": 0.0} if bounces else {})

    def _touch(self, key: str, value: float) -> None:
        for link in range(-1, pybullet.getNumJoints(self.body, self.id)):
            pybullet.changeDynamics(self.body, link, physicsClientId=self.id, **{key: value})
        if key == "restitution":
            pybullet.changeDynamics(self._ground, -1, restitution=1.0, physicsClientId=self.id)

    def _soften(self, time: float) -> None:
        """Contacts become springs that bring all of the robot's mass to rest in this time constant, critically damped."""
        mass = sum(own.mass for own in self.masses())
        spring = {"contactStiffness": mass / time**2, "contactDamping": 2 * mass / time}
        for link in range(-1, pybullet.getNumJoints(self.body, self.id)):
            pybullet.changeDynamics(self.body, link, physicsClientId=self.id, **spring)

    def friction(self) -> float:
        """The lateral friction of the root link."""
        return float(pybullet.getDynamicsInfo(self.body, -1, self.id)[1])

    # State

    def base(self) -> list[float]:
        """Position, rotation (w, x, y, z), velocity and rate of the base link's frame, in the world's frame."""
        position, turn = pybullet.getBasePositionAndOrientation(self.body, self.id)
        velocity, rate = pybullet.getBaseVelocity(self.body, self.id)
        if self._offset is not None:
            # Bullet speaks of the centre of mass and of the inertia's axes: back to the link's frame.
            turn = product(turn, inverse(self._turned))
            origin = np.subtract(position, rotated(turn, self._offset)).tolist()
            velocity = np.add(velocity, np.cross(rate, np.subtract(origin, position))).tolist()
            position = origin
        x, y, z, w = turn
        return [*position, w, x, y, z, *velocity, *rate]

    def set_base(self, b: list[float]) -> None:
        """Inverse of `base`."""
        position, (w, x, y, z), velocity, rate = b[:3], b[3:7], b[7:10], b[10:]
        turn = (x, y, z, w)
        if self._offset is not None:
            centre = np.add(position, rotated(turn, self._offset)).tolist()
            turn = product(turn, self._turned)
            velocity = np.add(velocity, np.cross(rate, np.subtract(centre, position))).tolist()
            position = centre
        pybullet.resetBasePositionAndOrientation(self.body, position, turn, self.id)
        pybullet.resetBaseVelocity(self.body, velocity, rate, self.id)

    def set_joints(self, joints: Array) -> None:
        """joints (nj, 2)."""
        if self.index:
            position, velocity = joints.T.reshape(2, -1, 1).tolist()
            pybullet.resetJointStatesMultiDof(self.body, self.index, position, velocity, self.id)

    def joint_states(self) -> Array:
        """(nj, 2): positions and velocities."""
        states = pybullet.getJointStates(self.body, self.index, self.id) if self.index else ()
        return np.array([s[:2] for s in states]).reshape(-1, 2)

    def poses(self, position: Array, base: Array | None) -> tuple[list[str], Array]:
        """Names of the links, and their frames (n, links, 7) at rest in positions (n, nj) and places of the base (n, 13)."""
        number = pybullet.getNumJoints(self.body, self.id)
        names = [pybullet.getBodyInfo(self.body, self.id)[0].decode()]
        names += [pybullet.getJointInfo(self.body, k, self.id)[12].decode() for k in range(number)]
        poses = np.empty((len(position), len(names), 7))
        for k, row in enumerate(position):
            if base is not None:
                self.set_base([*base[k, :7].tolist(), *[0.0] * 6])
            self.set_joints(np.column_stack([row, np.zeros_like(row)]))
            poses[k, 0] = self.base()[:7]
            for j, link in enumerate(pybullet.getLinkStates(self.body, range(number), 0, 1, self.id) if number else ()):
                x, y, z, w = link[5]
                poses[k, 1 + j] = [*link[4], w, x, y, z]
        return names, poses

    def servo(self, drive: Drive, wheels: list[int], targets: Array, effort: Array) -> None:
        """Efforts for one sub-step: those given, and on the wheels what their servos add (or a rate motor in their place)."""
        body, number, index = self.body, self.id, [self.index[k] for k in wheels]
        forces = effort.copy()
        if drive.gain is not None:
            rates = np.array([s[1] for s in pybullet.getJointStates(body, index, number)])
            forces[wheels] += drive.effort(targets, rates)
        pybullet.setJointMotorControlArray(
            body, self.index, pybullet.TORQUE_CONTROL, forces=forces.tolist(), physicsClientId=number
        )
        if drive.gain is None:
            limit = _STRONG if drive.limit is None else drive.limit
            pybullet.setJointMotorControlArray(
                body,
                index,
                pybullet.VELOCITY_CONTROL,
                targetVelocities=targets.tolist(),
                forces=[limit] * len(index),
                physicsClientId=number,
            )

    def _inertial(self) -> tuple[Any, Any]:
        """The base's inertial frame seen from its link frame; (None, …) where they are the same."""
        _, _, _, offset, turn, *_ = pybullet.getDynamicsInfo(self.body, -1, self.id)
        same = offset == (0.0, 0.0, 0.0) and turn == (0.0, 0.0, 0.0, 1.0)
        return (None, turn) if same else (offset, turn)


def _joint(info: Any) -> Joint:
    # Bullet's mark for "no limits" is an upper one below the lower one.
    kind: Any = _TYPES.get(info[2], "other")
    joint = Joint(info[1].decode(), kind, damping=info[6])
    return replace(joint, limited=True, ends=(info[8], info[9])) if info[8] <= info[9] else joint


def _load(file: RobotFile, config: PyBulletConfig, copies: int, client: int) -> int:
    flags = pybullet.URDF_USE_INERTIA_FROM_FILE if config.use_inertia_from_file else 0
    flags |= pybullet.URDF_USE_SELF_COLLISION if config.self_collision else 0
    shapes = config.touches or not config.use_inertia_from_file
    if file.path.is_file() and file.path.read_bytes() != file.content:
        raise UsageError(f"robot: {file.path} has changed since it was read; run again")
    with tempfile.TemporaryDirectory() as folder, muted() as said:
        path = str(file.path)
        if copies > 1 or not file.limits:
            path = os.path.join(folder, "written.urdf")
            with open(path, "w", encoding="utf-8") as text:
                text.write(file.tiled(copies) if copies > 1 else file.text(shapes=shapes))
        try:
            body = pybullet.loadURDF(path, useFixedBase=config.fixed_base, flags=flags, physicsClientId=client)
        except pybullet.error:
            body = None
    if body is None:
        message = " ".join(said[0].split())
        raise UsageError(f"robot: PyBullet cannot load {file.path}: {message}; expected a valid URDF file")
    return int(body)


def _disconnect(client: int) -> None:
    # An engine that is gone already (at exit, or closed by hand) is what is wanted.
    with contextlib.suppress(pybullet.error):
        pybullet.disconnect(client)


# Unit quaternions (x, y, z, w) as Bullet writes them; its own helpers of Python compute in single precision


def inverse(turn: Sequence[float]) -> Turn:
    """The turn back."""
    x, y, z, w = turn
    return -x, -y, -z, w


def product(a: Sequence[float], b: Sequence[float]) -> Turn:
    """First b, then a."""
    (x, y, z, w), (p, q, r, s) = a, b
    return (
        w * p + x * s + y * r - z * q,
        w * q - x * r + y * s + z * p,
        w * r + x * q - y * p + z * s,
        w * s - x * p - y * q - z * r,
    )


def rotated(turn: Sequence[float], v: Sequence[float]) -> Vector:
    """v turned: v + 2 w (n × v) + 2 n × (n × v) with n = (x, y, z)."""
    x, y, z, w = turn
    a, b, c = 2 * (y * v[2] - z * v[1]), 2 * (z * v[0] - x * v[2]), 2 * (x * v[1] - y * v[0])
    return v[0] + w * a + y * c - z * b, v[1] + w * b + z * a - x * c, v[2] + w * c + x * b - y * a
