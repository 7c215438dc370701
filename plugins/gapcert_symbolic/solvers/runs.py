"""Invariance where windows depend on each other, compiled: rows of a window are looked up as runs of cells that are alive.

The run of a cell is how many cells along the last axis are alive from it on, up to the end of the axis. A row of a window is
alive where the run of its first cell is as long as the row.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gapcert.plugin import Bools, Ints
from gapcert_symbolic.kernels.kernels import (
    Bits,
    Game,
    Values,
    _ends,
    _entry,
    _keep,
    _next,
    _on,
    _range,
    _row,
    borrowing,
    inlined,
    part,
    together,
)
from gapcert_symbolic.thresholds import THRESHOLDS

from .problem import Problem, Solution

Runs = npt.NDArray[np.int32]
BLOCK = 1 << 12  # rows whose differences are taken at once: chosen for memory, not measured
ROOM = 36  # rows of what each thread counts in, of which four are used: the rest keeps what threads write to apart


class Rows(NamedTuple):
    """alive (cells,): as in `invariance`. Rows of the first axis: least and most, the first and last that a window of one
    touches; stale, those to be looked at again, and fresh, those where a cell died.
    """

    alive: Values
    least: Ints
    most: Ints
    stale: Bools
    fresh: Bools


class Own(NamedTuple):
    """What a thread has: a run per cell; room for the indices of a cell, and for the ends of a window and a cell of it (3,
    axes); and for what rows of windows have in common (2, cells of the last axis).
    """

    run: Runs
    cell: Ints
    ends: Ints
    known: Ints


@borrowing
def _count(alive: Values, n: int, run: Runs) -> None:
    for row in range(0, len(alive), n):
        length = 0
        for i in range(row + n - 1, row - 1, -1):
            length = length + 1 if alive[i] >= 0 else 0
            run[i] = length


@inlined
def _die(row: int, i: int, run: Runs) -> None:
    """Cell i of a row that begins at `row` is alive no more: runs end before it."""
    at, length = i, 0
    while at >= row and run[at] > length:
        run[at] = length
        at, length = at - 1, length + 1


@inlined
def _shortest(game: Any, own: Any, z: int, enough: int) -> int:
    """The least run, from the cell z of the last axis on, of the rows of a window; or one that is not enough."""
    a, b, c, n = own.ends[0], own.ends[1], own.ends[2], len(game.counts) - 1
    for k in range(n):
        c[k] = a[k]
    least, more = game.counts[n], True
    while more and least >= enough:
        least = min(least, own.run[_row(game.counts, game.strides, c) + z])
        more = _on(a, b, c, n)
    return int(least)


@inlined
def _holds(game: Any, own: Any, i: int, j: int) -> bool:
    """Is the window of an input inside the grid and alive?"""
    n, ends = len(game.counts) - 1, own.ends
    inside = _ends(game, i, own.cell, j, n + 1, ends[0], ends[1])
    z, last = ends[0, n], ends[1, n]
    length, beyond = min(last, game.counts[n] - 1) - z + 1, last - game.counts[n] + 1
    return inside and _shortest(game, own, z, length) >= length and (beyond <= 0 or _shortest(game, own, 0, beyond) >= beyond)


def _sense(game: Game) -> int:
    """1 where windows of all inputs differ along the last axis alone, which does not wrap, and there lie in the order of the
    inputs, both ends of them; −1 where in the opposite order; 0 where neither is so.
    """
    first, last, start, column = game.packed.first, game.packed.last, game.packed.start, game.packed.column
    own = column[-1]
    rises = falls = not game.wraps[-1] and bool((column[:-1] == column[:-1, :1]).all())
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
def _in_order(game: Any, own: Any, sense: int, i: int, bits: Bits) -> bool:
    """Has a cell a valid input, where windows are in order (`_sense`)? All are kept in its row of bits, where there are any.

    The windows within one run of the last axis that is alive in all rows are those of consecutive inputs.
    """
    first, last, column, index, found = game.packed.first, game.packed.last, game.packed.column, own.cell, False
    n, m = len(game.counts) - 1, column.shape[1]
    inside = _ends(game, i, index, 0, n, own.ends[0], own.ends[1])
    base, at, top = _entry(game.packed, i, index, n), index[n] if game.packed.moves[n] else 0, m - 1
    low, high = (0, top) if sense > 0 else (top, 0)
    z, stop = max(0, at + first[base + column[n, low]]), min(game.counts[n] - 1, at + last[base + column[n, high]])
    while inside and z <= stop:
        length = _shortest(game, own, z, 1)
        if length > 0:
            begin = _below(first, base, column[n], sense, z - at)
            end = _below(last, base, column[n], sense, z + length - at)
            if begin < end:
                found = True
                if not len(bits):
                    break
                _keep_range(bits, i, begin if sense > 0 else m - end, end if sense > 0 else m - begin)
        z += length + 1
    return found


@inlined
def _one(game: Any, own: Any, i: int, witness: Runs) -> bool:
    """Has a cell a valid input? The one that it had before is looked at first."""
    m = game.packed.column.shape[1]
    # Then from the middle outwards: such inputs are the least likely to be lost later.
    for t in range(-1 if witness[i] >= 0 else 0, m):
        j = witness[i] if t < 0 else ((m >> 1) - ((t + 1) >> 1) if t % 2 else (m >> 1) + (t >> 1))
        if game.allowed.size and not game.allowed[i, j]:
            continue
        if _holds(game, own, i, j):
            witness[i] = j
            return True
    return False


@inlined
def _mark(wraps: bool, rows: Any, row: int, begin: int, end: int) -> None:
    """Of the rows begin … end − 1, those from which a window reaches this one are to be looked at again."""
    for other in range(begin, end):
        rows.stale[other] |= wraps or rows.least[other] <= row <= rows.most[other]


@borrowing
def _learn(game: Any, rows: Any, runs: Runs, own: int) -> None:
    """From the other threads' rows where a cell died: their runs, and which of the own rows are to be looked at again."""
    parts, number, size = len(runs), len(rows.fresh), game.strides[0]
    begin, end = own * number // parts, (own + 1) * number // parts
    for row in range(number):
        if rows.fresh[row] and not begin <= row < end:
            theirs = ((row + 1) * parts - 1) // number
            for i in range(row * size, (row + 1) * size):
                runs[own, i] = runs[theirs, i]
            _mark(game.wraps[0], rows, row, begin, end)


