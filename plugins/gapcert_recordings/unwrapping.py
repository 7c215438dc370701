"""Angles as they turn: what a sensor wraps is unwrapped, and a hole does not lose count of the turns."""

from __future__ import annotations

import itertools

import numpy as np
import numpy.typing as npt

from gapcert.plugin import Array
from gapcert_recordings.thresholds import THRESHOLDS

Rows = npt.NDArray[np.intp]
TURN = 2 * np.pi


def counted(values: Array, t: Array, dt: float, rate: Array | None = None) -> Array:
    """Angles (T,) at times t (T,), `dt` apart, without jumps by whole turns; NaN stays. rate (T,): measured, in rad/s.

    From sample to sample an angle moves by less than half a turn. Over a hole it may turn several times: a log that counts
    turns itself is taken at its word, else the turn nearest to where the rate leads is meant.
    """
    rows = np.flatnonzero(np.isfinite(values))
    if len(rows) < 2:
        return values
    holes = 1 + np.flatnonzero((np.diff(rows) > 1) | (np.diff(t[rows]) > THRESHOLDS.hole_step * dt))
    runs = [rows[a:b] for a, b in itertools.pairwise([0, *holes.tolist(), len(rows)])]
    out = values.copy()
    for run in runs:
        out[run] = np.unwrap(values[run])
    wraps = any(np.abs(out[run] - values[run]).max() > 1 for run in runs)
    if not wraps and np.ptp(values[rows]) > TURN:
        return values
    for before, after in itertools.pairwise(runs):
        expected = out[before[-1]] + _moved(out, t, dt, before, after, rate, wraps)
        out[after] += TURN * np.round((expected - out[after[0]]) / TURN)
    return out


def _moved(angle: Array, t: Array, dt: float, before: Rows, after: Rows, rate: Array | None, turns: bool) -> float:
    """By how much an angle moved over a hole: by its measured rate, else at the speed of both ends if it is one that turns."""
    a, b = int(before[-1]), int(after[0])
    inner = slice(a + 1, b)
    if rate is not None and np.isfinite(rate[inner]).sum() >= ((t[b] - t[a]) / dt - 1) / 2:
        known = np.flatnonzero(np.isfinite(rate))
        at = np.arange(a, b + 1)
        return float(np.trapezoid(np.interp(at, known, rate[known]), t[at])) if len(known) else 0.0
    ends = [run for run in (before[-THRESHOLDS.hole_ends :], after[: THRESHOLDS.hole_ends]) if len(run) > 1]
    if not turns or not ends:
        return 0.0
    return float(t[b] - t[a]) * float(np.mean([(angle[e[-1]] - angle[e[0]]) / (t[e[-1]] - t[e[0]]) for e in ends]))
