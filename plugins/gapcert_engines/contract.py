"""What a physics engine's plugin supplies: a description of the robot, and worlds that advance it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Literal, final

import numpy as np
import numpy.typing as npt

from gapcert.plugin import Array, Parameter, Scene, StateSpec, UsageError

from .config import FEEDBACK, DriveConfig, EngineConfig
from .robot.links import NATIVE, NATIVE_UNITS, Link, as_section

JointType = Literal["revolute", "prismatic", "fixed", "ball", "planar", "free", "other"]

_PLACE = tuple(StateSpec(f"base.{a}", "m") for a in "xyz")
_MOTION = (*(StateSpec(f"base.v{a}", "m/s") for a in "xyz"), *(StateSpec(f"base.w{a}", "rad/s") for a in "xyz"))
BASE = (*_PLACE, StateSpec("base.rotation", "1", "quaternion"), *_MOTION)
"""A base that floats, as worlds order it: position, rotation (w, x, y, z), velocity, rate; all in the world's frame."""
BASE_EULER = (*_PLACE, *(StateSpec(f"base.{a}", "rad", "angle") for a in ("roll", "pitch", "yaw")), *_MOTION)
"""The same with rotation = turns about the fixed axes x, y, z in this order."""


def body_columns(name: str) -> tuple[StateSpec, ...]:
    """Of a free body, as of a base that floats."""
    return tuple(StateSpec(f"{name}.{s.name.removeprefix('base.')}", s.unit, s.kind) for s in BASE)


def ball_columns(name: str) -> tuple[StateSpec, ...]:
    """Of a ball joint: rotation (w, x, y, z), and rate in the frame of what it carries."""
    return StateSpec(f"{name}.rotation", "1", "quaternion"), *(StateSpec(f"{name}.w{a}", "rad/s") for a in "xyz")


ENDLESS = (-float("inf"), float("inf"))
ABSURD = 1e100
"""No position or velocity of a robot, in any unit; its square is still finite."""
LIGHTEST = 1e-9
"""kg; a body without any mass makes its joint's acceleration undefined."""


@final
@dataclass(frozen=True)
class Joint:
    """A joint of the loaded robot; `damping` and position at `rest` as the file states them, `limited` where it has an end.

    ends, speeds, efforts: between what the engine holds its position and velocity, and to what it cuts its effort.
    """

    name: str
    type: JointType
    damping: float = 0.0
    limited: bool = False
    rest: float = 0.0
    ends: tuple[float, float] = ENDLESS
    speeds: tuple[float, float] = ENDLESS
    efforts: tuple[float, float] = ENDLESS

    @property
    def movable(self) -> bool:
        """Has it one position and one velocity?"""
        return self.type in ("revolute", "prismatic")


@final
@dataclass(frozen=True)
class Motor:
    """An actuator of the file that is an effort gear · control at one joint; the control is cut to `controls`."""

    name: str
    joint: str
    gear: float
    controls: tuple[float, float] = ENDLESS


@final
@dataclass(frozen=True)
class Law:
    """The effort of an actuator at one joint, gear · clip(gain · c + offset + position · l + velocity · l̇, forces), with c its
    control, cut to `controls`, and l = gear · q.

    held: where nothing is cut, what it takes from the rate is solved with the step.
    """

    joint: str
    gear: float
    gain: float
    offset: float = 0.0
    position: float = 0.0
    velocity: float = 0.0
    controls: tuple[float, float] = ENDLESS
    forces: tuple[float, float] = ENDLESS
    held: bool = False

    @property
    def commands(self) -> Literal["position", "velocity", "effort"]:
        """What its control is: where it pulls the joint to, how fast, or how much."""
        if self.gain and self.position == -self.gain:
            return "position"
        return "velocity" if self.gain and not self.position and self.velocity == -self.gain else "effort"


@final
@dataclass(frozen=True)
class Actuator:
    """An actuator that stays in the engine: it turns its control, whose unit is stated, into forces in every sub-step.

    law: of one at a joint that equations can have; None of any other, such as a propeller fixed to a body.
    """

    name: str
    unit: str
    law: Law | None = None