@inlined
def _first(game: Any, own: Any, row: int) -> None:
    """The index of the first cell of a row of the first axis."""
    own.cell[:] = 0
    own.cell[0] = row


@borrowing
def _valid_in_order(game: Any, alive: Values, own: Any, sense: int, bits: Bits, begin: int, stop: int) -> None:
    """As `_valid`, for windows in order, and all inputs allowed."""
    _first(game, own, begin)
    for i in range(begin * game.strides[0], stop * game.strides[0]):
        if alive[i] == 0:
            _in_order(game, own, sense, i, bits)
        _next(game.counts, own.cell)


@borrowing
def _valid(game: Any, alive: Values, own: Any, changes: Bools, bits: Bits, begin: int, stop: int) -> None:
    """All inputs whose windows are alive, for the rows begin … stop − 1 of the first axis.

    Inputs in a row that differ along the last axis alone share what is found of rows of a window. changes: which inputs differ
    from the one before along another axis, too.
    """
    first, last, column, n = game.packed.first, game.packed.last, game.packed.column, len(game.counts) - 1
    index, least, stamps, stamp = own.cell, own.known[0], own.known[1], 0
    size, whole = game.counts[n], game.wraps[n]
    _first(game, own, begin)
    for i in range(begin * game.strides[0], stop * game.strides[0]):
        if alive[i] == 0:
            base, at, inside = _entry(game.packed, i, index, n), index[n] if game.packed.moves[n] else 0, True
            for j in range(column.shape[1]):
                if changes[j]:
                    stamp, inside = stamp + 1, _ends(game, i, index, j, n, own.ends[0], own.ends[1])
                entry = base + column[n, j]
                z, end, within = _range(size, whole, at + first[entry], at + last[entry])
                if not (inside and within) or (game.allowed.size and not game.allowed[i, j]):
                    continue
                if stamps[z] != stamp:
                    least[z], stamps[z] = _shortest(game, own, z, 0), stamp
                if least[z] < min(end, size - 1) - z + 1:
                    continue
                if end >= size and _shortest(game, own, 0, 0) < end - size + 1:
                    continue
                _keep(bits, i, j)
        _next(game.counts, index)


