"""Greatest and least fixpoints over windows of cells."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Protocol, final

import numpy as np
import numpy.typing as npt

from gapcert.plugin import Bools, Ints
from gapcert_symbolic.cells.abstraction import Windows
from gapcert_symbolic.kernels import inverse, kernels

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
    values, bits = np.where(safe, 0, -1).astype(np.int32), _no_bits(windows)
    rounds = runs.invariance(threads, *_given(windows), values, bits, _allowed(windows), *windows.rows)
    return Solution(values, bits, rounds)


def reach_avoid(windows: Windows, safe: Bools, target: Bools, threads: int = 1) -> Solution:
    """Least number of steps to the target; the inputs of a cell are all that lead wholly into cells of fewer steps.

    Target cells have value 0 and every input that is allowed: the promise ends there.
    """
    fresh = target & safe
    values = np.where(fresh, 0, np.where(safe, -1, -2)).astype(np.int32)
    bits = _no_bits(windows)
    bits[fresh] = np.packbits(np.ones(windows.inputs, dtype=bool))
    if windows.allowed is not None:
        bits[fresh] = np.packbits(windows.allowed[fresh], axis=1)
    allowed = _allowed(windows)
    rounds = inverse.reach(windows, values, bits, allowed, threads)
    if rounds is None:
        whole = np.int32 if windows.grid.size * windows.inputs < 2**31 else np.int64
        head, following = np.full(windows.grid.size, -1, whole), np.empty(windows.grid.size * windows.inputs, whole)
        rounds = kernels.reach(*_given(windows), values, bits, allowed, _near(windows, fresh), head, following)
    return Solution(np.maximum(values, -1), bits, rounds)


def _given(windows: Windows) -> tuple[Ints, Bools, tuple[npt.NDArray[np.generic], ...]]:
    return np.array(windows.grid.counts), np.array(windows.grid.wraps), windows.packed


def _allowed(windows: Windows) -> Bools:
    return np.empty((0, 0), dtype=bool) if windows.allowed is None else windows.allowed


def _no_bits(windows: Windows) -> npt.NDArray[np.uint8]:
    return np.zeros((windows.grid.size, (windows.inputs + 7) // 8), dtype=np.uint8)


def _near(windows: Windows, marked: Bools) -> tuple[Ints, Ints]:
    """First and last index of each axis between which windows may touch a marked cell."""
    low, high = np.empty((2, len(windows.axes)), dtype=np.int64)
    cells, (least, most) = marked.reshape(windows.grid.counts), windows.reach
    for k, n in enumerate(cells.shape):
        rows = np.flatnonzero(cells.any(axis=tuple(j for j in range(cells.ndim) if j != k)))
        if windows.grid.wraps[k] and len(rows):
            low[k], high[k] = 0, n - 1
        else:
            low[k], high[k] = (rows[0] - most[k], rows[-1] - least[k]) if len(rows) else (n, -1)
    return low, high
