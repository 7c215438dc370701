"""Goals beyond reach-avoid and invariance, solved with the two."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from gapcert import Box, Region
from gapcert.plugin import Bools, Ints
from gapcert_symbolic.cells.abstraction import Windows
from gapcert_symbolic.cells.grid import Grid
from gapcert_symbolic.kernels.kernels import Bits
from gapcert_symbolic.solvers import runs
from gapcert_symbolic.solvers.problem import Problem, Solution
from gapcert_symbolic.solvers.solvers import solve

CHUNK = 200_000


def leading(windows: Windows, into: Bools, asked: Bools) -> Bits:
    """Per cell that is asked for, all inputs that lead wholly into the cells `into`; packed."""
    own, after = (np.where(on, 0, -1).astype(np.int32) for on in (asked, into))
    bits = windows.no_bits
    runs.leading(windows.game, after, own, bits)
    return bits


def remaining(problem: Problem, won: Bools, some: Bools) -> tuple[Bools, Bits]:
    """νY. some ∩ Pre(won ∪ Y): of some cells, those from which one can remain among them until one comes to what is won; and
    the inputs that do so.
    """
    windows, alive = problem.windows(), np.where(some, 0, np.where(won, 1, -1)).astype(np.int32)
    bits = windows.no_bits
    runs.invariance(problem.threads, windows.game, alive, bits, *windows.rows)
    return alive == 0, bits


def reach_and_stay(problem: Problem, target: Bools) -> Solution:
    """μX. νY. Pre(X) ∪ (target ∩ Pre(X ∪ Y)), in `safe`: the state is outside the target finitely often.

    First the largest part of the target that can be kept for ever, at 0, and the steps to it. Then the cells of the target
    from which one either remains among them or comes to what is won by then: at one lasting value, greater than all so far;
    and the steps to these. So at a lasting value a step leads to no greater one, at others to a smaller one.
    """
    safe = problem.safe
    kept = solve(replace(problem, safe=safe & target))
    fresh, values, bits, rounds = kept.values >= 0, np.full(len(safe), -1, dtype=np.int32), kept.bits, kept.rounds
    lasting = list[int]()
    while fresh.any():
        level = int(values.max()) + 1
        lasting.append(level)
        values[fresh] = level
        way = solve(replace(problem, target=values >= 0))
        later = way.values > 0
        values[later] = level + way.values[later]
        bits, rounds = np.where(later[:, None], way.bits, bits), rounds + way.rounds
        won = values >= 0
        fresh, own = remaining(problem, won, safe & target & ~won)
        bits = np.where(fresh[:, None], own, bits)
    return Solution(values, bits, rounds, tuple(lasting) or (0,))


def recurrence(problem: Problem, target: Bools) -> Solution:
    """νZ μX. (target ∩ Pre(Z)) ∪ Pre(X): steps to the next visit, and in the target the inputs from which another follows."""
    windows, safe, rounds = problem.windows(), problem.safe, 0
    visits = safe & target
    while True:
        way = solve(replace(problem, safe=safe, target=visits))
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
