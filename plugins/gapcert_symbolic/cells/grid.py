"""A uniform grid that tiles a box of states, and the values that the inputs may take."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, reduce
from typing import Any, final

import numpy as np
import numpy.typing as npt

from gapcert import Array, Box, Region, UsageError
from gapcert.plugin import TURN, Bools, Ints, circle

Small = npt.NDArray[np.int32]
CHUNK = 200_000


@final
@dataclass(frozen=True)
class Grid:
    """counts cells per axis tile the box exactly: cell i of axis k is [edges[k][i], edges[k][i + 1]].

    Axis k is state number states[k] of the model (default: all of them). `frame` (nx, 2) holds the range of every state where
    only some have cells: a cell then stands for all values of the others. nodes: the centres, where they came first.
    """

    box: Box
    counts: tuple[int, ...]
    on: tuple[int, ...] | None = None
    frame: Array | None = None
    nodes: tuple[Array, ...] | None = None

    @classmethod
    def scots(cls, box: Box, eta: tuple[float, ...]) -> Grid:
        """Aligned as SCOTS 0.2 has it: the centres are the multiples of eta in the box, up to a rounding of 1e-10 eta, and the
        outermost cells may stick out of it by half a cell.
        """
        nodes = tuple(multiples(a, b, e) for a, b, e in zip(box.low, box.high, eta, strict=True))
        low = tuple(float(c[0] - e / 2) for c, e in zip(nodes, eta, strict=True))
        high = tuple(float(c[-1] + e / 2) for c, e in zip(nodes, eta, strict=True))
        return cls(Box(box.axes, low, high), tuple(len(c) for c in nodes), nodes=nodes)

    def __post_init__(self) -> None:
        for axis, low, high in zip(self.box.axes, self.box.low, self.box.high, strict=True):
            # Two turns less than that leave one, or more.
            if axis.kind == "angle" and not circle.spans(high, low + 2 * TURN):
                raise UsageError(
                    f"goal: stay has {axis.name} in [{low:g}, {high:g}] rad, more than a full turn; give at most 2π"
                )

    @property
    def states(self) -> tuple[int, ...]:
        return tuple(range(len(self.counts))) if self.on is None else self.on

    @property
    def edges(self) -> tuple[Array, ...]:
        bounds = zip(self.box.low, self.box.high, self.counts, strict=True)
        return tuple(np.linspace(low, high, n + 1) for low, high, n in bounds)

    @cached_property
    def ends(self) -> tuple[tuple[Array, Array], ...]:
        """Lower and upper ends of the cells of each axis."""
        if self.nodes is None:
            return tuple((e[:-1], e[1:]) for e in self.edges)
        half = self.widths / 2
        return tuple((c - h, c + h) for c, h in zip(self.nodes, half, strict=True))

    @property
    def wraps(self) -> tuple[bool, ...]:
        """Axes that close on themselves: angles over a full turn. A narrower angle is a real number."""
        return self.box.wraps

    @property
    def size(self) -> int:
        return int(np.prod(self.counts, dtype=np.int64))

    @property
    def widths(self) -> Array:
        return np.asarray((np.asarray(self.box.high) - np.asarray(self.box.low)) / np.asarray(self.counts))

    @property
    def hull(self) -> tuple[Array, Array]:
        """Lower and upper corner (nx,) of all cells together, over all states."""
        ends = np.array([self.box.low, self.box.high])
        if self.frame is None:
            return ends[0], ends[1]
        whole = self.frame.T.copy()
        whole[:, self.states] = ends
        return whole[0], whole[1]

    def cells(self, start: int, stop: int) -> tuple[Array, Array]:
        """Lower and upper corners (n, nx) of the cells start … stop − 1, as far as there are any, over all states."""
        return self.boxes(np.arange(start, min(stop, self.size)))

    def along(self, axes: tuple[int, ...], cell: Ints | None = None) -> tuple[View, Ints | None]:
        """The cells that differ along these axes; or those that some cells need, and which of them each of these does."""
        if cell is None:
            return View(self, axes), None
        rows, row = self.rows(axes, cell)
        return View(self, axes, rows), row

    def rows(self, axes: tuple[int, ...], cell: Ints) -> tuple[Ints, Ints]:
        """Rows of the product of these axes, in C order, that some cells are in, ascending; and which of them each cell is."""
        index, counts = np.unravel_index(cell, self.counts), [self.counts[k] for k in axes]
        key = np.ravel_multi_index([index[k] for k in axes], counts) if axes else np.zeros(len(cell), dtype=np.int64)
        rows, row = np.unique(key, return_inverse=True)
        return rows, np.asarray(row.ravel())

    def boxes(self, cell: Ints) -> tuple[Array, Array]:
        """Lower and upper corners (n, nx) of cells, over all states."""
        index = np.stack(np.unravel_index(cell, self.counts), axis=-1)
        return self.spanned(index, index)

    def spanned(self, first: Ints | Small, last: Ints | Small) -> tuple[Array, Array]:
        """Lower and upper corners (n, nx) of blocks of cells, from one with the indices first (n, axes) to one with last."""
        low, high = np.empty((2, len(first), len(self.counts)))
        for k, (lower, upper) in enumerate(self.ends):
            low[:, k], high[:, k] = lower[first[:, k]], upper[last[:, k]]
        if self.frame is None:
            return low, high
        whole = np.repeat(self.frame.T[:, None], len(low), axis=1)
        whole[0][:, self.states], whole[1][:, self.states] = low, high
        return whole[0], whole[1]

    def touching(self, region: Region | None, cell: Ints | None = None) -> Bools:
        """(cells,): the closed cell may have a point in the region (over-approximates: for obstacles); of all, or of some.

        None is no region, and nothing is in it.
        """
        return self._related(region, cell, outer=True)

    def inside(self, region: Region | None, cell: Ints | None = None) -> Bools:
        """(cells,): the closed cell lies wholly in one part of the region (under-approximates: for targets), whatever the
        states without cells are; of all, or of some.
        """
        return self._related(region, cell, outer=False)

    def _related(self, region: Region | None, cell: Ints | None, outer: bool) -> Bools:
        found = np.zeros(self.size if cell is None else len(cell), dtype=bool)
        for box in region.boxes if region else ():
            found |= self._product([self._axis(k, box, outer) for k in range(len(self.counts))], cell)
        for shape in region.shapes if region else ():
            asked = shape.touches if outer else shape.covers
            for start in range(0, len(found), CHUNK):
                low, high = self.cells(start, start + CHUNK) if cell is None else self.boxes(cell[start : start + CHUNK])
                low[:, self.states] -= self._rounded
                high[:, self.states] += self._rounded
                found[start : start + CHUNK] |= asked(low, high)
        return found

    @property
    def _rounded(self) -> Array:
        """Where nodes come first, an edge is a node and half a width, rounded."""
        return 0.0 * self.widths if self.nodes is None else 1e-10 * self.widths

    def _axis(self, k: int, box: Box, outer: bool) -> Bools:
        (lower, upper), j = self.ends[k], self.states[k]
        low, high, angle = box.low[j], box.high[j], box.axes[j].kind == "angle"
        found = np.full(self.counts[k], angle and circle.spans(low, high))
        for turns in circle.copies(low, high, self.box.low[k], self.box.high[k]) if angle else range(1):
            # As states on the turn of the grid are held against the box: what holds of both ends of a cell holds within it.
            first, last = (upper + self._rounded[k], lower - self._rounded[k]) if outer else (lower, upper)
            found |= circle.between(low, high, turns, first, last)
        return found

    def _product(self, masks: list[Bools], cell: Ints | None) -> Bools:
        if cell is None:
            return np.asarray(reduce(np.logical_and.outer, masks)).ravel()
        index = np.unravel_index(cell, self.counts)
        return np.asarray(reduce(np.logical_and, [mask[i] for mask, i in zip(masks, index, strict=True)]))

    @property
    def halved(self) -> Grid:
        """Twice as many cells per axis; each edge of this grid is one of that, bit for bit."""
        return Grid(self.box, tuple(2 * n for n in self.counts), self.on, self.frame)


@final
@dataclass(frozen=True)
class View:
    """The cells of a grid that differ along some of its axes, or some of these; along the others they are the first."""

    whole: Grid
    axes: tuple[int, ...]
    rows: Ints | None = None

    @property
    def size(self) -> int:
        return math.prod(self.whole.counts[k] for k in self.axes) if self.rows is None else len(self.rows)

    def flat(self, start: int, stop: int) -> Ints:
        """Numbers of the cells start … stop − 1 in the whole grid."""
        at = np.zeros((len(self.whole.counts), min(stop, self.size) - start), dtype=np.int64)
        if self.axes:
            row = np.arange(start, min(stop, self.size)) if self.rows is None else self.rows[start:stop]
            part = np.unravel_index(row, [self.whole.counts[k] for k in self.axes])
            at[list(self.axes)] = part
        return np.asarray(np.ravel_multi_index(list(at), self.whole.counts))

    def cells(self, start: int, stop: int) -> tuple[Array, Array]:
        return self.whole.boxes(self.flat(start, stop))


@final
@dataclass(frozen=True)
class Blocks:
    """An axis of n items cut into contiguous blocks: `of` (n,) the block of each item, `starts` (blocks + 1,)."""

    of: Ints
    starts: Ints

    @classmethod
    def cut(cls, n: int, blocks: int) -> Blocks:
        starts = np.arange(blocks + 1) * n // blocks
        return cls(np.repeat(np.arange(blocks), np.diff(starts)), starts)

    def __len__(self) -> int:
        return len(self.starts) - 1


def flat(blocks: list[Blocks]) -> Ints:
    """The flat block of every item of the product of the axes, in C order."""
    return np.asarray(np.ravel_multi_index(tuple(combined([b.of for b in blocks]).T), [len(b) for b in blocks]))


def combined(axes: Sequence[npt.NDArray[Any]]) -> npt.NDArray[Any]:
    """(n, axes): every combination of values that are given per axis, in C order."""
    return np.stack([m.ravel() for m in np.meshgrid(*axes, indexing="ij")], axis=-1)


def share(counts: tuple[int, ...], budget: int, weights: Sequence[float] | None = None) -> tuple[int, ...]:
    """Blocks per axis with a product of at most `budget`, as much in proportion to the weights (> 0) as the counts allow.

    With the same weights they are as equal as can be. Σ weight / blocks is about the least there is.
    """
    weight = np.ones(len(counts)) if weights is None else np.asarray(weights) / max(weights)

    def blocks(scale: float) -> Array:
        return np.clip(np.floor(scale * weight), 1, counts)

    low, high = 0.0, float((np.array(counts) / weight).max()) + 1.0
    while high - low > 1e-9 * high:
        middle = (low + high) / 2
        low, high = (middle, high) if blocks(middle).prod() <= budget else (low, middle)
    found = blocks(low)
    # What rounding down has left goes to where blocks are widest.
    for j in np.argsort(found / weight, kind="stable"):
        found[j] = min(counts[j], np.floor(budget / (found.prod() / found[j]) + 1e-9))
    return tuple(int(b) for b in found)


def spaced(low: float, high: float, n: int) -> Array:
    """n values from low to high, as far apart; 0 exactly where it is one of them."""
    found = np.linspace(low, high, n)
    inner = found[1:-1]
    inner[np.abs(inner) < 1e-12 * (high - low)] = 0.0
    return found


def multiples(low: float, high: float, eta: float) -> Array:
    """The multiples of eta between low and high, with the rounding of SCOTS 0.2 (UniformGrid)."""
    delta = eta / 1e10

    def number(bound: float, side: int) -> int:
        sign = (bound > 0) - (bound < 0)
        rounded = abs(bound) / eta + side * sign * (0.5 - delta)
        return sign * math.floor(rounded + 0.5)

    first, last = number(low, 1), number(high, -1)
    if last < first:
        raise UsageError(f"controller.eta: no multiple of {eta:g} lies in [{low:g}, {high:g}]; give a smaller distance")
    return np.asarray(float(first) * eta + eta * np.arange(last - first + 1))
