"""Invariance where windows depend on each other, compiled: rows of a window are looked up as runs of cells that are alive.

The run of a cell is how many cells along the last axis are alive from it on, up to the end of the axis. A row of a window is
alive where the run of its first cell is as long as the row. `packed` as in kernels.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

from .kernels import Bits, Bools, Ints, Values, _keep, _next, _strides, compiled

inlined = njit(inline="always", error_model="numpy")
Runs = npt.NDArray[np.int32]


@compiled
def _count(alive: Values, row: int, n: int, run: Runs) -> None:
    length = 0
    for i in range(row + n - 1, row - 1, -1):
        length = length + 1 if alive[i] == 0 else 0
        run[i] = length


@compiled
def _die(row: int, i: int, run: Runs) -> None:
    """Cell i of a row that begins at `row` is alive no more: runs end before it."""
    at, length = i, 0
    while at >= row and run[at] > length:
        run[at] = length
        at, length = at - 1, length + 1


@inlined
def _base(packed: Any, index: Ints, k: int) -> int:
    """Where the entries of axis k begin for a cell."""
    start, strides = packed[2], packed[3]
    at = start[k]
    for d in range(len(index)):
        at += index[d] * strides[k, d]
    return int(at)


@inlined
def _range(count: int, wraps: bool, begin: int, end: int) -> tuple[int, int, bool]:
    """First and last cell along an axis, and whether they are in the grid; on an axis that wraps the first one is."""
    if wraps:
        turn = count if begin < 0 else (-count if begin >= count else 0)
        return begin + turn, end + turn, True
    return begin, end, begin >= 0 and end < count


@inlined
def _shortest(counts: Ints, strides: Ints, run: Runs, ends: Ints, z: int, enough: int) -> int:
    """The least run, from the cell z of the last axis on, of the rows of a window; or one that is not enough."""
    a, b, c, n = ends[0], ends[1], ends[2], len(counts) - 1
    for k in range(n):
        c[k] = a[k]
    least, d = counts[n], 0
    while d >= 0 and least >= enough:
        row = z
        for k in range(n):
            row += (c[k] if c[k] < counts[k] else c[k] - counts[k]) * strides[k]
        least = min(least, run[row])
        d = n - 1
        while d >= 0:
            c[d] += 1
            if c[d] <= b[d]:
                break
            c[d] = a[d]
            d -= 1
    return int(least)


@inlined
def _holds(counts: Ints, wraps: Bools, packed: Any, strides: Ints, run: Runs, index: Ints, j: int, ends: Ints) -> bool:
    """Is the window of an input inside the grid and alive? ends (3, axes): room for its ends and a cell of it."""
    first, last, moves, column = packed[0], packed[1], packed[4], packed[5]
    n, inside = len(counts) - 1, True
    for k in range(n + 1):
        at = _base(packed, index, k) + column[k, j]
        own = index[k] if moves[k] else 0
        ends[0, k], ends[1, k], within = _range(counts[k], wraps[k], own + first[at], own + last[at])
        inside = inside and within
    z, last_z = ends[0, n], ends[1, n]
    length, beyond = min(last_z, counts[n] - 1) - z + 1, last_z - counts[n] + 1
    return (
        inside
        and _shortest(counts, strides, run, ends, z, length) >= length
        and (beyond <= 0 or _shortest(counts, strides, run, ends, 0, beyond) >= beyond)
    )


@inlined
def _alike(wraps: Bools, column: Ints) -> bool:
    """Do windows of all inputs differ along the last axis alone, which does not wrap?"""
    n, same = len(wraps) - 1, not wraps[len(wraps) - 1]
    for k in range(n):
        for j in range(1, column.shape[1]):
            same = same and column[k, j] == column[k, 0]
    return same


@inlined
def _any(counts: Ints, wraps: Bools, packed: Any, strides: Ints, run: Runs, index: Ints, ends: Ints, room: Ints) -> int:
    """The first input, from the middle outwards, whose window is alive, or −1; for windows that are alike. room: (2, cells)."""
    first, last, moves, column = packed[0], packed[1], packed[4], packed[5]
    n, m, inside, found = len(counts) - 1, packed[5].shape[1], True, -1
    for k in range(n):
        at, mine = _base(packed, index, k) + column[k, 0], index[k] if moves[k] else 0
        ends[0, k], ends[1, k], within = _range(counts[k], wraps[k], mine + first[at], mine + last[at])
        inside = inside and within
    base, own = _base(packed, index, n), index[n] if moves[n] else 0
    room[1, :] = -1
    for t in range(m if inside else 0):
        j = (m >> 1) - ((t + 1) >> 1) if t % 2 else (m >> 1) + (t >> 1)
        z, end = own + first[base + column[n, j]], own + last[base + column[n, j]]
        if z >= 0 and end < counts[n]:
            if room[1, z] < 0:
                room[1, z] = _shortest(counts, strides, run, ends, z, 0)
            if room[1, z] > end - z:
                found = j
                break
    return found


@compiled
def _sweep(
    counts: Ints,
    wraps: Bools,
    packed: Any,
    strides: Ints,
    alive: Values,
    allowed: Bools,
    witness: Runs,
    run: Runs,
    number: int,
) -> bool:
    """Over the cells of a row of the first axis: those without a valid input die. Did any?"""
    m, n, died = packed[5].shape[1], counts[len(counts) - 1], False
    index, ends = np.zeros(len(counts), np.int64), np.zeros((3, len(counts)), np.int64)
    alike, room = not allowed.size and _alike(wraps, packed[5]), np.empty((2, n), np.int64)
    index[0] = number
    for i in range(number * strides[0], (number + 1) * strides[0]):
        if alive[i] == 0:
            kept = False
            if alike:
                kept = witness[i] >= 0 and _holds(counts, wraps, packed, strides, run, index, witness[i], ends)
                if not kept:
                    witness[i] = _any(counts, wraps, packed, strides, run, index, ends, room)
                    kept = witness[i] >= 0
            # What is remembered first; then from the middle outwards: such inputs are the least likely to be lost later.
            for t in range(m if alike else (-1 if witness[i] >= 0 else 0), m):
                j = witness[i] if t < 0 else ((m >> 1) - ((t + 1) >> 1) if t % 2 else (m >> 1) + (t >> 1))
                if allowed.size and not allowed[i, j]:
                    continue
                if _holds(counts, wraps, packed, strides, run, index, j, ends):
                    witness[i], kept = j, True
                    break
            if not kept:
                alive[i], died = -1, True
                _die(i // n * n, i, run)
        _next(counts, index)
    return died


@compiled
def _valid_alike(counts: Ints, wraps: Bools, packed: Any, strides: Ints, alive: Values, run: Runs, bits: Bits) -> None:
    """As `_valid`, for windows that are alike, and all inputs allowed."""
    first, last, moves, column = packed[0], packed[1], packed[4], packed[5]
    n, m, size = len(counts) - 1, packed[5].shape[1], counts[len(counts) - 1]
    index, ends = np.zeros(len(counts), np.int64), np.zeros((3, len(counts)), np.int64)
    least, before, low, high = np.empty(size, np.int64), -1, 0, 0
    for i in range(len(alive)):
        inside = alive[i] == 0
        for k in range(n if inside else 0):
            at, mine = _base(packed, index, k) + column[k, 0], index[k] if moves[k] else 0
            ends[0, k], ends[1, k], within = _range(counts[k], wraps[k], mine + first[at], mine + last[at])
            inside = inside and within
        if inside:
            base, own, byte = _base(packed, index, n), index[n] if moves[n] else 0, 0
            if base != before:
                before, low, high = base, first[base + column[n, 0]], first[base + column[n, 0]]
                for j in range(1, m):
                    low, high = min(low, first[base + column[n, j]]), max(high, first[base + column[n, j]])
            for z in range(max(0, own + low), min(size, own + high + 1)):
                least[z] = _shortest(counts, strides, run, ends, z, 0)
            for j in range(m):
                z, end = own + first[base + column[n, j]], own + last[base + column[n, j]]
                if z >= 0 and end < size and least[z] > end - z:
                    byte |= 128 >> (j & 7)
                if (j & 7) == 7 or j == m - 1:
                    bits[i, j >> 3], byte = byte, 0
        _next(counts, index)


@compiled
def _valid(
    counts: Ints, wraps: Bools, packed: Any, strides: Ints, alive: Values, allowed: Bools, run: Runs, bits: Bits
) -> None:
    """All inputs whose windows are alive. Inputs in a row that differ along the last axis alone share what is found of rows."""
    first, last, moves, column = packed[0], packed[1], packed[4], packed[5]
    n, m = len(counts) - 1, packed[5].shape[1]
    index, ends = np.zeros(len(counts), np.int64), np.zeros((3, len(counts)), np.int64)
    size, whole = counts[n], wraps[n]
    least, stamps, stamp = np.empty(size, np.int64), np.zeros(size, np.int64), 0
    changes = np.ones(m, np.bool_)
    for j in range(1, m):
        changes[j] = (column[:n, j] != column[:n, j - 1]).any()
    for i in range(len(alive)):
        if alive[i] == 0:
            base, own, inside = _base(packed, index, n), index[n] if moves[n] else 0, True
            for j in range(m):
                if changes[j]:
                    stamp, inside = stamp + 1, True
                    for k in range(n):
                        at = _base(packed, index, k) + column[k, j]
                        mine = index[k] if moves[k] else 0
                        ends[0, k], ends[1, k], within = _range(counts[k], wraps[k], mine + first[at], mine + last[at])
                        inside = inside and within
                at = base + column[n, j]
                z, end, within = _range(size, whole, own + first[at], own + last[at])
                if not (inside and within) or (allowed.size and not allowed[i, j]):
                    continue
                if stamps[z] != stamp:
                    least[z], stamps[z] = _shortest(counts, strides, run, ends, z, 0), stamp
                if least[z] < min(end, size - 1) - z + 1:
                    continue
                if end >= size and _shortest(counts, strides, run, ends, 0, 0) < end - size + 1:
                    continue
                _keep(bits, i, j)
        _next(counts, index)


@compiled
def invariance(
    counts: Ints, wraps: Bools, packed: Any, alive: Values, bits: Bits, allowed: Bools, least: Ints, most: Ints
) -> int:
    """alive: 0 for safe cells, −1 for others; changed to the greatest set that can be kept, and bits filled. Returns sweeps.

    A cell stays while the input remembered for it stays valid. A sweep looks at the rows of the first axis from which a window
    reaches one where a cell has died since they were looked at; least, most: how far windows reach along it.
    """
    rows, n, strides = counts[0], counts[len(counts) - 1], _strides(counts)
    witness, run = np.full(len(alive), -1, np.int32), np.empty(len(alive), np.int32)
    for row in range(0, len(alive), n):
        _count(alive, row, n, run)
    stale, sweeps = np.ones(rows, np.bool_), 0
    while stale.any():
        sweeps += 1
        for step in range(rows):
            row = step if sweeps % 2 else rows - 1 - step
            if stale[row]:
                stale[row] = False
                if _sweep(counts, wraps, packed, strides, alive, allowed, witness, run, row):
                    if wraps[0]:
                        stale[:] = True
                    else:
                        stale[max(0, row - most[0]) : max(0, min(rows, row - least[0] + 1))] = True
    if not allowed.size and _alike(wraps, packed[5]):
        _valid_alike(counts, wraps, packed, strides, alive, run, bits)
    else:
        _valid(counts, wraps, packed, strides, alive, allowed, run, bits)
    return sweeps
