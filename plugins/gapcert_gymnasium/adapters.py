"""What is known of environments: their state, their actions, their parameters, and how they are set."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, final

import numpy as np

from gapcert import Array, Parameter, StateSpec, UsageError
from gapcert_engines import Engine

OURS = "gymnasium.envs."


@final
@dataclass(frozen=True)
class Known:
    """An environment: `state` and `action` in order, the attribute that is its period, native parameters (attribute, unit,
    least value) and what follows from them; single: its state is single precision."""

    state: tuple[StateSpec, ...]
    action: tuple[StateSpec, ...]
    period: str | None
    parameters: tuple[tuple[str, str, float], ...] = ()
    levels: Callable[[Any], Mapping[int, float]] | None = None
    follow: Callable[[Any], None] | None = None
    single: bool = False
    forget: Mapping[str, Any] = field(default_factory=dict)


def _cartpole(env: Any) -> None:
    env.total_mass, env.polemass_length = env.masspole + env.masscart, env.masspole * env.length


def _angle(name: str) -> StateSpec:
    return StateSpec(name, "rad", "angle")


_CAR = (StateSpec("position", "1"), StateSpec("velocity", "1"))
CLASSIC: dict[str, Known] = {
    "PendulumEnv": Known(
        (_angle("theta"), StateSpec("theta_dot", "rad/s")),
        (StateSpec("torque", "N*m"),),
        "dt",
        (("g", "m/s^2", -math.inf), ("m", "kg", 1e-9), ("l", "m", 1e-9)),
    ),
    "CartPoleEnv": Known(
        (StateSpec("x", "m"), StateSpec("x_dot", "m/s"), _angle("theta"), StateSpec("theta_dot", "rad/s")),
        (StateSpec("force", "N"),),
        "tau",
        (("gravity", "m/s^2", -math.inf), ("masscart", "kg", 1e-9), ("masspole", "kg", 1e-9), ("length", "m", 1e-9)),
        levels=lambda env: {0: -float(env.force_mag), 1: float(env.force_mag)},
        follow=_cartpole,
        forget={"steps_beyond_terminated": None},
    ),
    "Continuous_MountainCarEnv": Known(_CAR, (StateSpec("force", "1"),), None, (("power", "1", 0.0),), single=True),
    "MountainCarEnv": Known(
        _CAR,
        (StateSpec("force", "1"),),
        None,
        (("force", "1", 0.0), ("gravity", "1", -math.inf)),
        levels=lambda env: {0: -1.0, 1: 0.0, 2: 1.0},
    ),
    "AcrobotEnv": Known(
        (_angle("theta1"), _angle("theta2"), StateSpec("theta1_dot", "rad/s"), StateSpec("theta2_dot", "rad/s")),
        (StateSpec("torque", "N*m"),),
        "dt",
        (
            ("LINK_MASS_1", "kg", 1e-9),
            ("LINK_MASS_2", "kg", 1e-9),
            ("LINK_LENGTH_1", "m", 1e-9),
            ("LINK_COM_POS_1", "m", -math.inf),
            ("LINK_COM_POS_2", "m", -math.inf),
            ("LINK_MOI", "kg*m^2", 1e-9),
        ),
        levels=lambda env: {k: float(v) for k, v in enumerate(env.AVAIL_TORQUE)},
    ),
}
"""By the class of the bare environment. MountainCar counts steps, and has no seconds, metres or newtons."""


class Adapter(ABC):
    """A bare environment: state in, state out. `state` and `action` in order; `rest` is the state's default."""

    state: tuple[StateSpec, ...]
    action: tuple[StateSpec, ...]
    rest: tuple[float, ...]
    parameters: tuple[Parameter, ...] = ()
    levels: Mapping[int, float] | None = None
    single: bool = False
    period: float | None = None

    @abstractmethod
    def adjust(self, values: Mapping[str, float]) -> None:
        """Native parameters, all of them."""

    @abstractmethod
    def step(self, state: Array, action: Any) -> Array:
        """The state after one step of the environment; rewards and ends of episodes are nobody's business here."""

    def set_period(self, period: float) -> None:
        """UsageError where the environment has its own, another one."""
        if self.period is not None and abs(self.period - period) > 1e-12 * period:
            raise UsageError(
                f"backend.period: the environment steps by {self.period:.9g} s; expected that; leave it out, or set the model's"
            )


