"""Cells that lost, but may yet win on finer ones, are halved and solved again; what is won stays won, by the inputs it has.

Let W be won on the grids so far. A set of finer cells is added to it in which each has an input that leads into it or into W:
the promise of W holds as it did, and that of the finer cells by their own windows. Which cells are halved changes nothing in
this. A cell is left whole where no finer one can win: a finer cell's window lies in that of the cell it is part of, and what
lies in the target touches it. So all cells with a winning part are in what the same fixpoint gives where a window need only
meet a set, W among it, and a cell only touch the target. So the domain is that of the finest grid on all of the box.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, final

import numpy as np

from gapcert import Goal, UsageError
from gapcert.plugin import Bools, Ints
from gapcert_cells import Splits, SuccessorsByLevel
from gapcert_symbolic.cells.abstraction import Windows
from gapcert_symbolic.cells.grid import Grid
from gapcert_symbolic.kernels import reach, sets
from gapcert_symbolic.kernels.kernels import Game
from gapcert_symbolic.solvers.problem import Solution
from gapcert_symbolic.thresholds import THRESHOLDS

from .automata import Labels
from .games import inside, touching


@final
class Refined(NamedTuple):
    """`solution` has the nodes of `splits` as cells; windows, one per level, are those on which they rest.

    With an automaton, labels of the nodes, and which of these win with the memory that a run begins with there.
    """

    splits: Splits
    solution: Solution
    windows: tuple[Windows, ...]
    levels: list[dict[str, Any]]
    labels: Labels | None = None
    wins: Bools | None = None

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


@final
class Tree:
    """Nodes as they grow; `flat` are the numbers of the last level's nodes, from `start` on, on its own `grid`."""

    def __init__(self, grid: Grid, coarse: Solution) -> None:
        self.grid, self.level, self.start, self.flat = grid, 0, 0, np.arange(grid.size)
        self.roots = grid.counts
        self.first = np.zeros(grid.size, dtype=np.int64)
        self.values, self.bits, self.lasting = coarse.values.astype(np.int32), coarse.bits, list(coarse.lasting)

    def game(self, windows: Windows) -> Game:
        return windows.game._replace(
            size=len(self.flat), level=self.level, children=self.first, start=self.start, flat=self.flat
        )

    def near(self, windows: Windows) -> Ints:
        """(2, axes): least first and largest last cell of the windows of the last level's nodes, counted from the own index."""
        index, out = np.unravel_index(self.flat, self.grid.counts), []
        for k, axis in enumerate(windows.axes):
            row = axis.rows(index, self.grid.counts, np.arange(len(self.flat)))
            own = 0 if axis.moves else index[k]
            least, most = axis.first.min(axis=1)[row] - own, axis.last.max(axis=1)[row] - own
            out.append([least.min(), most.max()])
        return np.array(out, dtype=np.int64).T.copy()

    def hopeful(self, windows: Windows, goal: Goal) -> Bools:
        """(nodes of the last level,): those of which a part may win on finer cells."""
        game, won = self.game(windows), (self.values >= 0).astype(np.uint8)
        asked = self.values[self.start :] < 0
        if goal.avoid is not None:
            asked[asked] = ~inside(self.grid, goal.avoid, self.flat[asked])
        goals = asked.copy()
        if goal.target is not None:
            goals[asked] = touching(self.grid, goal.target, self.flat[asked])
        while True:
            marks = won.copy()
            own = marks[self.start :]
            own[goals] = 1
            if goal.kind in ("invariance", "reach_and_stay"):
                sets.hopeful(game, goals, marks, 1)
            if goal.kind != "invariance":
                sets.hopeful(game, asked, marks, 0)
            if goal.kind != "recurrence":
                return np.asarray(asked & (own > 0))
            sets.hopeful(game, asked, marks, 1)
            before, goals = goals, goals & (own > 0)
            if goals.sum() == before.sum():
                return np.asarray(asked & (own > 0))

    def halve(self, split: Bools, inputs: int) -> None:
        """The children of nodes of the last level, which nobody has won yet."""
        dims, number = len(self.roots), int(split.sum())
        new = number << dims
        need = float(new) * (THRESHOLDS.cell_bytes + 16 + (inputs + 7) // 8 + 8 * inputs)
        if need > THRESHOLDS.memory:
            raise UsageError(
                f"controller.refine: {new:,} cells × {inputs:,} inputs on level {self.level + 1} need {need / 1e9:.1f} GB "
                f"(limit {THRESHOLDS.memory / 1e9:.0f}); use a smaller number"
            )
        at = len(self.first)
        self.first[self.start :][split] = at + (np.arange(number) << dims)
        index = np.stack(np.unravel_index(self.flat[split], self.grid.counts), axis=-1)
        index = (2 * index[:, None] + np.indices((2,) * dims).reshape(dims, -1).T).reshape(-1, dims)
        self.grid, self.level, self.start = self.grid.halved, self.level + 1, at
        self.flat = np.asarray(np.ravel_multi_index(tuple(index.T), self.grid.counts))
        self.first = np.append(self.first, np.zeros(new, dtype=np.int64))
        self.values = np.append(self.values, np.full(new, -1, dtype=np.int32))
        self.bits = np.append(self.bits, np.zeros((new, self.bits.shape[1]), dtype=np.uint8), axis=0)

    def solve(self, windows: Windows, goal: Goal) -> int:
        """The game on the last level; the number of rounds."""
        safe = np.ones(len(self.flat), dtype=bool)
        if goal.avoid is not None:
            safe &= ~touching(self.grid, goal.avoid, self.flat)
        target = safe if goal.target is None else safe & inside(self.grid, goal.target, self.flat)
        level = Level(windows, self.game(windows), self.near(windows))
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

    def splits(self) -> Splits:
        return Splits(self.roots, self.level, self.first.astype(np.int32 if len(self.first) < 2**31 else np.int64))

    def facts(self) -> dict[str, Any]:
        """What the last level brought: the winning fraction is of the volume, of all levels so far."""
        own = self.values[self.start :]
        names = [a.name for a in self.grid.box.axes]
        return {
            "cell": dict(zip(names, self.grid.widths.tolist(), strict=True)),
            "cells": len(own),
            "uniform_cells": self.grid.size,
            "winning_cells": int((own >= 0).sum()),
        }


@final
class Level(NamedTuple):
    """The last level, with its windows as the compiled functions see them. near: as in `sets.invariance`."""

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


def refined(goal: Goal, levels: int, coarse: Solution, windows: Windows, finer: Callable[[Grid, Ints], Windows]) -> Refined:
    """From a solution on a grid, with its windows, to one on at most so many further levels. finer: windows of some cells."""
    tree, made, rounds = Tree(windows.grid, coarse), [windows], coarse.rounds
    facts = [tree.facts()]
    for _ in range(levels):
        split = tree.hopeful(made[-1], goal)
        if not split.any():
            break
        tree.halve(split, windows.inputs)
        made.append(finer(tree.grid, tree.flat))
        rounds += tree.solve(made[-1], goal)
        facts.append(tree.facts())
    won = 0.0
    for k, fact in enumerate(facts):
        won += fact["winning_cells"] * 0.5 ** (k * len(tree.roots)) / windows.grid.size
        fact["winning_fraction"] = won
    return Refined(tree.splits(), Solution(tree.values, tree.bits, rounds, tuple(tree.lasting)), tuple(made), facts)