@final
@dataclass(frozen=True)
class BodyInertia:
    """A body's mass (kg), largest principal moment of inertia (kg·m²), the others in proportion, and centre of mass (m)."""

    name: str
    mass: float
    moment: float = 0.0
    centre: tuple[float, ...] = ()

    @classmethod
    def of(cls, name: str, mass: float, inertia: Array, centre: Array) -> BodyInertia:
        """From the inertia (3, 3) about the centre of mass (3,)."""
        return cls(name, float(mass), float(np.linalg.eigvalsh(inertia)[-1]), tuple(np.asarray(centre).tolist()))

    def parameters(self, lightest: float | None = LIGHTEST) -> list[Parameter]:
        """`mass.BODY`, and where there are any `inertia.BODY` and `com_x.BODY`, `_y`, `_z`.

        lightest: kg; None: between a thousandth and a thousand times the mass, as always for the moment.
        """
        mass, moment = self.mass, self.moment
        low, high = (1e-3 * mass, 1e3 * mass) if lightest is None else (lightest, np.inf)
        out = [Parameter(f"mass.{self.name}", mass, "kg", low=low, high=high)]
        if moment > 0:
            out.append(Parameter(f"inertia.{self.name}", moment, "kg*m^2", low=1e-3 * moment, high=1e3 * moment))
        return out + [Parameter(f"com_{a}.{self.name}", c, "m") for a, c in zip("xyz", self.centre, strict=False)]

    def under(self, values: Mapping[str, float]) -> BodyInertia:
        """As native parameters have it; its moment is that at the stated mass."""
        centre = (values.get(f"com_{a}.{self.name}", c) for a, c in zip("xyz", self.centre, strict=False))
        mass, moment = values.get(f"mass.{self.name}", self.mass), values.get(f"inertia.{self.name}", self.moment)
        return BodyInertia(self.name, mass, moment, tuple(centre))

    def factor(self, stated: BodyInertia) -> float:
        """Of the stated inertia, which follows the mass."""
        return self.mass / stated.mass * (self.moment / stated.moment if self.moment != stated.moment else 1.0)


@final
@dataclass(frozen=True)
class Drive:
    """target (m,) = mixing (m, nu) · commands + yaw · heading + yaw_rate · turning rate; see DriveConfig."""

    elements: tuple[str, ...]
    mixing: Array
    yaw: Array
    yaw_rate: Array
    gain: float | None
    limit: float | None
    every: int

    @classmethod
    def of(cls, config: DriveConfig, inputs: Sequence[str]) -> Drive:
        """With the columns of `mixing` in the order of `inputs`."""

        def column(name: str) -> list[float]:
            return [row.get(name, 0.0) for row in config.elements.values()]

        mixing = np.array([column(name) for name in inputs]).reshape(len(inputs), -1).T
        yaw, rate = (np.array(column(name)) for name in FEEDBACK)
        return cls(tuple(config.elements), mixing, yaw, rate, config.gain, config.limit, config.every)

    @property
    def feeds_back(self) -> bool:
        return bool(self.yaw.any() or self.yaw_rate.any())

    def commands(self, u: Array) -> Array:
        """mixing · u, (n, nu) → (n, m), summed input by input: a matrix product's bits depend on the batch."""
        out = np.zeros((len(u), len(self.elements)))
        for j in range(u.shape[1]):
            out += u[:, j : j + 1] * self.mixing[:, j]
        return out

    def targets(self, command: Array, rotation: Sequence[Array | float], turning: Array | float) -> Array:
        """Rates (m,) or (n, m) from `command` = mixing · inputs of that shape, the base's rotation (w, x, y, z) and rate about
        the vertical: numbers, or n of each."""
        w, x, y, z = (np.asarray(part) for part in rotation)
        heading = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        return np.asarray(command + self.yaw * heading[..., None] + self.yaw_rate * np.asarray(turning)[..., None])

    def effort(self, targets: Array, rates: Array) -> Array:
        """clip(gain · (targets − rates), ±limit) of a drive with a gain."""
        assert self.gain is not None, "without a gain the engine's own rate motors follow"
        limit = np.inf if self.limit is None else self.limit
        return np.clip(self.gain * (targets - rates), -limit, limit)


