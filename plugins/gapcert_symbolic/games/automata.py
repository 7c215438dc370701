"""Games on cells × states of an automaton.

A position (c, q) is a cell and the automaton's state once it has read the regions of a point of that cell. A cell at the border
of a region may be read in several ways; it can be trusted as a successor only if every one of them wins.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, final

import numpy as np
import numpy.typing as npt

from gapcert import Region
from gapcert.plugin import Automaton, Bools, Ints
from gapcert_symbolic.cells.abstraction import Windows
from gapcert_symbolic.cells.grid import Grid
from gapcert_symbolic.kernels import reach, repeats
from gapcert_symbolic.kernels.kernels import whole
from gapcert_symbolic.solvers.problem import Play, Solution

from .games import leading


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
