"""From a motion to what a logger writes: noise, its colour, and the dirt of real logs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, final

import numpy as np
from scipy.signal import lfilter

from exams.hidden.rig import Motion, Rig
from gapcert.contracts.data.recording import Recording
from gapcert.numerics.arrays import Array

DIRT = ("dropouts", "gap", "outliers", "nan", "reset", "jitter")


@final
@dataclass(frozen=True)
class Noise:
    """sigma: standard deviation by channel; colour: lag-1 autocorrelation at the same standard deviation."""

    sigma: dict[str, float]
    colour: float = 0.0


def measured(plant_names: Sequence[str], hidden: Sequence[str], both: bool, n: int) -> tuple[str, ...]:
    """Positions, or positions and velocities, without what no sensor shows."""
    names = plant_names if both else plant_names[:n]
    return tuple(name for name in names if name not in hidden)


def channels(rig: Rig, both: bool) -> tuple[str, ...]:
    plant = rig.plant
    return measured((*plant.positions, *plant.velocities), plant.hidden, both, plant.n)


def logged(rig: Rig, motion: Motion, noise: Noise, quantum: Mapping[str, float], rng: np.random.Generator) -> dict[str, Array]:
    """Columns of the log: t, noisy outputs (rounded last, as converters do), commands."""
    names = (*rig.plant.positions, *rig.plant.velocities)
    out = {"t": motion.t.copy()}
    for channel, sigma in noise.sigma.items():
        j = names.index(channel)
        values = motion.y[:, j] + sigma * coloured(len(motion.t), noise.colour, rng)
        out[channel] = np.round(values / quantum[channel]) * quantum[channel] if channel in quantum else values
    return out | {name: motion.u[:, i].copy() for i, name in enumerate(rig.plant.inputs)}


def coloured(count: int, rho: float, rng: np.random.Generator) -> Array:
    """White noise through a first-order filter; unit variance."""
    white = rng.standard_normal(count + 200)
    return np.asarray(lfilter([np.sqrt(1 - rho**2)], [1.0, -rho], white)[200:])


def soil(table: dict[str, Array], kinds: Sequence[str], inputs: Sequence[str], rng: np.random.Generator) -> dict[str, Array]:
    """The same log with dirt: rows that are missing, absurd readings, NaN, a clock that starts again."""
    out = {k: v.copy() for k, v in table.items()}
    outputs = [k for k in out if k != "t" and k not in inputs]
    count = len(out["t"])
    if "outliers" in kinds:
        for name in outputs:
            rows = rng.choice(count, max(2, count // 200), replace=False)
            out[name][rows] += rng.choice([-1, 1], len(rows)) * rng.uniform(5, 50, len(rows)) * np.std(out[name])
    if "nan" in kinds:
        first = int(rng.integers(count // 5, count // 2))
        for name in outputs:
            out[name][first : first + count // 50] = np.nan
    keep = np.ones(count, dtype=bool)
    if "dropouts" in kinds:
        keep[1:-1] &= rng.random(count - 2) > 0.03
    if "gap" in kinds:
        first = int(rng.integers(count // 3, count // 2))
        keep[first : first + max(3, round(0.15 / np.median(np.diff(out["t"]))))] = False
    if "reset" in kinds:
        first = int(rng.integers(count // 4, count // 2))
        out["t"][first:] -= out["t"][first]
    return {k: v[keep] for k, v in out.items()}


def recording(table: dict[str, Array], hold: Literal["zero", "first"] | None = None) -> Recording:
    """As a reader would hand it over."""
    return Recording.of(table["t"], {k: v for k, v in table.items() if k != "t"}, hold=hold)
