"""Goals beyond reach-avoid and invariance, solved with the two."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from gapcert import Box, Region
from gapcert.plugin import Bools, Ints
from gapcert_symbolic.cells.abstraction import Windows
from gapcert_symbolic.cells.grid import Grid
from gapcert_symbolic.kernels import kernels
from gapcert_symbolic.solvers import solvers
from gapcert_symbolic.solvers.solvers import Compiled, Fixpoints, Solution

CHUNK = 200_000
ALONE = Compiled()


@kernels.compiled
def _lead(counts: Ints, wraps: Bools, packed: Any, values: kernels.Values, asked: Bools, allowed: Bools, bits: Any) -> None:
    strides, m = kernels._strides(counts), packed[5].shape[1]
    index, a, b, c = np.zeros((4, len(counts)), np.int64)
    for i in range(len(values)):
        if asked[i]:
            for j in range(m):
                if (not allowed.size or allowed[i, j]) and kernels._valid(
                    counts, wraps, packed, strides, values, index, j, a, b, c
                ):
                    kernels._keep(bits, i, j)
        kernels._next(counts, index)


def leading(windows: Windows, into: Bools, asked: Bools) -> npt.NDArray[np.uint8]:
    """Per cell that is asked for, all inputs that lead wholly into the cells `into`; packed."""
    bits = solvers._no_bits(windows)
    values = np.where(into, 0, -1).astype(np.int32)
    _lead(*solvers._given(windows), values, asked, solvers._allowed(windows), bits)
    return bits


@kernels.compiled
def _remain(counts: Ints, wraps: Bools, packed: Any, values: kernels.Values, cells: Ints, allowed: Bools) -> None:
    strides, m, sweeps, lost = kernels._strides(counts), packed[5].shape[1], 0, True
    index, a, b, c = np.zeros((4, len(counts)), np.int64)
    witness = np.zeros(len(cells), np.int64)
    while lost:
        lost = False
        for t in range(len(cells)):
            at = t if sweeps % 2 == 0 else len(cells) - 1 - t
            i, j = cells[at], witness[at]
            if values[i] == 0:
                kernels._unravel(strides, i, index)
                # What led out of a larger set leads out of a smaller one.
                while j < m and not (
                    (not allowed.size or allowed[i, j])
                    and kernels._valid(counts, wraps, packed, strides, values, index, j, a, b, c)
                ):
                    j += 1
                witness[at] = j
                if j == m:
                    values[i], lost = -1, True
        sweeps += 1


def remaining(windows: Windows, won: Bools, some: Bools) -> Bools:
    """νY. some ∩ Pre(won ∪ Y): of some cells, those from which one can remain among them until one comes to what is won."""
    values, cells = np.where(won | some, 0, -1).astype(np.int32), np.flatnonzero(some)
    _remain(*solvers._given(windows), values, cells, solvers._allowed(windows))
    return np.asarray(some & (values == 0))


def reach_and_stay(windows: Windows, safe: Bools, target: Bools, by: Fixpoints = ALONE) -> Solution:
    """μX. νY. Pre(X) ∪ (target ∩ Pre(X ∪ Y)), in `safe`: the state is outside the target finitely often.

    First the largest part of the target that can be kept for ever, at 0, and the steps to it. Then the cells of the target
    from which one either remains among them or comes to what is won by then: at one lasting value, greater than all so far;
    and the steps to these. So at a lasting value a step leads to no greater one, at others to a smaller one.
    """
    kept = by.invariance(windows, safe & target)
    fresh, values, bits, rounds = kept.values >= 0, np.full(len(safe), -1, dtype=np.int32), kept.bits, kept.rounds
    lasting = list[int]()
    while fresh.any():
        level = int(values.max()) + 1
        lasting.append(level)
        values[fresh] = level
        way = by.reach_avoid(windows, safe, values >= 0)
        later = way.values > 0
        values[later] = level + way.values[later]
        bits, rounds = np.where(later[:, None], way.bits, bits), rounds + way.rounds
        won = values >= 0
        fresh = remaining(windows, won, safe & target & ~won)
        bits = np.where(fresh[:, None], leading(windows, won | fresh, fresh), bits)
    return Solution(values, bits, rounds, tuple(lasting) or (0,))


def recurrence(windows: Windows, safe: Bools, target: Bools, by: Fixpoints = ALONE) -> Solution:
    """νZ μX. (target ∩ Pre(Z)) ∪ Pre(X): steps to the next visit, and in the target the inputs from which another follows."""
    visits, rounds = safe & target, 0
    while True:
        way = by.reach_avoid(windows, safe, visits)
        safe, rounds = way.values >= 0, rounds + way.rounds
        again = leading(windows, safe, visits)
        left = visits & again.any(axis=1)
        if left.sum() == visits.sum():
            return Solution(way.values, np.where(visits[:, None], again, way.bits), rounds)
        visits = left


def inside(grid: Grid, region: Region, cell: Ints | None = None) -> Bools:
    """(cells,): the cell lies wholly in one part of the region, whatever the states without cells are; of all, or of some."""
    return _any(grid, region, grid.inside, "covers", cell)


def touching(grid: Grid, region: Region, cell: Ints | None = None) -> Bools:
    """(cells,): the cell may have a point in the region; of all, or of some."""
    return _any(grid, region, grid.touching, "touches", cell)


def _any(grid: Grid, region: Region, of_box: Callable[..., Bools], of_shape: str, cell: Ints | None) -> Bools:
    found = np.zeros(grid.size if cell is None else len(cell), dtype=bool)
    for box in region.boxes:
        found |= of_box(over(box, grid.states), cell)
    for shape in region.shapes:
        found |= _each(grid, getattr(shape, of_shape), len(found), cell)
    return found


def over(box: Box, states: tuple[int, ...]) -> Box:
    """The box over some of its axes."""
    return Box(tuple(box.axes[j] for j in states), tuple(box.low[j] for j in states), tuple(box.high[j] for j in states))


def _each(grid: Grid, asked: Any, size: int, cell: Ints | None) -> Bools:
    # Where nodes come first, an edge is a node and half a width, rounded.
    pad = 0.0 if grid.nodes is None else 1e-10 * grid.widths
    parts = []
    for start in range(0, size, CHUNK):
        low, high = grid.cells(start, start + CHUNK) if cell is None else grid.boxes(cell[start : start + CHUNK])
        low[:, grid.states] -= pad
        high[:, grid.states] += pad
        parts.append(asked(low, high))
    return np.concatenate(parts)
