"""On what an answer is judged where nobody says: which data are held out, and over which horizons."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from gapcert.plugin import Array, Recording, Trajectory
from gapcert_diagnosis.thresholds import THRESHOLDS


def last_quarter(recording: Recording) -> Mapping[str, Any]:
    """What is held out: the end of each trajectory; of many the last ones, whole, as each has a start to be found first."""
    names = [tr.name for tr in recording.trajectories]
    if len(names) < THRESHOLDS.many_trajectories or len(set(names)) < len(names):
        return {"last": 0.25}
    return {"trajectories": names[-(len(names) // 4) :]}


def usual_horizons(recording: Recording, held_out: Recording, outputs: Sequence[str]) -> tuple[float, ...]:
    """(T, 3 T) in s, where T is in how long the slowest output turns once; shorter where what is held out is.

    T is four times the lag of the first zero of the autocorrelation, as of a sine, in the median of trajectories.
    """
    turns = [[_turn(tr, n) for tr in recording.trajectories] for n in outputs if n in recording.trajectories[0].channels]
    turn = max((float(np.median(t)) for t in turns), default=1.0)
    room = max(float(np.nanmax(tr.t) - np.nanmin(tr.t)) for tr in held_out.trajectories)
    # Two rollouts at least, each behind the stretch that its start is found in.
    longest = max((room - min(THRESHOLDS.rollout_leads[-1], room / 3)) / 2, THRESHOLDS.least_horizon * recording.period)
    return tuple(sorted({float(f"{min(h, longest):.3g}") for h in (turn, 3 * turn)}))


def _turn(tr: Trajectory, channel: str) -> float:
    """In s; the whole length of what never turns."""
    t = np.asarray(tr.t, dtype=np.float64)
    there = np.isfinite(t) & np.isfinite(tr.channels[channel])
    if there.sum() < 2 or not (length := float(np.ptp(t[there]))) > 0:
        return 1.0
    grid = np.linspace(t[there].min(), t[there].max(), min(len(t), THRESHOLDS.turning_samples))
    order = np.argsort(t[there], kind="stable")
    lag = _first_zero(np.interp(grid, t[there][order], tr.channels[channel][there][order]))
    return length if lag is None else 4 * lag * float(grid[1] - grid[0])


def _first_zero(y: Array) -> int | None:
    """The first lag at which a series has no correlation with itself, by its Fourier transform."""
    spectrum = np.fft.rfft(y - y.mean(), 2 * len(y))
    correlation = np.fft.irfft(np.abs(spectrum) ** 2)[: len(y)]
    below = np.flatnonzero(correlation <= 0)
    return int(below[0]) if len(below) and correlation[0] > 0 else None
