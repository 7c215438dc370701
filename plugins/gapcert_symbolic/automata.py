"""Games on cells × states of an automaton, solved state by state with the solver for reaching.

A position (c, q) is a cell and the automaton's state once it has read the regions of a point of that cell. A cell at the border
of a region may be read in several ways; it can be trusted as a successor only if every one of them wins.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, final

import numpy as np

from gapcert import Automaton, Goal, Region

from . import solvers
from .abstraction import Windows
from .games import inside, leading, touching
from .grid import Bools, Grid, Ints
from .solvers import Solution


@final
@dataclass(frozen=True)
class Labels:
    """Regions that a cell lies wholly inside (must), and those that it may touch (may), as letters (cells,)."""

    must: Ints
    may: Ints

    @classmethod
    def of(cls, grid: Grid, regions: tuple[Region, ...]) -> Labels:
        must, may = np.zeros((2, grid.size), dtype=np.int64)
        for p, region in enumerate(regions):
            whole = inside(grid, region)
            must |= whole.astype(np.int64) << p
            may |= (touching(grid, region) | whole).astype(np.int64) << p
        return cls(must, may)

    def kinds(self) -> tuple[list[list[int]], Ints]:
        """The letters that the cells of each kind may be read as, and the kind of every cell."""
        pairs, kind = np.unique(np.stack([self.must, self.may], axis=1), axis=0, return_inverse=True)
        letters = [[letter for letter in range(int(b) + 1) if letter & ~b == 0 and a & ~letter == 0] for a, b in pairs]
        return letters, kind.reshape(-1)


def product(windows: Windows, safe: Bools, automaton: Automaton, labels: Labels) -> Solution:
    """νZ μX. done ∪ (accepting ∩ Pre(Z)) ∪ Pre(X): from every position that wins, the inputs that keep it so.

    values and bits have one more axis, the automaton's states; values fall with every step until it accepts.
    """
    game = _Game(windows, safe, automaton, labels)
    won = np.broadcast_to(safe, game.values.shape)
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


def unlabelled(goal: Goal, labels: Labels | None) -> str:
    """Which region no cell lies wholly inside, or nothing."""
    if goal.automaton is None or labels is None:
        return ""
    lost = [n for p, n in enumerate(goal.automaton.propositions) if not (labels.must >> p & 1).any()]
    return f"no cell lies wholly inside region {lost[0]}; use smaller cells, or align it with their edges" if lost else ""


@final
@dataclass
class _Game:
    windows: Windows
    safe: Bools
    automaton: Automaton
    labels: Labels
    values: Any = field(init=False)  # (states, cells) int32
    bits: Any = field(init=False)  # (states, cells, bytes) uint8

    def __post_init__(self) -> None:
        states = len(self.automaton.after)
        letters, self.kind = self.labels.kinds()
        table = self.automaton.table
        # leads[q, kind, t]: a cell of that kind may take the automaton from q to t; the last column is nowhere.
        self.leads = np.zeros((states, len(letters), states + 1), dtype=bool)
        for k, some in enumerate(letters):
            for q in range(states):
                self.leads[q, k, table[q, some]] = True
        self.values = np.full((states, self.windows.grid.size), -1, dtype=np.int32)
        self.bits = np.stack([solvers._no_bits(self.windows)] * states)

    def entered(self, q: int, won: Any) -> tuple[Bools, Bools]:
        """Per cell, as a successor in state q: all readings that leave q win; there is a reading that stays in q."""
        kinds = self.leads[q]
        good = self.safe & ~kinds[:, -1][self.kind]
        for t in np.flatnonzero(kinds[:, :-1].any(axis=0)):
            if t != q:
                good &= ~kinds[:, t][self.kind] | won[t]
        return good, kinds[:, q][self.kind]

    def least(self, assumed: Any) -> int:
        """The least fixpoint where accepting states lead to `assumed`; the largest value."""
        self.values[:], self.bits[:] = -1, 0
        done, accepting = self.automaton.done, np.array(self.automaton.accepting)
        every = np.packbits(np.ones(self.windows.inputs, dtype=bool))
        allowed = self.windows.allowed
        for q in np.flatnonzero(accepting).tolist():
            if done[q]:
                self.bits[q][self.safe] = every if allowed is None else np.packbits(allowed[self.safe], axis=1)
                self.values[q][self.safe] = 0
                continue
            good, stays = self.entered(q, assumed)
            self.bits[q] = leading(self.windows, good & (~stays | assumed[q]), self.safe & assumed[q])
            self.values[q][self.bits[q].any(axis=1)] = 0
        level, order, idle = 0, self._order(), 0
        while idle < len(order):
            for q in order:
                more = self._grow(q, level)
                idle = 0 if more > level else idle + 1
                level = max(level, more)
                if idle >= len(order):
                    break
        return level

    def _grow(self, q: int, level: int) -> int:
        """Positions of state q from which those that have won are reached; the largest value so far."""
        won = self.values >= 0
        good, stays = self.entered(q, won)
        target = good & (~stays | won[q])
        way = solvers.reach_avoid(self.windows, good, target)
        fresh = way.values > 0
        top = level
        if fresh.any():
            # Where a cell had won before, its inputs stay those that led on earlier.
            self.values[q][fresh], self.bits[q][fresh] = level + way.values[fresh], way.bits[fresh]
            top = level + int(way.values.max())
        asked = self.safe & (self.values[q] < 0)
        bits = leading(self.windows, target | fresh, asked)
        late = bits.any(axis=1)
        if late.any():
            top += 1
            self.values[q][late], self.bits[q][late] = top, bits[late]
        return top

    def _order(self) -> list[int]:
        """States that do not accept, those nearest to accepting ones first."""
        table, accepting = self.automaton.table, np.array(self.automaton.accepting)
        order, near = list[int](), accepting.copy()
        while True:
            step = ~near & (near[table] & (table >= 0)).any(axis=1)
            if not step.any():
                return order
            order += np.flatnonzero(step).tolist()
            near |= step
