"""One robot, or copies of it in one body, advanced by PyBullet."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, final

import numpy as np

from gapcert import Array
from gapcert_engines import Drive, EngineWorld

from .client import Client, pybullet

if TYPE_CHECKING:
    from .config import PyBulletConfig
    from .urdf import RobotFile


def fuses(period: float, substeps: int) -> bool:
    """Whether Bullet's own sub-stepping takes exactly `substeps` steps, every time.

    It adds up time and takes int(time / step) steps; only a remainder of exactly zero leaves nothing for the next query.
    """
    step = period / substeps
    return substeps > 1 and int(period / step) == substeps and period - substeps * step == 0


@final
class PyBulletWorld(EngineWorld):
    """Two clients at most: one engine call per sub-step, and one that takes a period's sub-steps in one call."""

    def __init__(self, file: RobotFile, config: PyBulletConfig, copies: int, period: float, drive: Drive | None) -> None:
        self.copies, self.drive = copies, drive
        self._file, self._config, self._period, self._substeps = file, config, period, config.substeps
        self._fusible = fuses(period, config.substeps) and drive is None
        self.clients: dict[bool, Client] = {}
        self._values: Mapping[str, float] = {}

    def set(self, values: Mapping[str, float]) -> None:
        if self._values.get("contact_time", 0.0) > 0 == values.get("contact_time", 0.0):
            self.close()  # Bullet knows no way back from springs in contacts
        self._values = values

    def close(self) -> None:
        for client in self.clients.values():
            client.close()
        self.clients.clear()

    def advance(
        self, joints: Array, effort: Array, base: Array | None = None, command: Array | None = None
    ) -> tuple[Array, Array | None]:
        # Bullet adds joint damping once per call, and takes the strength of motors, here dry friction, for the step of a call:
        # only joints without either get it right inside one fused call.
        damped = any(v for name, v in self._values.items() if name.startswith(("damping.", "coulomb_friction.")))
        fused = self._fusible and effort.shape[1] == 1 and not damped
        client = self._client(fused)
        client.set(self._values)
        if self.drive is not None:
            assert command is not None
            return self._driven(client, self.drive, joints, np.broadcast_to(effort, self._all(effort)), base, command)
        steps = effort if fused else np.broadcast_to(effort, self._all(effort))
        return self._free(client, joints, steps, base)

    def _all(self, effort: Array) -> tuple[int, int, int]:
        return len(effort), self._substeps, effort.shape[2]

    def _client(self, fused: bool) -> Client:
        if fused not in self.clients:
            client = self.clients[fused] = Client(self._file, self._config, self.copies)
            pybullet.setTimeStep(self._period if fused else self._period / self._substeps, client.id)
            if fused:
                pybullet.setPhysicsEngineParameter(numSubSteps=self._substeps, physicsClientId=client.id)
        return self.clients[fused]

    def _free(self, client: Client, joints: Array, effort: Array, base: Array | None) -> tuple[Array, Array | None]:
        """All copies at once: one call each for reset, efforts, step and reading."""
        n, nj, _ = joints.shape
        blocks, width = n // self.copies, self.copies * nj
        # Inner lists of one number: the form that the multi-dof call takes.
        position = joints[:, :, 0].reshape(blocks, width, 1)
        velocity = joints[:, :, 1].reshape(blocks, width, 1)
        many = effort.shape[1]
        steps = effort.reshape(blocks, self.copies, many, nj).transpose(0, 2, 1, 3).reshape(blocks, many, width)
        flat: list[float] = []
        after: list[list[float]] = []
        body, index, number, mode = client.body, client.index, client.id, pybullet.TORQUE_CONTROL
        reset, motors = pybullet.resetJointStatesMultiDof, pybullet.setJointMotorControlArray
        step, read = pybullet.stepSimulation, pybullet.getJointStates
        for k in range(blocks):
            client.forget()
            if base is not None:
                client.set_base(base[k].tolist())
            if index:
                reset(body, index, position[k].tolist(), velocity[k].tolist(), number)
            for forces in steps[k].tolist():
                if index:
                    motors(body, index, mode, forces=forces, physicsClientId=number)
                step(number)
            for s in read(body, index, number) if index else ():
                flat.append(s[0])
                flat.append(s[1])
            if base is not None:
                after.append(client.base())
        return np.array(flat).reshape(n, nj, 2), np.array(after) if base is not None else None

    def _driven(
        self, client: Client, drive: Drive, joints: Array, effort: Array, base: Array | None, command: Array
    ) -> tuple[Array, Array | None]:
        """One robot under its drive: efforts beside servos, whose targets are renewed every `drive.every` sub-steps."""
        out, after = np.empty_like(joints), None if base is None else np.empty_like(base)
        wheels = [client.names.index(name) for name in drive.elements]
        for k in range(len(joints)):
            client.forget()
            if base is not None:
                client.set_base(base[k].tolist())
            client.set_joints(joints[k])
            targets = command[k]
            for s in range(self._substeps):
                if base is not None and drive.feeds_back and s % drive.every == 0:
                    pose = client.base()
                    targets = drive.targets(command[k], pose[3:7], pose[12])
                client.servo(drive, wheels, targets, effort[k, s])
                pybullet.stepSimulation(client.id)
            out[k] = client.joint_states()
            if after is not None:
                after[k] = client.base()
        return out, after
