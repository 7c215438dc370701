"""Cells that lost, but may yet win on finer ones, are halved and solved again; what is won stays won, by the inputs it has.

Let W be won on the grids so far. A set of finer cells is added to it in which each has an input that leads into it or into W:
the promise of W holds as it did, and that of the finer cells by their own windows. Which cells are halved changes nothing in
this. A cell is left whole where no finer one can win: a finer cell's window lies in that of the cell it is part of, so that
all cells with a winning part are in the greatest set (invariance) or in the least one about the target and W (reach) of which
each has an input whose window meets the set or W. So the domain is that of the finest grid on all of the box.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, final

import numpy as np

from gapcert import Along, Goal, Splits, Successors, SuccessorsByLevel, UsageError

from . import tree_kernels
from .abstraction import BYTES, MEMORY, Axis, Windows
from .games import inside, touching
from .grid import Bools, Grid, Ints
from .solvers import Solution

Offer = Callable[[Grid, Ints], Bools | None]
GOALS = ("invariance", "reach_avoid")


@final
class Refined(NamedTuple):
    """`solution` has the nodes of `splits` as cells; windows, one per level, are those on which they rest."""

    splits: Splits
    solution: Solution
    windows: tuple[Windows, ...]
    levels: list[dict[str, Any]]

    def promised(self) -> SuccessorsByLevel | None:
        made = tuple(
            Successors(
                w.grid.counts, w.grid.wraps, tuple(Along(a.on, a.moves, a.column, a.first, a.last, a.row) for a in w.axes)
            )
            for w in self.windows
        )
        return SuccessorsByLevel(self.splits, made).unless_large()

    def won(self, least: int = 0) -> int:
        """Cells of at least this value."""
        return int((self.solution.values >= least).sum())

    def facts(self) -> dict[str, Any]:
        """Counts of whole cells; the fraction is of the volume."""
        return {
            "cells": int((self.splits.first == 0).sum()),
            "winning_cells": self.won(),
            "winning_fraction": self.levels[-1]["winning_fraction"],
            "rounds": self.solution.rounds,
            "levels": self.levels,
        }


class _Tree:
    """Nodes as they grow; `flat` are the numbers of the last level's nodes, from `start` on, on its own `grid`."""

    def __init__(self, grid: Grid, coarse: Solution) -> None:
        self.grid, self.level, self.start, self.flat = grid, 0, 0, np.arange(grid.size)
        self.roots = grid.counts
        self.first = np.zeros(grid.size, dtype=np.int64)
        self.values, self.bits = coarse.values.astype(np.int32), coarse.bits

    def game(self, windows: Windows) -> tree_kernels.Game:
        axes, counts, wraps = windows.axes, np.array(windows.grid.counts), np.array(windows.grid.wraps)
        first, last = (np.concatenate([getattr(a, end).ravel() for a in axes]) for end in ("first", "last"))
        start = np.cumsum([0, *(a.first.size for a in axes)])[:-1]
        width, moves = np.array([a.first.shape[1] for a in axes]), np.array([a.moves for a in axes])
        column, rows = np.stack([a.column for a in axes]), np.stack([self._rows(a) for a in axes])
        tables = first, last, start, width, moves, column, rows
        return tree_kernels.Game(np.array(self.roots), self.level, self.first, counts, wraps, tables, self.start, self.flat)

    def _rows(self, axis: Axis) -> Ints:
        """The row of the axis for each node of the last level."""
        if axis.row is not None:
            return axis.row
        index, counts = np.unravel_index(self.flat, self.grid.counts), [self.grid.counts[d] for d in axis.on]
        return np.asarray(np.ravel_multi_index([index[d] for d in axis.on], counts) if axis.on else 0 * self.flat)

    def near(self, windows: Windows) -> Ints:
        """(2, axes): least first and largest last cell of the windows of the last level's nodes, counted from the own index."""
        index, out = np.unravel_index(self.flat, self.grid.counts), []
        for k, axis in enumerate(windows.axes):
            row, own = self._rows(axis), 0 if axis.moves else index[k]
            least, most = axis.first.min(axis=1)[row] - own, axis.last.max(axis=1)[row] - own
            out.append([least.min(), most.max()])
        return np.array(out, dtype=np.int64).T.copy()

    def hopeful(self, windows: Windows, goal: Goal) -> Bools:
        """(nodes of the last level,): those of which a part may win on finer cells."""
        own = self.values[self.start :]
        asked = own < 0
        if goal.avoid is not None:
            asked[asked] = ~inside(self.grid, goal.avoid, self.flat[asked])
        marks = (self.values >= 0).astype(np.uint8)
        if goal.target is None:
            marks[self.start :][asked] = 1
        else:
            marks[self.start :][asked] = touching(self.grid, goal.target, self.flat[asked])
        tree_kernels.hopeful(self.game(windows), asked, marks, int(goal.target is None))
        return asked & (marks[self.start :] > 0)

    def halve(self, split: Bools, inputs: int) -> None:
        """The children of nodes of the last level, which nobody has won yet."""
        dims, number = len(self.roots), int(split.sum())
        new = number << dims
        need = float(new) * (BYTES + 16 + (inputs + 7) // 8 + 8 * inputs)
        if need > MEMORY:
            raise UsageError(
                f"controller.refine: {new:,} cells × {inputs:,} inputs on level {self.level + 1} need {need / 1e9:.1f} GB "
                f"(limit {MEMORY / 1e9:.0f}); use a smaller number"
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

    def solve(self, windows: Windows, goal: Goal, allowed: Bools | None) -> int:
        """The game on the last level; the number of rounds."""
        own, bits = self.values[self.start :], self.bits[self.start :]
        safe = np.ones(len(own), dtype=bool)
        if goal.avoid is not None:
            safe &= ~touching(self.grid, goal.avoid, self.flat)
        offered = np.empty((0, 0), dtype=bool) if allowed is None else allowed
        if goal.target is None:
            own[safe] = 0
            return int(tree_kernels.invariance(self.game(windows), self.values, bits, offered, self.near(windows)))
        fresh = safe & inside(self.grid, goal.target, self.flat)
        own[~safe], own[fresh] = -2, 0
        bits[fresh] = np.packbits(np.ones(windows.inputs, dtype=bool))
        if allowed is not None:
            bits[fresh] = np.packbits(allowed[fresh], axis=1)
        pairs, given = len(own) * windows.inputs, int(self.values.max(initial=-1)) + 1
        whole = np.int32 if pairs < 2**31 else np.int64
        lists = np.full(len(own), -1, whole), np.full(given, -1, whole), np.empty(pairs, whole)
        rounds = tree_kernels.reach(self.game(windows), self.values, bits, offered, lists)
        np.maximum(own, -1, out=own)
        return int(rounds)

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


def refined(
    goal: Goal, levels: int, coarse: Solution, windows: Windows, finer: Callable[[Grid, Ints], Windows], offer: Offer
) -> Refined:
    """From a solution on a grid, with its windows, to one on at most so many further levels. offer: the inputs of cells."""
    tree, made, rounds = _Tree(windows.grid, coarse), [windows], coarse.rounds
    facts = [tree.facts()]
    for _ in range(levels):
        split = tree.hopeful(made[-1], goal)
        if not split.any():
            break
        tree.halve(split, windows.inputs)
        made.append(finer(tree.grid, tree.flat))
        rounds += tree.solve(made[-1], goal, offer(tree.grid, tree.flat))
        facts.append(tree.facts())
    won = 0.0
    for k, fact in enumerate(facts):
        won += fact["winning_cells"] * 0.5 ** (k * len(tree.roots)) / windows.grid.size
        fact["winning_fraction"] = won
    splits = Splits(tree.roots, tree.level, tree.first.astype(np.int32 if len(tree.first) < 2**31 else np.int64))
    return Refined(splits, Solution(tree.values, tree.bits, rounds), tuple(made), facts)
