"""How far a gap function's bound over boxes lies beyond what its band takes in them, as a search finds it."""

from __future__ import annotations

import numpy as np

from gapcert.plugin import Array, GapFunction, Interval, Predictor

_DRAWN, _STEPS = 24, 24  # points of each box to begin with, and steps from them; chosen, not measured


def reached(
    gap: GapFunction, boxes: Interval, seed: int = 0, steps: int = _STEPS, known: Predictor | None = None
) -> tuple[Array, Array]:
    """About (min l, max u) over each box (n, nz), each (n, nx), from inside; `known` is subtracted from both.

    Corners, the middle and random points; then, for each end, random steps from its best point, of falling size. A largest
    value on a ridge is hard to find: the more steps, the nearer.
    """
    rng, (n, nz), low, width = np.random.default_rng([seed, 0xE5]), boxes.shape, boxes.lo, boxes.hi - boxes.lo
    corners = [np.array([k >> j & 1 for j in range(nz)], dtype=np.float64) for k in range(2**nz)]
    first = [np.full(nz, 0.5), *corners, *(rng.random((n, nz)) for _ in range(_DRAWN))]

    def ends(t: Array) -> Array:
        """(2 nx, n): −l and u at low + t · width."""
        z = np.clip(low + t * width, boxes.lo, boxes.hi)
        p = known(z) if known else 0.0
        found = gap.interval(z)
        return np.concatenate([(p - found[0]).T, (found[1] - p).T])

    tried = [np.broadcast_to(t, (n, nz)) for t in first]
    values = np.stack([ends(t) for t in tried])
    best, at = values.max(axis=0), np.stack(tried)[values.argmax(axis=0), np.arange(n)]
    for k in range(steps):
        for i in range(len(best)):
            moved = (rng.random((n, nz)) - 0.5) * 0.8 ** (k * _STEPS / steps) * (rng.random((n, nz)) < 0.6)
            t = np.clip(at[i] + moved, 0.0, 1.0)
            value = ends(t)[i]
            better = value > best[i]
            best[i, better], at[i, better] = value[better], t[better]
    nx = len(best) // 2
    return -best[:nx].T, best[nx:].T


def excess(gap: GapFunction, boxes: Interval, seed: int = 0, steps: int = _STEPS, remainder: bool = False) -> Array:
    """(n, nx): by how much `interval_over`, or `remainder_over`, lies beyond what is `reached`, on the side where it does so
    most.
    """
    over = gap.remainder_over(boxes) if remainder else gap.interval_over(boxes)
    low, high = reached(gap, boxes, seed, steps, gap.predictor if remainder else None)
    return np.asarray(np.maximum(over.hi - high, low - over.lo))
