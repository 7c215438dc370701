"""The gap over cells and inputs: its supremum over blocks of these, and over coordinates that tables have no room for."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, final

import numpy as np
import numpy.typing as npt

from gapcert import Array, GapFunction, Interval
from gapcert.plugin import Ints
from gapcert_symbolic.thresholds import THRESHOLDS

from .bounds import Part
from .grid import Blocks, Grid, combined, flat, share


@final
@dataclass(frozen=True)
class Disturbance:
    """[l, u] over blocks of cells and inputs, (state blocks, input blocks, nx), and the blocks of each axis and each input.

    The supremum over a block is one over each of its cells.
    """

    r: Interval
    blocks: tuple[Blocks, ...]
    inputs: tuple[Blocks, ...]

    def of(self, grid: Grid, cell: Ints) -> Ints:
        """The block of each flat cell of the grid."""
        index = np.unravel_index(cell, grid.counts)
        return np.asarray(
            np.ravel_multi_index([b.of[i] for b, i in zip(self.blocks, index, strict=True)], [len(b) for b in self.blocks])
        )

    @property
    def of_inputs(self) -> Ints:
        """The block of each input."""
        return flat(list(self.inputs))

    def scaled(self, scale: float) -> Disturbance:
        return replace(self, r=Interval(scale * self.r.lo, scale * self.r.hi))


def disturbance(
    gap: GapFunction,
    grid: Grid,
    axes: tuple[Array, ...],
    budget: int = THRESHOLDS.gap_boxes,
    tick: Callable[[int, int], None] | None = None,
) -> Disturbance:
    """The gap's signed interval over at most `budget` boxes that cover all cells and inputs, and all of the other states.

    One block is enough along axes on which the gap changes by less than `shared_change` cells. Along others blocks are the
    narrower the more it changes there, as points tell.
    """
    states, nx = grid.states, len(grid.hull[0])
    nz = nx + len(axes)
    ends = _ends(grid, axes)
    held = [j for j in range(nx) if j not in states]
    order = [*states, *range(nx, nz), *held]
    still, weight = _still(gap, grid, ends), _weights(gap, grid, ends)
    counts = tuple(1 if still[j] else len(ends[j][0]) for j in order)
    sizes = share(counts, budget, [float(weight[j]) for j in order])
    blocks = [Blocks.cut(len(ends[j][0]), b) for j, b in zip(order, sizes, strict=True)]
    parts_of = [(ends[j][0][b.starts[:-1]], ends[j][1][b.starts[1:] - 1]) for j, b in zip(order, blocks, strict=True)]
    low, high = np.empty((2, int(np.prod(sizes)), nz))
    low[:, order], high[:, order] = (combined(e) for e in zip(*parts_of, strict=True))
    parts = []
    for k in range(0, len(low), 4096):
        parts.append(gap.interval_over(Interval(low[k : k + 4096], high[k : k + 4096])))
        if tick:
            tick(min(k + 4096, len(low)), len(low))
    n, m = len(states), len(axes)
    r = Interval.concatenate(parts).reshape(int(np.prod(sizes[:n])), int(np.prod(sizes[n : n + m])), -1, nx)
    return Disturbance(Interval(r.lo.min(axis=2), r.hi.max(axis=2)), tuple(blocks[:n]), tuple(blocks[n : n + m]))


def _ends(grid: Grid, axes: tuple[Array, ...]) -> list[tuple[Array, Array]]:
    """Per state and input, lower and upper ends of the pieces that may be put into blocks."""
    cells = dict(zip(grid.states, grid.ends, strict=True))
    for j, (low, high) in enumerate(zip(*grid.hull, strict=True)):
        if j not in cells:
            pieces = np.linspace(low, high, THRESHOLDS.held_pieces + 1)
            cells[j] = pieces[:-1], pieces[1:]
    return [cells[j] for j in sorted(cells)] + [(a, a) for a in axes]


def _hull(ends: list[tuple[Array, Array]]) -> Interval:
    return Interval(np.array([[low.min() for low, _ in ends]]), np.array([[high.max() for _, high in ends]]))


def _still(gap: GapFunction, grid: Grid, ends: list[tuple[Array, Array]]) -> npt.NDArray[np.bool_]:
    """(nz,): coordinates along all of which together the gap changes by at most `shared_change` cells, as its constants
    prove."""
    hull = _hull(ends)
    with np.errstate(invalid="ignore"):
        change = gap.lipschitz(hull)[0, list(grid.states)] * hull.width[0] / grid.widths[:, None]
    return np.asarray((change <= THRESHOLDS.shared_change / len(ends)).all(axis=0))


def _weights(gap: GapFunction, grid: Grid, ends: list[tuple[Array, Array]]) -> Array:
    """(nz,): how many cells the gap moves by, on average over random pairs of points that differ in one coordinate."""
    hull, nz, rng = _hull(ends), len(ends), np.random.default_rng(0x6A9)
    a, b = (hull.lo + (hull.hi - hull.lo) * rng.random((THRESHOLDS.gap_pairs, nz)) for _ in range(2))
    moved = np.repeat(a[None], nz + 1, axis=0)
    moved[range(nz), :, range(nz)] = b.T
    band = np.stack(gap.interval(moved.reshape(-1, nz))).reshape(2, nz + 1, THRESHOLDS.gap_pairs, -1)
    band = band[..., list(grid.states)] / grid.widths
    with np.errstate(invalid="ignore"):
        change = np.nan_to_num(np.abs(band[:, :nz] - band[:, nz:]), nan=0.0, posinf=1e3).max(axis=(0, 3)).mean(axis=1)
    return np.asarray(np.maximum(change, THRESHOLDS.faint_weight * change.max()) if change.max() > 0 else np.ones(nz))


@final
@dataclass
class Tables:
    """What the windows of each axis are tabulated over: `parts` of f, widened by the coordinates on which `added` depends.

    `told`, JSON-able, says over what the supremum of the gap was taken, and how many cells wider that made windows on average.
    """

    parts: list[Part]
    added: Disturbance | None
    told: dict[str, Any] = field(default_factory=dict)


def fitted(
    added: Disturbance | None, parts: list[Part], grid: Grid, axes: tuple[Array, ...], cells: int, names: Sequence[str] = ()
) -> Tables:
    """Tables of at most `window_entries` for so many cells, as far as the gap decides: it enters the window of an axis by its
    supremum over all coordinates that cost at most `shared_change` cells anywhere, and then over those that cost the least on
    average.

    names: of the axes and the inputs.
    """
    if added is None:
        return Tables(parts, None)
    n, blocks = len(grid.counts), (*added.blocks, *added.inputs)
    lengths, sizes = [*grid.counts, *(len(a) for a in axes)], [len(b) for b in blocks]
    ends = np.stack([-added.r.lo, added.r.hi]).reshape(2, *sizes, -1)
    cut = [_Cut(ends[..., s], w, _uses(p), lengths, n, cells) for s, w, p in zip(grid.states, grid.widths, parts, strict=True)]
    while sum(c.entries for c in cut) > THRESHOLDS.window_entries and (open_ := [c for c in cut if c.on - c.own]):
        min(open_, key=lambda c: c.next[0]).drop()
    lo, hi = added.r.lo.copy(), added.r.hi.copy()
    for s, c in zip(grid.states, cut, strict=True):
        lo[..., s], hi[..., s] = (v.reshape(lo.shape[:2]) for v in (-c.least[0], c.least[1]))
    wide = [_widened(p, k, c.on, n) for k, (p, c) in enumerate(zip(parts, cut, strict=True))]
    told: dict[str, Any] = {"blocks": dict(zip(names, sizes, strict=False))}
    dropped = [(name, c) for name, c in zip(names, cut, strict=False) if c.lost > THRESHOLDS.shared_change]
    if dropped:
        told["suprema"] = {name: {"over": [names[d] for d in sorted(c.dropped)], "cells": c.lost} for name, c in dropped}
    return Tables(wide, replace(added, r=Interval(lo, hi)), told)


def _uses(part: Part) -> tuple[set[int], set[int]]:
    return set(part.on), {e for e, used in enumerate(part.inputs) if used}


class _Cut:
    """−l and u of one state over blocks (2, …), over all but the `dropped` coordinates; `on` are those of its table."""

    def __init__(
        self, ends: Array, width: float, uses: tuple[set[int], set[int]], lengths: list[int], n: int, cells: int
    ) -> None:
        self.ends, self.width, self.lengths, self.n, self.cells = ends, width, lengths, n, cells
        self.own = uses[0] | {n + e for e in uses[1]}
        varies = {d for d in range(len(lengths)) if (np.ptp(ends, axis=d + 1) > 0).any()}
        self.on, self.dropped = self.own | varies, set[int]()
        while self.on - self.own and self.next[1] <= THRESHOLDS.shared_change:
            self.drop()

    @property
    def least(self) -> Array:
        """The suprema, over blocks again."""
        along = tuple(d + 1 for d in self.dropped)
        return np.broadcast_to(self.ends.max(axis=along, keepdims=True), self.ends.shape) if along else self.ends

    @property
    def entries(self) -> int:
        rows = float(np.prod([self.lengths[d] for d in self.on if d < self.n], dtype=float))
        return int(min(rows, self.cells) * np.prod([self.lengths[d] for d in self.on if d >= self.n], dtype=float))

    @property
    def lost(self) -> float:
        """How many cells windows are wider, on average."""
        return self._loss(self.dropped)[0]

    @property
    def next(self) -> tuple[float, float, int]:
        """Of the coordinate that costs least: what all that are dropped cost then, on average and at most, and which it is."""
        return min((*self._loss({*self.dropped, d}), d) for d in self.on - self.own)

    def drop(self) -> None:
        d = self.next[2]
        self.dropped.add(d)
        self.on.discard(d)

    def _loss(self, dropped: set[int]) -> tuple[float, float]:
        if not dropped:
            return 0.0, 0.0
        with np.errstate(invalid="ignore"):
            wider = self.ends.max(axis=tuple(d + 1 for d in dropped), keepdims=True) - self.ends
        cells = np.nan_to_num(wider, nan=0.0).sum(axis=0) / self.width
        return float(cells.mean()), float(cells.max())


def _widened(part: Part, k: int, uses: set[int], n: int) -> Part:
    on = tuple(sorted(d for d in uses if d < n))
    inputs = tuple(n + e in uses for e in range(len(part.inputs)))
    return Part(on, part.moves and k not in on, inputs, part.leak)
