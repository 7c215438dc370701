"""The cells of a saved controller: their boxes, the indices that a box of successors touches, and what regions say of them.

Cells of a uniform grid are one level; nodes of a refined one have as many as they were halved, each on a grid of its own. A
state without cells is an axis of one cell, which its box fills.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, reduce
from typing import Any, final

import numpy as np
import numpy.typing as npt

from gapcert.plugin import TURN, Array, Bools, Goal, Ints, Region
from gapcert_cells import GridController
from gapcert_verify.arithmetic import Range

BEYOND = 2**30
"""The height of what loses, or lies beyond the grid."""


@final
@dataclass(frozen=True)
class Axis:
    """Edges of the cells of one state; of an angle over a full turn the last cell is beside the first."""

    edges: Array
    wraps: bool

    @property
    def count(self) -> int:
        return len(self.edges) - 1

    @property
    def width(self) -> float:
        return float(self.edges[-1] - self.edges[0]) / self.count

    def coarser(self, factor: int) -> Axis:
        return Axis(self.edges[::factor], self.wraps)

    def touched(self, x: Range) -> tuple[Ints, Ints]:
        """The first and the last cell that has a point of the interval; −1 and `count` lie beyond. A cell has its lower edge.

        Where the axis wraps, 0 ≤ first < count and last − first < count. Taking whole turns off rounds, by which the interval
        is widened.
        """
        with np.errstate(invalid="ignore"):
            return self._around(x) if self.wraps else (self._below(x.lo, True), self._below(x.hi, False))

    def _below(self, x: Array, low: bool) -> Ints:
        n = self.count
        at = np.searchsorted(self.edges, x, "right") - 1
        at = np.where(x == self.edges[-1], n - 1, at)
        return np.where(np.isnan(x), -1 if low else n, at)

    def _around(self, x: Range) -> tuple[Ints, Ints]:
        n, start = self.count, self.edges[0]
        turn = np.floor((x.lo - start) / TURN)
        pad = 2.0**-50 * (TURN * (np.abs(turn) + 2) + abs(start))
        low, high = x.lo - TURN * turn - pad, x.hi - TURN * turn + pad
        more = np.floor((high - start) / TURN)
        first = np.searchsorted(self.edges, low, "right") - 1
        last = np.searchsorted(self.edges, high - TURN * more, "right") - 1
        last = np.where(np.isfinite(more), np.minimum(last, n - 1) + n * np.where(np.isfinite(more), more, 0), n).astype(
            np.int64
        )
        whole = ~(last - first < n) | ~np.isfinite(turn)
        first = np.minimum(first, n - 1)
        first, last = np.where(whole, 0, first), np.where(whole, n - 1, last)
        return np.where(first < 0, first + n, first), np.where(first < 0, last + n, last)


@final
@dataclass(frozen=True)
class Level:
    """One grid, and the nodes that are cells of it: node (n,) by number, index (n, axes). half (axes,): of the widest cell."""

    axes: tuple[Axis, ...]
    node: Ints
    index: npt.NDArray[np.int32]

    @property
    def counts(self) -> tuple[int, ...]:
        return tuple(a.count for a in self.axes)

    @property
    def half(self) -> Array:
        return np.array([float(np.diff(a.edges).max()) / 2 for a in self.axes])

    def boxes(self, rows: Any) -> tuple[Array, Array]:
        """Lower and upper corners (n, axes) of some of the nodes."""
        own = self.index[rows]
        low = np.stack([a.edges[own[:, k]] for k, a in enumerate(self.axes)], axis=1)
        return low, np.stack([a.edges[own[:, k] + 1] for k, a in enumerate(self.axes)], axis=1)


@final
@dataclass(frozen=True)
class Cells:
    """All cells of a controller. values (…, nodes) have the states of an automaton before the nodes, where there is one."""

    controller: GridController
    levels: tuple[Level, ...]

    @classmethod
    def of(cls, c: GridController) -> Cells:
        """ValueError where these are no cells: edges that do not rise, or nodes that are no tree of halves."""
        axes = list[Axis]()
        made = dict(zip(c.on, zip(c.edges, c.wraps, strict=True), strict=True))
        for j in range(len(c.goal.stay.axes)):
            if j in made:
                axes.append(Axis(np.asarray(made[j][0], dtype=np.float64), made[j][1]))
            else:
                assert c.held is not None, "a state without cells is held"
                k = c.held.names.index(c.goal.stay.axes[j].name)
                axes.append(Axis(np.array([c.held.low[k], c.held.high[k]]), False))
        for axis in axes:
            if (
                axis.edges.ndim != 1
                or len(axis.edges) < 2
                or not (np.diff(axis.edges) > 0).all()
                or not np.isfinite(axis.edges).all()
            ):
                raise ValueError("the edges of its cells do not rise")
        if c.splits is None:
            size = math.prod(a.count for a in axes)
            index = np.stack(np.unravel_index(np.arange(size), [a.count for a in axes]), axis=1).astype(np.int32)
            return cls(c, (Level(tuple(axes), np.arange(size), index),))
        return cls(c, tuple(_levels(c, axes)))

    @property
    def size(self) -> int:
        return sum(len(level.node) for level in self.levels)

    @cached_property
    def whole(self) -> Bools:
        """(nodes,): those that are not halved."""
        return np.ones(self.size, dtype=bool) if self.controller.splits is None else self.controller.splits.first == 0

    def heights(self, height: npt.NDArray[np.int32]) -> list[Heights]:
        """Per level, what is greatest over boxes of its cells, given the height of each whole node."""
        splits = self.controller.splits
        if splits is None:
            (level,) = self.levels
            return [Heights(height.reshape(level.counts), tuple(a.wraps for a in level.axes))]
        most = np.where(self.whole, height, -1)
        for level in self.levels[::-1]:
            parts = level.node[~self.whole[level.node]]
            children = splits.first[parts].astype(np.int64)[:, None] + np.arange(len(splits.sides))
            most[parts] = most[children].max(axis=1)
        out, painted = list[Heights](), np.empty(0, dtype=np.int32)
        for k, level in enumerate(self.levels):
            on = [j for j, a in enumerate(level.axes) if k == 0 or a.count > self.levels[k - 1].axes[j].count]
            painted = reduce(lambda p, j: np.repeat(p, 2, axis=j), on, painted) if k else np.empty(level.counts, dtype=np.int32)
            painted[tuple(level.index.T)] = most[level.node]
            out.append(Heights(painted, tuple(a.wraps for a in level.axes)))
        return out

    def related(self, region: Region | None, touching: bool) -> Bools:
        """(nodes,): the closed cell may have a point in the region (`touching`), or lies wholly in one part of it."""
        out = np.zeros(self.size, dtype=bool)
        for level in self.levels if region else ():
            assert region is not None, "there is a region"
            found = np.zeros(len(level.node), dtype=bool)
            for box in region.boxes:
                masks = [_meets(a, box, j, touching)[level.index[:, j]] for j, a in enumerate(level.axes)]
                found |= reduce(np.logical_and, masks)
            for shape in region.shapes:
                for k in range(0, len(found), 1 << 16):
                    ends = level.boxes(slice(k, k + (1 << 16)))
                    found[k : k + (1 << 16)] |= (shape.touches if touching else shape.covers)(*ends)
            out[level.node] = found
        return out

    def labels(self, regions: Sequence[Region]) -> tuple[Ints, Ints]:
        """(must, may), each (nodes,): regions that a cell lies wholly in, and those that it may touch, as letters."""
        must, may = np.zeros((2, self.size), dtype=np.int64)
        for p, region in enumerate(regions):
            within = self.related(region, touching=False)
            must |= within.astype(np.int64) << p
            may |= (self.related(region, touching=True) | within).astype(np.int64) << p
        return must, may

    def kept(self, goal: Goal) -> Bools:
        """(nodes,): every state of the cell is in `stay`, and none in `avoid`. Edges are rounded: by an ulp or two."""
        out = ~self.related(goal.avoid, touching=True)
        for level in self.levels:
            inside = []
            for j, a in enumerate(level.axes):
                low, high = goal.stay.low[j], goal.stay.high[j]
                spare = 4 * np.spacing(max(abs(low), abs(high)))
                whole = a.wraps and (high - low) * (1 + 1e-15) >= TURN
                inside.append((whole | ((a.edges[:-1] >= low - spare) & (a.edges[1:] <= high + spare)))[level.index[:, j]])
            out[level.node] &= reduce(np.logical_and, inside)
        return out


def _levels(c: GridController, axes: Sequence[Axis]) -> list[Level]:
    splits = c.splits
    assert splits is not None, "it is refined"
    first, parts = splits.first, 1 << len(splits.counts)
    starts = splits.starts
    split = np.flatnonzero(first)
    fits = starts[-1] == len(first) and np.array_equal(first[split], starts[1] + parts * np.arange(len(split)))
    if not fits or (first < 0).any() or any(a.count % (1 << splits.levels) for j, a in enumerate(axes) if j in c.on):
        raise ValueError("its nodes are no tree of halves")
    out = []
    for k, (low, high) in enumerate(itertools.pairwise(starts)):
        own = tuple(a.coarser(1 << (splits.levels - k)) if j in c.on else a for j, a in enumerate(axes))
        index = np.zeros((high - low, len(axes)), dtype=np.int32)
        index[:, list(c.on)] = splits.index[low:high]
        out.append(Level(own, np.arange(low, high), index))
    return out


def _meets(axis: Axis, box: Any, j: int, touching: bool) -> Bools:
    """(count,): the cells of an axis that a box touches there, or that lie in it; an angle in any of its turns."""
    low, high, found = axis.edges[:-1], axis.edges[1:], np.zeros(axis.count, dtype=bool)
    turns = [0]
    if box.axes[j].kind == "angle":
        turns = list(range(math.floor((low[0] - box.high[j]) / TURN) - 1, math.ceil((high[-1] - box.low[j]) / TURN) + 2))
    for t in turns:
        # Moving by a turn rounds: obstacles are taken too large then, and targets too small.
        pad = 2.0**-50 * TURN * abs(t) * (1 if touching else -1)
        a, b = box.low[j] + t * TURN - pad, box.high[j] + t * TURN + pad
        found |= (low <= b) & (high >= a) if touching else (low >= a) & (high <= b)
    return found


@final
class Heights:
    """The greatest height over boxes of cells: tables over boxes of 2^p cells per axis, of which 2^axes cover any box."""

    def __init__(self, height: npt.NDArray[np.int32], wraps: tuple[bool, ...]) -> None:
        self.wraps = wraps
        self._tables = {(0,) * height.ndim: height}

    def over(self, first: Ints, last: Ints) -> Ints:
        """(n,): over cells first … last (n, axes), both included; BEYOND where these leave the grid."""
        counts = np.array(self._tables[(0,) * len(self.wraps)].shape)
        inside = (np.array(self.wraps) | ((first >= 0) & (last < counts))).all(axis=1)
        out = np.full(len(first), BEYOND, dtype=np.int64)
        rows = np.flatnonzero(inside)
        a, b = first[rows], last[rows]
        power = np.frexp((b - a + 1).astype(np.float64))[1] - 1  # the largest 2^p ≤ size
        key = np.ravel_multi_index(tuple(power.T), (32,) * len(counts))
        for k in np.unique(key):
            own = np.flatnonzero(key == k)
            p = tuple(int(v) for v in np.unravel_index(k, (32,) * len(counts)))
            table = self._table(p)
            sides = [(a[own, j] % n, (b[own, j] + 1 - (1 << p[j])) % n) for j, n in enumerate(counts)]
            corners = [s if p[j] else s[:1] for j, s in enumerate(sides)]
            out[rows[own]] = reduce(np.maximum, (table[corner] for corner in itertools.product(*corners)))
        return out

    def _table(self, p: tuple[int, ...]) -> npt.NDArray[np.int32]:
        if p not in self._tables:
            j = int(np.argmax(p))
            before = self._table((*p[:j], p[j] - 1, *p[j + 1 :]))
            at = np.arange(before.shape[j]) + (1 << (p[j] - 1))
            at = at % len(at) if self.wraps[j] else np.minimum(at, len(at) - 1)
            self._tables[p] = np.maximum(before, before.take(at, axis=j))
        return self._tables[p]
