"""Invariance where windows depend on each other, compiled: rows of a window are looked up as runs of cells that are alive.

The run of a cell is how many cells along the last axis are alive from it on, up to the end of the axis. A row of a window is
alive where the run of its first cell is as long as the row. `packed` as in kernels.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from gapcert.plugin import Bools, Ints
from gapcert_symbolic.kernels.kernels import Bits, Values, _keep, _next, _range, borrowing, inlined, part, together

Runs = npt.NDArray[np.int32]
MOST = 4  # threads: each takes four bytes per cell
BLOCK = 1 << 12  # rows whose differences are taken at once: chosen for memory, not measured
ROOM = 36  # rows of what each thread counts in, of which four are used: the rest keeps what threads write to apart


@borrowing
def _count(alive: Values, n: int, run: Runs) -> None:
    for row in range(0, len(alive), n):
        length = 0
        for i in range(row + n - 1, row - 1, -1):
            length = length + 1 if alive[i] == 0 else 0
            run[i] = length


@inlined
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


def _sense(wraps: Bools, packed: Any) -> int:
    """1 where windows of all inputs differ along the last axis alone, which does not wrap, and there lie in the order of the
    inputs, both ends of them; −1 where in the opposite order; 0 where neither is so.
    """
    first, last, start, column = packed[0], packed[1], packed[2], packed[5]
    own = column[-1]
    rises = falls = not wraps[-1] and bool((column[:-1] == column[:-1, :1]).all())
    tables = [end[start[-1] :].reshape(-1, own.max() + 1) for end in (first, last)]
    for row in range(0, len(tables[0]) if rises else 0, BLOCK):
        steps = [np.diff(table[row : row + BLOCK, own], axis=1) for table in tables]
        rises, falls = rises and all((d >= 0).all() for d in steps), falls and all((d <= 0).all() for d in steps)
        if not (rises or falls):
            break
    return 1 if rises else (-1 if falls else 0)


@inlined
def _below(table: Runs, base: int, column: Ints, sense: int, bound: int) -> int:
    """How many inputs, in the order of their windows, have an end below `bound`."""
    m, low, high = len(column), 0, len(column)
    while low < high:
        middle = (low + high) >> 1
        if table[base + column[middle if sense > 0 else m - 1 - middle]] < bound:
            low = middle + 1
        else:
            high = middle
    return low


@inlined
def _keep_range(bits: Bits, i: int, begin: int, end: int) -> None:
    """Keep the inputs begin … end − 1."""
    low, high = begin >> 3, (end - 1) >> 3
    before, upto = 255 >> (begin & 7), 255 & (-256 >> (((end - 1) & 7) + 1))
    if low == high:
        bits[i, low] |= before & upto
        return
    bits[i, low] |= before
    bits[i, low + 1 : high] = 255
    bits[i, high] |= upto


@inlined
def _in_order(
    counts: Ints, wraps: Bools, packed: Any, strides: Ints, run: Runs, index: Ints, ends: Ints, sense: int, i: int, bits: Bits
) -> bool:
    """Has a cell a valid input, where windows are in order (`_sense`)? All are kept in its row of bits, where there are any.

    The windows within one run of the last axis that is alive in all rows are those of consecutive inputs.
    """
    first, last, moves, column = packed[0], packed[1], packed[4], packed[5]
    n, m, inside, found = len(counts) - 1, packed[5].shape[1], True, False
    for k in range(n):
        at, mine = _base(packed, index, k) + column[k, 0], index[k] if moves[k] else 0
        ends[0, k], ends[1, k], within = _range(counts[k], wraps[k], mine + first[at], mine + last[at])
        inside = inside and within
    base, own, top = _base(packed, index, n), index[n] if moves[n] else 0, m - 1
    low, high = (0, top) if sense > 0 else (top, 0)
    z, stop = max(0, own + first[base + column[n, low]]), min(counts[n] - 1, own + last[base + column[n, high]])
    while inside and z <= stop:
        length = _shortest(counts, strides, run, ends, z, 1)
        if length > 0:
            begin = _below(first, base, column[n], sense, z - own)
            end = _below(last, base, column[n], sense, z + length - own)
            if begin < end:
                found = True
                if not len(bits):
                    break
                _keep_range(bits, i, begin if sense > 0 else m - end, end if sense > 0 else m - begin)
        z += length + 1
    return found


@inlined
def _sweep_in_order(
    counts: Ints, wraps: Bools, packed: Any, strides: Ints, alive: Values, run: Runs, row: int, sense: int, room: Ints, no: Bits
) -> bool:
    """As `_sweep`, for windows in order, and all inputs allowed. no: bits, of which there are none."""
    n, died, index, ends = counts[len(counts) - 1], False, room[0], room[1:]
    index[:] = 0
    index[0] = row
    for i in range(row * strides[0], (row + 1) * strides[0]):
        if alive[i] == 0 and not _in_order(counts, wraps, packed, strides, run, index, ends, sense, i, no):
            alive[i], died = -1, True
            _die(i // n * n, i, run)
        _next(counts, index)
    return died


@inlined
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
    room: Ints,
) -> bool:
    """Over the cells of a row of the first axis: those without a valid input die. Did any? room (ROOM, axes)."""
    m, n, died, index, ends = packed[5].shape[1], counts[len(counts) - 1], False, room[0], room[1:]
    index[:] = 0
    index[0] = number
    for i in range(number * strides[0], (number + 1) * strides[0]):
        if alive[i] == 0:
            kept = False
            # What is remembered first; then from the middle outwards: such inputs are the least likely to be lost later.
            for t in range(-1 if witness[i] >= 0 else 0, m):
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


@inlined
def _mark(wraps: bool, least: Ints, most: Ints, row: int, stale: Bools, begin: int, end: int) -> None:
    """Of the rows begin … end − 1, those from which a window reaches this one are to be looked at again."""
    for other in range(begin, end):
        stale[other] |= wraps or least[other] <= row <= most[other]


@borrowing
def _learn(wraps: bool, least: Ints, most: Ints, size: int, fresh: Bools, runs: Runs, own: int, stale: Bools) -> None:
    """From the other threads' rows where a cell died: their runs, and which of the own rows are to be looked at again."""
    parts, rows = len(runs), len(fresh)
    begin, end = own * rows // parts, (own + 1) * rows // parts
    for row in range(rows):
        if fresh[row] and not begin <= row < end:
            theirs = ((row + 1) * parts - 1) // rows
            for i in range(row * size, (row + 1) * size):
                runs[own, i] = runs[theirs, i]
            _mark(wraps, least, most, row, stale, begin, end)


