"""Do values lie on a lattice? Read off their distribution, so that neither motion nor model is needed."""

from __future__ import annotations

import numpy as np

from gapcert import Array
from gapcert_effects.thresholds import THRESHOLDS


def lattice(values: Array) -> float | None:
    """The step δ of values near multiples of δ (and an offset), or None.

    |mean exp(2πi y/δ)| is 1 on a lattice, exp(−2π²σ²/δ²) under noise σ that is added to it, and about 1/√cells else.
    """
    y = values[np.isfinite(values)]
    if (step := _exact(y)) is not None:
        return step
    floor = float(np.sqrt(np.mean(np.diff(y, 4) ** 2) / 70)) if len(y) > 50 else 0.0
    reach = float(np.ptp(y)) if len(y) else 0.0
    if not (floor > 0 and reach > THRESHOLDS.lattice_coarsest * THRESHOLDS.lattice_finest * floor):
        return None
    cell = np.minimum(((y - y.min()) / reach * THRESHOLDS.lattice_cells).astype(int), THRESHOLDS.lattice_cells - 1)
    count = np.bincount(cell, minlength=THRESHOLDS.lattice_cells)
    levels = int(np.count_nonzero(count))
    if levels < THRESHOLDS.lattice_levels:
        return None
    weight = 1.0 / (levels * count[cell])
    frequency, found = _spectrum(y, weight, reach, floor)
    inside = (frequency >= max(THRESHOLDS.lattice_coarsest / reach, 1 / (THRESHOLDS.lattice_widest * floor))) & (
        frequency <= 1 / (THRESHOLDS.lattice_finest * floor)
    )
    peaks = np.where(inside, found, 0.0)
    # The largest of some thousand sums of `levels` random phases stays below 2.8/√levels.
    if peaks.max() < min(0.98, 0.1 + 2.8 / np.sqrt(levels)):
        return None
    first = int(np.argmax(peaks >= 0.9 * peaks.max()))
    while first + 1 < len(peaks) and peaks[first + 1] > peaks[first]:
        first += 1
    return _regressed(y, weight, 1 / float(frequency[first]))


def _exact(y: Array) -> float | None:
    """The step of a few values that come again and again, where all of them are whole multiples of it apart."""
    levels = np.unique(np.round(y, 12))
    if not 3 <= len(levels) <= len(y) / THRESHOLDS.lattice_repeats:
        return None
    apart = np.diff(levels)
    ratio = apart / apart.min()
    step = float(np.ptp(levels) / np.round(ratio).sum())
    coarse = step > THRESHOLDS.lattice_finest * float(np.sqrt(np.mean(np.diff(y, 4) ** 2) / 70))
    return step if coarse and np.abs(ratio - np.round(ratio)).max() < 1e-3 else None


def _spectrum(y: Array, weight: Array, reach: float, floor: float) -> tuple[Array, Array]:
    """(frequencies, |Σ w exp(2πi f y)|) by one transform of a fine histogram."""
    bins = int(min(THRESHOLDS.lattice_bins, np.ceil(reach / (0.2 * floor))))
    width = reach / bins
    at = np.minimum(((y - y.min()) / width).astype(int), bins - 1)
    total = np.bincount(at, weight, minlength=bins)
    return np.asarray(np.fft.rfftfreq(8 * bins, width)), np.asarray(np.abs(np.fft.rfft(total, 8 * bins)), dtype=np.float64)


def _regressed(y: Array, weight: Array, step: float) -> float:
    """The step that fits best once every value has its whole number."""
    for _ in range(4):
        phase = np.angle(np.sum(weight * np.exp(2j * np.pi * (y - y.mean()) / step)))
        origin = y.mean() + phase * step / (2 * np.pi)
        number = np.round((y - origin) / step)
        centred = number - np.sum(weight * number)
        step = float(np.sum(weight * centred * y) / np.sum(weight * centred * number))
    return step