@borrowing
def _sweep(game: Any, rows: Any, own: Any, begin: int, end: int, forth: bool, sense: Any, witness: Any, no: Bits) -> None:
    """Over the rows begin … end − 1 of the first axis that are stale: cells without a valid input die.

    sense: that of windows in order, or None; witness: the inputs that others rely on, or None. It is compiled for either alone.
    no: bits, of which there are none.
    """
    size, width, alive = game.strides[0], game.counts[len(game.counts) - 1], rows.alive
    for step in range(end - begin):
        row = begin + step if forth else end - 1 - step
        rows.fresh[row] = False
        if rows.stale[row]:
            rows.stale[row] = False
            _first(game, own, row)
            for i in range(row * size, (row + 1) * size):
                if alive[i] == 0:
                    kept = False
                    if sense is not None:
                        kept = _in_order(game, own, sense, i, no)
                    if witness is not None:
                        kept = _one(game, own, i, witness)
                    if not kept:
                        alive[i], rows.fresh[row] = -1, True
                        _die(i // width * width, i, own.run)
                _next(game.counts, own.cell)
            if rows.fresh[row]:
                _mark(game.wraps[0], rows, row, begin, end)


def _shared(game: Game, cells: int, threads: int) -> tuple[int, Any, list[Own], list[tuple[int, int]]]:
    """`_sense`, or 0 where relations decide; the runs of all threads; and what each thread has, and its rows."""
    sense, counts = 0 if game.allowed.size else _sense(game), game.counts
    # With one axis a run passes from one thread's cells into another's.
    parts = 1 if len(counts) == 1 else min(threads, THRESHOLDS.run_threads, int(counts[0]))
    runs, rooms = np.empty((parts, cells), np.int32), np.zeros((parts, ROOM, len(counts)), np.int64)
    known = np.zeros((parts, 2, 0 if sense else counts[-1]), np.int64)
    own = [Own(runs[p], rooms[p, 0], rooms[p, 1:4], known[p]) for p in range(parts)]
    return sense, runs, own, [part(int(counts[0]), parts, p) for p in range(parts)]


def _kept(game: Game, asked: Values, own: Own, sense: int, bits: Bits, rows: tuple[int, int]) -> None:
    """All inputs whose windows are alive, of the cells asked for, which have 0."""
    if sense:
        _valid_in_order(game, asked, own, sense, bits, *rows)
    else:
        column = game.packed.column
        changes = np.append(True, (column[:-1, 1:] != column[:-1, :-1]).any(axis=0))
        _valid(game, asked, own, changes, bits, *rows)


def leading(game: Game, into: Values, asked: Values, bits: Bits) -> None:
    """Fills bits of the cells asked for, which have 0, with all inputs that lead wholly into cells that have 0."""
    sense, _, (own,), (rows,) = _shared(game, len(into), 1)
    _count(into, game.counts[-1], own.run)
    _kept(game, asked, own, sense, bits, rows)


def solve(problem: Problem) -> Solution:
    """Invariance, whatever the windows."""
    windows, values = problem.windows(), np.where(problem.safe, 0, -1).astype(np.int32)
    bits = windows.no_bits
    return Solution(values, bits, invariance(problem.threads, windows.game, values, bits, *windows.rows))


def invariance(threads: int, game: Game, alive: Values, bits: Bits, least: Ints, most: Ints) -> int:
    """alive: 0 for safe cells, more for those that need no input, −1 for others; changed to the greatest set that can be kept,
    and bits filled of those with 0. Returns sweeps.

    A cell stays while the input remembered for it stays valid. A sweep looks at the rows of the first axis from which a window
    reaches one where a cell has died since they were looked at; least, most: the first and last that any window of a row does.
    Each thread has rows and runs of its own, and learns after a sweep what died in the others' rows: so nothing is written that
    another reads, and the number of sweeps depends on how many threads there are, but on nothing else.
    """
    sense, runs, own, ranges = _shared(game, len(alive), threads)
    rows = Rows(alive, least, most, np.ones(game.counts[0], np.bool_), np.zeros(game.counts[0], np.bool_))
    witness, sweeps = None if sense else np.full(len(alive), -1, np.int32), 0

    def sweep(p: int) -> None:
        _sweep(game, rows, own[p], *ranges[p], sweeps % 2 == 1, sense or None, witness, bits[:0])

    with together(len(own)) as each:
        each(lambda p: _count(alive, game.counts[-1], runs[p]))
        while rows.stale.any():
            sweeps += 1
            each(sweep)
            if len(own) > 1:
                each(lambda p: _learn(game, rows, runs, p))
        each(lambda p: _kept(game, alive, own[p], sense, bits, ranges[p]))
    return sweeps
