"""Where a cell may go under an input: a bound of f + [l, u] over it, as windows of cell indices."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, final

import numpy as np
import numpy.typing as npt

from gapcert import GapFunction, Interval, UsageError

from .bounds import Bound, Grown
from .grid import Array, Blocks, Bools, Grid, Ints, View, corners, flat, share
from .nominal import Nominal
from .structure import Part, structure

EPS = float(np.finfo(np.float64).eps)
GAP_BOXES = 60_000
PAIRS = 400_000
MEMORY, BYTES = 8e9, 8  # in all; per cell, without its inputs
HELD = 16  # pieces per state without cells, over which the gap is bounded one by one


@final
@dataclass(frozen=True)
class Axis:
    """Where successors lie along one axis of the grid: cells first … last, both included, by rows and columns.

    A row is a cell of the product of the axes `on`, in C order; column (m,) is that of each input. Where it `moves`, indices
    count from the cell's own. On a bounded axis what lies beyond the grid is −1 or n before the own index is added, or further
    out; on one that wraps, 0 ≤ first < n and last − first < n, and indices count modulo n. row: of each cell in question, where
    there are rows for some cells only.
    """

    on: tuple[int, ...]
    moves: bool
    column: Ints
    first: npt.NDArray[np.int32]
    last: npt.NDArray[np.int32]
    row: Ints | None = None


@final
@dataclass(frozen=True)
class Windows:
    """Cells that the successors may touch: per axis of the grid a table.

    allowed (cells, inputs): what the relations of the domain leave; None is everything.
    """

    grid: Grid
    axes: tuple[Axis, ...]
    allowed: Bools | None = None

    @property
    def inputs(self) -> int:
        return len(self.axes[0].column)

    def ends(self, cell: Ints, which: Ints) -> tuple[Ints, Ints]:
        """First and last cell of each axis (n, axes), of pairs of a flat cell and an input; −1 and n are outside."""
        index = np.unravel_index(cell, self.grid.counts)
        ends = np.empty((2, len(cell), len(self.axes)), dtype=np.int64)
        for k, axis in enumerate(self.axes):
            on = axis.on
            row = np.ravel_multi_index([index[d] for d in on], [self.grid.counts[d] for d in on]) if on else 0
            own = index[k] if axis.moves else 0
            for end, table in zip(ends, (axis.first, axis.last), strict=True):
                end[:, k] = own + table[row, axis.column[which]]
            if not self.grid.wraps[k]:
                ends[:, :, k] = np.clip(ends[:, :, k], -1, self.grid.counts[k])
        return ends[0], ends[1]

    @property
    def packed(self) -> tuple[Any, ...]:
        """Tables of all axes in one, as the compiled solvers read them: (first, last, start, strides, moves, column).

        The entry of axis k is at start_k + Σ_d index_d strides_kd + column_kj.
        """
        n = len(self.axes)
        strides, start, at = np.zeros((n, n), dtype=np.int64), np.zeros(n, dtype=np.int64), 0
        for k, axis in enumerate(self.axes):
            start[k], step = at, axis.first.shape[1]
            for d in axis.on[::-1]:
                strides[k, d], step = step, step * self.grid.counts[d]
            at += axis.first.size
        first, last = (np.concatenate([getattr(a, end).ravel() for a in self.axes]) for end in ("first", "last"))
        return first, last, start, strides, np.array([a.moves for a in self.axes]), np.stack([a.column for a in self.axes])

    @property
    def rows(self) -> tuple[Ints, Ints]:
        """For each index of the first axis, the first and last one that a window of such cells touches."""
        axis, n = self.axes[0], self.grid.counts[0]
        # The first axis comes first among those that a table is over.
        shape = (n if 0 in axis.on else 1, -1)
        ends = np.stack([axis.first.reshape(shape).min(axis=1), axis.last.reshape(shape).max(axis=1)])
        least, most = ends + (np.arange(n) if axis.moves else np.zeros(n, dtype=np.int64))
        return least, most

    @property
    def reach(self) -> tuple[Ints, Ints]:
        """Least first and largest last cell of each axis, counted from the own index."""
        least, most = np.empty((2, len(self.axes)), dtype=np.int64)
        for k, axis in enumerate(self.axes):
            first, last = axis.first.min(axis=1), axis.last.max(axis=1)
            own = np.zeros(len(first), dtype=np.int64)
            if k in axis.on:
                own = np.indices([self.grid.counts[d] for d in axis.on])[axis.on.index(k)].ravel()
            n = 0 if axis.moves or k in axis.on else self.grid.counts[k] - 1
            least[k], most[k] = (first - own).min() - n, (last - own).max()
        return least, most


@final
@dataclass(frozen=True)
class Disturbance:
    """[l, u] over blocks of cells and inputs, (state blocks, input blocks, nx), and the block of each cell and input.

    The supremum over a block is one over each of its cells.
    """

    r: Interval
    cell: Ints
    input: Ints


def disturbance(
    gap: GapFunction,
    grid: Grid,
    axes: tuple[Array, ...],
    budget: int = GAP_BOXES,
    tick: Callable[[int, int], None] | None = None,
) -> Disturbance:
    """The gap's signed interval over at most `budget` boxes that cover all cells and inputs, and all of the other states.

    One block is enough along axes on which the gap does not depend.
    """
    states, nx, nz = grid.states, gap_states(grid), gap_states(grid) + len(axes)
    ends = _ends(grid, axes)
    flat_axes: Bools = (gap.lipschitz(_hull(ends)) == 0).reshape(nx, nz).all(axis=0)
    held = [j for j in range(nx) if j not in states]
    order = [*states, *range(nx, nz), *held]
    counts = tuple(1 if flat_axes[j] else len(ends[j][0]) for j in order)
    sizes = share(counts, budget)
    blocks = [Blocks.cut(len(ends[j][0]), b) for j, b in zip(order, sizes, strict=True)]
    parts_of = [(ends[j][0][b.starts[:-1]], ends[j][1][b.starts[1:] - 1]) for j, b in zip(order, blocks, strict=True)]
    low, high = np.empty((2, int(np.prod(sizes)), nz))
    low[:, order], high[:, order] = corners([e[0] for e in parts_of], [e[1] for e in parts_of])
    parts = []
    for k in range(0, len(low), 4096):
        parts.append(gap.interval_over(Interval(low[k : k + 4096], high[k : k + 4096])))
        if tick:
            tick(min(k + 4096, len(low)), len(low))
    n = len(states)
    r = Interval.concatenate(parts).reshape(int(np.prod(sizes[:n])), int(np.prod(sizes[n : n + len(axes)])), -1, nx)
    return Disturbance(Interval(r.lo.min(axis=2), r.hi.max(axis=2)), flat(blocks[:n]), flat(blocks[n : n + len(axes)]))


def gap_states(grid: Grid) -> int:
    """How many states the model has."""
    return len(grid.counts) if grid.frame is None else len(grid.frame)


def _ends(grid: Grid, axes: tuple[Array, ...]) -> list[tuple[Array, Array]]:
    """Per state and input, lower and upper ends of the pieces that may be put into blocks."""
    cells = dict(zip(grid.states, grid.ends, strict=True))
    for j in range(gap_states(grid)):
        if j not in cells:
            assert grid.frame is not None
            pieces = np.linspace(grid.frame[j, 0], grid.frame[j, 1], HELD + 1)
            cells[j] = pieces[:-1], pieces[1:]
    return [cells[j] for j in sorted(cells)] + [(a, a) for a in axes]


def _hull(ends: list[tuple[Array, Array]]) -> Interval:
    return Interval(np.array([[low.min() for low, _ in ends]]), np.array([[high.max() for _, high in ends]]))


def _ends_of(
    base: Nominal, added: Disturbance | None, f: Interval, slope: Interval | None, k: int, cell: Ints, which: Ints
) -> tuple[Array, Array, float]:
    """Ends (cells, inputs) of the successors of state k, and a bound on the rounding error in them."""
    lo, hi = f.lo[:, base.of], f.hi[:, base.of]
    size, terms = size_of(f), 2
    for j, d in enumerate(base.offset.T if slope is not None else ()):
        assert slope is not None
        right, left = np.maximum(d, 0.0), np.minimum(d, 0.0)
        a, b = slope.lo[:, base.of, j], slope.hi[:, base.of, j]
        lo, hi = lo + (a * right + b * left), hi + (b * right + a * left)
        size, terms = size + size_of(slope[:, :, j]) * float(np.abs(d).max()), terms + 3
    if added is not None:
        r, block = added.r[:, :, k], np.ix_(added.cell[cell], added.input[which])
        lo, hi = lo + r.lo[block], hi + r.hi[block]
        size += size_of(r)
    return lo, hi, terms * EPS * size


def size_of(x: Interval) -> float:
    """The largest finite magnitude: an infinite end needs no care for rounding."""
    mag = x.mag
    return float(mag.max(initial=0.0, where=np.isfinite(mag)))


def check_size(grid: Grid, inputs: int, lists: bool) -> None:
    """UsageError where values, sets of inputs and, for goals with a target, the lists of pairs would not fit into memory."""
    need = float(grid.size) * (BYTES + (inputs + 7) // 8 + (8 * inputs if lists else 0))
    if need > MEMORY:
        raise UsageError(
            f"controller: {grid.size:,} cells × {inputs:,} inputs need {need / 1e9:.1f} GB (limit {MEMORY / 1e9:.0f}); "
            f"use fewer of either"
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
    the blocks of the gap.
    """
    parts = dependence(bound, grid, axes, added)
    alike: dict[tuple[tuple[int, ...], tuple[bool, ...]], list[int]] = {}
    for k, part in enumerate(parts):
        alike.setdefault((part.on, part.inputs), []).append(k)
    views = {on: grid.along(on, cell) for on, _ in alike}
    total, done, tables = sum(views[on][0].size for on, _ in alike), 0, dict[int, Axis]()
    for (on, _), ks in alike.items():

        def told(rows: int, before: int = done) -> None:
            if tick:
                tick(before + rows, total)

        tables |= _tables(bound, grid, axes, added, {k: parts[k] for k in ks}, views[on], told)
        done += views[on][0].size
    return Windows(grid, tuple(tables[k] for k in range(len(parts))), allowed)


