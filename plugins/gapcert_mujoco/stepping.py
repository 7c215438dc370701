"""The two ways in which C code advances many rows: rollouts where nothing can touch, and full states with their warnings.

What a drive moves acts in between: rate motors of joints, and surfaces of geoms.
"""

from __future__ import annotations

import threading
from typing import Any, final

import mujoco
import numpy as np
from mujoco.batch import Batch, SimulationError
from mujoco.rollout import Rollout

from gapcert import Array
from gapcert.plugin import cross
from gapcert_engines import Drive

from .robot import loose

_FORCE = int(mujoco.mjtState.mjSTATE_QFRC_APPLIED)
_PUSHED = _FORCE | int(mujoco.mjtState.mjSTATE_CTRL)
"""Controls of actuators, then forces at joints."""
_NUMBERS = 2**19
"""Numbers of 8 bytes that one call may write."""
_ROWS = 256
"""Rows of one batch."""
HUGE = 1e10
"""Beyond this MuJoCo takes a number for broken."""
_WARNINGS = {
    int(mujoco.mjtWarning.mjWARN_INERTIA): "the mass matrix became singular",
    int(mujoco.mjtWarning.mjWARN_CONTACTFULL): "contacts did not fit into its memory; give the file <size memory>",
    int(mujoco.mjtWarning.mjWARN_CNSTRFULL): "constraints did not fit into its memory; give the file <size memory>",
}


@final
class Broken(Exception):
    """The engine gave up on a row."""

    def __init__(self, row: int, reason: str) -> None:
        super().__init__(reason)
        self.row = row


@final
class Unheard:
    """Keeps warnings off the terminal and out of MuJoCo's log file while any thread steps; they come back as `Broken`."""

    def __init__(self) -> None:
        self._lock, self._inside, self._before = threading.Lock(), 0, None

    def __enter__(self) -> None:
        with self._lock:
            if not self._inside:
                self._before = mujoco.get_mju_user_warning()
                mujoco.set_mju_user_warning(_nothing)
            self._inside += 1

    def __exit__(self, *error: object) -> None:
        with self._lock:
            self._inside -= 1
            if not self._inside:
                mujoco.set_mju_user_warning(self._before)


def _nothing(message: str) -> None:
    """A warning that its counter tells as well."""


unheard = Unheard()
"""MuJoCo has one handler of warnings per process."""