@borrowing
def _valid_in_order(
    counts: Ints,
    wraps: Bools,
    packed: Any,
    strides: Ints,
    alive: Values,
    run: Runs,
    sense: int,
    bits: Bits,
    room: Ints,
    begin: int,
    stop: int,
) -> None:
    """As `_valid`, for windows in order, and all inputs allowed."""
    index, ends = room[0], room[1:]
    index[:] = 0
    index[0] = begin
    for i in range(begin * strides[0], stop * strides[0]):
        if alive[i] == 0:
            _in_order(counts, wraps, packed, strides, run, index, ends, sense, i, bits)
        _next(counts, index)


@borrowing
def _valid(
    counts: Ints,
    wraps: Bools,
    packed: Any,
    strides: Ints,
    alive: Values,
    allowed: Bools,
    run: Runs,
    bits: Bits,
    room: Ints,
    known: Ints,
    changes: Bools,
    begin: int,
    stop: int,
) -> None:
    """All inputs whose windows are alive, for the rows begin … stop − 1 of the first axis.

    Inputs in a row that differ along the last axis alone share what is found of rows of a window.

    known (2, cells of the last axis): zeros. changes: which inputs differ from the one before along another axis, too.
    """
    first, last, moves, column = packed[0], packed[1], packed[4], packed[5]
    n, m = len(counts) - 1, packed[5].shape[1]
    index, ends, least, stamps, stamp = room[0], room[1:], known[0], known[1], 0
    size, whole = counts[n], wraps[n]
    index[:] = 0
    index[0] = begin
    for i in range(begin * strides[0], stop * strides[0]):
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


