"""One PyBullet client that holds one robot, or copies of it in one body, and advances its joints."""

from __future__ import annotations

import contextlib
import ctypes
import os
import sys
import tempfile
import weakref
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, final

import numpy as np
import numpy.typing as npt

from gapcert import UsageError

if TYPE_CHECKING:
    from gapcert_pybullet.config import PyBulletConfig
    from gapcert_pybullet.urdf import RobotFile

Array = npt.NDArray[np.float64]


@contextlib.contextmanager
def muted() -> Iterator[list[str]]:
    """Collects what C code prints on file descriptors 1 and 2, where a program's own output must stay clean."""
    said: list[str] = []
    libc = ctypes.CDLL(None)
    sys.stdout.flush()
    sys.stderr.flush()
    libc.fflush(None)
    saved = os.dup(1), os.dup(2)
    with tempfile.TemporaryFile() as sink:
        os.dup2(sink.fileno(), 1)
        os.dup2(sink.fileno(), 2)
        try:
            yield said
        finally:
            libc.fflush(None)
            for number, copy in zip((1, 2), saved, strict=True):
                os.dup2(copy, number)
                os.close(copy)
            sink.seek(0)
            said.append(sink.read().decode(errors="replace").strip())


with muted():
    import pybullet

JOINTS_AT_MOST = 120
"""Bullet's state arrays hold 128 numbers, seven of them for the base; beyond, it answers wrongly without a word."""

_SCALAR = {pybullet.JOINT_REVOLUTE: "revolute", pybullet.JOINT_PRISMATIC: "prismatic"}
_OTHER = {pybullet.JOINT_SPHERICAL: "spherical", pybullet.JOINT_PLANAR: "planar", pybullet.JOINT_FIXED: "fixed"}


@final
@dataclass(frozen=True)
class Joint:
    """A joint of the loaded robot; `damping` as the file states it."""

    name: str
    index: int
    type: str
    damping: float
    limited: bool

    @property
    def movable(self) -> bool:
        return self.type in _SCALAR.values()


