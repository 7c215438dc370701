"""Where a cell may go under an input: a bound of f + [l, u] over it, as windows of cell indices."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, final

import numpy as np

from gapcert import Array, Interval, UsageError
from gapcert.plugin import Bools, Ints
from gapcert_cells import Along, Successors
from gapcert_symbolic.kernels.kernels import Bits, Game, Packed, _strides
from gapcert_symbolic.thresholds import THRESHOLDS

from .bounds import Bound, Nominal, Part, structure
from .gaps import Disturbance, fitted
from .grid import Grid, View, combined

EPS = float(np.finfo(np.float64).eps)
PAIRS = 400_000


@final
@dataclass(frozen=True)
class Windows:
    """Cells that the successors may touch: per axis of the grid a table.

    On a bounded axis what lies beyond the grid is −1 or n before the own index is added, or further out; on one that wraps,
    0 ≤ first < n and last − first < n, and indices count modulo n. allowed (cells, inputs): what the relations of the domain
    leave; None is everything. told: how the gap entered.
    """

    grid: Grid
    axes: tuple[Along, ...]
    allowed: Bools | None = None
    told: Mapping[str, Any] = field(default_factory=dict)

    @property
    def inputs(self) -> int:
        return len(self.axes[0].column)

    @property
    def successors(self) -> Successors:
        """As controllers have them."""
        return Successors(self.grid.counts, self.grid.wraps, self.axes)

    @property
    def game(self) -> Game:
        """As the compiled solvers have it."""
        n, offset = len(self.axes), [a.row * a.first.shape[1] for a in self.axes if a.row is not None]
        strides, start, at = np.zeros((n, n), dtype=np.int64), np.zeros(n, dtype=np.int64), 0
        for k, axis in enumerate(self.axes):
            start[k], step = at, axis.first.shape[1]
            for d in axis.on[::-1]:
                strides[k, d], step = step, step * self.grid.counts[d]
            at += axis.first.size
        first, last = (np.concatenate([getattr(a, end).ravel() for a in self.axes]) for end in ("first", "last"))
        moves, column = np.array([a.moves for a in self.axes]), np.stack([a.column for a in self.axes])
        rows, none = np.stack(offset) if offset else np.empty((n, 0), dtype=np.int64), np.empty(0, dtype=np.int64)
        packed = Packed(first, last, start, strides, rows, moves, column)
        counts, wraps = np.array(self.grid.counts), np.array(self.grid.wraps)
        return Game(counts, wraps, _strides(counts), packed, self.permitted, self.grid.size, 0, none, 0, none)

    @property
    def permitted(self) -> Bools:
        """`allowed` as the compiled solvers have it: empty where it is None."""
        return np.empty((0, 0), dtype=bool) if self.allowed is None else self.allowed

    @property
    def every(self) -> Bits:
        """All inputs that the relations leave, packed: (cells, bytes), or (1, bytes) where they leave all."""
        return np.packbits(np.ones((1, self.inputs), dtype=bool) if self.allowed is None else self.allowed, axis=1)

    @property
    def no_bits(self) -> Bits:
        """(cells, bytes) of no inputs."""
        return np.zeros((self.grid.size, (self.inputs + 7) // 8), dtype=np.uint8)

    def offered(self, cells: Bools) -> Bits:
        """All inputs that the relations leave, packed, in some of the cells (cells,)."""
        return np.where(cells[:, None], self.every, np.uint8(0))

    @property
    def rows(self) -> tuple[Ints, Ints]:
        """For each index of the first axis, the first and last one that a window of such cells touches."""
        axis, n = self.axes[0], self.grid.counts[0]
        # The first axis comes first among those that a table is over.
        shape = (n if 0 in axis.on else 1, -1)
        ends = np.stack([axis.first.reshape(shape).min(axis=1), axis.last.reshape(shape).max(axis=1)])
        least, most = ends + (np.arange(n) if axis.moves else np.zeros(n, dtype=np.int64))
        return least, most


def _ends_of(base: Nominal, f: Interval, slope: Interval | None) -> tuple[Array, Array, float]:
    """Ends (cells, inputs) of one state under f, and a bound on the rounding error in them."""
    lo, hi = f.lo[:, base.of], f.hi[:, base.of]
    size, terms = size_of(f), 2
    for j, d in enumerate(base.offset.T if slope is not None else ()):
        assert slope is not None
        right, left = np.maximum(d, 0.0), np.minimum(d, 0.0)
        a, b = slope.lo[:, base.of, j], slope.hi[:, base.of, j]
        lo, hi = lo + (a * right + b * left), hi + (b * right + a * left)
        size, terms = size + size_of(slope[:, :, j]) * float(np.abs(d).max()), terms + 3
    return lo, hi, terms * EPS * size


def size_of(x: Interval) -> float:
    """The largest finite magnitude: an infinite end needs no care for rounding."""
    mag = x.mag
    return float(mag.max(initial=0.0, where=np.isfinite(mag)))


def check_size(grid: Grid, inputs: int, lists: bool) -> None:
    """UsageError where values, sets of inputs and, for goals with a target, the lists of pairs would not fit into memory."""
    need = float(grid.size) * (THRESHOLDS.cell_bytes + (inputs + 7) // 8 + (8 * inputs if lists else 0))
    if need > THRESHOLDS.memory:
        raise UsageError(
            f"controller: {grid.size:,} cells × {inputs:,} inputs need {need / 1e9:.1f} GB (limit "
            f"{THRESHOLDS.memory / 1e9:.0f}); use fewer of either"
        )


def windows(
    bound: Bound,
    grid: Grid,
    axes: tuple[Array, ...],
    added: Disturbance | None,
    tick: Callable[[int, int], None] | None = None,
    allowed: Bools | None = None,
    cell: Ints | None = None,
) -> Windows:
    """Successor boxes as windows of cells, of all or of some; every closed cell that a closed box may touch is in its window.

    Each axis has a table over the axes on which its window depends, which the Jacobian over all cells and inputs tells, and
    the blocks of the gap. f is asked only where its own axes differ.
    """
    own, model = structure(bound, grid, axes), bound.model
    names = [*(model.states[j].name for j in grid.states), *(s.name for s in model.inputs)]
    made = fitted(added, own, grid, axes, grid.size if cell is None else len(cell), names)
    alike: dict[tuple[Any, ...], list[int]] = {}
    for k, (part, wide) in enumerate(zip(own, made.parts, strict=True)):
        alike.setdefault((part.on, part.inputs, wide.on, wide.inputs), []).append(k)
    views = {on: grid.along(on, cell) for _, _, on, _ in alike}
    total, done, tables = sum(views[on][0].size for _, _, on, _ in alike), 0, dict[int, Along]()
    for (_, _, on, _), ks in alike.items():

        def told(rows: int, before: int = done) -> None:
            if tick:
                tick(before + rows, total)

        asked = _Asked(bound, axes, {k: own[k] for k in ks}, {k: made.parts[k] for k in ks}, cell)
        tables |= _tables(asked, made.added, views[on], told)
        done += views[on][0].size
    return Windows(grid, tuple(tables[k] for k in range(len(own))), allowed, made.told)


@final
@dataclass(frozen=True)
class _Asked:
    """Axes of the grid that depend on the same: by what f depends on (`own`), and by what their tables do (`wide`)."""

    bound: Bound
    axes: tuple[Array, ...]
    own: dict[int, Part]
    wide: dict[int, Part]
    cell: Ints | None

    def columns(self, part: Part) -> tuple[tuple[Array, ...], Ints, Ints]:
        """Values per input, one where it does not matter; of these, which inputs they are, and the column of every input."""
        used = tuple(a if used else a[:1] for a, used in zip(self.axes, part.inputs, strict=True))
        whole, shape = [len(a) for a in self.axes], [len(a) for a in used]
        # The first value stands for all of an input that does not matter.
        which = np.arange(math.prod(whole)).reshape(whole)[tuple(slice(n) for n in shape)].ravel()
        index = np.indices(whole).reshape(len(whole), -1)
        return used, which, np.ravel_multi_index(list(np.minimum(index, np.array(shape)[:, None] - 1)), shape)


def _tables(
    asked: _Asked, added: Disturbance | None, over: tuple[View, Ints | None], told: Callable[[int], None]
) -> dict[int, Along]:
    """Of axes that depend on the same, for which f is asked once."""
    one, (view, row) = next(iter(asked.own.values())), over
    wide, grid = next(iter(asked.wide.values())), view.whole
    used, _, from_ = asked.columns(one)
    _, which, column = asked.columns(wide)
    base = Nominal.coarsest(asked.bound, grid.along(one.on, asked.cell)[0], used, tuple(asked.own))
    ends = {k: np.empty((2, view.size, len(which)), dtype=np.int32) for k in asked.own}
    step, known = max(1, PAIRS // len(which)), None
    for start in range(0, view.size, step):
        stop = min(start + step, view.size)
        cell = view.flat(start, stop)
        rows, place = grid.rows(one.on, cell)
        if known is None or not np.array_equal(known[0], rows):
            part = replace(base, view=View(grid, one.on, rows))
            known = rows, part.over(0, len(rows)), None if base.direct else part.slopes(0, len(rows))
        _, f, slopes = known
        for k, own in asked.own.items():
            state = grid.states[k]
            slope = None if slopes is None else slopes[:, :, state]
            lo, hi, error = _ends_of(base, f[:, :, state], slope)
            if one != wide:
                lo, hi = (v[np.ix_(place, from_[which])] for v in (lo, hi))
            if added is not None:
                r, block = added.r[:, :, state], np.ix_(added.of(grid, cell), added.of_inputs[which])
                lo, hi, error = lo + r.lo[block], hi + r.hi[block], error + 8 * EPS * size_of(r)
            found = touched(grid, k, lo, hi, error + own.leak, own.moves)
            ends[k][:, start:stop] = found if own.moves == asked.wide[k].moves else _counted(grid, k, cell, found)
        told(stop)
    for k, part_ in asked.wide.items():
        _stay(asked.bound, view, asked.axes, added, k, part_, column, ends[k])
    return {k: Along(p.on, p.moves, column, ends[k][0], ends[k][1], row) for k, p in asked.wide.items()}


def _counted(grid: Grid, k: int, cell: Ints, ends: tuple[Array, Array]) -> tuple[Array, Array]:
    """Windows that counted from the own index, in indices of the grid."""
    own, n = np.unravel_index(cell, grid.counts)[k][:, None], grid.counts[k]
    first, last = (end + own for end in ends)
    if grid.wraps[k]:
        turns = n * (first >= n)
        return first - turns, last - turns
    return np.clip(first, -1, n), np.clip(last, -1, n)


def _stay(
    bound: Bound, view: View, axes: tuple[Array, ...], added: Disturbance | None, k: int, part: Part, column: Ints, ends: Any
) -> None:
    """A state that an input leaves exactly where it is stays in its cell, though a bound on it touches the cells beside."""
    grid = view.whole
    if part.moves or k in part.on:
        moved = ~kept(bound, combined(axes), added)[:, grid.states[k]]
        still = np.bincount(column, moved, ends.shape[2]) == 0
        ends[:, :, still] = 0 if part.moves else np.unravel_index(view.flat(0, view.size), grid.counts)[k][:, None]


def kept(bound: Bound, points: Array, added: Disturbance | None) -> Bools:
    """(inputs, states): an input leaves the state exactly where it is, and so does the gap."""
    still = bound.unmoved(points)
    return still if added is None else still & ~added.r.mag.any(axis=(0, 1))


def touched(grid: Grid, k: int, lo: Array, hi: Array, error: float, moves: bool) -> tuple[Array, Array]:
    """The first and last cell that [lo − error, hi + error] touches."""
    n, low, high = grid.counts[k], grid.box.low[k], grid.box.high[k]
    scale = n / (high - low)
    # An edge, a difference and a quotient err by a few ulp of their size; all of it in units of one cell.
    slack = 2 * error * scale + 16 * EPS * (n + max(abs(low), abs(high)) * scale)
    a, b = np.floor((lo - low) * scale - slack), np.floor((hi - low) * scale + slack)
    if grid.wraps[k]:
        whole = ~(b - a < n)
        a, b = np.where(whole, 0, a), np.where(whole, n - 1, b)
        turns = n * np.floor(a / n)
        return a - turns, b - turns
    # Beyond the grid from every own index; what is no number leaves it on both sides.
    least, most = (-n, n) if moves else (-1, n)
    return np.fmin(np.fmax(a, least), most), np.fmax(np.fmin(b, most), least)
