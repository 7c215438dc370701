"""Where a cell may go under an input: f over the cell, by its equations or by a growth bound about its centre, and [l, u]."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np
import numpy.typing as npt

from gapcert.plugin import Array, Bools, Ints
from gapcert_verify import arithmetic as ar
from gapcert_verify.arithmetic import Range
from gapcert_verify.evaluator import Equations, Term

from .cells import Cells, Level
from .gap_bounds import Gap

ENTRIES = 1 << 22  # of a table that is kept
BOXES = 40_000  # over which [l, u] is bounded at first
PIECES = 16  # of a state without cells, at first
HALVED = 400_000  # of these, at most
CLOSE = 1 / 32  # of a cell: to which [l, u] is then known; of a state without cells a 16th of that


@final
@dataclass(frozen=True)
class Growth:
    """|f(x, u) − f(c, u)| ≤ ρ(r + z, u) + z where |x − c| ≤ r, as it is declared; z (nx,): errors of measurement."""

    radius: Equations
    error: Array

    def over(self, half: Array, u: Array, k: int) -> Array:
        """(n,) of half widths (n, nx) and inputs (n, nu), rounded up."""
        z = np.concatenate([ar.up(half + self.error), u], axis=1)
        return np.asarray(ar.up(self.radius.over(z, z, self.radius.terms[k]).hi + self.error[k]))


@final
@dataclass(frozen=True)
class Flow:
    """x⁺ ∈ f(x, u) + [l, u](x, u) over boxes. points (m, nu): the inputs. gap: None is none."""

    model: Equations
    gap: Gap | None
    growth: Growth | None
    points: Array

    def over(self, low: Array, high: Array, which: Ints) -> list[Range]:
        """Per state, of boxes (n, nx) under inputs by number."""
        u, middle, half = self.points[which], low / 2 + high / 2, None
        first, last = (low, high) if self.growth is None else (middle, middle)
        first, last = (np.concatenate([end, u], axis=1) for end in (first, last))
        out = [self.model.over(first, last, t) for t in self.model.terms]
        if self.growth is not None:
            half = ar.up(np.maximum(high - middle, middle - low))
            out = [_wider(x, self.growth.over(half, u, k)) for k, x in enumerate(out)]
        if self.gap is None:
            return out
        r = self.gap.over(*(np.concatenate([end, u], axis=1) for end in (low, high)))
        return [ar.add(x, Range(r.lo[:, k], r.hi[:, k])) for k, x in enumerate(out)]

    def still(self, k: int, which: Ints) -> Bools:
        """(n,): these inputs, by number, leave state k exactly where it is, whatever it is, and so does the gap."""
        beside, u = self.model.moves(k), self.points[which]
        pushed = self.gap is not None and not self.gap.nothing(k)
        if beside is None or self.growth is not None or pushed or any(j < self.model.nx for j in beside.on):
            return np.zeros(len(which), dtype=bool)
        z = np.concatenate([np.zeros((len(u), self.model.nx)), u], axis=1)
        return np.asarray(ar.zero(self.model.over(z, z, beside)))

    def certain(self, x: Array, which: Ints) -> list[list[Range]]:
        """Two of the states that a step from each x (n, nx) may lead to: f + l and f + u. None where a bound stands between."""
        z = np.concatenate([x, self.points[which]], axis=1)
        if self.growth is not None or (self.gap is not None and self.gap.extended is not None):
            return []
        f = [self.model.over(z, z, t) for t in self.model.terms]
        if self.gap is None:
            return [f]
        return [[ar.add(a, Range(r.lo[:, k], r.hi[:, k])) for k, a in enumerate(f)] for r in self.gap.at(z)]

    @cached_property
    def values(self) -> list[Array]:
        """Per input, the values that it takes, in rising order."""
        return [np.unique(column) for column in self.points.T]

    @cached_property
    def digits(self) -> Ints:
        """(m, nu): which of its values each input has."""
        return np.stack([np.searchsorted(v, c) for v, c in zip(self.values, self.points.T, strict=True)], axis=1)


def _wider(x: Range, by: Array) -> Range:
    return Range(ar.down(x.lo - by), ar.up(x.hi + by))


@final
@dataclass(frozen=True)
class Spread:
    """[l, u] over blocks of cells and inputs, (blocks, nx) each way; of (n,) for each cell and input along each axis."""

    low: Array
    high: Array
    blocks: list[Ints]
    counts: tuple[int, ...]

    def on(self, k: int) -> set[int]:
        """The coordinates along which that of state k varies."""
        ends = [end[:, k].reshape(self.counts) for end in (self.low, self.high)]
        with np.errstate(invalid="ignore"):  # of boxes beyond Z nothing is known
            return {j for j, n in enumerate(self.counts) if n > 1 and any((np.ptp(e, axis=j) > 0).any() for e in ends)}


def spread(flow: Flow, level: Level) -> Spread | None:
    """Of a level: over blocks that are the finer along a coordinate the more the gap changes there."""
    if flow.gap is None:
        return None
    ends = list[tuple[Array, Array]]()
    held = [a.count == 1 for a in level.axes]
    for a, alone in zip(level.axes, held, strict=True):
        edges = np.linspace(a.edges[0], a.edges[-1], PIECES + 1) if alone else a.edges
        ends.append((edges[:-1], edges[1:]))
    ends += [(v, v) for v in flow.values]
    counts = _shares(flow, level, [len(low) for low, _ in ends], np.array([high[-1] - low[0] for low, high in ends]))
    starts = [np.arange(n) * len(low) // n for n, (low, _) in zip(counts, ends, strict=True)]
    parts = [(low[s], high[np.append(s[1:], len(low)) - 1]) for s, (low, high) in zip(starts, ends, strict=True)]
    boxes = [np.stack([m.ravel() for m in np.meshgrid(*side, indexing="ij")], axis=1) for side in zip(*parts, strict=True)]
    # A state without cells is anywhere in its box.
    along = tuple(j for j, alone in enumerate(held) if alone)
    block = np.arange(math.prod(counts)).reshape(counts)
    block = np.broadcast_to(block.min(axis=along, keepdims=True), counts).ravel()
    low, high = _hulls(flow.gap, level, boxes[0], boxes[1], block, along)
    own = [
        np.zeros(1, dtype=np.int64) if j in along else np.searchsorted(s, np.arange(len(e[0])), "right") - 1
        for j, (s, e) in enumerate(zip(starts, ends, strict=True))
    ]
    return Spread(low, high, own, tuple(1 if j in along else n for j, n in enumerate(counts)))


def _hulls(gap: Gap, level: Level, low: Array, high: Array, block: Ints, along: tuple[int, ...]) -> tuple[Array, Array]:
    """The least l and the largest u of each block, (blocks, nx) each, in the blocks' order.

    Boxes that may have more than is known from middles are halved along states without cells, which every successor depends on.
    """
    names, of = np.unique(block, return_inverse=True)
    ends, seen = (np.full((2, len(names), len(level.axes)), -np.inf) for _ in range(2))
    near = np.array([a.width * (CLOSE / 16 if a.count == 1 else CLOSE) for a in level.axes])
    left = HALVED if along else 0
    while len(low):
        found, c = _bounds(gap, low, high), low / 2 + high / 2
        for k, value in enumerate(_bounds(gap, c, c) if left > 0 else found):
            np.maximum.at(seen[k], of, value)
        wide = (found > seen[:, of] + near).any(axis=(0, 2))
        left -= int(wide.sum())
        wide &= left > 0
        for k in range(2):
            np.maximum.at(ends[k], of[~wide], found[k][~wide])
        low, high, of, row = low[wide], high[wide], of[wide], np.arange(wide.sum())
        j = np.array(along, dtype=np.int64)[np.argmax((high - low)[:, along], axis=1)] if len(row) else row
        below, above = high.copy(), low.copy()
        below[row, j] = above[row, j] = (low / 2 + high / 2)[row, j]
        low, high, of = np.concatenate([low, above]), np.concatenate([below, high]), np.tile(of, 2)
    return -ends[0], ends[1]


def _bounds(gap: Gap, low: Array, high: Array) -> Array:
    """(−l, u) over boxes, (2, n, nx)."""
    found = [gap.over(low[a : a + 4096], high[a : a + 4096]) for a in range(0, len(low), 4096)]
    return np.stack([np.concatenate([-r.lo for r in found]), np.concatenate([r.hi for r in found])])


def _shares(flow: Flow, level: Level, most: Sequence[int], widths: Array) -> list[int]:
    """Blocks per coordinate."""
    assert flow.gap is not None, "there is a gap to bound"
    slopes, counts = flow.gap.slopes, [1] * len(most)
    if slopes is None:
        weight = np.ones(len(most))
    else:
        weight = (slopes * widths / np.array([a.width for a in level.axes])[:, None]).max(axis=0)
    while True:
        open_ = [j for j, n in enumerate(counts) if n < most[j] and weight[j] > 0]
        if not open_:
            return counts
        j = max(open_, key=lambda j: weight[j] / counts[j])
        more = min(2 * counts[j], most[j])
        if math.prod(counts) // counts[j] * more > BOXES:
            return counts
        counts[j] = more


@final
class Windows:
    """First and last cells of successors, of pairs of a node of a level and an input."""

    def __init__(self, flow: Flow, level: Level) -> None:
        self.flow, self.level, self.spread = flow, level, spread(flow, level)
        self.parts = [self._part(k) for k in range(len(level.axes))]
        self._kept: dict[int, tuple[Ints, Ints, Ints]] = {}
        for k, part in enumerate(self.parts):
            rows, row = part.rows(level, level.index)
            if len(rows) * len(part.columns) <= ENTRIES:
                self._kept[k] = (row, *part.table(self, rows))

    def _part(self, k: int) -> _Part:
        flow, nx = self.flow, len(self.level.axes)
        beside = flow.model.moves(k)
        term = flow.model.terms[k] if beside is None else beside
        gap = set[int]() if self.spread is None else self.spread.on(k)
        uses = set(term.on) | (set() if flow.growth is None else set(range(nx, nx + flow.points.shape[1])))
        on = sorted({j for j in uses | gap if j < nx} | (set() if beside is None else {k}))
        inputs = sorted(j - nx for j in uses | gap if j >= nx)
        columns, column = np.unique(flow.digits[:, inputs], axis=0, return_index=True, return_inverse=True)[1:]
        return _Part(k, term, beside is not None, on, columns, column.reshape(-1))

    def of(self, rows: Ints, pairs: tuple[Ints, Ints]) -> tuple[Ints, Ints]:
        """(first, last), each (n, axes), of pairs (position among `rows`, input); rows: nodes by their place in the level."""
        first, last = np.empty((2, len(pairs[0]), len(self.parts)), dtype=np.int64)
        for k, part in enumerate(self.parts):
            if k in self._kept:
                row, a, b = self._kept[k]
                row = row[rows]
            else:
                found, row = part.rows(self.level, self.level.index[rows])
                a, b = part.table(self, found)
            at = row[pairs[0]], part.column[pairs[1]]
            first[:, k], last[:, k] = a[at], b[at]
        return first, last


@final
@dataclass(frozen=True)
class _Part:
    """State k of successors: of `term`, beside x_k where it `moves`; on: the axes that it depends on. columns: inputs that
    differ in what matters, by number; column (m,): which of these each input is.
    """

    k: int
    term: Term
    moves: bool
    on: list[int]
    columns: Ints
    column: Ints

    def rows(self, level: Level, index: npt.NDArray[np.int32]) -> tuple[npt.NDArray[np.int32], Ints]:
        """Indices that differ along `on`, and which of them each is."""
        if not self.on:
            return index[:1], np.zeros(len(index), dtype=np.int64)
        counts = [level.axes[j].count for j in self.on]
        key = np.ravel_multi_index(tuple(index[:, self.on].T), counts)
        _, one, row = np.unique(key, return_index=True, return_inverse=True)
        return index[one], np.asarray(row.reshape(-1))

    def table(self, windows: Windows, index: npt.NDArray[np.int32]) -> tuple[Ints, Ints]:
        """(rows, columns): first and last cell."""
        level, axis = windows.level, windows.level.axes[self.k]
        x = self._of_model(windows, index)
        if (r := windows.spread) is not None:
            cell = [r.blocks[j][index[:, j]][:, None] for j in range(len(level.axes))]
            digit = windows.flow.digits[self.columns]
            put = [r.blocks[len(level.axes) + e][digit[:, e]][None] for e in range(digit.shape[1])]
            at = np.ravel_multi_index([np.broadcast_to(c, x.lo.shape) for c in (*cell, *put)], r.counts)
            x = ar.add(x, Range(r.low[at, self.k], r.high[at, self.k]))
        if not self.moves:
            return axis.touched(ar.known(x))
        own = index[:, self.k, None]
        low, high = axis.edges[own], axis.edges[own + 1]
        if windows.flow.growth is not None:
            return axis.touched(ar.known(ar.add(x, ar.point(low / 2 + high / 2))))
        # The upper edge is the next cell's: what does not move at all does not come there.
        first, last = axis.touched(ar.known(ar.add(x, Range(low, high))))
        still = ar.zero(x)
        return np.where(still, own, first), np.where(still, own, last)

    def _of_model(self, windows: Windows, index: npt.NDArray[np.int32]) -> Range:
        """The term over cells that differ in what it depends on, (rows, columns)."""
        level, flow = windows.level, windows.flow
        own = [j for j in sorted(self.term.on) if j < len(level.axes)]
        part = _Part(self.k, self.term, False, own, self.columns, self.column)
        rows, row = part.rows(level, index)
        n, m = len(rows), len(self.columns)
        low, high = (np.zeros((n, len(level.axes))) for _ in range(2))
        for j in own:
            low[:, j], high[:, j] = level.axes[j].edges[rows[:, j]], level.axes[j].edges[rows[:, j] + 1]
        if flow.growth is not None:
            low = high = low / 2 + high / 2
        u = np.tile(flow.points[self.columns], (n, 1))
        ends = [np.concatenate([np.repeat(end, m, axis=0), u], axis=1) for end in (low, high)]
        x = flow.model.over(ends[0], ends[0] if low is high else ends[1], self.term)
        if flow.growth is not None:
            half = np.repeat(level.half[None], m, axis=0)
            x = _wider(x, np.tile(flow.growth.over(half, flow.points[self.columns], self.k), n))
        return Range(x.lo.reshape(n, m)[row], x.hi.reshape(n, m)[row])


@final
@dataclass(frozen=True)
class Stored:
    """The successors that a controller has stored, of the nodes of a level; a state without cells stays in its box."""

    cells: Cells
    level: Level

    def of(self, rows: Ints, pairs: tuple[Ints, Ints]) -> tuple[Ints, Ints]:
        """As `Windows.of`."""
        c = self.cells.controller
        found = c.successors
        assert found is not None, "asked of what has them"
        ends = found.ends(self.level.node[rows[pairs[0]]], pairs[1])
        shift = 0 if c.splits is None else c.splits.levels - self.cells.levels.index(self.level)
        first, last = np.zeros((2, len(pairs[0]), len(self.level.axes)), dtype=np.int64)
        for k, j in enumerate(c.on):
            axis = self.level.axes[j]
            first[:, j], last[:, j] = ends[0][:, k] >> shift, ends[1][:, k] >> shift
            if axis.wraps:
                size = np.minimum(last[:, j] - first[:, j], axis.count - 1)
                first[:, j] %= axis.count
                last[:, j] = first[:, j] + size
        return first, last