def dependence(bound: Bound, grid: Grid, axes: tuple[Array, ...], added: Disturbance | None) -> list[Part]:
    """On what the window along each axis depends."""
    # What rests on a bound in floating point may rest on slopes in it, too.
    found = structure(bound.model, grid, axes, rounded=isinstance(bound, Grown))
    return [_widened(own, added, grid, axes, k) for k, own in enumerate(found)]


def _widened(part: Part, added: Disturbance | None, grid: Grid, axes: tuple[Array, ...], k: int) -> Part:
    """With the axes and inputs along which the gap's blocks differ."""
    if added is None:
        return part
    state = grid.states[k]
    both = np.stack([added.r.lo[:, :, state], added.r.hi[:, :, state]])
    cells, inputs = added.cell.reshape(grid.counts), added.input.reshape([len(a) for a in axes])
    on = tuple(d for d in range(len(grid.counts)) if d in part.on or _varies(both, cells, d, 1))
    uses = tuple(_varies(both, inputs, e, 2) or own for e, own in enumerate(part.inputs))
    return Part(on, part.moves and k not in on, uses, part.leak)


def _varies(values: Array, block: Ints, axis: int, along: int) -> bool:
    """Do the values of blocks differ between neighbours along an axis?"""
    if block.shape[axis] < 2 or values.shape[along] < 2:
        return False
    before, after = (np.moveaxis(block, axis, 0)[s].ravel() for s in (slice(None, -1), slice(1, None)))
    pairs = np.unique(np.stack([before, after])[:, before != after], axis=1)
    return bool((values.take(pairs[0], axis=along) != values.take(pairs[1], axis=along)).any())