class EngineWorld(ABC):
    """`copies` of a robot in one simulation, advanced together; holds native objects, so it is never pickled."""

    copies: int

    @abstractmethod
    def set(self, values: Mapping[str, float]) -> None:
        """The engine's native parameters, all of them, by name."""

    def set_rows(self, values: Sequence[Mapping[str, float]], rows: npt.NDArray[np.intp]) -> None:
        """Those of the next `advance`, row by row: row k has values[rows[k]]. Of engines that are `rowwise`."""
        raise TypeError(f"{type(self).__name__} has one set of native parameters for all rows")

    @abstractmethod
    def advance(
        self, joints: Array, effort: Array, base: Array | None = None, command: Array | None = None
    ) -> tuple[Array, Array | None]:
        """One period: (joints, base) afterwards, as new arrays.

        joints (n, nj, 2): position and velocity of the movable joints, n a multiple of `copies`; effort (n, 1, nj + nt), held,
        or (n, substeps, nj + nt): at the joints, and the controls of nt actuators; base (n, ·): 13 numbers as BASE orders them,
        where it floats, then those of `Engine.beside`; command (n, m): mixing · inputs of the drive.
        The answer for a row must not depend on earlier rows: every query starts from a state that is set in full.
        """

    @abstractmethod
    def close(self) -> None:
        """Gives the native objects back."""


