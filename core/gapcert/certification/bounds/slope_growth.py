"""Slopes that grow as the distance shrinks: close pairs are followed towards their steeper part."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, final

import numpy as np
import numpy.typing as npt

from gapcert.certification.thresholds import THRESHOLDS
from gapcert.contracts.systems.domain import Domain
from gapcert.numerics.arrays import Array

Index = npt.NDArray[np.intp]


@final
@dataclass(frozen=True)
class Trails:
    """Where the steepest part of each segment lies: ends z (n, 2, nz) and g (n, 2, nx) of the last, shortest part.

    slope (n, k): |Δg_state| over the length, relative to the first segment's length, after each step; NaN once a trail ended.
    settled (n,): ended at a slope that is allowed, `enough`. `queried` counts transitions.
    """

    z: Array
    g: Array
    state: Index
    slope: Array
    settled: npt.NDArray[np.bool_]
    queried: int

    @property
    def change(self) -> Array:
        """(n, nx) |Δg| over the last part."""
        return np.asarray(np.abs(self.g[:, 1] - self.g[:, 0]))

    @property
    def steps(self) -> Index:
        """(n,) how often each was shortened by four."""
        return np.asarray(np.isfinite(self.slope).sum(axis=1) - 1)

    @property
    def growing(self) -> npt.NDArray[np.bool_]:
        """(n,) where the slope grew in each of the last two steps, threefold in both: a jump has 16, a slope 1."""
        last, rows = self.steps, np.arange(len(self.slope))
        end, middle, before = (self.slope[rows, np.maximum(last - k, 0)] for k in range(3))
        lately = (end >= 1.5 * middle) & (middle >= 1.5 * before) & (end >= 3 * before)
        return np.asarray((last >= 2) & lately & (end >= 4 * self.slope[:, 0]) & ~self.settled)


def follow(
    query: Callable[[int, Array], Array],
    z: Array,
    g: Array,
    state: Index,
    noise: Array,
    steps: int | Index,
    enough: Array | None = None,
) -> Trails:
    """Cut segments z (n, 2, nz) with remainders g (n, 2, nx) in four and go on with the quarter in which g_state changes most.

    query(k, points) returns g at the points of step k; noise (nx,) is what arithmetic alone may change g by; `steps` limits
    each trail, which ends before where the change drowns in the noise, or, after two steps, where the slope is at most `enough`
    (n,): a change that is allowed over the whole segment.
    """
    z, g, rows, queried = z.copy(), g.copy(), np.arange(len(z)), 0
    most = np.broadcast_to(np.asarray(steps), (len(z),))
    slope = np.full((len(z), int(most.max(initial=0)) + 1), np.nan)
    slope[:, 0] = np.abs(g[rows, 1, state] - g[rows, 0, state])
    settled = np.zeros(len(z), dtype=bool)
    t = (np.arange(1, THRESHOLDS.trail_parts) / THRESHOLDS.trail_parts)[:, None]
    for k in range(slope.shape[1] - 1):
        rows = rows[most[rows] > k]
        if not len(rows):
            break
        a, b = z[rows, :1], z[rows, 1:]
        inner = np.clip(a * (1 - t) + b * t, np.minimum(a, b), np.maximum(a, b))
        values = query(k, inner.reshape(-1, z.shape[2])).reshape(len(rows), THRESHOLDS.trail_parts - 1, -1)
        queried += inner.shape[0] * inner.shape[1]
        at = np.concatenate([g[rows, :1], values, g[rows, 1:]], axis=1)
        points = np.concatenate([a, inner, b], axis=1)
        each, own = np.arange(len(rows)), state[rows]
        change = np.abs(np.diff(at[each, :, own], axis=1))
        best = change.argmax(axis=1)
        most_change = change[each, best]
        clear = (most_change > THRESHOLDS.trail_clear * noise[own]) & (points[each, best] != points[each, best + 1]).any(axis=1)
        rows, each, best, most_change = rows[clear], each[clear], best[clear], most_change[clear]
        z[rows] = np.stack([points[each, best], points[each, best + 1]], axis=1)
        g[rows] = np.stack([at[each, best], at[each, best + 1]], axis=1)
        slope[rows, k + 1] = most_change * float(THRESHOLDS.trail_parts) ** (k + 1)
        if enough is not None and k > 0:
            settled[rows] = slope[rows, k + 1] <= enough[rows]
            rows = rows[~settled[rows]]
    return Trails(z, g, state, slope, settled, queried)


def steepest(z: Array, g: Array, constants: Array, most: int = 4) -> tuple[Array, Index]:
    """Segments (n, 2, nz) and their states (n,): per state the pairs of samples that use most of what the constants allow."""
    upper = np.triu_indices(len(z), 1)
    apart = np.abs(z[upper[0]] - z[upper[1]])
    segments, states = [], []
    for i in range(g.shape[1]):
        allowed = apart @ constants[i]
        used = np.abs(g[upper[0], i] - g[upper[1], i]) / np.maximum(allowed, np.finfo(float).tiny)
        for k in np.argsort(-used, kind="stable")[:most]:
            segments.append(z[[upper[0][k], upper[1][k]]])
            states.append(i)
    return np.array(segments).reshape(-1, 2, z.shape[1]), np.array(states, dtype=np.intp)


def along_axes(segments: Array, domain: Domain) -> tuple[Array, Index]:
    """Each segment (n, 2, nz) as the steps of a staircase, one axis after the other: (m, 2, nz), and whose each step is."""
    steps, owner = [], []
    for k, (a, b) in enumerate(segments):
        corner = a
        for j in np.flatnonzero(a != b):
            after = corner.copy()
            after[j] = b[j]
            if domain.contains(np.stack([corner, after])).all():
                steps.append((corner, after))
                owner.append(k)
            corner = after
    return np.array(steps).reshape(-1, 2, segments.shape[2]), np.array(owner, dtype=np.intp)


def growth(
    remainder: Callable[[str, Array], Array], domain: Domain, segments: Array, state: Index, noise: Array, steps: int = 8
) -> tuple[dict[str, Any] | None, int]:
    """The largest jump on the way from one end of a segment to the other, or None where all settled, and transitions spent.

    remainder(name, z) returns g; every segment is followed for its own state along each of the axes that it crosses.
    """
    stairs, owner = along_axes(segments, domain)
    if not len(stairs):
        return None, 0
    ends = remainder("growth-ends", stairs.reshape(-1, stairs.shape[2])).reshape(len(stairs), 2, -1)
    t = follow(lambda k, z: remainder(f"growth-{k}", z), stairs, ends, state[owner], noise, steps)
    rows = np.arange(len(stairs))
    size = np.where(t.growing, t.change[rows, t.state] / np.maximum(noise[t.state], np.finfo(float).tiny), 0.0)
    spent = 2 * len(stairs) + t.queried
    if not size.any():
        return None, spent
    k = int(size.argmax())
    i, j = int(t.state[k]), int(np.flatnonzero(stairs[k, 0] != stairs[k, 1])[0])
    lengths = [float(np.abs(s[k, 1, j] - s[k, 0, j])) for s in (stairs, t.z)]
    changes = [float(np.abs(e[k, 1, i] - e[k, 0, i])) for e in (ends, t.g)]
    found = {"state": i, "axis": j, "where": t.z[k].mean(axis=0).tolist(), "size": changes[1]}
    return {**found, "distances": lengths, "slopes": [c / n for c, n in zip(changes, lengths, strict=True)]}, spent
