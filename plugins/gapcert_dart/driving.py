"""The drive in DART: an effort from a gain, or DART's own motors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, final

import numpy as np

from gapcert import Array, UsageError
from gapcert_engines import Drive

from .loader import dartpy

_AHEAD = (1.0, 0.0, 0.0, 0.0)


@final
class Driver:
    """Without a gain the joints get DART's servo motor within the limit, or its velocity motor, which has none."""

    def __init__(self, drive: Drive, skeleton: Any, joints: Sequence[Any], *, floats: bool) -> None:
        self.drive, self.skeleton = drive, skeleton
        names = [j.getName() for j in joints]
        self._columns = [names.index(element) for element in drive.elements]
        self._dofs = [joints[k].getIndexInSkeleton(0) for k in self._columns]
        self._base = skeleton.getRootBodyNode(0) if floats and drive.feeds_back else None
        if drive.gain is None:
            for k in self._columns:
                self._motor(joints[k])

    def check(self, effort: Array) -> None:
        """Refuses forces on a joint that follows DART's own motor, which would pass over them."""
        if self.drive.gain is None and (pushed := effort[:, :, self._columns].any(axis=(0, 1))).any():
            name = self.drive.elements[int(np.argmax(pushed))]
            raise UsageError(
                f"DartWorld: joint '{name}' follows DART's own motor, which takes no force; give the drive a gain and a limit"
            )

    def run(self, world: Any, efforts: Array, command: Array, substeps: int) -> None:
        """All sub-steps of one period under efforts (1 or substeps, dofs)."""
        skeleton, drive, target = self.skeleton, self.drive, command
        limit = np.inf if drive.limit is None else drive.limit
        for k in range(substeps):
            if k % drive.every == 0:
                target = self._targets(command)
            effort = efforts[k if len(efforts) > 1 else 0]
            if drive.gain is None:
                skeleton.setForces(effort)
                for dof, rate in zip(self._dofs, target.tolist(), strict=True):
                    skeleton.setCommand(dof, rate)
            else:
                effort = effort.copy()
                effort[self._dofs] += np.clip(drive.gain * (target - skeleton.getVelocities()[self._dofs]), -limit, limit)
                skeleton.setForces(effort)
            world.step(False)

    def _targets(self, command: Array) -> Array:
        if self._base is None:
            return self.drive.targets(command, _AHEAD, 0.0)
        rotation = self._base.getWorldTransform().quaternion().wxyz()
        return self.drive.targets(command, rotation.tolist(), float(self._base.getAngularVelocity()[2]))

    def _motor(self, joint: Any) -> None:
        limit = self.drive.limit
        kinds = dartpy.dynamics.ActuatorType
        joint.setActuatorType(kinds.VELOCITY if limit is None else kinds.SERVO)
        # DART would cut the command to the file's limits without a word.
        joint.setVelocityLowerLimit(0, -np.inf)
        joint.setVelocityUpperLimit(0, np.inf)
        joint.setForceLowerLimit(0, -np.inf if limit is None else -limit)
        joint.setForceUpperLimit(0, np.inf if limit is None else limit)
