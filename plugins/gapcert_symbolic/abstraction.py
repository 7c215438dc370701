"""Where a cell may go under an input: an interval over-approximation of f + [l, u], as windows of cell indices."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, final

import numpy as np
import numpy.typing as npt

from gapcert import GapFunction, Interval, Model, UsageError

from .grid import Array, Blocks, Bools, Grid, Ints, corners, flat, share

EPS = float(np.finfo(np.float64).eps)
GAP_BOXES = 60_000
ROWS = 20_000
PAIRS = 400_000
MEMORY = 2e9
SHARED = 1e-3
HELD = 16  # pieces per state without cells, over which the gap is bounded one by one


@final
@dataclass(frozen=True)
class Windows:
    """Cells that the successors may touch: per state, first and last index (cells, inputs), both included.

    Indices are those of the extended grid: a bounded axis has one layer outside on either side (index 0 and n + 1), where
    every successor beyond the grid is put; an axis that wraps is laid out twice, and a window starts in the first copy.
    allowed (cells, inputs): what the relations of the domain leave; None is everything.
    """

    grid: Grid
    first: tuple[npt.NDArray[np.signedinteger], ...]
    last: tuple[npt.NDArray[np.signedinteger], ...]
    allowed: Bools | None = None

    @property
    def inputs(self) -> int:
        return int(self.first[0].shape[1])


def _extended(grid: Grid) -> tuple[int, ...]:
    return tuple(2 * n if wraps else n + 2 for n, wraps in zip(grid.counts, grid.wraps, strict=True))


def enclose(model: Model, low: Array, high: Array, u: Array) -> Interval:
    """Contains f(x, u) for x in each cell: the model's own enclosure ∩ the growth bound f(c, u) ± sup |∂f/∂x| · r."""
    nx = low.shape[1]
    z = Interval(np.concatenate([low, u], axis=1), np.concatenate([high, u], axis=1))
    cell = z[:, :nx]
    centre = cell.mid
    growth = model.jacobian_enclosure(z)[:, :, :nx] * (cell - centre).reshape(len(low), 1, nx)
    return model.enclosure(z).intersect(growth.sum(-1) + model.enclosure(Interval.exact(np.concatenate([centre, u], axis=1))))


