"""Greatest and least fixpoints over windows of cells, by summed-area tables."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, final

import numpy as np
import numpy.typing as npt

from .abstraction import Windows
from .grid import Bools, Ints

PAIRS = 1_000_000


@final
@dataclass(frozen=True)
class Solution:
    """values (cells,): steps to the target, −1 losing; bits: all valid inputs per cell, packed; rounds of the fixpoint."""

    values: npt.NDArray[np.int32]
    bits: npt.NDArray[np.uint8]
    rounds: int


@final
@dataclass(frozen=True)
class Table:
    """How many marked cells a window contains: the summed-area table of a set of cells."""

    sums: npt.NDArray[np.int32]

    @classmethod
    def of(cls, windows: Windows, marked: Bools, outside: bool) -> Table:
        """`outside`: do the cells beyond the grid count as marked?"""
        cells = marked.reshape(windows.grid.counts)
        for k, wraps in enumerate(windows.grid.wraps):
            if wraps:
                cells = np.concatenate([cells, cells], axis=k)
            else:
                pad = [(int(j == k), int(j == k)) for j in range(cells.ndim)]
                cells = np.pad(cells, pad, constant_values=outside)
        sums = np.pad(cells, [(1, 0)] * cells.ndim).astype(np.int32)
        for k in range(sums.ndim):
            np.cumsum(sums, axis=k, out=sums)
        return cls(sums)

    def meets(self, first: tuple[npt.NDArray[Any], ...], last: tuple[npt.NDArray[Any], ...]) -> Bools:
        """Does the window contain a marked cell? By inclusion and exclusion over its 2^nx corners."""
        kind = np.int32 if self.sums.size < 2**31 else np.int64
        strides = [s // self.sums.itemsize for s in self.sums.strides]
        origin: Any = 0
        for begin, s in zip(first, strides, strict=True):
            origin = origin + begin.astype(kind) * s
        corners = [(1, origin)]
        for begin, end, s in zip(first, last, strides, strict=True):
            span = (end.astype(kind) + 1 - begin) * s
            corners = [(-sign, at) for sign, at in corners] + [(sign, at + span) for sign, at in corners]
        total = np.zeros(np.shape(origin), dtype=np.int32)
        for sign, at in corners:
            total += sign * self.sums.ravel().take(at)
        return np.asarray(total > 0)


def _chunks(windows: Windows, cells: Ints) -> Iterator[Ints]:
    step = max(1, PAIRS // windows.inputs)
    return (cells[k : k + step] for k in range(0, len(cells), step))


def _clear(windows: Windows, bad: Table, cells: Ints) -> Bools:
    """(n, inputs): no successor touches a bad cell, and the input is allowed."""
    clear = ~bad.meets(tuple(f[cells] for f in windows.first), tuple(f[cells] for f in windows.last))
    return clear if windows.allowed is None else clear & windows.allowed[cells]


def invariance(windows: Windows, safe: Bools) -> Solution:
    """Greatest set of safe cells from which some input leads wholly back into the set; then all such inputs.

    A cell stays while the input remembered for it (its witness) stays valid, so most cells cost one lookup per sweep.
    """
    alive, witness, rounds = safe.copy(), np.full(len(safe), -1, dtype=np.int64), 0
    while True:
        rounds += 1
        bad = Table.of(windows, ~alive, outside=True)
        cells = np.flatnonzero(alive)
        chosen = witness[cells]
        ends = tuple(f[cells, chosen] for f in windows.first), tuple(f[cells, chosen] for f in windows.last)
        broken = cells[(chosen < 0) | bad.meets(*ends)]
        before = alive.sum()
        for part in _chunks(windows, broken):
            valid = _clear(windows, bad, part)
            number = valid.sum(axis=1)
            # The middle valid input is the least likely to be lost in a later sweep.
            witness[part] = (np.cumsum(valid, axis=1) > (number // 2)[:, None]).argmax(axis=1)
            alive[part[number == 0]] = False
        if alive.sum() == before:
            break
    bits = np.zeros((len(safe), (windows.inputs + 7) // 8), dtype=np.uint8)
    bad = Table.of(windows, ~alive, outside=True)
    for part in _chunks(windows, np.flatnonzero(alive)):
        bits[part] = np.packbits(_clear(windows, bad, part), axis=1)
    return Solution(np.where(alive, 0, -1).astype(np.int32), bits, rounds)


def reach_avoid(windows: Windows, safe: Bools, target: Bools) -> Solution:
    """Least number of steps to the target; the inputs of a cell are all that lead wholly into cells of fewer steps.

    Target cells have value 0 and every input that is allowed: the promise ends there.
    """
    fresh = target & safe
    values = np.where(fresh, 0, -1).astype(np.int32)
    bits = np.zeros((len(safe), (windows.inputs + 7) // 8), dtype=np.uint8)
    bits[fresh] = np.packbits(np.ones(windows.inputs, dtype=bool))
    if windows.allowed is not None:
        bits[fresh] = np.packbits(windows.allowed[fresh], axis=1)
    # Only a cell with some successor in a newly won cell can be won next.
    hull = tuple(f.min(axis=1) for f in windows.first), tuple(f.max(axis=1) for f in windows.last)
    level = 0
    while fresh.any():
        level += 1
        near, lost = Table.of(windows, fresh, outside=False), Table.of(windows, values < 0, outside=True)
        waiting = np.flatnonzero(safe & (values < 0))
        near_ends = tuple(f[waiting] for f in hull[0]), tuple(f[waiting] for f in hull[1])
        fresh = np.zeros(len(safe), dtype=bool)
        for part in _chunks(windows, waiting[near.meets(*near_ends)]):
            valid = _clear(windows, lost, part)
            won = valid.any(axis=1)
            fresh[part[won]] = True
            bits[part[won]] = np.packbits(valid[won], axis=1)
        values[fresh] = level
    return Solution(values, bits, level)
