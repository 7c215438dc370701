"""On which cells and inputs the successors along an axis depend, from the Jacobian over all of them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import final

import numpy as np

from gapcert import Array, Interval, Model, UsageError
from gapcert_symbolic.thresholds import THRESHOLDS

from .grid import Grid

ROUNDING = 64 * float(np.finfo(np.float64).eps)  # of a slope, relative


@final
@dataclass(frozen=True)
class Part:
    """f_k(x, u) = [x_k] + g(x_on, u_used), up to `leak`: with x_k where it `moves`, and k not in `on` then.

    on: axes of the grid. inputs: which ones matter.
    """

    on: tuple[int, ...]
    moves: bool
    inputs: tuple[bool, ...]
    leak: float

    def rows(self, grid: Grid) -> int:
        return math.prod(grid.counts[d] for d in self.on)


def structure(model: Model, grid: Grid, axes: tuple[Array, ...], rounded: bool = False) -> list[Part]:
    """One part per axis of the grid.

    With J over the hull of all cells and inputs, replacing x_j by another value of the grid changes f_k by |J_kj| w_j at most
    (mean-value theorem), w_j the width of the grid, and moving x_k by d changes f_k by d ± |J_kk − 1| w_k. Where that is below
    `axis_leak` cells, the sum of it over all such axes is the leak. `rounded`: slopes may be taken in floating point, from
    models that tell which are constant; all others count. One that says nothing of its derivatives is asked at points.
    """
    z, nx = _hull(grid, axes), len(model.states)
    if rounded and (known := model.constant_slopes()) is not None:
        return _parts(grid, nx, *_told(known, z.width[0]))
    try:
        slope, widths = model.jacobian_enclosure(z)[0], z.width[0]
        with np.errstate(invalid="ignore"):
            change = slope.mag * widths
            along = (slope[range(nx), range(nx)] - 1.0).mag * widths[:nx]
    except UsageError:
        change, along = _seen(model, z)
    return _parts(grid, nx, change, along)


def inferred(model: Model, grid: Grid, axes: tuple[Array, ...]) -> bool:
    """Is what the successors depend on known from points alone, since the model tells nothing of its derivatives?"""
    if model.constant_slopes() is not None:
        return False
    try:
        model.jacobian_enclosure(_hull(grid, axes))
    except UsageError:
        return True
    return False


def _hull(grid: Grid, axes: tuple[Array, ...]) -> Interval:
    low, high = grid.hull
    least, most = (np.array([end(a) for a in axes]) for end in (np.min, np.max))
    return Interval(np.concatenate([low, least])[None], np.concatenate([high, most])[None])


def _told(slope: Array, widths: Array) -> tuple[Array, Array]:
    """As `_seen`, from slopes that are constant, with what they may err by rounding; what varies may change anything."""
    nx, size = len(slope), np.where(np.isnan(slope), np.inf, np.abs(slope))
    own = np.where(np.isnan(np.diagonal(slope)), np.inf, np.abs(np.diagonal(slope) - 1))
    with np.errstate(invalid="ignore"):
        return size * (1 + ROUNDING) * widths, (own + ROUNDING) * widths[:nx]


def _seen(model: Model, z: Interval) -> tuple[Array, Array]:
    """The largest |Δf_k| (nx, nz) where one coordinate changes, and |Δf_k − Δx_k| (nx,), of pairs of random points of a box."""
    rng, nz, nx = np.random.default_rng(0x57A7), z.shape[1], len(model.states)
    a, b = (z.lo + z.width * rng.random((THRESHOLDS.structure_pairs, nz)) for _ in range(2))
    others = [a.copy() for _ in range(nz)]
    for j, other in enumerate(others):
        other[:, j] = b[:, j]
    points = np.concatenate([a, *others])
    after = model.fast_rollout(points[:, :nx], points[:, None, nx:]).x[:, 1].reshape(nz + 1, THRESHOLDS.structure_pairs, nx)
    moved = after[1:] - after[0]
    along = np.abs(np.diagonal(moved[:nx], axis1=0, axis2=2) - (b - a)[:, :nx]).max(axis=0)
    return np.abs(moved).max(axis=1).T, along


def _parts(grid: Grid, nx: int, change: Array, along: Array) -> list[Part]:
    found = []
    for k, state in enumerate(grid.states):
        still, own = change[state], float(along[state])
        limit = THRESHOLDS.axis_leak * float(grid.widths[k])
        on = tuple(d for d, j in enumerate(grid.states) if d != k and not still[j] <= limit)
        moves = own <= limit
        if not moves and not still[state] <= limit:
            on = tuple(sorted((*on, k)))
        uses = tuple(not v <= limit for v in still[nx:])
        small = [still[j] for d, j in enumerate(grid.states) if d != k and d not in on]
        small += [own if moves else still[state]] if k not in on else []
        small += [v for v, used in zip(still[nx:], uses, strict=True) if not used]
        found.append(Part(on, moves, uses, 2 * float(sum(small))))
    return found
