"""Games on cells: which solver answers one, and goals beyond reach-avoid and invariance, solved with the two."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from gapcert.plugin import Bools
from gapcert_symbolic.cells.abstraction import Windows
from gapcert_symbolic.kernels import reach, repeats
from gapcert_symbolic.kernels.kernels import Bits, whole
from gapcert_symbolic.solvers import affine, erosion, lazy, runs
from gapcert_symbolic.solvers.problem import Problem, Solution
from gapcert_symbolic.thresholds import THRESHOLDS


def usable(asked: int | None, pairs: int) -> int:
    """How many threads are used for so many pairs of a cell and an input: as asked, else one per core from `threaded_pairs`
    on."""
    return asked or (len(os.sched_getaffinity(0)) if pairs >= THRESHOLDS.threaded_pairs else 1)


def solve(problem: Problem) -> Solution:
    """On JAX where that is asked for; steps to a target; or what the first of SOLVERS finds that suits the problem."""
    if problem.solver == "jax":
        from gapcert_symbolic.solvers import dense

        return dense.solve(problem)
    if problem.target is not None:
        return _reach(problem, problem.target)
    return next(found for solver in SOLVERS if (found := solver(problem)) is not None)


SOLVERS: tuple[Callable[[Problem], Solution | None], ...] = (affine.solve, lazy.solve, erosion.solve, runs.solve)
"""Of invariance; None where a problem does not suit one. In closed form; by blocks of cells; else on tables of windows, the
special one first."""


def _reach(problem: Problem, target: Bools) -> Solution:
    """Where windows repeat, by what is watched at a cell, whatever the cell is; else each pair of a cell and an input is
    watched at one.
    """
    windows, fresh = problem.windows(), target & problem.safe
    values, bits = np.where(fresh, 0, np.where(problem.safe, -1, -2)).astype(np.int32), windows.offered(fresh)
    if (given := repeats.inverse(windows, whole(windows.grid.size * windows.inputs))) is None:
        reach.reach(windows.game, values, bits)
    else:
        repeats.reach(given, values, bits, windows.permitted, problem.threads)
    return Solution(np.maximum(values, -1), bits, int(values.max(initial=0)))


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
