"""A MuJoCo model that holds one robot, or copies of it, and advances joints and base by one period."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NoReturn, final

import numpy as np
import numpy.typing as npt

from gapcert import Array, UsageError
from gapcert_engines import Drive, EngineWorld

from .parameters import Natives
from .robot import idle, loose, scalar, unconstrained
from .stepping import Broken, Motors, Rollouts, Rows, turned, unheard
from .xla import Compiled

if TYPE_CHECKING:
    from .config import MuJoCoConfig


@final
class MuJoCoWorld(EngineWorld):
    """`many` holds `copies` of the robot that `one` holds; both are models whose time step is set."""

    def __init__(self, one: Any, many: Any, copies: int, config: MuJoCoConfig, drive: Drive | None) -> None:
        self.copies = copies
        self._one, self._many, self._config, self._drive = one, many, config, drive
        self._steps = config.substeps
        self._natives = Natives(one, copies)
        self._motors = Motors(drive, many) if drive is not None else None
        self._unconstrained = unconstrained(one)
        single = scalar(many)
        self._position, self._velocity = many.jnt_qposadr[single], many.jnt_dofadr[single]
        self._floats, self._loose = not single.all(), loose(many, fixed_base=config.fixed_base)
        self._values: dict[str, float] = {}
        self._stepper: Rollouts | Rows | Compiled | None = None
        self._alone: MuJoCoWorld | None = None

    def set(self, values: Mapping[str, float]) -> None:
        if values == self._values:
            return
        if self._config.implementation == "mjx":
            self._load([values])
            self._values = dict(values)
            return
        self.close()
        self._values = dict(values)
        free = self._unconstrained and not self._natives.dry(values)
        if self.copies > 1 and not free:
            # One solver for all copies would stop for all at once: not the bits of one robot.
            self._alone = MuJoCoWorld(self._one, self._one, 1, self._config, self._drive)
            self._alone.set(values)
            return
        model = self._natives.varied(self._many, values)
        if free:
            model.opt.disableflags |= idle(model)
        threads = self._config.threads
        rolls = free and self._motors is None
        self._stepper = Rollouts(model, threads) if rolls else Rows(model, threads, self._motors)

    def set_rows(self, values: Sequence[Mapping[str, float]], rows: npt.NDArray[np.intp]) -> None:
        self._load(values, rows)
        self._values = {}

    def _load(self, values: Sequence[Mapping[str, float]], rows: npt.NDArray[np.intp] | None = None) -> None:
        if not isinstance(self._stepper, Compiled):
            self._stepper = Compiled(self._one, self._natives, self._config.tiles)
        self._stepper.load(values, rows)

    def advance(
        self, joints: Array, effort: Array, base: Array | None = None, command: Array | None = None
    ) -> tuple[Array, Array | None]:
        if self._alone is not None:
            return self._alone.advance(joints, effort)
        assert self._stepper is not None, "parameters are set before the first query"
        state, force = self._state(joints, base), self._force(effort)
        try:
            with unheard:
                after = self._stepper.advance(state, force, self._steps, command)
        except Broken as broken:
            self._complain(broken, joints, effort, base)
        return self._joints(after), None if base is None else self._base(after)

    # To MuJoCo's order and back: a row is time, positions, velocities of all copies

    def _state(self, joints: Array, base: Array | None) -> Array:
        nq, nv = self._many.nq, self._many.nv
        state = np.zeros((len(joints) // self.copies, 1 + nq + nv))
        for part, places, field in ((state[:, 1 : 1 + nq], self._position, 0), (state[:, 1 + nq :], self._velocity, 1)):
            if not self._floats:
                part.reshape(len(state), self.copies, -1)[:] = joints[:, :, field].reshape(len(state), self.copies, -1)
            else:
                part[:, places] = joints[:, :, field]
        if base is None:
            return state
        at = 0
        for one in self._loose:
            q, v, place = 1 + one.q, 1 + nq + one.v, 0 if one.ball else 3
            own = base[:, at : at + place + 4 + place + 3]
            at += own.shape[1]
            rotation = own[:, place : place + 4]
            length = np.linalg.norm(rotation, axis=1, keepdims=True)
            if not length.all():
                row, floats = int(np.flatnonzero(length == 0)[0]), not self._config.fixed_base
                what = "the base" if floats and one is self._loose[0] else one.name
                raise UsageError(f"MuJoCo: the rotation of {what} in row {row} is (0, 0, 0, 0); expected a unit quaternion")
            rotation = rotation / length
            state[:, q : q + place], state[:, q + place : q + place + 4] = own[:, :place], rotation
            state[:, v : v + place] = own[:, place + 4 : -3]
            # MuJoCo turns a free body in its own frame, and moves it in the world's.
            state[:, v + place : v + place + 3] = own[:, -3:] if one.ball else turned(rotation, own[:, -3:], back=True)
        return state

    def _force(self, effort: Array) -> Array:
        """Controls of the actuators of all copies, then forces."""
        n, steps, _ = effort.shape
        nj = len(self._position) // self.copies
        if self.copies > 1:
            effort = effort.reshape(-1, self.copies, steps, effort.shape[2]).swapaxes(1, 2)
        control = effort[..., nj:].reshape(n // self.copies, steps, -1)
        force = effort[..., :nj].reshape(n // self.copies, steps, -1)
        if self._floats:
            force = np.zeros((n, steps, self._many.nv))
            force[:, :, self._velocity] = effort[..., :nj]
        return np.concatenate([control, force], axis=2) if control.shape[2] else force

    def _joints(self, after: Array) -> Array:
        nq, nj = self._many.nq, len(self._position) // self.copies
        joints = np.empty((len(after), len(self._position), 2))
        joints[..., 0] = after[:, 1 + self._position] if self._floats else after[:, 1 : 1 + nq]
        joints[..., 1] = after[:, 1 + nq + self._velocity] if self._floats else after[:, 1 + nq :]
        return joints.reshape(len(after) * self.copies, nj, 2)

    def _base(self, after: Array) -> Array:
        parts, nq = list[Array](), self._many.nq
        for one in self._loose:
            q, v, place = 1 + one.q, 1 + nq + one.v, 0 if one.ball else 3
            pose, rates = after[:, q : q + place + 4], after[:, v : v + place + 3]
            spin = rates[:, place:] if one.ball else turned(pose[:, place:], rates[:, place:])
            parts += [pose, rates[:, :place], spin]
        return np.concatenate(parts, axis=1)

    def _complain(self, broken: Broken, joints: Array, effort: Array, base: Array | None) -> NoReturn:
        rows = slice(broken.row * self.copies, (broken.row + 1) * self.copies)
        worst = rows.start + int(np.argmax(np.abs(joints[rows]).max(axis=(1, 2), initial=0)))
        at = "" if base is None else f", base {base[worst].tolist()}"
        raise UsageError(
            f"MuJoCo: {broken} from positions {joints[worst, :, 0].tolist()}, velocities {joints[worst, :, 1].tolist()}{at}, "
            f"efforts {effort[worst, 0].tolist()}; expected a motion that {self._steps} steps of {self._one.opt.timestep:g} s "
            f"can follow; use more substeps or a smaller domain"
        ) from None

    def close(self) -> None:
        for part in (self._stepper, self._alone):
            if part is not None:
                part.close()
        self._stepper = self._alone = None
        self._values = {}