def _tables(
    bound: Bound,
    grid: Grid,
    axes: tuple[Array, ...],
    added: Disturbance | None,
    parts: dict[int, Part],
    over: tuple[View, Ints | None],
    told: Callable[[int], None],
) -> dict[int, Axis]:
    """Of axes that depend on the same, for which f is asked once."""
    one, asked = next(iter(parts.values())), tuple(parts)
    (view, row), own = over, tuple(a if used else a[:1] for a, used in zip(axes, one.inputs, strict=True))
    base = Nominal.coarsest(bound, view, own, asked)
    whole, shape = [len(a) for a in axes], [len(a) for a in own]
    # The first value stands for all of an input that does not matter.
    which = np.arange(math.prod(whole)).reshape(whole)[tuple(slice(n) for n in shape)].ravel()
    index = np.indices(whole).reshape(len(axes), -1)
    column = np.ravel_multi_index(list(np.minimum(index, np.array(shape)[:, None] - 1)), shape)
    ends = {k: np.empty((2, view.size, len(which)), dtype=np.int32) for k in asked}
    step = max(1, PAIRS // len(which))
    for start in range(0, view.size, step):
        stop = min(start + step, view.size)
        f, slopes = base.over(start, stop), None if base.direct else base.slopes(start, stop)
        for k, part in parts.items():
            state = grid.states[k]
            slope = None if slopes is None else slopes[:, :, state]
            lo, hi, error = _ends_of(base, added, f[:, :, state], slope, state, view.flat(start, stop), which)
            ends[k][:, start:stop] = touched(grid, k, lo, hi, error + part.leak, part.moves)
        told(stop)
    for k, part in parts.items():
        _stay(bound, view, axes, added, k, part, column, ends[k])
    return {k: Axis(part.on, part.moves, column, ends[k][0], ends[k][1], row) for k, part in parts.items()}


def _stay(
    bound: Bound, view: View, axes: tuple[Array, ...], added: Disturbance | None, k: int, part: Part, column: Ints, ends: Any
) -> None:
    """A state that an input leaves exactly where it is stays in its cell, though a bound on it touches the cells beside."""
    grid = view.whole
    state = grid.states[k]
    if (added is None or not added.r[:, :, state].mag.any()) and (part.moves or k in part.on):
        moved = ~bound.unmoved(corners(list(axes), list(axes))[0])[:, state]
        still = np.bincount(column, moved, ends.shape[2]) == 0
        ends[:, :, still] = 0 if part.moves else np.unravel_index(view.flat(0, view.size), grid.counts)[k][:, None]


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