@final
class World:
    """`copies` of a robot, advanced together. One engine step lasts `period` (or `period / fused` with `fused` sub-steps)."""

    def __init__(self, file: RobotFile, config: PyBulletConfig, copies: int, period: float, fused: int) -> None:
        self.copies, self.snapshot = copies, None
        self.client = pybullet.connect(pybullet.DIRECT)
        self.close = weakref.finalize(self, _disconnect, self.client)
        self.body, self.messages = _load(file, config, copies, self.client)
        pybullet.setTimeStep(period, self.client)
        if fused > 1:
            pybullet.setPhysicsEngineParameter(numSubSteps=fused, physicsClientId=self.client)
        found = [_joint(pybullet.getJointInfo(self.body, k, self.client)) for k in range(self._count())]
        if many := next((j for j in found if j.type in ("spherical", "planar")), None):
            # Its position is no single number, so it could be neither reset nor declared hidden: the answers would not be pure.
            raise UsageError(
                f"backend.robot: joint '{many.name}' is {many.type}; expected revolute, continuous, prismatic or fixed joints; "
                f"write it as a chain of those"
            )
        index = {j.name: j.index for j in found}
        self.joints = found if copies == 1 else [j for j in found if j.name.endswith("#0")]
        self._names = [j.name.removesuffix("#0") if copies > 1 else j.name for j in self.joints if j.movable]
        self._index = [index[n if copies == 1 else f"{n}#{k}"] for k in range(copies) for n in self._names]
        for j in self._index:
            # PyBullet starts with a velocity motor in every joint, strong enough to hold it.
            pybullet.setJointMotorControl2(self.body, j, pybullet.VELOCITY_CONTROL, force=0, physicsClientId=self.client)
        self._values: Mapping[str, float] = {}
        if config.self_collision:
            self.snapshot = pybullet.saveState(self.client)

    def _count(self) -> int:
        return int(pybullet.getNumJoints(self.body, self.client))

    def set(self, values: Mapping[str, float]) -> None:
        """Gravity and damping, by the backend's parameter names."""
        if values == self._values:
            return
        pybullet.setGravity(values["gravity_x"], values["gravity_y"], values["gravity_z"], self.client)
        pybullet.changeDynamics(
            self.body,
            -1,
            linearDamping=values["linear_damping"],
            angularDamping=values["angular_damping"],
            physicsClientId=self.client,
        )
        for index, name in zip(self._index, self._names * self.copies, strict=True):
            pybullet.changeDynamics(self.body, index, jointDamping=values[f"damping.{name}"], physicsClientId=self.client)
        self._values = dict(values)

    def base(self) -> list[float]:
        """Position, rotation (w, x, y, z), velocity and rate of the base link's centre of mass."""
        position, (x, y, z, w) = pybullet.getBasePositionAndOrientation(self.body, self.client)
        velocity, rate = pybullet.getBaseVelocity(self.body, self.client)
        return [*position, w, x, y, z, *velocity, *rate]

    def set_base(self, b: list[float]) -> None:
        w, x, y, z = b[3:7]
        pybullet.resetBasePositionAndOrientation(self.body, b[:3], (x, y, z, w), self.client)
        pybullet.resetBaseVelocity(self.body, b[7:10], b[10:], self.client)

    def advance(self, joints: Array, torque: Array, base: Array | None = None) -> tuple[Array, Array | None]:
        """From positions and velocities (n, nj, 2) under torques (n, engine steps, nj); n is a multiple of `copies`.

        The base (n, 13) is given where it floats.
        """
        n, nj, _ = joints.shape
        blocks, width = n // self.copies, self.copies * nj
        # Inner lists of one number: the form that the multi-dof call takes.
        position = joints[:, :, 0].reshape(blocks, width, 1)
        velocity = joints[:, :, 1].reshape(blocks, width, 1)
        steps = torque.reshape(blocks, self.copies, -1, nj).transpose(0, 2, 1, 3).reshape(blocks, -1, width)
        flat: list[float] = []
        after: list[list[float]] = []
        body, index, client, mode = self.body, self._index, self.client, pybullet.TORQUE_CONTROL
        reset, motors = pybullet.resetJointStatesMultiDof, pybullet.setJointMotorControlArray
        step, read = pybullet.stepSimulation, pybullet.getJointStates
        for k in range(blocks):
            if self.snapshot is not None:
                # Contacts warm-start from the last query; only a restored state forgets them.
                pybullet.restoreState(self.snapshot, physicsClientId=client)
            if base is not None:
                self.set_base(base[k].tolist())
            reset(body, index, position[k].tolist(), velocity[k].tolist(), client)
            for forces in steps[k].tolist():
                motors(body, index, mode, forces=forces, physicsClientId=client)
                step(client)
            for s in read(body, index, client):
                flat.append(s[0])
                flat.append(s[1])
            if base is not None:
                after.append(self.base())
        return np.array(flat).reshape(n, nj, 2), np.array(after) if base is not None else None


def _joint(info: Any) -> Joint:
    # Bullet's mark for "no limits" is an upper one below the lower one.
    kind = {**_SCALAR, **_OTHER}.get(info[2], "unknown")
    return Joint(info[1].decode(), info[0], kind, damping=info[6], limited=info[8] <= info[9])


def _load(file: RobotFile, config: PyBulletConfig, copies: int, client: int) -> tuple[int, str]:
    flags = pybullet.URDF_USE_INERTIA_FROM_FILE if config.use_inertia_from_file else 0
    flags |= pybullet.URDF_USE_SELF_COLLISION if config.self_collision else 0
    if file.path.is_file() and file.path.read_bytes() != file.content:
        raise UsageError(f"robot: {file.path} has changed since it was read; run again")
    with tempfile.TemporaryDirectory() as folder, muted() as said:
        path = str(file.path)
        if copies > 1:
            path = os.path.join(folder, "tiled.urdf")
            with open(path, "w", encoding="utf-8") as text:
                text.write(file.tiled(copies))
        try:
            body = pybullet.loadURDF(path, useFixedBase=config.fixed_base, flags=flags, physicsClientId=client)
        except pybullet.error:
            body = None
    if body is None:
        message = " ".join(said[0].split())
        raise UsageError(f"robot: PyBullet cannot load {file.path}: {message}; expected a valid URDF file")
    return body, said[0]


def _disconnect(client: int) -> None:
    # An engine that is gone already (at exit, or closed by hand) is what is wanted.
    with contextlib.suppress(pybullet.error):
        pybullet.disconnect(client)
