"""Games on cells: of all goals, and which solver answers one.

A goal with an automaton is a game on cells × its states. A position (c, q) is a cell and the automaton's state once it has read
the regions of a point of that cell. A cell at the border of a region may be read in several ways; it can be trusted as a
successor only if every one of them wins.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Protocol, final

import numpy as np
import numpy.typing as npt

from gapcert import Goal, Region
from gapcert.plugin import Automaton, Bools, Ints
from gapcert_symbolic.cells.abstraction import Windows
from gapcert_symbolic.cells.grid import Grid
from gapcert_symbolic.kernels import reach, repeats
from gapcert_symbolic.kernels.kernels import Bits, whole
from gapcert_symbolic.solvers import affine, erosion, lazy, runs
from gapcert_symbolic.solvers.problem import Play, Problem, Solution
from gapcert_symbolic.thresholds import THRESHOLDS


def solve_goal(goal: Goal, problem: Problem, target: Bools, labels: Labels | None) -> Solution:
    """The game of a goal; labels: of the cells, where it has an automaton."""
    if goal.automaton is not None and labels is not None:
        by: Any = None
        if problem.solver == "jax":
            from gapcert_symbolic.solvers import dense

            by = dense.Positions
        return product(problem.windows(), problem.safe, goal.automaton, labels, by)
    if goal.kind in ("invariance", "reach_avoid"):
        return solve(problem if goal.kind == "invariance" else replace(problem, target=target))
    return {"reach_and_stay": reach_and_stay, "recurrence": recurrence}[goal.kind](problem, target)


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


@final
@dataclass(frozen=True)
class Labels:
    """Regions that a cell lies wholly inside (must), and those that it may touch (may), as letters (cells,)."""

    must: Ints
    may: Ints

    @classmethod
    def of(cls, grid: Grid, regions: tuple[Region, ...], cell: Ints | None = None) -> Labels:
        """Of all cells, or of some."""
        must, may = np.zeros((2, grid.size if cell is None else len(cell)), dtype=np.int64)
        for p, region in enumerate(regions):
            within = grid.inside(region, cell)
            must |= within.astype(np.int64) << p
            may |= (grid.touching(region, cell) | within).astype(np.int64) << p
        return cls(must, may)

    def followed_by(self, other: Labels) -> Labels:
        return Labels(np.append(self.must, other.must), np.append(self.may, other.may))

    def kinds(self) -> tuple[list[list[int]], Ints]:
        """The letters that the cells of each kind may be read as, and the kind of every cell."""
        size = 1 + int(self.may.max(initial=0))
        both = self.must * size + self.may
        found = np.flatnonzero(np.bincount(both))
        letters = [[n for n in range(b + 1) if n & ~b == 0 and a & ~n == 0] for a, b in (divmod(int(v), size) for v in found)]
        number = np.zeros(size**2, dtype=np.int64)
        number[found] = np.arange(len(found))
        return letters, number[both]


class Least(Protocol):
    """The least fixpoint of a play: values (states, cells), bits (states, cells, bytes), those of the last one that was asked
    for; `least` has accepting states lead to the positions `assumed`, and tells the largest value.
    """

    values: Any
    bits: Any

    def least(self, assumed: Bools) -> int: ...


def product(
    windows: Windows, safe: Bools, automaton: Automaton, labels: Labels, by: Callable[[Play], Least] | None = None
) -> Solution:
    """νZ μX. done ∪ (accepting ∩ Pre(Z)) ∪ Pre(X): from every position that wins, the inputs that keep it so.

    values and bits have one more axis, the automaton's states; values are the steps until it accepts. by: what solves the
    inner fixpoint, by default the compiled lists.
    """
    game = (by or Watched)(Play(windows, safe, automaton, *leads_of(automaton, labels)))
    won = np.broadcast_to(safe, (len(automaton.after), len(safe)))
    rounds = 0
    while True:
        rounds += game.least(won)
        found = game.values >= 0
        # Without accepting states that must be met again, nothing depended on what was assumed.
        if automaton.ends or found.sum() == won.sum():
            return Solution(game.values, game.bits, rounds)
        won = found


def started(automaton: Automaton, labels: Labels, won: Bools) -> Bools:
    """(cells,): runs that begin there win, however the cell is read."""
    letters, kind = labels.kinds()
    out = np.ones(len(kind), dtype=bool)
    for k, some in enumerate(letters):
        for q in {int(automaton.table[automaton.start, letter]) for letter in some}:
            out &= (kind != k) | (won[q] if q >= 0 else False)
    return out


def leads_of(automaton: Automaton, labels: Labels) -> tuple[Bools, Ints]:
    """leads[q, kind, t]: a cell of that kind may take the automaton from q to t, the last column being nowhere; all kinds."""
    letters, kind = labels.kinds()
    states = len(automaton.after)
    leads = np.zeros((states, len(letters), states + 1), dtype=bool)
    for k, some in enumerate(letters):
        for q in range(states):
            leads[q, k, automaton.table[q, some]] = True
    return leads, kind


def missed(leads: Bools, kind: Ints, safe: Bools) -> npt.NDArray[np.int16]:
    """(states, cells): how many positions entering a cell may lead to; more than there are where it must not be entered."""
    never = 2 * len(leads)
    missing = np.where(leads[:, :, -1], never, leads[:, :, :-1].sum(axis=2)).astype(np.int16)
    missing = np.ascontiguousarray(missing[:, kind])
    missing[:, ~safe] = never
    return missing


@final
class Watched:
    """`Least`, compiled."""

    def __init__(self, play: Play) -> None:
        self.play, self.windows, self.safe = play, play.windows, play.safe
        shape = len(play.leads), self.windows.grid.size
        self.values, self.bits = np.empty(shape, dtype=np.int32), np.stack([self.windows.no_bits] * len(play.leads))
        self.repeats = repeats.inverse(self.windows, whole(self.values.size * self.windows.inputs))

    def least(self, assumed: Bools) -> int:
        """The least fixpoint where accepting states lead to `assumed`; the largest value."""
        automaton, leads, kind = self.play.automaton, self.play.leads, self.play.kind
        accepting, done = np.array(automaton.accepting), automaton.done
        self.values[:], self.bits[:] = np.where(self.safe, -1, -2), 0
        for q in np.flatnonzero(accepting).tolist():
            if done[q]:
                self.bits[q] = self.windows.offered(self.safe)
            else:
                self.bits[q] = leading(self.windows, self.play.entered(q, assumed), self.safe & assumed[q])
            self.values[q] = np.where(self.safe if done[q] else self.bits[q].any(axis=1), 0, -2)
        missing, good = missed(leads, kind, self.safe), np.full(self.values.shape, -1, dtype=np.int32)
        on = reach.Positions(leads, kind, ~accepting, self.values, self.bits, good, missing)
        if self.repeats is None:
            reach.least(self.windows.game, on)
        else:
            repeats.least(self.repeats, on, self.windows.permitted)
        np.maximum(self.values, -1, out=self.values)
        return int(self.values.max(initial=0))
