"""Where rollouts start: a body that floats is where the first samples of its motion put it, and moves as they do."""

from __future__ import annotations

from typing import final

import numpy as np

from gapcert.engine.native import NativeModel
from gapcert.errors import UsageError
from gapcert.states import difference, turned
from gapcert.system import Array

LEAD = 0.12  # s, at most
FEWEST = 6  # samples: over so many, sliding with another friction is no flight
ASTRAY = 10.0  # noise floors: what is further from a line meets something that the rollout does not
PASSES = 2
_PAIRS = (("position", "velocity"), ("rotation", "rate"))


def settled(model: NativeModel, sigma: Array, seen: Array, u: Array) -> Array:
    """Starts (n, nx) of motions seen (n, T, nx), NaN beyond their ends, under u (n, T − 1, nu); sigma (G,): noise floors.

    A velocity from a filter is late, and one from a single sample is noisy. While a body flies, a wrong start shows in its place
    as an error that grows evenly, whatever a contact does to it later: a line through the differences from a rollout of the
    stated model, and the velocity that was measured, give the error of the start. As many samples count as tell the slope best,
    by their own misfit: an impact spoils it. Where no line fits, as in a contact, the start is the measured one.
    """
    groups = {g.output.name: (g, float(s)) for g, s in zip(model.groups, sigma, strict=True)}
    pairs = [(groups[a], groups[b]) for a, b in _PAIRS if a in groups and b in groups]
    measured = model.turned(seen[:, 0], back=False)
    now = measured.copy()
    for _ in range(PASSES if pairs else 0):
        try:
            rolled = model.rollout(model.turned(now, back=True), u).x
        except UsageError:  # the engine cannot follow the stated model
            break
        for (place, noise), (speed, spread) in pairs:
            at, columns = list(place.columns), list(speed.columns)
            with np.errstate(invalid="ignore"):
                off = difference(place.specs, seen[..., at], rolled[..., at])
            rows, offset, slope = _lines(model.period, off / noise, (measured - now)[:, columns] / noise, noise / spread)
            now[np.ix_(rows, columns)] += noise * slope
            where, moved = np.ix_(rows, at), noise * offset
            now[where] = turned(now[where], moved) if place.specs[0].kind == "quaternion" else now[where] + moved
    return np.where((now == measured).all(axis=1, keepdims=True), seen[:, 0], model.turned(now, back=True))


def _lines(period: float, off: Array, late: Array, ratio: float) -> tuple[Array, Array, Array]:
    """Rows (r,) of `off` (n, T, 3) that begin with a line, its offset and its slope (r, 3); off: in noise floors.

    late (n, 3): the slope that the measured velocity asks for; in the units of `off`, its noise is 1 / ratio.
    """
    t = period * np.arange(off.shape[1])
    n, t1, t2 = (np.cumsum(a)[:, None] for a in (np.ones_like(t), t, t**2))
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        y0, y1 = np.cumsum(off, axis=1), np.cumsum(t[:, None] * off, axis=1)
        wide = np.maximum(t2 - t1**2 / n, 1e-300)
        slope = (y1 - t1 / n * y0) / wide
        square = np.cumsum(off**2, axis=1) - y0**2 / n - wide * slope**2
        misfit = np.sum(square, axis=-1) / np.maximum(n[:, 0] - 2, 1)
        noise = np.maximum(misfit, 1.0)[..., None] / wide
    noise[:, : FEWEST - 1] = np.inf
    noise[~(misfit <= ASTRAY**2)] = np.inf
    rows, best = np.arange(len(off)), np.argmin(noise[..., 0], axis=1)
    rows = rows[np.isfinite(noise[rows, best, 0])]
    best = best[rows]
    share = noise[rows, best] * ratio**2 / (1 + noise[rows, best] * ratio**2)
    found = slope[rows, best] + share * (late[rows] - slope[rows, best])
    return rows, (y0[rows, best] - t1[best] * found) / n[best], found
