"""Exam cases: everything about them drawn from (seed, part, index) alone."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, final

import numpy as np

from exams.hidden import log
from exams.hidden.laws import KIND, NAMES, Hidden, Shape, Tables, shape, sites
from exams.hidden.plants import PLANTS, TOLERANCE
from exams.hidden.rig import COARSE, EXCITATIONS, FINE, Motion, Rig, rig
from exams.hidden.truth import EVIDENT, Truth
from gapcert.contracts.data.recording import Recording

ENGINES, ROBOTS = ("mujoco", "pybullet", "dart", "gazebo"), ("pendulum", "drive", "cartpole", "arm")
SYSTEMS = ("pendulum", "drive", "cartpole", "arm", "motor", "base")
PERIODS, SHARES = (0.002, 0.004, 0.005, 0.01), (0.1, 0.2, 0.35, 0.35)
CLEAR, FAINT, LEFT = 5.0, 1.0, 1.0  # σ: changes of 1 s rollouts; what is left of a clear one after refitting
STRONGEST = 40.0
SHARE = 0.02  # of the effort; less than half of that is negligible by definition, and not to be named
PARAMETER = 3.0  # tolerances
FIRST, TOLD = 0.15, 0.75  # shares of open-loop logs whose inputs ran in straight lines; of logs that say how they ran
Label = Literal["clear", "faint", "hidden", "nothing"]


@final
@dataclass(frozen=True)
class Case:
    """One exam: a rig, what is hidden in it, and how it is measured.

    strength: change of 1 s rollouts in σ; remains: what refitting leaves of it; share: of the effort; told: does the log say
    how its inputs were held?
    """

    part: str
    seed: int
    index: int
    rig: Rig
    hidden: tuple[Hidden, ...]
    noise: log.Noise
    label: Label
    strength: float = 0.0
    remains: float = 0.0
    share: float = 0.0
    dirt: tuple[str, ...] = ()
    step: float = FINE
    scheme: int = 0
    engine: str | None = None
    told: bool = True

    @property
    def model(self) -> dict[str, Any]:
        """The nominal model's section."""
        return self.rig.plant.section(self.rig.period)

    def motion(self) -> Motion:
        if self.engine is None:
            return self.rig.play(self.hidden, self.step, self.scheme)
        from exams.hidden.engines import play

        with tempfile.TemporaryDirectory() as folder:
            return play(self.engine, self.rig, self.hidden, Path(folder))

    def recording(self, motion: Motion | None = None, salt: int = 0) -> Recording:
        """What the diagnosis gets to see."""
        motion = self.motion() if motion is None else motion
        rng = generator(self.part, self.seed, self.index, 1 + salt)
        quantum = Tables.of(self.rig.plant, self.rig.parameters).hide(self.hidden).quantum
        table = log.logged(self.rig, motion, self.noise, quantum, rng)
        if self.dirt:
            table = log.soil(table, self.dirt, self.rig.plant.inputs, rng)
        return log.recording(table, self.rig.hold if self.told else None)

    def classes(self) -> tuple[tuple[tuple[str, str], ...], ...]:
        """Per effect, what could not be told from it even without noise, itself first."""
        rng = generator(self.part, self.seed, self.index, 99)
        return Truth(self.rig, self.hidden, self.noise.sigma).classes(rng) if self.hidden else ()


def generator(part: str, seed: int, index: int, salt: int = 0) -> np.random.Generator:
    """Random numbers of one case; equal names give equal numbers in every process."""
    return np.random.default_rng([seed, *part.encode(), index, salt])


def single(
    part: str,
    seed: int,
    index: int,
    systems: Sequence[str] = SYSTEMS,
    faint: bool = False,
    dirt: tuple[str, ...] = (),
    effect: str = "",
) -> Case:
    """One effect, effects in turn; everything else drawn again until it can be as clear (or as faint) as asked.

    effect: this one, whosever turn it is.
    """
    rng = generator(part, seed, index)
    names = [e for e in NAMES if any(sites(PLANTS[p], e) for p in systems)]
    effect = effect or names[index % len(names)]
    best: Case | None = None
    for _ in range(30):
        plant = PLANTS[str(rng.choice([p for p in systems if sites(PLANTS[p], effect)]))]
        made, noise = setting(plant.name, rng)
        seen = [s for s in sites(plant, effect) if KIND[effect] != "output" or s in noise.sigma]
        site = str(rng.choice(seen))
        case = _strong(part, seed, index, made, noise, (effect, site), faint, rng)
        if case.label == ("faint" if faint else "clear"):
            return soiled(case, dirt)
        best = case if best is None or case.strength > best.strength else best
    assert best is not None
    return soiled(best, dirt)


def soiled(case: Case, dirt: tuple[str, ...]) -> Case:
    """The same case with a dirty log; a clock that trembles moves the instants of sampling and of acting alike."""
    made = case.rig
    if "jitter" in dirt:
        rng = generator(case.part, case.seed, case.index, 7)
        made = replace(made, offsets=made.period * rng.uniform(-0.3, 0.3, len(made.u)) * (np.arange(len(made.u)) > 0))
    return replace(case, rig=made, dirt=dirt)