@final
@dataclass(frozen=True)
class Nominal:
    """f over cells at one input value v per group of inputs, and the slope that carries it to the group's other inputs.

    f(x, u) ∈ f(x, v) + J_u (u − v), with J_u the Jacobian over the cell and the group (mean-value theorem in u alone).
    middle, low, high (groups, nu): v and the hull of the group. of (m,), offset (m, nu): group of each input and u − v.
    """

    model: Model
    grid: Grid
    middle: Array
    low: Array
    high: Array
    of: Ints
    offset: Array

    @classmethod
    def of_groups(cls, model: Model, grid: Grid, axes: tuple[Array, ...], size: int) -> Nominal:
        """At most `size` groups per input."""
        blocks = [Blocks.cut(len(a), min(len(a), size)) for a in axes]
        ends = [(a[b.starts[:-1]], a[b.starts[1:] - 1]) for a, b in zip(axes, blocks, strict=True)]
        low, high = corners([e[0] for e in ends], [e[1] for e in ends])
        middle, of = low + (high - low) / 2, flat(blocks)
        return cls(model, grid, middle, low, high, of, corners(list(axes), list(axes))[0] - middle[of])

    @classmethod
    def coarsest(cls, model: Model, grid: Grid, axes: tuple[Array, ...]) -> Nominal:
        """As few groups as lose at most a thousandth of a cell anywhere."""
        size = 1
        while not (found := cls.of_groups(model, grid, axes, size)).tight():
            size *= 2
        return found

    @property
    def direct(self) -> bool:
        """Is every input its own group?"""
        return len(self.middle) == len(self.of)

    def tight(self) -> bool:
        step = max(1, ROWS // len(self.middle))
        return self.direct or all(self._loss(k, k + step) <= SHARED for k in range(0, self.grid.size, step))

    def _loss(self, start: int, stop: int) -> float:
        # Two Jacobians in the interval differ by at most its width; the farthest input is half a group away.
        slope = self.slopes(start, stop)[:, :, list(self.grid.states)]
        with np.errstate(invalid="ignore"):
            loss = ((slope.hi - slope.lo) * (self.high - self.middle)[:, None, :]).sum(-1) / self.grid.widths
        return float(loss.max()) if np.isfinite(loss).all() else np.inf

    def over(self, start: int, stop: int) -> Interval:
        """f over cells start … stop − 1 at each group's v: (cells, groups, nx)."""
        (low, high), m = self.grid.cells(start, stop), len(self.middle)
        n, nx = low.shape
        box = enclose(self.model, np.repeat(low, m, axis=0), np.repeat(high, m, axis=0), np.tile(self.middle, (n, 1)))
        return box.reshape(n, m, nx)

    def slopes(self, start: int, stop: int) -> Interval:
        """J_u over cells start … stop − 1 and each group: (cells, groups, nx, nu)."""
        (low, high), (m, nu) = self.grid.cells(start, stop), self.low.shape
        n, nx = low.shape
        z = Interval(
            np.concatenate([np.repeat(low, m, axis=0), np.tile(self.low, (n, 1))], axis=1),
            np.concatenate([np.repeat(high, m, axis=0), np.tile(self.high, (n, 1))], axis=1),
        )
        return self.model.jacobian_enclosure(z)[:, :, nx:].reshape(n, m, nx, nu)


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
    cells = dict(zip(grid.states, grid.edges, strict=True))
    for j in range(gap_states(grid)):
        if j not in cells:
            assert grid.frame is not None
            cells[j] = np.linspace(grid.frame[j, 0], grid.frame[j, 1], HELD + 1)
    return [(cells[j][:-1], cells[j][1:]) for j in sorted(cells)] + [(a, a) for a in axes]


def _hull(ends: list[tuple[Array, Array]]) -> Interval:
    return Interval(np.array([[low.min() for low, _ in ends]]), np.array([[high.max() for _, high in ends]]))


def successors(base: Nominal, added: Disturbance | None, start: int, stop: int) -> list[tuple[Array, Array, float]]:
    """Per axis of the grid, ends (cells, inputs) of the successor boxes and a bound on the rounding error in them."""
    f = base.over(start, stop)
    slope = None if base.direct else base.slopes(start, stop)
    return [_axis(base, added, f[:, :, k], None if slope is None else slope[:, :, k], k, start, stop) for k in base.grid.states]


def _axis(
    base: Nominal, added: Disturbance | None, f: Interval, slope: Interval | None, k: int, start: int, stop: int
) -> tuple[Array, Array, float]:
    lo, hi = f.lo[:, base.of], f.hi[:, base.of]
    size, terms = _size(f), 2
    for j, d in enumerate(base.offset.T if slope is not None else ()):
        assert slope is not None
        right, left = np.maximum(d, 0.0), np.minimum(d, 0.0)
        a, b = slope.lo[:, base.of, j], slope.hi[:, base.of, j]
        lo, hi = lo + (a * right + b * left), hi + (b * right + a * left)
        size, terms = size + _size(slope[:, :, j]) * float(np.abs(d).max()), terms + 3
    if added is not None:
        r, block = added.r[:, :, k], np.ix_(added.cell[start:stop], added.input)
        lo, hi = lo + r.lo[block], hi + r.hi[block]
        size += _size(r)
    return lo, hi, terms * EPS * size


def _size(x: Interval) -> float:
    """The largest finite magnitude: an infinite end needs no care for rounding."""
    mag = x.mag
    return float(mag.max(initial=0.0, where=np.isfinite(mag)))


def _integer(grid: Grid) -> type[np.signedinteger[Any]]:
    return np.int16 if max(_extended(grid)) < np.iinfo(np.int16).max else np.int32


def check_size(grid: Grid, inputs: int) -> None:
    """UsageError where the windows would not fit into memory."""
    need = 2.0 * grid.size * inputs * len(grid.counts) * np.dtype(_integer(grid)).itemsize
    if need > MEMORY:
        raise UsageError(
            f"controller: {grid.size:,} cells × {inputs:,} inputs need {need / 1e9:.1f} GB (limit {MEMORY / 1e9:.0f}); "
            f"use fewer of either"
        )


def windows(
    base: Nominal,
    added: Disturbance | None,
    grid: Grid,
    tick: Callable[[int, int], None] | None = None,
    allowed: Bools | None = None,
) -> Windows:
    """Successor boxes as windows of cells; every closed cell that a closed box may touch is in its window."""
    n, m, nx = grid.size, len(base.of), len(grid.counts)
    kind = _integer(grid)
    first = tuple(np.empty((n, m), kind) for _ in range(nx))
    last = tuple(np.empty((n, m), kind) for _ in range(nx))
    step = max(1, PAIRS // m)
    for start in range(0, n, step):
        stop = min(start + step, n)
        for k, (lo, hi, error) in enumerate(successors(base, added, start, stop)):
            first[k][start:stop], last[k][start:stop] = _indices(grid, k, lo, hi, error)
        if tick:
            tick(stop, n)
    return Windows(grid, first, last, allowed)


def _indices(grid: Grid, k: int, lo: Array, hi: Array, error: float) -> tuple[Array, Array]:
    """Extended indices of the first and last cell that [lo − error, hi + error] touches."""
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
    return np.clip(a, -1, n) + 1, np.clip(b, -1, n) + 1
