"""One experiment on a plant: what is commanded, from where, for how long; and the motion that follows."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, final

import numpy as np

from exams.hidden import slots
from exams.hidden.laws import Hidden, Scales, Tables
from exams.hidden.motion import Drive, Machine, simulate
from exams.hidden.plants import PLANTS, Plant
from exams.hidden.terms import mass
from gapcert.numerics.arrays import Array, Ints

FINE, COARSE, DRY = 50e-6, 1e-3, 2e-4  # s: steps of the truth, of what is computed about it, and that where joints may stick
STICKING = (
    "coulomb-friction",
    "asymmetric-coulomb-friction",
    "stribeck-friction",
    "load-dependent-friction",
    "dahl-friction",
    "lugre-friction",
)
EXCITATIONS = ("multisine", "steps", "chirp", "decay", "tracking")


@final
@dataclass(frozen=True)
class Motion:
    """States x and sensed states y (T, 2n) at the times t (T,), and what was commanded, u (T, nu)."""

    t: Array
    x: Array
    y: Array
    u: Array


@final
@dataclass(frozen=True)
class Rig:
    """A plant with its true parameters, the input that is played (or the controller that plays it), and where it starts.

    u (T, nu), gains (nu, 2n), reference (T, 2n), limit (nu,), start (2n,), offsets (T,): of the ticks from an even grid, in s.
    """

    plant: Plant
    parameters: Array
    period: float
    u: Array
    start: Array
    gains: Array
    reference: Array
    limit: Array
    offsets: Array
    disturbance: Array
    excitation: str = "given"
    hold: Literal["zero", "first"] = "zero"

    def play(self, effects: tuple[Hidden, ...] = (), step: float = FINE, scheme: int = 0) -> Motion:
        """The motion with the effects acting."""
        t = np.arange(len(self.u)) * self.period + self.offsets
        ticks = np.round(t / step).astype(np.int64)
        return self._run(effects, self.u.copy(), ticks, step, scheme, np.array([0]), self.start[None], self.gains)

    def given(self, u: Array) -> Rig:
        """The same plant at rest, under another input (T, nu)."""
        count, n = len(u), self.plant.n
        still = np.zeros((count, 2 * n))
        return replace(
            self,
            u=u,
            start=still[0],
            gains=np.zeros_like(self.gains),
            reference=still,
            limit=np.full(u.shape[1], np.inf),
            offsets=still[:, 0],
            disturbance=still[:, :n],
            excitation="given",
        )

    def replay(
        self, effects: tuple[Hidden, ...], u: Array, resets: Ints, starts: Array, parameters: Array, step: float = COARSE
    ) -> Array:
        """Sensed states (T, 2n) under recorded inputs, with the state set to starts[k] at tick resets[k]."""
        rig = replace(self, parameters=parameters, limit=np.full(len(self.limit), np.inf))
        t = np.arange(len(u)) * self.period + self.offsets[: len(u)]
        ticks = np.round(t / step).astype(np.int64)
        return rig._run(effects, u.copy(), ticks, step, 0, resets, starts, np.zeros_like(self.gains)).y

    def _run(
        self,
        effects: tuple[Hidden, ...],
        u: Array,
        ticks: Ints,
        step: float,
        scheme: int,
        resets: Ints,
        starts: Array,
        gains: Array,
    ) -> Motion:
        tables = Tables.of(self.plant, self.parameters).hide(effects)
        exact, starts, hold = np.array([*self.plant.exact, 0.0]), np.ascontiguousarray(starts), int(self.hold == "first")
        faults = tables.coordinates, tables.inputs, tables.outputs
        machine = Machine(self.plant.number, tables.parameters, exact, *faults)
        asked = Drive(ticks, step, u, gains, self.reference, self.limit, resets, starts, self.disturbance, scheme, hold)
        x, y = simulate(machine, asked)
        return Motion(np.asarray(ticks * step, dtype=np.float64), x, y, u)

    def scales(self, motion: Motion, kind: str, site: str) -> Scales:
        """Sizes at a site in a motion without effects."""
        plant, n = self.plant, self.plant.n
        seconds = len(self.u) * self.period
        if kind == "parameter":
            return Scales(stated=plant.stated[site][0], seconds=seconds)
        if kind == "input":
            column = motion.u[:, plant.inputs.index(site)]
            return Scales(size=_rms(column), peak=float(np.abs(column).max()) or 1.0, seconds=seconds)
        if kind == "output":
            j = (*plant.positions, *plant.velocities).index(site)
            return Scales(swing=float(np.std(motion.x[:, j])), seconds=seconds)
        j = plant.sites.index(site)
        q, v = motion.x[:, j], motion.x[:, n + j]
        effort, peak = self._effort(motion, j)
        load = next(iter(v for v, unit in plant.stated.values() if unit == "kg")) if plant.name != "motor" else 1.0
        return Scales(effort, _rms(v), float(np.std(q)), float(q.mean()), float(np.ptp(q)), effort, peak, load, seconds)

    def _effort(self, motion: Motion, j: int) -> tuple[float, float]:
        """(rms, peak) of what it takes to move a coordinate as it moved."""
        n = self.plant.n
        v = motion.x[:, n + j]
        pull = np.gradient(v, self.period)
        W, M = np.zeros((slots.WORKSPACE, n)), np.zeros((2, n, n))
        C, exact = np.zeros((n, slots.COORDINATE)), np.array([*self.plant.exact, 0.0])
        rows = np.linspace(0, len(v) - 1, min(60, len(v))).astype(int)
        inertia = []
        for k in rows:
            W[:2] = motion.x[k].reshape(2, n)
            mass(self.plant.number, self.parameters, exact, C, W, 0, M)
            inertia.append(M[0, j, j])
        inertial = float(np.mean(inertia)) * pull
        if len(self.plant.inputs) == n and self.plant.name != "base":
            column = motion.u[:, j]
            return float(np.hypot(_rms(inertial), _rms(column))), float(np.abs(column).max()) or 1.0
        return _rms(inertial), float(np.quantile(np.abs(inertial), 0.98)) or 1.0


def rig(name: str, excitation: str, period: float, seconds: float, rng: np.random.Generator, strength: float = 1.0) -> Rig:
    """An experiment with everything drawn: true parameters within half the tolerance, signals, start."""
    plant = PLANTS[name]
    count, n, nu = round(seconds / period), plant.n, len(plant.inputs)
    true = np.array([v * (1 + rng.uniform(-0.01, 0.01)) for v, _ in plant.stated.values()])
    start = rng.uniform(-1, 1, 2 * n) * np.array(plant.start)
    t = np.asarray(np.arange(count) * period, dtype=np.float64)
    u, reference, gains = np.zeros((count, nu)), np.zeros((count, 2 * n)), np.zeros((nu, 2 * n))
    limit = np.full(nu, np.inf)
    if excitation == "tracking":
        reference = _reference(plant, t, rng)
        gains, limit = np.array(plant.gains), 3.0 * np.array(plant.amplitude)
        start = np.where(np.array(plant.start) > 0, reference[0], 0.0)
    elif excitation == "decay":
        u, start = _decay(plant, t, start, rng)
    else:
        u = np.stack([a * _signal(plant, excitation, t, rng) for a in plant.amplitude], axis=1)
        u *= strength * rng.uniform(0.6, 1.0)
    made = Rig(plant, true, period, u, start, gains, reference, limit, np.zeros(count), np.zeros((count, n)), excitation)
    return made if excitation == "tracking" else _tamed(made)


def _tamed(made: Rig) -> Rig:
    """Weaker until nothing swings farther than a machine would be let."""
    for _ in range(12):
        if made.plant.free and made.plant.name != "base":
            made = _centred(made)
        path = made.play(step=COARSE).x[:, : made.plant.n]
        if (np.ptp(path, axis=0) <= np.array(made.plant.room)).all():
            break
        made = replace(made, u=0.75 * made.u, start=0.8 * made.start)
    return made


def _centred(made: Rig) -> Rig:
    """With a first speed that brings a free mass back to where it began."""
    path = made.play(step=COARSE).x[:, 0]
    start = made.start.copy()
    start[made.plant.n] -= (path[-1] - path[0]) / (len(path) * made.period)
    return replace(made, start=start)


def _signal(plant: Plant, kind: str, t: Array, rng: np.random.Generator) -> Array:
    """One channel (T,) within ±1; a single `sine` is the poorest of all."""
    low, high = plant.band
    if kind == "multisine":
        f = np.linspace(low, high, 10) * rng.uniform(0.9, 1.1, 10)
        waves = np.sin(2 * np.pi * f[:, None] * t + rng.uniform(0, 2 * np.pi, (10, 1)))
        total = waves.sum(axis=0)
        return np.asarray(total / np.abs(total).max())
    if kind == "sine":
        return np.asarray(np.sin(2 * np.pi * rng.uniform(low, 0.5 * (low + high)) * t + rng.uniform(0, 2 * np.pi)))
    if kind == "chirp":
        top = high * rng.uniform(0.8, 1.2)
        phase = rng.uniform(0, 2 * np.pi)
        return np.asarray(np.sin(2 * np.pi * (low * t + (top - low) * t**2 / (2 * t[-1])) + phase))
    holds: list[float] = []
    levels: list[float] = []
    while sum(holds) < t[-1]:
        hold, level = rng.uniform(0.15, 0.6), rng.uniform(0.3, 1.0) * rng.choice([-1, 1])
        # A free mass gets each push back, so that it stays near.
        pair = 2 if plant.free or plant.name == "motor" else 1
        holds += [hold] * pair
        levels += [level, -level][:pair]
    edges = np.concatenate([[0.0], np.cumsum(holds)])
    return np.asarray(np.array(levels)[np.clip(np.searchsorted(edges, t, side="right") - 1, 0, len(levels) - 1)])


def _reference(plant: Plant, t: Array, rng: np.random.Generator) -> Array:
    """Positions and speeds (T, 2n) to be tracked: a few slow sines."""
    n = plant.n
    out = np.zeros((len(t), 2 * n))
    for j, reach in enumerate(plant.reach):
        f = rng.uniform(0.15, 0.9, 4)
        phase = rng.uniform(0, 2 * np.pi, 4)
        wave = 2 * np.pi * f[:, None] * t + phase[:, None]
        out[:, j] = 0.5 * reach * np.sin(wave).sum(axis=0)
        out[:, n + j] = 0.5 * reach * (2 * np.pi * f[:, None] * np.cos(wave)).sum(axis=0)
    return out


def _decay(plant: Plant, t: Array, start: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """A release from far out; where nothing pulls back, a short push every 2.5 s, and coasting in between."""
    n, u = plant.n, np.zeros((len(t), len(plant.inputs)))
    if plant.free or plant.name == "motor":
        for i, a in enumerate(plant.amplitude):
            sign = rng.choice([-1, 1])
            for k, since in enumerate(np.arange(0.2, t[-1], 2.5)):
                part = (t >= since) & (t < since + 0.25)
                u[part, i] = a * sign * (-1) ** k * rng.uniform(0.7, 1.0)
        return u, start
    far = np.array(plant.start[:n]) * rng.uniform(0.8, 1.2, n) * rng.choice([-1, 1], n)
    return u, np.concatenate([far, np.zeros(n)])


def _rms(a: Array) -> float:
    return float(np.sqrt(np.mean(a**2))) or 1.0