@borrowing
def _sweep_rows(
    counts: Ints,
    wraps: Bools,
    packed: Any,
    strides: Ints,
    alive: Values,
    least: Ints,
    most: Ints,
    sense: Any,
    run: Runs,
    room: Ints,
    stale: Bools,
    fresh: Bools,
    begin: int,
    end: int,
    forth: bool,
    single: Any,
    no: Bits,
) -> None:
    """Over the rows begin … end − 1 of the first axis that are stale: fresh are those where a cell died.

    sense: that of windows in order, or None; single: what is needed for others, or None. It is compiled for either alone.
    no: bits, of which there are none.
    """
    for step in range(end - begin):
        row = begin + step if forth else end - 1 - step
        fresh[row] = False
        if stale[row]:
            stale[row] = False
            if sense is not None:
                fresh[row] = _sweep_in_order(counts, wraps, packed, strides, alive, run, row, sense, room, no)
            if single is not None:
                fresh[row] = _sweep(counts, wraps, packed, strides, alive, single[0], single[1], run, row, room)
            if fresh[row]:
                _mark(wraps[0], least, most, row, stale, begin, end)


def invariance(
    threads: int,
    counts: Ints,
    wraps: Bools,
    packed: Any,
    alive: Values,
    bits: Bits,
    allowed: Bools,
    least: Ints,
    most: Ints,
) -> int:
    """alive: 0 for safe cells, −1 for others; changed to the greatest set that can be kept, and bits filled. Returns sweeps.

    A cell stays while the input remembered for it stays valid. A sweep looks at the rows of the first axis from which a window
    reaches one where a cell has died since they were looked at; least, most: the first and last that any window of a row does.
    Each thread has rows and runs of its own, and learns after a sweep what died in the others' rows: so nothing is written that
    another reads, and the number of sweeps depends on how many threads there are, but on nothing else.
    """
    sense = 0 if allowed.size else _sense(wraps, packed)
    strides = np.array([counts[k + 1 :].prod() for k in range(len(counts))])
    # With one axis a run passes from one thread's cells into another's.
    parts = 1 if len(counts) == 1 else min(threads, MOST, int(counts[0]))
    rows = [part(int(counts[0]), parts, p) for p in range(parts)]
    runs, rooms = np.empty((parts, len(alive)), np.int32), np.zeros((parts, ROOM, len(counts)), np.int64)
    stale, fresh, single, sweeps = np.ones(counts[0], np.bool_), np.zeros(counts[0], np.bool_), None, 0
    if not sense:
        column = packed[5]
        single = allowed, np.full(len(alive), -1, np.int32)
        known = np.zeros((parts, 2, counts[-1]), np.int64)
        changes = np.append(True, (column[:-1, 1:] != column[:-1, :-1]).any(axis=0))
    given = counts, wraps, packed, strides, alive

    def sweep(p: int) -> None:
        forth = sweeps % 2 == 1
        _sweep_rows(*given, least, most, sense or None, runs[p], rooms[p], stale, fresh, *rows[p], forth, single, bits[:0])

    def valid(p: int) -> None:
        if single is None:
            _valid_in_order(*given, runs[p], sense, bits, rooms[p], *rows[p])
        else:
            _valid(*given, allowed, runs[p], bits, rooms[p], known[p], changes, *rows[p])

    with together(parts) as each:
        each(lambda p: _count(alive, counts[-1], runs[p]))
        while stale.any():
            sweeps += 1
            each(sweep)
            if parts > 1:
                each(lambda p: _learn(wraps[0], least, most, strides[0], fresh, runs, p, stale))
        each(valid)
    return sweeps
