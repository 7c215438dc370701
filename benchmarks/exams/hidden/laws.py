"""Every effect that can be hidden: its numbers, how they are drawn, and where they go in the tables of the motion."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import final

import numpy as np

from exams.hidden import slots as s
from exams.hidden.plants import Plant
from gapcert.numerics.arrays import Array
from gapcert.numerics.errors import UsageError

Numbers = Mapping[str, float]
LENGTHS = ("drive.q", "cartpole.x", "base.x", "base.y")
WEIGHED = ("pendulum.q", "cartpole.theta", "arm.q1", "arm.q2")
PLACED = ("motor.w",)  # the state equations whose state is the rate of a position


@final
@dataclass(frozen=True)
class Hidden:
    """An effect at a site with its numbers, as the library calls them."""

    effect: str
    site: str
    numbers: Numbers

    def __hash__(self) -> int:
        return hash((self.key, tuple(self.numbers.items())))

    @property
    def key(self) -> tuple[str, str]:
        return self.effect, self.site


@final
@dataclass
class Tables:
    """What a motion reads: numbers per coordinate, input and output, and the parameters, all by the names of the sites.

    neighbours: coordinate → the one whose speed a coupling feels; quantum: output → resolution.
    """

    sites: tuple[str, ...]
    lines: tuple[str, ...]
    sensors: tuple[str, ...]
    stated: Mapping[str, float] = field(default_factory=dict)
    neighbours: Mapping[str, str] = field(default_factory=dict)
    quantum: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.parameters = np.array(list(self.stated.values()), dtype=np.float64)
        self.coordinates = np.zeros((len(self.sites), s.COORDINATE))
        self.coordinates[:, [s.STRIBECK_SPEED, s.LUGRE_SPEED]] = 1.0
        self.inputs = np.zeros((len(self.lines), s.INPUT))
        self.inputs[:, s.GAIN] = 1.0
        self.inputs[:, [s.RATE, s.LAG_RATE, s.SATURATION]] = np.inf
        self.outputs = np.zeros((len(self.sensors), s.OUTPUT))
        self.outputs[:, s.SCALE] = 1.0

    @classmethod
    def of(cls, plant: Plant, parameters: Array) -> Tables:
        """Of a plant with given parameters, in their order."""
        near = {q: other for q in plant.sites if (other := neighbour(plant, q)) is not None}
        stated = dict(zip(plant.stated, map(float, parameters), strict=True))
        return cls(plant.sites, plant.inputs, (*plant.positions, *plant.velocities), stated, near)

    def hide(self, effects: Sequence[Hidden]) -> Tables:
        """With the effects in it; UsageError where there is no such effect or site."""
        for e in effects:
            if e.effect not in _PUT:
                raise UsageError(f"hide: cannot hide '{e.effect}'; it knows {', '.join(_PUT)}")
            known = {"coordinate": self.sites, "input": self.lines, "output": self.sensors, "parameter": tuple(self.stated)}
            there = known[KIND[e.effect]]
            if e.site not in there:
                raise UsageError(f"hide: {e.effect} cannot act at '{e.site}'; there are {', '.join(there) or 'no such sites'}")
            _PUT[e.effect](self, e.site, e.numbers)
        return self

    def joint(self, site: str) -> Array:
        return np.asarray(self.coordinates[self.sites.index(site)])

    def line(self, site: str) -> Array:
        return np.asarray(self.inputs[self.lines.index(site)])

    def sensor(self, site: str) -> Array:
        return np.asarray(self.outputs[self.sensors.index(site)])


def neighbour(plant: Plant, site: str) -> str | None:
    """The coordinate that a coupling at `site` feels: the next of the same kind, the one before at the end."""
    groups = {"arm": ("q1", "q2"), "base": ("x", "y"), "chain": plant.positions}
    group = groups.get(plant.name, ())
    if site not in group:
        return None
    i = group.index(site)
    return group[i + 1] if i + 1 < len(group) else group[i - 1]


def sites(plant: Plant, effect: str) -> tuple[str, ...]:
    """Where an effect can act."""
    kind = KIND[effect]
    if kind == "input":
        return plant.inputs
    if kind == "output":
        names = (*plant.positions, *plant.velocities)
        return tuple(n for n in names if n not in plant.hidden)
    if kind == "parameter":
        return tuple(plant.stated)
    return tuple(q for q in plant.sites if _fits(plant, effect, q))


def _fits(plant: Plant, effect: str, site: str) -> bool:
    name = f"{plant.name}.{site}"
    driven = {"cartpole": ("x",), "motor": ()}.get(plant.name, plant.sites)
    placed = plant.name != "motor" or name in PLACED
    points = {"pendulum", "drive", "cartpole", "arm"}
    rules = {
        "load-dependent-friction": site in driven,
        "backlash": site in driven,
        "wheel-slip": site in driven and name in LENGTHS,
        "gravity-tilt": name in (*LENGTHS, *WEIGHED) or plant.name == "chain",
        "payload": plant.name in points,
        "joint-coupling": neighbour(plant, site) is not None,
    }
    needs_place = ("linear-spring", "cubic-spring", "cogging", "dahl-friction", "lugre-friction")
    return rules.get(effect, placed if effect in needs_place else True)


def _slots(table: str, **places: int) -> Callable[[Tables, str, Numbers], None]:
    """Numbers that go into a table as they are."""

    def put(t: Tables, site: str, numbers: Numbers) -> None:
        row: Array = getattr(t, table)(site)
        for name, place in places.items():
            row[place] += numbers[name]

    return put


def _into(table: str, **places: int) -> Callable[[Tables, str, Numbers], None]:
    """Numbers that replace what is in a table."""

    def put(t: Tables, site: str, numbers: Numbers) -> None:
        row: Array = getattr(t, table)(site)
        for name, place in places.items():
            row[place] = numbers[name]

    return put


def _viscous(t: Tables, site: str, numbers: Numbers) -> None:
    t.joint(site)[[s.VISCOUS_UP, s.VISCOUS_DOWN]] += numbers["coefficient"]


def _coulomb(t: Tables, site: str, numbers: Numbers) -> None:
    t.joint(site)[[s.DRY_UP, s.DRY_DOWN]] += numbers["level"]


def _stribeck(t: Tables, site: str, numbers: Numbers) -> None:
    _coulomb(t, site, numbers)
    t.joint(site)[s.STATIC] = numbers["level"] * numbers["ratio"]
    t.joint(site)[s.STRIBECK_SPEED] = numbers["velocity"]


def _dahl(t: Tables, site: str, numbers: Numbers) -> None:
    t.joint(site)[s.DAHL] = numbers["level"]
    t.joint(site)[s.DAHL_STIFFNESS] = numbers["level"] / numbers["displacement"]


def _lugre(t: Tables, site: str, numbers: Numbers) -> None:
    row = t.joint(site)
    row[s.LUGRE], row[s.LUGRE_STATIC] = numbers["level"], numbers["level"] * (1 + numbers["ratio"])
    row[s.LUGRE_SPEED], row[s.LUGRE_STIFFNESS] = numbers["velocity"], numbers["level"] / numbers["displacement"]


def _cogging(t: Tables, site: str, numbers: Numbers) -> None:
    row = t.joint(site)
    row[s.COGGING], row[s.COGGING_PHASE] = numbers["amplitude"], numbers["phase"]
    row[s.COGGING_FREQUENCY] = 2 * math.pi / numbers["period"]


def _coupling(t: Tables, site: str, numbers: Numbers) -> None:
    row = t.joint(site)
    row[s.COUPLING], row[s.PARTNER] = numbers["coefficient"], t.sites.index(t.neighbours[site])


def _quantum(t: Tables, site: str, numbers: Numbers) -> None:
    t.quantum[site] = numbers["resolution"]


def _parameter(t: Tables, site: str, numbers: Numbers) -> None:
    t.parameters[tuple(t.stated).index(site)] = numbers["value"]


_PUT: dict[str, Callable[[Tables, str, Numbers], None]] = {
    "viscous-friction": _viscous,
    "coulomb-friction": _coulomb,
    "stribeck-friction": _stribeck,
    "lugre-friction": _lugre,
    "dahl-friction": _dahl,
    "quadratic-drag": _slots("joint", coefficient=s.QUADRATIC),
    "load-dependent-friction": _slots("joint", coefficient=s.LOAD),
    "asymmetric-coulomb-friction": _slots("joint", plus=s.DRY_UP, minus=s.DRY_DOWN),
    "asymmetric-viscous-friction": _slots("joint", plus=s.VISCOUS_UP, minus=s.VISCOUS_DOWN),
    "linear-spring": _slots("joint", stiffness=s.SPRING),
    "cubic-spring": _slots("joint", stiffness=s.CUBIC),
    "constant-force": _slots("joint", force=s.CONSTANT),
    "gravity-tilt": _slots("joint", angle=s.TILT),
    "cogging": _cogging,
    "payload": _slots("joint", mass=s.PAYLOAD),
    "joint-coupling": _coupling,
    "backlash": _into("joint", width=s.PLAY),
    "external-push": _into("joint", force=s.PUSH, time=s.PUSH_TIME, duration=s.PUSH_DURATION),
    "wheel-slip": _into("joint", traction=s.SLIP),
    "parameter": _parameter,
    "input-gain": _into("line", gain=s.GAIN),
    "input-offset": _into("line", offset=s.OFFSET),
    "input-dead-zone": _into("line", width=s.DEAD_ZONE),
    "input-saturation": _into("line", level=s.SATURATION),
    "input-delay": _into("line", delay=s.DELAY),
    "input-lag": _into("line", time_constant=s.LAG),
    "input-rate-limit": _into("line", rate=s.RATE),
    "supply-sag": _into("line", sag=s.SAG, time_constant=s.SAG_TIME),
    "sensor-bias": _into("sensor", bias=s.BIAS),
    "sensor-scale": _into("sensor", scale=s.SCALE),
    "sensor-delay": _into("sensor", delay=s.LATE),
    "sensor-quantisation": _quantum,
    "input-rate-limited-lag": _into("line", rate=s.LAG_RATE, time_constant=s.LAG),
    "input-nonlinearity": _into("line", square=s.SQUARE, cube=s.CUBE),
    "input-hysteresis": _into("line", width=s.FOLLOWED),
}
KNOWN = tuple(_PUT)
LATER = ("input-rate-limited-lag", "input-nonlinearity", "input-hysteresis")  # more in turn would draw every exam anew
NAMES = tuple(n for n in KNOWN if n not in LATER)
KIND = {
    name: (
        "parameter"
        if name == "parameter"
        else "output"
        if name.startswith("sensor-")
        else "input"
        if name.startswith("input-") or name == "supply-sag"
        else "coordinate"
    )
    for name in KNOWN
}


@final
@dataclass(frozen=True)
class Scales:
    """Sizes at a site in the run without any effect: rms force, speed, position about its mean, range, rms and peak input."""

    force: float = 1.0
    speed: float = 1.0
    swing: float = 1.0
    centre: float = 0.0
    reach: float = 1.0
    size: float = 1.0
    peak: float = 1.0
    stated: float = 1.0
    seconds: float = 12.0


@final
@dataclass(frozen=True)
class Shape:
    """Numbers of an effect as a function of its strength alone, in (0, most]; everything else has been drawn."""

    at: Callable[[float], dict[str, float]]
    most: float = 3.0


def shape(effect: str, z: Scales, rng: np.random.Generator, sign: float = 0.0) -> Shape:
    """One effect with everything drawn but its strength (and its sign, where that is given)."""
    sign = sign or float(rng.choice([-1.0, 1.0]))
    share = float(rng.uniform(0.25, 0.6))
    first, second = (1.0, share) if sign > 0 else (share, 1.0)
    speed, bend = float(rng.uniform(0.1, 0.35)) * z.speed, float(rng.uniform(0.03, 0.15)) * z.swing
    ratio, part, turn = float(rng.uniform(0.4, 1.2)), float(rng.uniform(0.15, 0.6)), float(rng.uniform(-math.pi, math.pi))
    turns, wait, length = float(rng.uniform(2.0, 8.0)), float(rng.uniform(0.3, 1.5)), float(rng.uniform(0.1, 0.4))
    late = 0.5 * share
    f, v = z.force, z.speed
    about = max(z.swing, abs(z.centre))
    shapes = {
        "viscous-friction": Shape(lambda k: {"coefficient": k * f / v}),
        "coulomb-friction": Shape(lambda k: {"level": k * f}, 0.9),
        "stribeck-friction": Shape(lambda k: {"level": k * f, "ratio": ratio, "velocity": speed}, 0.7),
        "lugre-friction": Shape(lambda k: {"level": k * f, "ratio": ratio, "velocity": speed, "displacement": bend}, 0.7),
        "dahl-friction": Shape(lambda k: {"level": k * f, "displacement": bend}, 0.9),
        "quadratic-drag": Shape(lambda k: {"coefficient": k * f / v**2}),
        "load-dependent-friction": Shape(lambda k: {"coefficient": k}, 0.7),
        "asymmetric-coulomb-friction": Shape(lambda k: {"plus": first * k * f, "minus": second * k * f}, 0.9),
        "asymmetric-viscous-friction": Shape(lambda k: {"plus": first * k * f / v, "minus": second * k * f / v}),
        "linear-spring": Shape(lambda k: {"stiffness": k * f / about}),
        "cubic-spring": Shape(lambda k: {"stiffness": k * f / about**3}),
        "constant-force": Shape(lambda k: {"force": sign * k * f}, 1.0),
        "gravity-tilt": Shape(lambda k: {"angle": sign * k}, 0.3),
        "cogging": Shape(lambda k: {"amplitude": k * f, "period": z.reach / turns, "phase": turn}, 1.5),
        "payload": Shape(lambda k: {"mass": k * z.stated}, 1.0),
        "joint-coupling": Shape(lambda k: {"coefficient": sign * k * f / v}, 1.0),
        "backlash": Shape(lambda k: {"width": k * z.size}, 0.8),
        "external-push": Shape(lambda k: {"force": sign * k * f, "time": part * z.seconds, "duration": length}, 5.0),
        "wheel-slip": Shape(lambda k: {"traction": z.peak / k}, 4.0),
        "parameter": Shape(lambda k: {"value": z.stated * (1 + k if sign > 0 else 1 / (1 + k))}, 0.6),
        "input-gain": Shape(lambda k: {"gain": 1 + k if sign > 0 else 1 / (1 + k)}, 0.8),
        "input-offset": Shape(lambda k: {"offset": sign * k * z.size}, 1.0),
        "input-dead-zone": Shape(lambda k: {"width": k * z.size}, 1.0),
        "input-saturation": Shape(lambda k: {"level": z.peak / (1 + k)}, 4.0),
        "input-delay": Shape(lambda k: {"delay": k}, 0.08),
        "input-lag": Shape(lambda k: {"time_constant": k}, 0.4),
        "input-rate-limit": Shape(lambda k: {"rate": z.peak / k}, 0.8),
        "input-rate-limited-lag": Shape(lambda k: {"rate": z.peak / k, "time_constant": late * k}, 0.8),
        "input-nonlinearity": Shape(lambda k: {"square": sign * share * k / z.peak, "cube": k / z.peak**2}, 1.0),
        "input-hysteresis": Shape(lambda k: {"width": k * z.size}, 0.8),
        "supply-sag": Shape(lambda k: {"sag": k / z.peak, "time_constant": wait}, 0.8),
        "sensor-bias": Shape(lambda k: {"bias": sign * k * z.swing}, 1.0),
        "sensor-scale": Shape(lambda k: {"scale": 1 + k if sign > 0 else 1 / (1 + k)}, 0.5),
        "sensor-delay": Shape(lambda k: {"delay": k}, 0.06),
        # An angle is logged within one turn, whose steps must fit into it.
        "sensor-quantisation": Shape(lambda k: {"resolution": k * min(z.swing, 1.0)}, 1.0),
    }
    return shapes[effect]
