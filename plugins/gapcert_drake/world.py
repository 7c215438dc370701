"""One Drake plant that holds one robot, or copies of it, and the context that is set in full before every query."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, final

import numpy as np
from pydrake.multibody.tree import RotationalInertia, SpatialInertia
from pydrake.systems.analysis import ResetIntegratorFromFlags, Simulator

from gapcert import Array, UsageError
from gapcert_engines import ABSURD, BodyInertia, Drive, EngineWorld

from .config import FIXED_STEP, DrakeConfig
from .loader import Loaded, listening, load
from .robot import RobotFile


@final
class DrakeWorld(EngineWorld):
    """`copies` of a robot in one plant. Gravity and the ground's friction are a plant's own: other values build a new one."""

    def __init__(self, robot: RobotFile, config: DrakeConfig, copies: int, period: float, drive: Drive | None) -> None:
        if drive is not None and drive.gain is None:
            raise UsageError("backend.drive: Drake has no rate motor of its own; give the drive a gain and a limit")
        self.copies, self.robot, self.config, self.period, self.drive = copies, robot, config, period, drive
        self._values: Mapping[str, float] = {}
        self._plant: tuple[object, ...] = ()

    def close(self) -> None:
        """Leaves the objects to Python's memory management."""

    def set(self, values: Mapping[str, float]) -> None:
        if values == self._values:
            return
        gravity, ground = tuple(values[f"gravity_{a}"] for a in "xyz"), values.get("ground")
        if (gravity, ground) != self._plant:
            self._build(gravity, ground)
            self._plant = gravity, ground
        self._values = dict(values)
        for joints in self._joints:
            for joint in joints:
                joint.SetDampingVector(self._context, [values[f"damping.{joint.name()}"]])
                actuator = self.loaded.actuator(joint)
                rotor = values[f"armature.{joint.name()}"] / actuator.default_gear_ratio() ** 2
                actuator.SetRotorInertia(self._context, rotor)
        for k in range(self.copies):
            for body in self.loaded.heavy(k):
                self._weigh(body, values)

    def advance(
        self, joints: Array, effort: Array, base: Array | None = None, command: Array | None = None
    ) -> tuple[Array, Array | None]:
        n, nj, _ = joints.shape
        blocks, steps = n // self.copies, effort.shape[1]
        nq, nv = self.loaded.plant.num_positions(), self.loaded.plant.num_velocities()
        state, force = np.zeros((blocks, nq + nv)), np.zeros((blocks, steps, nv))
        state[:, self._q] = joints[:, :, 0].reshape(blocks, -1)
        state[:, nq + self._v] = joints[:, :, 1].reshape(blocks, -1)
        force[:, :, self._v] = effort.reshape(blocks, self.copies, steps, nj).transpose(0, 2, 1, 3).reshape(blocks, steps, -1)
        if base is not None:
            # Drake's floating base: a quaternion and a place, then a rate and a velocity, all of the frame, in the world's.
            q, v = self._base
            state[:, q : q + 4], state[:, q + 4 : q + 7] = base[:, 3:7], base[:, :3]
            state[:, nq + v : nq + v + 3], state[:, nq + v + 3 : nq + v + 6] = base[:, 10:], base[:, 7:10]
        after = np.empty_like(state)
        for k in range(blocks):
            try:
                after[k] = self._advance(state[k], force[k], None if command is None else command[k])
            except RuntimeError as error:
                raise self._lost(state[k], str(error)) from None
        if not (np.abs(after) < ABSURD).all():
            raise self._lost(state[int(np.argmax(~(np.abs(after) < ABSURD).all(axis=1)))], "the state has run away")
        out = np.stack([after[:, self._q], after[:, nq + self._v]], axis=-1).reshape(n, nj, 2)
        if base is None:
            return out, None
        turn = after[:, q : q + 4] / np.linalg.norm(after[:, q : q + 4], axis=1, keepdims=True)
        moved = after[:, nq + v : nq + v + 6]
        return out, np.concatenate([after[:, q + 4 : q + 7], turn, moved[:, 3:], moved[:, :3]], axis=1)

    def _build(self, gravity: Sequence[float], ground: float | None) -> None:
        config = self.config
        step = self.period / config.substeps
        self.loaded = load(self.robot, config, self.copies, step if config.discrete else 0.0, gravity, ground)
        plant = self.loaded.plant
        with listening():
            self._root = self.loaded.system.CreateDefaultContext()
        self._context = plant.GetMyMutableContextFromRoot(self._root)
        self._joints = [self.loaded.movable(k) for k in range(self.copies)]
        every = [j for joints in self._joints for j in joints]
        self._q = np.array([j.position_start() for j in every], dtype=np.intp)
        self._v = np.array([j.velocity_start() for j in every], dtype=np.intp)
        self._base = next(((b.floating_positions_start(), b.floating_velocities_start_in_v())
                           for b in self.loaded.floating()), (0, 0))  # fmt: skip
        self._port = plant.get_applied_generalized_force_input_port()
        self._port.FixValue(self._context, np.zeros(plant.num_velocities()))
        self._advance: Callable[[Array, Array, Array | None], Array] = self._discrete if config.discrete else self._continuous
        if not config.discrete:
            self._simulator = Simulator(self.loaded.system, self._root)
            self._forget()

    def _discrete(self, state: Array, force: Array, command: Array | None) -> Array:
        plant, context, targets = self.loaded.plant, self._context, None
        context.SetDiscreteState(state)
        for k in range(self.config.substeps):
            if k < len(force) or command is not None:
                row = force[min(k, len(force) - 1)]
                if command is not None:
                    row, targets = self._driven(k, row, command, state, targets)
                self._port.FixValue(context, row)
            state = plant.EvalUniquePeriodicDiscreteUpdate(context).value()
            if k + 1 < self.config.substeps:
                context.SetDiscreteState(state)
        return state

    def _continuous(self, state: Array, force: Array, command: Array | None) -> Array:
        context, step, targets = self._root, self.period / self.config.substeps, None
        context.SetTime(0.0)
        context.SetContinuousState(state)
        held = command is None and len(force) == 1
        for k in range(1 if held else self.config.substeps):
            row = force[min(k, len(force) - 1)]
            if command is not None:
                row, targets = self._driven(k, row, command, context.get_continuous_state_vector().CopyToVector(), targets)
            self._port.FixValue(self._context, row)
            self._forget()
            self._simulator.Initialize()
            self._simulator.AdvanceTo(self.period if held else (k + 1) * step)
        return np.asarray(context.get_continuous_state_vector().CopyToVector())

    def _forget(self) -> None:
        """A new integrator: the old one remembers how long its last steps were."""
        config, step = self.config, self.period / self.config.substeps
        integrator = ResetIntegratorFromFlags(self._simulator, config.integrator, step)
        integrator.set_maximum_step_size(step)
        if config.integrator in FIXED_STEP:
            integrator.set_fixed_step_mode(True)
        else:
            integrator.set_target_accuracy(config.accuracy)

    def _driven(self, k: int, force: Array, command: Array, state: Array, targets: Any) -> tuple[Array, Any]:
        """The effort with the drive's, and the rates that it is after."""
        drive, nq = self.drive, self.loaded.plant.num_positions()
        assert drive is not None, "commands go to a drive"
        names = [j.name() for j in self._joints[0]]
        at = self._v[[names.index(e) for e in drive.elements]]
        if k % drive.every == 0:
            q, v = self._base
            turn = (state[q : q + 4] / np.linalg.norm(state[q : q + 4])).tolist() if drive.feeds_back else (1.0, 0.0, 0.0, 0.0)
            targets = drive.targets(command, turn, float(state[nq + v + 2]) if drive.feeds_back else 0.0)
        row = force.copy()
        row[at] += drive.effort(targets, state[nq + at])
        return row, targets

    def _weigh(self, body: Any, values: Mapping[str, float]) -> None:
        """A body's inertia, which follows its mass."""
        own, stated = body.default_spatial_inertia(), body_inertia(body)
        wanted = stated.under(values)
        if wanted == stated:
            body.SetSpatialInertiaInBodyFrame(self._context, own)
            return
        full = central(own) * wanted.factor(stated)
        about = RotationalInertia(full[0, 0], full[1, 1], full[2, 2], full[0, 1], full[0, 2], full[1, 2])
        made: Any = SpatialInertia.MakeFromCentralInertia
        body.SetSpatialInertiaInBodyFrame(self._context, made(wanted.mass, np.array(wanted.centre), about))

    def _lost(self, state: Array, reason: str) -> UsageError:
        start = state[self._q][: len(self._joints[0])].tolist()
        return UsageError(
            f"DrakeWorld: one period after positions {start}: {' '.join(reason.split())}; expected a stable simulation; use "
            f"more substeps or a smaller domain"
        )


def central(spatial: Any) -> Array:
    """The inertia (3, 3) about the centre of mass, along the axes of the body."""
    found = spatial.Shift(spatial.get_com()).CalcRotationalInertia().CopyToFullMatrix3()
    return np.asarray(found, dtype=np.float64)


def body_inertia(body: Any) -> BodyInertia:
    """As the file states it."""
    spatial = body.default_spatial_inertia()
    return BodyInertia.of(body.name(), spatial.get_mass(), central(spatial), spatial.get_com())


def state_of(loaded: Loaded) -> tuple[float, ...]:
    """The 13 numbers of a base that floats, in the file's pose; empty where it is fixed."""
    if not (found := loaded.floating()):
        return ()
    pose = loaded.plant.GetDefaultFloatingBaseBodyPose(found[0])
    return (*pose.translation().tolist(), *pose.rotation().ToQuaternion().wxyz().tolist(), *(0.0,) * 6)
