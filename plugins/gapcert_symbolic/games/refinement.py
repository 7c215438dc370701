"""Cells that lost, but may yet win on finer ones, are halved and solved again; what is won stays won, by the inputs it has.

Let W be won on the grids so far. A set of finer cells is added to it in which each has an input that leads into it or into W:
the promise of W holds as it did, and that of the finer cells by their own windows. Which cells are halved changes nothing in
this. A cell is left whole where no finer one can win: a finer cell's window lies in that of the cell it is part of, and what
lies in the target touches it. So all cells with a winning part are in what the same fixpoint gives where a window need only
meet a set, W among it, and a cell only touch the target. So the domain is that of the finest grid on all of the box.

For goals with an automaton the same is done on positions, pairs of a node and a state of the automaton. Nodes are halved for
all states at once. What is won at a node is won at its parts, by the same inputs in the same number of steps: W is then all
positions that are won, those of parts among them, and the game is solved for the other positions of the last level. A node is
halved where a position may win that does not, or where it may be entered in a state in which it must not be as a whole, since a
part of it may be read in fewer ways.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, NamedTuple, final

import numpy as np

from gapcert import Array, Goal, UsageError
from gapcert.plugin import Automaton, Bools, Ints
from gapcert_cells import Splits, SuccessorsByLevel
from gapcert_symbolic.cells.abstraction import Windows
from gapcert_symbolic.cells.grid import Grid
from gapcert_symbolic.kernels import reach, sets
from gapcert_symbolic.kernels.kernels import Game
from gapcert_symbolic.solvers.problem import Solution, entered
from gapcert_symbolic.thresholds import THRESHOLDS

from .games import Labels, leads_of, missed, started


@final
class Refined(NamedTuple):
    """`solution` has the nodes of `splits` as cells; windows, one per level, are those on which they rest.

    With an automaton, values and bits have one more axis, its states; labels of the nodes, and which of these win with the
    memory that a run begins with there.
    """

    splits: Splits
    solution: Solution
    windows: tuple[Windows, ...]
    levels: list[dict[str, Any]]
    labels: Labels | None = None
    wins: Bools | None = None

    @property
    def edges(self) -> tuple[Array, ...]:
        return self.windows[-1].grid.edges

    def promised(self) -> SuccessorsByLevel | None:
        return SuccessorsByLevel(self.splits, tuple(w.successors for w in self.windows)).unless_large()

    def won(self, least: int = 0) -> int:
        """Cells of at least this value."""
        return int((self.solution.values >= least if self.wins is None else self.wins).sum())

    def facts(self) -> dict[str, Any]:
        """Counts of whole cells; the fraction is of the volume."""
        return {
            "cells": int((self.splits.first == 0).sum()),
            "winning_cells": self.won(),
            "winning_fraction": self.levels[-1]["winning_fraction"],
            "rounds": self.solution.rounds,
            "levels": self.levels,
        }


def refined(goal: Goal, levels: int, coarse: Solution, windows: Windows, finer: Callable[[Grid, Ints], Windows]) -> Refined:
    """From a solution on a grid, with its windows, to one on at most so many further levels. finer: windows of some cells."""
    automaton = goal.automaton
    tree = _Nodes(goal, windows.grid, coarse) if automaton is None else _Positions(goal, windows.grid, coarse, automaton)
    made, rounds, facts = [windows], coarse.rounds, [tree.facts()]
    for _ in range(levels):
        split = tree.hopeful(made[-1])
        if not split.any():
            break
        tree.halve(split, windows.inputs)
        made.append(finer(tree.grid, tree.flat))
        rounds += tree.solve(made[-1])
        facts.append(tree.facts())
    # Runs are in the parts of a node that is halved, and never in the node.
    tree.values[..., tree.first > 0], tree.bits[..., tree.first > 0, :] = -1, 0
    solution, splits = Solution(tree.values, tree.bits, rounds, tuple(tree.lasting)), tree.splits()
    return Refined(splits, solution, tuple(made), facts, tree.labels, None if automaton is None else tree.wins())


class Tree(ABC):
    """Nodes as they grow; `flat` are the numbers of the last level's nodes, from `start` on, on its own `grid`.

    values (…, nodes) and bits (…, nodes, bytes) are those of a Solution; safe (nodes,).
    """

    labels: Labels | None = None

    def __init__(self, goal: Goal, grid: Grid, coarse: Solution) -> None:
        self.goal, self.grid, self.level, self.start, self.flat = goal, grid, 0, 0, np.arange(grid.size)
        self.roots, self.first = grid.counts, np.zeros(grid.size, dtype=np.int64)
        self.values, self.bits, self.lasting = coarse.values.astype(np.int32), coarse.bits, list(coarse.lasting)
        self.safe = ~grid.touching(goal.avoid)

    @abstractmethod
    def hopeful(self, windows: Windows) -> Bools:
        """(nodes of the last level,): those that have to be halved, since a part of them may win on finer cells."""

    @abstractmethod
    def solve(self, windows: Windows) -> int:
        """The game on the last level, given what is won; the number of rounds."""

    @abstractmethod
    def wins(self) -> Bools:
        """(nodes,): those that are whole and win, with the memory that a run begins with there."""

    def game(self, windows: Windows) -> Game:
        return windows.game._replace(
            size=len(self.flat), level=self.level, children=self.first, start=self.start, flat=self.flat
        )

    def last(self, windows: Windows) -> Level:
        index, near = np.unravel_index(self.flat, self.grid.counts), []
        for k, axis in enumerate(windows.axes):
            row = axis.rows(index, self.grid.counts, np.arange(len(self.flat)))
            own = 0 if axis.moves else index[k]
            least, most = axis.first.min(axis=1)[row] - own, axis.last.max(axis=1)[row] - own
            near.append([least.min(), most.max()])
        return Level(windows, self.game(windows), np.array(near, dtype=np.int64).T.copy())

    def halve(self, split: Bools, inputs: int) -> None:
        """The parts of nodes of the last level; they have the values and inputs of what they are part of."""
        dims, parents = len(self.roots), self.start + np.flatnonzero(split)
        new, at, inputs = len(parents) << dims, len(self.first), inputs * math.prod(self.values.shape[:-1])
        need = float(new) * (THRESHOLDS.cell_bytes + 16 + (inputs + 7) // 8 + 8 * inputs)
        if need > THRESHOLDS.memory:
            raise UsageError(
                f"controller.refine: {new:,} cells × {inputs:,} inputs on level {self.level + 1} need {need / 1e9:.1f} GB "
                f"(limit {THRESHOLDS.memory / 1e9:.0f}); use a smaller number"
            )
        self.first[parents] = at + (np.arange(len(parents)) << dims)
        index = np.stack(np.unravel_index(self.flat[split], self.grid.counts), axis=-1)
        index = (2 * index[:, None] + np.indices((2,) * dims).reshape(dims, -1).T).reshape(-1, dims)
        self.grid, self.level, self.start = self.grid.halved, self.level + 1, at
        self.flat = np.asarray(np.ravel_multi_index(tuple(index.T), self.grid.counts))
        parents = np.repeat(parents, 1 << dims)
        self.first = np.append(self.first, np.zeros(new, dtype=np.int64))
        self.values = np.append(self.values, self.values[..., parents], axis=-1)
        self.bits = np.append(self.bits, self.bits[..., parents, :], axis=-2)
        self.safe = np.append(self.safe, ~self.grid.touching(self.goal.avoid, self.flat))

    def splits(self) -> Splits:
        return Splits(self.roots, self.level, self.first.astype(np.int32 if len(self.first) < 2**31 else np.int64))

    def facts(self) -> dict[str, Any]:
        """What the last level brought: the winning fraction is of the volume, of all levels so far."""
        wins, names = self.wins(), [a.name for a in self.grid.box.axes]
        # Powers of two are added exactly.
        parts = 0.5 ** (len(self.roots) * self.splits().level(np.flatnonzero(wins)))
        return {
            "cell": dict(zip(names, self.grid.widths.tolist(), strict=True)),
            "cells": len(self.flat),
            "uniform_cells": self.grid.size,
            "winning_cells": int(wins[self.start :].sum()),
            "winning_fraction": float(parts.sum() / np.prod(self.roots, dtype=np.int64)),
        }


@final
class _Nodes(Tree):
    """For goals without an automaton."""

    def hopeful(self, windows: Windows) -> Bools:
        game, won = self.game(windows), (self.values >= 0).astype(np.uint8)
        asked = ~self.grid.inside(self.goal.avoid, self.flat) & (self.values[self.start :] < 0)
        goals = asked if self.goal.target is None else asked & self.grid.touching(self.goal.target, self.flat)
        while True:
            marks = won.copy()
            own = marks[self.start :]
            own[goals] = 1
            if self.goal.kind in ("invariance", "reach_and_stay"):
                sets.hopeful(game, goals, marks, 1)
            if self.goal.kind != "invariance":
                sets.hopeful(game, asked, marks, 0)
            if self.goal.kind != "recurrence":
                return np.asarray(asked & (own > 0))
            sets.hopeful(game, asked, marks, 1)
            before, goals = goals, goals & (own > 0)
            if goals.sum() == before.sum():
                return np.asarray(asked & (own > 0))

    def solve(self, windows: Windows) -> int:
        goal, safe, level = self.goal, self.safe[self.start :], self.last(windows)
        target = safe if goal.target is None else safe & self.grid.inside(goal.target, self.flat)
        own, bits = self.values[self.start :], self.bits[self.start :]
        if goal.kind == "recurrence":
            return self._recurrence(level, safe, target)
        if goal.kind == "reach_avoid":
            own[target], bits[target] = 0, windows.offered(target)[target]
            return level.reach(self.values, safe, bits)
        # What leads to where the target is kept for ever is kept for ever, too; for invariance that is all.
        rounds = level.remain(target, self.values == 0, own, bits, 0)
        return rounds if goal.kind == "invariance" else rounds + self._reach_and_stay(level, safe, target)

    def _reach_and_stay(self, level: Level, safe: Bools, target: Bools) -> int:
        """As `games.reach_and_stay`, from what is won on."""
        own, bits = self.values[self.start :], self.bits[self.start :]
        rounds = level.reach(self.values, safe, bits)
        while True:
            last = int(self.values.max()) + 1
            rounds += level.remain(target & (own < 0), self.values >= 0, own, bits, last)
            if not (own == last).any():
                return rounds
            self.lasting.append(last)
            way = np.where(self.values >= 0, 0, -1).astype(np.int32)
            rounds += level.reach(way, safe, bits)
            later = way[self.start :] > 0
            own[later] = last + way[self.start :][later]

    def _recurrence(self, level: Level, safe: Bools, visits: Bools) -> int:
        """As `games.recurrence`, given what is won on larger cells."""
        rounds = 0
        while True:
            values, bits = self.values.copy(), np.zeros((len(safe), self.bits.shape[1]), dtype=np.uint8)
            values[self.start :][visits] = 0
            rounds += level.reach(values, safe, bits)
            again = level.leading(values, visits)
            left = visits & again.any(axis=1)
            if left.sum() == visits.sum():
                self.values, self.bits[self.start :] = values, np.where(visits[:, None], again, bits)
                return rounds
            visits, safe = left, safe & (values[self.start :] >= 0)

    def wins(self) -> Bools:
        return np.asarray((self.first == 0) & (self.values >= 0))


@final
class _Positions(Tree):
    """For goals with an automaton: values and bits have its states before the nodes, and nodes have labels."""

    labels: Labels

    def __init__(self, goal: Goal, grid: Grid, coarse: Solution, automaton: Automaton) -> None:
        super().__init__(goal, grid, coarse)
        self.automaton, self.accepting = automaton, np.array(automaton.accepting)
        self.labels = Labels.of(grid, goal.regions)

    def halve(self, split: Bools, inputs: int) -> None:
        super().halve(split, inputs)
        self.labels = self.labels.followed_by(Labels.of(self.grid, self.goal.regions, self.flat))

    def hopeful(self, windows: Windows) -> Bools:
        leads, kind = leads_of(self.automaton, self.labels)
        last, game, won = slice(self.start, None), self.game(windows), self.values >= 0
        asked = ~self.grid.inside(self.goal.avoid, self.flat)
        may, before = won.copy(), -1
        may[self.accepting, last] |= asked
        while may.sum() != before:
            before = int(may.sum())
            for q in np.flatnonzero(~self.accepting).tolist():
                marks = _possible(leads[q], kind, may).astype(np.uint8)
                known = marks[last] > 0
                sets.hopeful(game, asked, marks, 0)
                own = may[q, last]
                own |= (marks[last] > 0) & ~known
                own |= sets.meeting(game, asked & known & ~own, marks)
        split = (may & ~won)[:, last].any(axis=0)
        for q in range(len(may)):
            split |= _in_part(leads[q], kind, self.safe, won, may)[last]
        return np.asarray(asked & split)

    def solve(self, windows: Windows) -> int:
        level, given, rounds = self.last(windows), self.values >= 0, 0
        free = self.safe & ~given
        free[:, : self.start] = False
        won = given | free
        while True:
            values, bits, steps = self._least(level, free, won)
            found, rounds = values >= 0, rounds + steps
            if self.automaton.ends or found.sum() == won.sum():
                self.values, self.bits[:, self.start :] = values, bits
                return rounds
            won = found

    def _least(self, level: Level, free: Bools, assumed: Bools) -> tuple[Any, Any, int]:
        """The least fixpoint where accepting states lead to `assumed`: values, bits of the last level, the largest value."""
        (leads, kind), last, done = leads_of(self.automaton, self.labels), slice(self.start, None), self.automaton.done
        values = np.where(free, -1, np.where(self.values >= 0, self.values, -2)).astype(np.int32)
        bits = self.bits[:, last].copy()
        for q in np.flatnonzero(self.accepting).tolist():
            own = free[q, last] & assumed[q, last]
            if done[q]:
                found = level.windows.offered(own)
            else:
                into = np.where(entered(leads[q], kind, self.safe, assumed), 0, -1).astype(np.int32)
                found = level.leading(into, own)
            wins = own if done[q] else own & found.any(axis=1)
            values[q, last][free[q, last]] = -2
            values[q, last][wins], bits[q][wins] = 0, found[wins]
        good, missing = np.full(values.shape, -1, dtype=np.int32), missed(leads, kind, self.safe)
        reach.least(level.game, reach.Positions(leads, kind, ~self.accepting, values, bits, good, missing))
        return np.maximum(values, -1), bits, int(values.max(initial=0))

    def wins(self) -> Bools:
        return np.asarray((self.first == 0) & started(self.automaton, self.labels, self.values >= 0))


def _possible(leads: Bools, kind: Ints, may: Bools) -> Bools:
    """(nodes,): entered in the state whose leads these are, some reading may win."""
    out = np.zeros(len(kind), dtype=bool)
    for t in np.flatnonzero(leads[:, :-1].any(axis=0)):
        out |= leads[:, t][kind] & may[t]
    return out


def _in_part(leads: Bools, kind: Ints, safe: Bools, won: Bools, may: Bools) -> Bools:
    """(nodes,): entered in the state whose leads these are, some reading may win, but not all do."""
    return np.asarray(_possible(leads, kind, may) & ~entered(leads, kind, safe, won))


@final
class Level(NamedTuple):
    """The last level, with its windows as the compiled functions see them. near (2, axes): least first and largest last cell of
    these windows, counted from the own index.
    """

    windows: Windows
    game: Game
    near: Ints

    def remain(self, some: Bools, won: Bools, own: Any, bits: Any, value: int) -> int:
        """Those of some nodes from which one can remain among them, or come to what is won, get the value and such inputs."""
        if not some.any():
            return 0
        values = np.where(won, 1, -1).astype(np.int32)
        values[self.game.start :][some] = 0
        rounds = sets.invariance(self.game, values, bits, self.near)
        own[values[self.game.start :] == 0] = value
        return int(rounds)

    def leading(self, values: Any, asked: Bools) -> Any:
        """Per node that is asked for, all inputs that lead into what is won."""
        bits = np.zeros((len(asked), self.windows.every.shape[1]), dtype=np.uint8)
        sets.leading(self.game, values, asked, bits)
        return bits

    def reach(self, values: Any, safe: Bools, bits: Any) -> int:
        """Steps of safe nodes of the level to what is won, of which its own nodes have value 0, into values."""
        own = values[self.game.start :]
        own[~safe & (own < 0)] = -2
        reach.reach(self.game, values, bits)
        np.maximum(own, -1, out=own)
        return int(own.max(initial=0))
