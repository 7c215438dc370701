"""Greatest and least fixpoints over windows of cells."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Protocol, final

import numpy as np
import numpy.typing as npt

from gapcert.plugin import Bools
from gapcert_symbolic.cells import repeats
from gapcert_symbolic.cells.abstraction import Windows
from gapcert_symbolic.kernels import inverse, reach
from gapcert_symbolic.kernels.kernels import whole

from . import erosion, runs

LARGE = 1 << 26  # pairs of a cell and an input: with fewer, to give threads their parts takes longer than they save


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


def usable(asked: int | None, pairs: int) -> int:
    """How many threads are used for so many pairs of a cell and an input: as asked, else one per core from LARGE on."""
    return asked or (len(os.sched_getaffinity(0)) if pairs >= LARGE else 1)


class Fixpoints(Protocol):
    """What solves both games."""

    def invariance(self, windows: Windows, safe: Bools) -> Solution: ...

    def reach_avoid(self, windows: Windows, safe: Bools, target: Bools) -> Solution: ...


@final
@dataclass(frozen=True)
class Compiled:
    """The functions of this module, with so many threads where they use more than one."""

    threads: int = 1

    def invariance(self, windows: Windows, safe: Bools) -> Solution:
        return invariance(windows, safe, self.threads)

    def reach_avoid(self, windows: Windows, safe: Bools, target: Bools) -> Solution:
        return reach_avoid(windows, safe, target, self.threads)


def invariance(windows: Windows, safe: Bools, threads: int = 1) -> Solution:
    """Greatest set of safe cells from which some input leads wholly back into the set; then all such inputs."""
    if (order := erosion.order(windows)) is not None:
        alive, bits, rounds = erosion.invariance(windows, safe, order, threads)
        return Solution(np.where(alive, 0, -1).astype(np.int32), bits, rounds)
    values, bits = np.where(safe, 0, -1).astype(np.int32), windows.no_bits
    rounds = runs.invariance(threads, windows.game, values, bits, *windows.rows)
    return Solution(values, bits, rounds)


def reach_avoid(windows: Windows, safe: Bools, target: Bools, threads: int = 1) -> Solution:
    """Least number of steps to the target; the inputs of a cell are all that lead wholly into cells of fewer steps.

    Target cells have value 0 and every input that is allowed: the promise ends there.
    """
    fresh = target & safe
    values, bits = np.where(fresh, 0, np.where(safe, -1, -2)).astype(np.int32), windows.offered(fresh)
    if (given := repeats.inverse(windows, whole(windows.grid.size * windows.inputs))) is None:
        reach.reach(windows.game, values, bits)
    else:
        inverse.reach(given, values, bits, windows.permitted, threads)
    return Solution(np.maximum(values, -1), bits, int(values.max(initial=0)))