def setting(name: str, rng: np.random.Generator, excitations: Sequence[str] = EXCITATIONS) -> tuple[Rig, log.Noise]:
    """A rig, and noise of 0.3 to 3 % of each measured channel's deviation in the run without effects."""
    period = float(rng.choice(PERIODS, p=SHARES))
    made = rig(name, str(rng.choice(excitations)), period, float(rng.uniform(14, 18)), rng)
    if made.excitation in ("multisine", "chirp", "steps") and rng.random() < FIRST:
        made = replace(made, hold="first")
    share, both = float(np.exp(rng.uniform(math.log(0.003), math.log(0.03)))), bool(rng.random() < 0.5)
    return made, noise(made, share, both)


def noise(made: Rig, share: float, both: bool, colour: float = 0.0) -> log.Noise:
    x = made.play((), COARSE).x
    names = (*made.plant.positions, *made.plant.velocities)
    deviation = {c: float(np.std(x[:, names.index(c)])) for c in log.channels(made, both)}
    largest = max(deviation.values())
    return log.Noise({c: share * max(d, 1e-3 * largest) for c, d in deviation.items()}, colour)


def _strong(
    part: str,
    seed: int,
    index: int,
    made: Rig,
    noise: log.Noise,
    key: tuple[str, str],
    faint: bool,
    rng: np.random.Generator,
) -> Case:
    """The effect at a strength drawn for its label, doubled where refitting would hide it."""
    low, high = (FAINT, 0.98 * CLEAR) if faint else (1.1 * CLEAR, STRONGEST)
    target = math.exp(rng.uniform(math.log(low), math.log(high)))
    drawn = shape(key[0], made.scales(made.play((), COARSE), KIND[key[0]], key[1]), rng)
    size, strength = sized(made, noise, key, drawn, target)
    remains, part_of = left(made, noise, key, drawn, size), share(made, noise, key, drawn, size)
    while not faint and strength >= CLEAR and (remains < LEFT or part_of < SHARE) and size < drawn.most:
        size = min(1.5 * size, drawn.most)
        remains, strength = left(made, noise, key, drawn, size), change(made, noise, key, drawn, size)
        part_of = share(made, noise, key, drawn, size)
    enough = key[0] != "parameter" or size / (1 + size) >= PARAMETER * TOLERANCE
    label: Label = "hidden" if strength < FAINT else "faint"
    if strength >= CLEAR and remains >= LEFT and part_of >= SHARE and enough and evident(made, noise, key, drawn, size):
        label = "clear"
    hidden = (Hidden(*key, drawn.at(size)),)
    return Case(part, seed, index, made, hidden, noise, label, strength, remains, part_of, told=bool(rng.random() < TOLD))


def change(made: Rig, noise: log.Noise, key: tuple[str, str], drawn: Shape, size: float) -> float:
    """RMS change of 1 s rollouts in σ."""
    numbers = drawn.at(size)
    if key[0] == "sensor-quantisation":
        return numbers["resolution"] / math.sqrt(12) / noise.sigma[key[1]]
    with np.errstate(all="ignore"):
        return Truth(made, (Hidden(*key, numbers),), noise.sigma).strength()


def left(made: Rig, noise: log.Noise, key: tuple[str, str], drawn: Shape, size: float) -> float:
    if key[0] == "sensor-quantisation":
        return change(made, noise, key, drawn, size)
    with np.errstate(all="ignore"):
        return Truth(made, (Hidden(*key, drawn.at(size)),), noise.sigma).remains()


def share(made: Rig, noise: log.Noise, key: tuple[str, str], drawn: Shape, size: float) -> float:
    with np.errstate(all="ignore"):
        return Truth(made, (Hidden(*key, drawn.at(size)),), noise.sigma).share()


def evident(made: Rig, noise: log.Noise, key: tuple[str, str], drawn: Shape, size: float) -> bool:
    """Would parameters have to be three tolerances off, all in all, to stand for it?"""
    if key[0] == "sensor-quantisation":
        return True
    with np.errstate(all="ignore"):
        return Truth(made, (Hidden(*key, drawn.at(size)),), noise.sigma).evidence() >= EVIDENT


def sized(made: Rig, noise: log.Noise, key: tuple[str, str], drawn: Shape, target: float) -> tuple[float, float]:
    """(size, change) near the target by bisection of the logarithm, or the largest that the shape allows."""
    most = change(made, noise, key, drawn, drawn.most)
    if most <= target:
        return drawn.most, most
    low, high = math.log(1e-4 * drawn.most), math.log(drawn.most)
    size, found = drawn.most, most
    for _ in range(12):
        middle = 0.5 * (low + high)
        value = change(made, noise, key, drawn, math.exp(middle))
        if value >= target:
            high, size, found = middle, math.exp(middle), value
        else:
            low = middle
        if abs(found / target - 1) < 0.05:
            break
    return size, found


