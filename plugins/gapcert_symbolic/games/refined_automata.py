"""Halved cells for goals with an automaton: `refinement` on positions, pairs of a node and a state of the automaton.

Nodes are halved for all states at once. What is won at a node is won at its parts, by the same inputs in the same number of
steps: W is then all positions that are won, those of parts among them, and the game is solved for the other positions of the
last level. A node is halved where a position may win that does not, or where it may be entered in a state in which it must not
be as a whole, since a part of it may be read in fewer ways.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, final

import numpy as np

from gapcert import Goal
from gapcert.plugin import Automaton, Bools, Ints
from gapcert_symbolic.cells.abstraction import Windows
from gapcert_symbolic.cells.grid import Grid
from gapcert_symbolic.kernels import reach, sets
from gapcert_symbolic.solvers.problem import Solution, entered

from .automata import Labels, leads_of, missed, started
from .games import inside, touching
from .refinement import Level, Refined, Tree


@final
class _Positions:
    """values (states, nodes), bits (states, nodes, bytes), safe and labels of the nodes of a tree as it grows."""

    def __init__(self, tree: Tree, goal: Goal, automaton: Automaton, coarse: Solution) -> None:
        self.tree, self.goal, self.automaton = tree, goal, automaton
        self.values, self.bits = coarse.values.astype(np.int32), coarse.bits.copy()
        self.safe, self.labels = self._safe(), self._labels()

    def _safe(self) -> Bools:
        tree, avoid = self.tree, self.goal.avoid
        return np.ones(len(tree.flat), dtype=bool) if avoid is None else ~touching(tree.grid, avoid, tree.flat)

    def _labels(self) -> Labels:
        return Labels.of(self.tree.grid, self.goal.regions, self.tree.flat)

    def hopeful(self, windows: Windows) -> Bools:
        """(nodes of the last level,): those that have to be halved."""
        tree, (leads, kind) = self.tree, leads_of(self.automaton, self.labels)
        last, game, won = slice(tree.start, None), tree.game(windows), self.values >= 0
        asked = np.ones(len(tree.flat), dtype=bool)
        if self.goal.avoid is not None:
            asked &= ~inside(tree.grid, self.goal.avoid, tree.flat)
        may, before = won.copy(), -1
        may[np.array(self.automaton.accepting), last] |= asked
        while may.sum() != before:
            before = int(may.sum())
            for q in np.flatnonzero(~np.array(self.automaton.accepting)).tolist():
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

    def halve(self, split: Bools, inputs: int) -> None:
        """Parts have the values and inputs of what they are part of."""
        tree, dims = self.tree, len(self.tree.roots)
        parents = np.repeat(tree.start + np.flatnonzero(split), 1 << dims)
        tree.halve(split, inputs * len(self.values))
        self.values = np.append(self.values, self.values[:, parents], axis=1)
        self.bits = np.append(self.bits, self.bits[:, parents], axis=1)
        self.safe = np.append(self.safe, self._safe())
        self.labels = self.labels.followed_by(self._labels())

    def solve(self, windows: Windows) -> int:
        """The game on the last level, given what is won; the number of rounds."""
        tree = self.tree
        level = Level(windows, tree.game(windows), tree.near(windows))
        given = self.values >= 0
        free = self.safe & ~given
        free[:, : tree.start] = False
        won, rounds = given | free, 0
        while True:
            values, bits, steps = self._least(level, free, won)
            found, rounds = values >= 0, rounds + steps
            if self.automaton.ends or found.sum() == won.sum():
                self.values, self.bits[:, tree.start :] = values, bits
                return rounds
            won = found

    def _least(self, level: Level, free: Bools, assumed: Bools) -> tuple[Any, Any, int]:
        """The least fixpoint where accepting states lead to `assumed`: values, bits of the last level, the largest value."""
        tree, (leads, kind) = self.tree, leads_of(self.automaton, self.labels)
        last, accepting, done = slice(tree.start, None), np.array(self.automaton.accepting), self.automaton.done
        values = np.where(free, -1, np.where(self.values >= 0, self.values, -2)).astype(np.int32)
        bits = self.bits[:, last].copy()
        for q in np.flatnonzero(accepting).tolist():
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
        reach.least(level.game, reach.Positions(leads, kind, ~accepting, values, bits, good, missing))
        return np.maximum(values, -1), bits, int(values.max(initial=0))

    def facts(self) -> dict[str, Any]:
        """As those of a tree; cells win with the memory that a run begins with there."""
        tree, wins = self.tree, self.wins()
        # Powers of two are added exactly.
        parts = 0.5 ** (len(tree.roots) * tree.splits().level(np.flatnonzero(wins)))
        fraction = float(parts.sum() / np.prod(tree.roots, dtype=np.int64))
        return tree.facts() | {"winning_cells": int(wins[tree.start :].sum()), "winning_fraction": fraction}

    def wins(self) -> Bools:
        """(nodes,): those that are whole and win with the memory that a run begins with there."""
        return np.asarray((self.tree.first == 0) & started(self.automaton, self.labels, self.values >= 0))


def _possible(leads: Bools, kind: Ints, may: Bools) -> Bools:
    """(nodes,): entered in the state whose leads these are, some reading may win."""
    out = np.zeros(len(kind), dtype=bool)
    for t in np.flatnonzero(leads[:, :-1].any(axis=0)):
        out |= leads[:, t][kind] & may[t]
    return out


def _in_part(leads: Bools, kind: Ints, safe: Bools, won: Bools, may: Bools) -> Bools:
    """(nodes,): entered in the state whose leads these are, some reading may win, but not all do."""
    return np.asarray(_possible(leads, kind, may) & ~entered(leads, kind, safe, won))


def refined_product(
    goal: Goal, levels: int, coarse: Solution, windows: Windows, finer: Callable[[Grid, Ints], Windows]
) -> Refined:
    """As `refinement.refined`; values and bits have one more axis, the automaton's states."""
    assert goal.automaton is not None
    plain = Solution(np.full(windows.grid.size, -1, dtype=np.int32), np.empty((windows.grid.size, 0), dtype=np.uint8), 0)
    found = _Positions(Tree(windows.grid, plain), goal, goal.automaton, coarse)
    tree, made, rounds, facts = found.tree, [windows], coarse.rounds, [found.facts()]
    for _ in range(levels):
        split = found.hopeful(made[-1])
        if not split.any():
            break
        found.halve(split, windows.inputs)
        made.append(finer(tree.grid, tree.flat))
        rounds += found.solve(made[-1])
        facts.append(found.facts())
    # Runs are in the parts of a node that is halved, and never in the node.
    found.values[:, tree.first > 0], found.bits[:, tree.first > 0] = -1, 0
    return Refined(tree.splits(), Solution(found.values, found.bits, rounds), tuple(made), facts, found.labels, found.wins())