@final
class Rollouts:
    """Rows of a model without constraints: there is no solver, so a state is time, positions and velocities."""

    def __init__(self, model: Any, threads: int) -> None:
        self.model = model
        self._data = [mujoco.MjData(model) for _ in range(threads)]
        self._pool = Rollout(nthread=threads if threads > 1 else 0)
        self._models: list[Any] = []

    def advance(self, state: Array, force: Array, steps: int, command: Array | None = None) -> Array:
        """States (n, 1 + nq + nv) after `steps` steps from time 0 under forces (n, 1 or steps, nu + nv); there is no drive."""
        n, width = state.shape
        after = np.empty_like(state)
        rows = min(n, max(1, _NUMBERS // (steps * (width + force.shape[2]))))
        if len(self._models) < rows:
            self._models = [self.model] * rows
        for k in range(0, n, rows):
            part = state[k : k + rows]
            held = force[k : k + rows]
            if held.shape[1] != steps:
                held = np.repeat(held, steps, axis=1)
            out = after[k : k + rows, None] if steps == 1 else np.empty((len(part), steps, width))
            self._pool.rollout(
                self._models[: len(part)],
                self._data,
                part,
                np.ascontiguousarray(held),
                control_spec=_PUSHED if self.model.nu else _FORCE,
                skip_checks=True,
                nstep=steps,
                state=out,
            )
            if steps > 1:
                after[k : k + rows] = out[:, -1]
        self._check(after, steps)
        return after

    def _check(self, after: Array, steps: int) -> None:
        # A row that breaks stops early; NaN fails every comparison.
        if after.max() < HUGE and after.min() > -HUGE and after[:, 0].min() > (steps - 0.5) * self.model.opt.timestep:
            return
        good = (np.abs(after) < HUGE).all(axis=1) & (after[:, 0] > (steps - 0.5) * self.model.opt.timestep)
        raise Broken(int(np.flatnonzero(~good)[0]), "a number became huge or undefined")

    def close(self) -> None:
        self._pool.close()


@final
class Motors:
    """Elements of a drive in a compiled model: joints follow their target rates through MuJoCo's own velocity actuators, which
    act in every step; geoms take target · (the file's surface velocity) as theirs.

    Without a gain a motor's is 1/(τ [M⁻¹]) at the file's pose, τ the time step: a free joint is at its rate after one step.
    """

    def __init__(self, drive: Drive, model: Any) -> None:
        self.drive = drive
        self._free = next(((one.q, one.v) for one in loose(model, fixed_base=False)), (0, 0))
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


def turned(rotation: Array, v: Array, *, back: bool = False) -> Array:
    """Vectors v (n, 3) turned by unit quaternions (n, 4): from the body's frame into the world's, or `back`."""
    w, r = rotation[:, :1], -rotation[:, 1:] if back else rotation[:, 1:]
    across = cross(r, v)
    return np.asarray(v + 2 * (w * across + cross(r, across)))


@final
class Rows:
    """Rows of any model, each a full state with its own solver memory, surface velocities and warnings; driven in between."""

    def __init__(self, model: Any, threads: int, motors: Motors | None) -> None:
        self.model, self._motors = model, motors
        self._batch = Batch(model, _ROWS, threads)
        self._clean = self._batch.state[0].copy()
        self._position, self._velocity = self._batch.bind("qpos"), self._batch.bind("qvel")
        self._force, self._control = self._batch.bind("qfrc_applied"), self._batch.bind("ctrl")
        belts = motors is not None and len(motors.geoms)
        self._pushed = model.nu if motors is None else 0
        self._surface = self._batch.expand("geom_surfacevel") if belts else None

    def advance(self, state: Array, force: Array, steps: int, command: Array | None = None) -> Array:
        """As `Rollouts.advance`; command (n, m) of the motors."""
        after = np.empty_like(state)
        for k in range(0, len(state), _ROWS):
            rows = slice(k, k + _ROWS)
            part = None if command is None else command[rows]
            try:
                after[rows] = self._block(state[rows], force[rows], steps, part)
            except Broken as broken:
                raise Broken(k + broken.row, str(broken)) from None
        return after

    def _block(self, state: Array, force: Array, steps: int, command: Array | None) -> Array:
        n, nq = len(state), self.model.nq
        batch, rows = self._batch, None if n == _ROWS else np.arange(n, dtype=np.int32)
        # Everything that a query could leave behind: solver memory, time, forces, controls, counters of warnings.
        batch.state[:n] = self._clean
        batch.warning[:n] = 0
        self._position[:n], self._velocity[:n] = state[:, 1 : 1 + nq], state[:, 1 + nq :]
        if self._pushed:
            self._control[:n] = force[:, 0, : self._pushed]
        self._force[:n] = force[:, 0, self._pushed :]
        every = steps if self._motors is None else self._motors.every(steps)
        try:
            for k in range(0, steps, every):
                if self._motors is not None and command is not None:
                    self._command(self._motors, command)
                if force.shape[1] == 1:
                    batch.step(rows, nstep=every)
                else:
                    batch.rollout(every, force[:, k : k + every], _PUSHED if self._pushed else _FORCE, record=(), ids=rows)
        except SimulationError as error:
            raise Broken(int(error.ids[0]), str(error)) from None
        counts = batch.warning[:n, :, 1]
        if counts.any():
            row = int(np.flatnonzero(counts.any(axis=1))[0])
            raise Broken(row, _WARNINGS.get(int(np.flatnonzero(counts[row])[0]), "a number became huge or undefined"))
        return np.concatenate([state[:, :1], self._position[:n], self._velocity[:n]], axis=1)

    def _command(self, motors: Motors, command: Array) -> None:
        n = len(command)
        targets = motors.targets(command, self._position[:n], self._velocity[:n])
        self._control[:n, motors.actuators] = targets[:, motors.joints]
        if self._surface is not None:
            self._surface[:n, motors.geoms] = targets[:, motors.belts, None] * motors.directions

    def close(self) -> None:
        del self._batch