@final
class Attribute(Adapter):
    """An environment whose whole state is one attribute."""

    def __init__(self, env: Any, known: Known, attribute: str = "state") -> None:
        self.env, self.known, self.attribute = env, known, attribute
        self.state, self.single = known.state, known.single
        self.levels = None if known.levels is None else known.levels(env)
        env.reset(seed=0)
        own: Any = getattr(env, attribute, None)
        size = sum(s.size for s in self.state)
        if own is None or np.shape(own) != (size,):
            raise UsageError(
                f"backend.attribute: '{attribute}' of {type(env).__name__} has shape {np.shape(own)}; expected {size} numbers, "
                f"as many as backend.state has"
            )
        self._type = np.asarray(own).dtype if self.single else np.dtype(np.float64)
        self.rest = (0.0,) * size
        self.action = known.action
        self.parameters = tuple(Parameter(n, float(getattr(env, n)), unit, low=low) for n, unit, low in known.parameters)
        self.period = None if known.period is None else float(getattr(env, known.period))

    def set_period(self, period: float) -> None:
        if self.known.period is not None:
            setattr(self.env, self.known.period, period)

    def adjust(self, values: Mapping[str, float]) -> None:
        for p in self.parameters:
            setattr(self.env, p.name, values[p.name])
        if self.known.follow is not None:
            self.known.follow(self.env)

    def step(self, state: Array, action: Any) -> Array:
        env = self.env
        for name, value in self.known.forget.items():
            setattr(env, name, value)
        setattr(env, self.attribute, state.astype(self._type) if self.single else state.copy())
        env.step(action)
        return np.asarray(getattr(env, self.attribute), dtype=np.float64)


def own(env: Any, attribute: str, state: Sequence[StateSpec], action: Sequence[StateSpec], single: bool) -> Attribute:
    """An environment of the user's whose whole state is one attribute, and whose actions are a box or numbered."""
    found = Attribute(env, Known(tuple(state), tuple(action), None, single=single), attribute)
    space = env.action_space
    if len(action) != (size := int(np.prod(space.shape))):
        raise UsageError(f"backend.action: it names {len(action)} numbers; expected {size}, as the environment's {space} has")
    if type(space).__name__ == "Discrete":
        found.levels = {k: float(k) for k in range(int(space.start), int(space.start + space.n))}
    return found


@final
class MuJoCo(Adapter):
    """Gymnasium's MuJoCo environments: positions and velocities of all joints, set in a simulation that was reset.

    Without that the solver's warm start would carry one query into the next.
    """

    def __init__(self, env: Any) -> None:
        import mujoco

        self.env, self._mujoco = env, mujoco
        model = self.model = env.model
        if model.na or model.nmocap:
            raise UsageError(f"backend.env: {type(env).__name__} has activations or mocap bodies; expected joints alone")
        env.reset(seed=0)
        places, rates, fills = list[StateSpec](), list[StateSpec](), list[float]()
        for j in range(model.njnt):
            name, kind = model.joint(j).name or f"joint{j}", int(model.jnt_type[j])
            at, free = int(model.jnt_qposadr[j]), kind == mujoco.mjtJoint.mjJNT_FREE
            if free:
                places += [StateSpec(f"{name}.{a}", "m") for a in "xyz"]
                rates += [StateSpec(f"{name}.v{a}", "m/s") for a in "xyz"]
            if free or kind == mujoco.mjtJoint.mjJNT_BALL:
                places.append(StateSpec(f"{name}.rotation", "1", "quaternion"))
                rates += [StateSpec(f"{name}.w{a}", "rad/s") for a in "xyz"]
            else:
                turns = kind == mujoco.mjtJoint.mjJNT_HINGE
                endless = turns and not model.jnt_limited[j]
                places.append(StateSpec(f"{name}.position", "rad" if turns else "m", "angle" if endless else "real"))
                rates.append(StateSpec(f"{name}.velocity", "rad/s" if turns else "m/s"))
            count = 7 if free else 4 if kind == mujoco.mjtJoint.mjJNT_BALL else 1
            fills += env.init_qpos[at : at + count].tolist()
        self.state, self.rest = (*places, *rates), (*fills, *(0.0,) * model.nv)
        self.action = tuple(StateSpec(model.actuator(k).name or f"action[{k}]") for k in range(model.nu))
        self.parameters = Engine.gravity_parameters(model.opt.gravity.tolist())
        self.period = float(env.dt)

    def adjust(self, values: Mapping[str, float]) -> None:
        self.model.opt.gravity[:] = [values[f"gravity_{a}"] for a in "xyz"]

    def step(self, state: Array, action: Any) -> Array:
        env, nq = self.env, self.model.nq
        self._mujoco.mj_resetData(self.model, env.data)
        env.set_state(state[:nq], state[nq:])
        env.step(action)
        if env.data.warning[self._mujoco.mjtWarning.mjWARN_BADQACC].number:
            raise UsageError("MuJoCo met an acceleration that is not finite, and began anew; expected a smaller domain")
        return np.concatenate([env.data.qpos, env.data.qvel])
