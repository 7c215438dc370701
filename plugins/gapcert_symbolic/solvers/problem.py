"""What solvers are asked, and what they find."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, final

import numpy as np
import numpy.typing as npt

from gapcert import Array
from gapcert.plugin import Automaton, Bools, Ints
from gapcert_symbolic.cells.abstraction import Windows
from gapcert_symbolic.cells.bounds import Bound
from gapcert_symbolic.cells.gaps import Disturbance
from gapcert_symbolic.cells.grid import Grid


@final
@dataclass(frozen=True)
class Solution:
    """values (cells,): steps to the target, −1 losing; bits: all valid inputs per cell, packed; rounds of the fixpoint.

    lasting: the values that need not fall, where all cells that have them are in the target (`games.reach_and_stay`).
    """

    values: npt.NDArray[np.int32] | npt.NDArray[np.int8]
    bits: npt.NDArray[np.uint8]
    rounds: int
    lasting: tuple[int, ...] = (0,)

    def told(self) -> dict[str, int]:
        """What one sees of it before the controller is made."""
        return {"winning cells": int((self.values >= 0).sum()), "rounds": self.rounds}


class Dynamics(NamedTuple):
    """What windows are made of: a bound of f over cells, these, the values of each input, [l, u] over blocks of both, and the
    inputs that the relations allow.
    """

    bound: Bound
    grid: Grid
    axes: tuple[Array, ...]
    added: Disturbance | None
    allowed: Bools | None


@final
@dataclass(frozen=True)
class Problem:
    """A game on cells.

    Without a target: the greatest set of safe cells from which some input leads wholly back into the set, and all such
    inputs. With one: the least number of steps to it, and all inputs that lead wholly into cells of fewer steps; cells of the
    target have value 0 and every input that is allowed: the promise ends there.

    windows: made where a solver asks for them; dynamics: what they are made of, where there may be another way: it may take
    `safe` for its own. solver: as the option says. threads: how many it may use; values and inputs do not depend on it.
    """

    windows: Callable[[], Windows]
    safe: Bools
    target: Bools | None = None
    dynamics: Dynamics | None = None
    solver: Literal["compiled", "jax"] = "compiled"
    threads: int = 1


@final
@dataclass(frozen=True)
class Play:
    """A game on cells × states of an automaton. leads[q, kind, t]: a cell of that kind may take the automaton from q to t,
    the last t being nowhere; kind (cells,).
    """

    windows: Windows
    safe: Bools
    automaton: Automaton
    leads: Bools
    kind: Ints

    def entered(self, q: int, won: Any) -> Bools:
        """(cells,): entered in state q, every reading wins."""
        return entered(self.leads[q], self.kind, self.safe, won)


def entered(leads: Bools, kind: Ints, safe: Bools, won: Any) -> Bools:
    """(cells,): entered in the state whose leads these are, every reading wins."""
    good: Bools = safe & ~leads[:, -1][kind]
    for t in np.flatnonzero(leads[:, :-1].any(axis=0)):
        good &= ~leads[:, t][kind] | won[t]
    return np.asarray(good)
