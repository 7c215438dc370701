"""What a drive moves in MuJoCo: rate motors of joints, and surfaces of geoms."""

from __future__ import annotations

from typing import Any, final

import mujoco
import numpy as np

from gapcert import Array
from gapcert.plugin import cross
from gapcert_engines import Drive


@final
class Motors:
    """Elements of a drive in a compiled model: joints follow their target rates through MuJoCo's own velocity actuators, which
    act in every step; geoms take target · (the file's surface velocity) as theirs.

    Without a gain a motor's is 1/(τ [M⁻¹]) at the file's pose, τ the time step: a free joint is at its rate after one step.
    """

    def __init__(self, drive: Drive, model: Any) -> None:
        self.drive = drive
        self._free = floating(model)
        motors = {model.actuator(k).name: k for k in range(model.nu)}
        self.joints = np.array([k for k, name in enumerate(drive.elements) if name in motors], dtype=np.intp)
        self.belts = np.array([k for k, name in enumerate(drive.elements) if name not in motors], dtype=np.intp)
        self.actuators = np.array([motors[drive.elements[k]] for k in self.joints], dtype=np.intp)
        self.geoms = np.array([model.geom(drive.elements[k]).id for k in self.belts], dtype=np.intp)
        self.directions = model.geom_surfacevel[self.geoms].copy()
        for k in self.actuators:
            dof = model.jnt_dofadr[model.actuator_trnid[k, 0]]
            gain = drive.gain if drive.gain is not None else 1 / (model.opt.timestep * model.dof_invweight0[dof])
            model.actuator_gainprm[k, 0], model.actuator_biasprm[k, 2] = gain, -gain

    def every(self, steps: int) -> int:
        """Steps between renewals of the targets, of `steps` in a period."""
        return self.drive.every if self.drive.feeds_back else steps

    def targets(self, command: Array, position: Array, velocity: Array) -> Array:
        """(n, m) from command (n, m), qpos (n, nq) and qvel (n, nv)."""
        if not self.drive.feeds_back:
            return command
        q, v = self._free
        rotation = position[:, q + 3 : q + 7]
        return self.drive.targets(command, tuple(rotation.T), turned(rotation, velocity[:, v + 3 : v + 6])[:, 2])


def floating(model: Any) -> tuple[int, int]:
    """Where the free joint's positions and velocities start."""
    free = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
    return (int(model.jnt_qposadr[free[0]]), int(model.jnt_dofadr[free[0]])) if len(free) else (0, 0)


def turned(rotation: Array, v: Array, *, back: bool = False) -> Array:
    """Vectors v (n, 3) turned by unit quaternions (n, 4): from the body's frame into the world's, or `back`."""
    w, r = rotation[:, :1], -rotation[:, 1:] if back else rotation[:, 1:]
    across = cross(r, v)
    return np.asarray(v + 2 * (w * across + cross(r, across)))
