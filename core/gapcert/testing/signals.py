"""Inputs that excite, and recordings as files: what tests of readers, effects and diagnoses begin with."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from gapcert.contracts.data.recording import Recording
from gapcert.numerics.arrays import Array


def multisine(seconds: float, period: float, amplitude: float, band: tuple[float, float], seed: int) -> Array:
    """(T, 1): ten sines with random phases, frequencies spread evenly over the band in Hz; its largest value is `amplitude`."""
    t = np.arange(round(seconds / period)) * period
    rng = np.random.default_rng(seed)
    phases = zip(np.linspace(*band, 10), rng.uniform(0, 2 * np.pi, 10), strict=True)
    waves = [np.sin(2 * np.pi * f * t + phase) for f, phase in phases]
    total = np.sum(waves, axis=0)
    return np.asarray(amplitude * total / np.abs(total).max())[:, None]


def steps(seconds: float, period: float, amplitude: float, hold: float, seed: int) -> Array:
    """(T, 1): random levels in [−amplitude, amplitude], each held for `hold` s."""
    count, each = round(seconds / period), max(1, round(hold / period))
    levels = np.random.default_rng(seed).uniform(-amplitude, amplitude, -(-count // each))
    return np.repeat(levels, each)[:count, None]


def chirp(seconds: float, period: float, amplitude: float, band: tuple[float, float]) -> Array:
    """(T, 1): a sine whose frequency rises evenly through the band in Hz."""
    t = np.arange(round(seconds / period)) * period
    return np.asarray(amplitude * np.sin(2 * np.pi * (band[0] * t + (band[1] - band[0]) * t**2 / (2 * seconds))))[:, None]


def write_csv(recording: Recording, path: Path | str, digits: int = 9) -> None:
    """One file: column t, then the channels; with several trajectories a column `trajectory` as well."""
    several = len(recording.trajectories) > 1
    with Path(path).open("w", newline="") as file:
        out = csv.writer(file, lineterminator="\n")
        out.writerow(["t", *recording.names, *(["trajectory"] if several else [])])
        for tr in recording.trajectories:
            for k in range(len(tr)):
                row = [f"{tr.t[k]:.{digits}g}", *(f"{tr.channels[n][k]:.{digits}g}" for n in recording.names)]
                out.writerow([*row, *([tr.name] if several else [])])