def doubtful(part: str, seed: int, index: int, systems: Sequence[str] = ("pendulum", "drive")) -> Case:
    """One effect in a noisy log of one sine, where several effects may look alike."""
    rng = generator(part, seed, index)
    names = [e for e in NAMES if e != "sensor-quantisation" and any(sites(PLANTS[p], e) for p in systems)]
    effect, case = names[index % len(names)], None
    for _ in range(20):
        plant = PLANTS[str(rng.choice([p for p in systems if sites(PLANTS[p], effect)]))]
        made = rig(plant.name, "sine", 0.01, float(rng.uniform(7, 11)), rng, float(rng.uniform(0.1, 0.5)))
        quiet = noise(made, float(rng.uniform(0.01, 0.03)), False)
        site = str(rng.choice([s for s in sites(plant, effect) if KIND[effect] != "output" or s in quiet.sigma]))
        drawn = shape(effect, made.scales(made.play((), COARSE), KIND[effect], site), rng)
        target = math.exp(rng.uniform(math.log(3), math.log(10)))
        size, strength = sized(made, quiet, (effect, site), drawn, target)
        case = Case(part, seed, index, made, (Hidden(effect, site, drawn.at(size)),), quiet, "faint", strength)
        if strength >= 3:
            break
    assert case is not None
    return case


def on_engine(part: str, seed: int, index: int, systems: Sequence[str] = ROBOTS) -> Case:
    """One effect in a robot that an engine moves, engines in turn."""
    case = single(part, seed, index, systems)
    return replace(case, engine=ENGINES[index % len(ENGINES)], rig=replace(case.rig, hold="zero"))


def nothing(part: str, seed: int, index: int, systems: Sequence[str] = SYSTEMS) -> Case:
    """No effect; noise white or coloured, steps finer or coarser, by another scheme, or in an engine (every sixth case)."""
    rng = generator(part, seed, index)
    made, white = setting(systems[index % len(systems)], rng)
    colour = float(rng.choice([0.0, 0.0, 0.5, 0.8, 0.9]))
    step, scheme = [(FINE, 0), (2e-4, 0), (1e-4, 1)][int(rng.integers(3))]
    case = Case(part, seed, index, made, (), log.Noise(white.sigma, colour), "nothing", step=step, scheme=scheme)
    engine = ENGINES[index // 6 % len(ENGINES)] if index % 6 < len(ROBOTS) and index // 6 % 6 == 5 else None
    return case if engine is None else replace(case, engine=engine, rig=replace(made, hold="zero"))


def pair(part: str, seed: int, index: int, systems: Sequence[str] = SYSTEMS) -> Case:
    """Two effects in one rig, each clear on its own and beside the other, at different sites or of different kinds."""
    rng = generator(part, seed, index)
    for _ in range(40):
        made, noise = setting(str(rng.choice(systems)), rng)
        hidden: list[Hidden] = []
        cases = []
        for _ in range(12):
            effect = str(rng.choice(NAMES))
            places = [s for s in sites(made.plant, effect) if KIND[effect] != "output" or s in noise.sigma]
            if not places or effect == "sensor-quantisation":
                continue
            key = effect, str(rng.choice(places))
            if any({family(effect), family(h.effect)} in MERGED for h in hidden):
                continue
            case = _strong(part, seed, index, made, noise, key, False, rng)
            if case.label == "clear":
                hidden.append(case.hidden[0])
                cases.append(case)
            if len(hidden) == 2:
                with np.errstate(all="ignore"):
                    beside = Truth(made, tuple(hidden), noise.sigma).beside()
                if beside >= LEFT:
                    return replace(min(cases, key=lambda c: c.strength), hidden=tuple(hidden))
                break
    raise AssertionError(f"no pair for {part} {index}")


# Effects that resemble each other so much that a pair of them is one effect; an offset beside dry friction makes it asymmetric.
FAMILIES = (
    ("viscous-friction", "asymmetric-viscous-friction", "quadratic-drag"),
    (
        "coulomb-friction",
        "stribeck-friction",
        "lugre-friction",
        "dahl-friction",
        "asymmetric-coulomb-friction",
        "load-dependent-friction",
    ),
    ("constant-force", "gravity-tilt", "input-offset", "sensor-bias"),
    (
        "input-delay",
        "input-lag",
        "input-rate-limit",
        "input-rate-limited-lag",
        "sensor-delay",
        "backlash",
        "input-dead-zone",
        "input-hysteresis",
    ),
    (
        "parameter",
        "input-gain",
        "payload",
        "sensor-scale",
        "supply-sag",
        "input-saturation",
        "wheel-slip",
        "input-nonlinearity",
    ),
    ("linear-spring", "cubic-spring", "cogging"),
)
MERGED = (*({i} for i in range(len(FAMILIES))), {1, 2})


def family(effect: str) -> int:
    """Effects that resemble each other so much that a pair of them is one effect."""
    return next((i for i, names in enumerate(FAMILIES) if effect in names), 100 + NAMES.index(effect))