class Engine(ABC):
    """A robot in a physics engine, described by plain data (it is pickled), and the worlds that step it.

    joints: all of them, in the engine's order; base: 13 default numbers where it floats, else empty; beside: what moves
    besides, free bodies and ball joints, and its default numbers; parameters: what `EngineWorld.set` takes, with the stated
    values; motors: at most one per joint; actuators: those that inputs name, where they are no motors; served: joints that
    the file drives by what is no motor, and by which; rowwise: its worlds take native parameters row by row as well,
    `EngineWorld.set_rows`, so that queries which differ in them share a batch; unsolved: the change of a state per second
    that a solver of constraints may leave undone; integrator: of its equations, see `as_section`; friction_after: their dry
    friction does not feel damping that is solved with the step; springs_held: where damping is solved with the step, so are
    springs.
    """

    config: EngineConfig
    file: str
    joints: tuple[Joint, ...]
    base: tuple[float, ...] = ()
    beside: tuple[StateSpec, ...] = ()
    beside_default: tuple[float, ...] = ()
    parameters: tuple[Parameter, ...] = ()
    motors: tuple[Motor, ...] = ()
    actuators: tuple[Actuator, ...] = ()
    served: Mapping[str, str] = MappingProxyType({})
    rowwise: bool = False
    unsolved: float = 0.0
    integrator: str = "semi_implicit"
    friction_after: bool = False
    springs_held: bool = True

    @abstractmethod
    def open(self, copies: int, period: float, drive: Drive | None) -> EngineWorld:
        """A world of `copies` robots whose `advance` lasts `period` seconds, in `config.substeps` engine steps."""

    @abstractmethod
    def digest_data(self) -> list[object]:
        """JSON-able: the engine's version and everything in the files that determines the answers (the config is added)."""

    @property
    def loose(self) -> tuple[float, ...]:
        """Default numbers of all that is no joint of one number: the base, and what moves besides."""
        return (*self.base, *self.beside_default)

    @property
    def stated(self) -> dict[str, float]:
        """Native parameters as the files and the spec have them."""
        return {p.name: p.value for p in self.parameters}

    @staticmethod
    def gravity_parameters(gravity: Sequence[float]) -> tuple[Parameter, ...]:
        """`gravity_x`, `_y` and `_z`."""
        return tuple(Parameter(f"gravity_{a}", g, "m/s^2") for a, g in zip("xyz", gravity, strict=True))

    @staticmethod
    def joint_parameter(kind: str, joint: Joint, own: float, given: float | None = None) -> Parameter:
        """`KIND.JOINT`, of damping, dry friction or armature: its own, unless a spec has given one to all joints."""
        unit = NATIVE_UNITS[joint.type == "prismatic"]["dry" if kind in NATIVE["coulomb-friction"] else kind]
        return Parameter(f"{kind}.{joint.name}", own if given is None else given, unit, low=0.0)

    def check_mass(self, matrix: Array, mover: Callable[[int], str]) -> None:
        """UsageError where a velocity moves no mass by this mass matrix; mover: what has velocity number k."""
        if matrix.size and not (np.isfinite(matrix).all() and np.linalg.eigvalsh(matrix)[0] > 0):
            what = mover(int(np.argmin(np.diag(matrix))))
            raise UsageError(f"robot: {self.file}: {what} moves no mass; expected <inertial> in a link that moves with it")

    def realises(self, effect: str, joint: str) -> str | None:
        """The native parameter that adds to a joint what an effect does, in the effect's own unit."""
        known = {p.name for p in self.parameters}
        return next((n for kind in NATIVE.get(effect, ()) if (n := f"{kind}.{joint}") in known), None)

    def rubs(self, values: Mapping[str, float]) -> bool:
        """Has any joint dry friction, under native parameters of which those that are not the stated ones are given?"""
        kinds = tuple(f"{kind}." for kind in NATIVE["coulomb-friction"])
        return any(values.get(p.name, p.value) for p in self.parameters if p.name.startswith(kinds))

    def accuracy(self, values: Mapping[str, float]) -> float:
        """Of a step: by how much the engine may miss its own equations under these native parameters, where it iterates."""
        return 1e-9

    def beyond(self) -> tuple[str, ...]:
        """What acts besides bodies on hinges and slides, each as a phrase; where nothing does, `section` is exact."""
        found: dict[str, object] = {
            "a base that floats": self.base,
            "free bodies or ball joints": self.beside,
            "a drive of its own": self.config.drive,
        }
        found |= {f"actuator {a.name}": a.law is None for a in self.actuators}
        return tuple(what for what, there in found.items() if there)

    def section(
        self, coordinates: Sequence[str], period: float, free: Mapping[str, str], values: Mapping[str, float]
    ) -> dict[str, Any]:
        """The robot as part of an equations model's section: parameters, bodies, gravity, forces without inputs, integrator.

        It is exact where `beyond` is empty. coordinates: of the movable joints; free: native parameters →
        names of parameters that stand for their numbers; values: those of native parameters that are not the file's.
        """
        named = dict(zip((j.name for j in self.joints if j.movable), coordinates, strict=True))
        links = self.links(named, period, values)
        x, y, z = (self.stated[f"gravity_{a}"] for a in "xyz")
        how: dict[str, Any] = {"after": self.friction_after, "integrator": self.integrator, "springs": self.springs_held}
        return as_section(links, (x, y, z), free, implicit=self.implicit(), **how)

    @abstractmethod
    def links(self, coordinates: Mapping[str, str], period: float, values: Mapping[str, float]) -> list[Link]:
        """What `section` writes; coordinates: joint → coordinate."""

    def implicit(self) -> bool:
        """Is the damping of joints solved with the step, (M + h D) a = forces − D v?"""
        return False

    def patched(self, values: Mapping[str, float]) -> dict[str, str]:
        """Files that have native parameters set, name → text: the robot file, else as it is, and code for what it cannot say.

        Empty where the engine writes none.
        """
        return {}

    def scene(self, position: Array, base: Array | None) -> Scene | None:
        """The robot's shapes, and its links by the engine's own kinematics; None where it says nothing of them.

        position (n, nj) of the movable joints, base (n, ·) as of a world, where anything is loose.
        """
        return None

    def tiles(self) -> tuple[int, str]:
        """How many copies one world can hold at most, and, where that is 1, the reason."""
        return 1, "untiled: this engine steps one robot at a time"

    def tileable(self, values: Mapping[str, float]) -> bool:
        """May copies share a world under these native parameters? Constraints, dry friction say, would be solved together."""
        return True

    def drivable(self) -> tuple[str, ...]:
        """What a drive may name: by default the movable joints."""
        return tuple(j.name for j in self.joints if j.movable)

    def resolution(self, magnitude: Array) -> Array:
        """e (nx,): bound on the arithmetic error of one step, by default 4 ulp of `magnitude` = max |x⁺| (nx,)."""
        return np.asarray(4 * np.spacing(np.maximum(np.abs(magnitude), np.finfo(float).tiny)))
