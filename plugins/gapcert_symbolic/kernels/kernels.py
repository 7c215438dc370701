"""Cells and their windows as compiled functions see them, and what all of these functions use.

Cells are numbered in C order. Values are 0 or more for cells that are won, −1 for cells that may be, and less for others.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from gapcert.plugin import Bools, Ints, compiler

Values = npt.NDArray[np.int32]
Bits = npt.NDArray[np.uint8]
Marks = npt.NDArray[np.uint8]

compiled = compiler(nogil=True, error_model="numpy")
# Put in by LLVM where it is called, and by compiled functions alone: called from Python it would crash.
inlined = compiler(nogil=True, error_model="numpy", _nrt=False, forceinline=True, no_cpython_wrapper=True)
_F = TypeVar("_F", bound=Callable[..., Any])


class Packed(NamedTuple):
    """The tables of windows of all axes in one. The entry of axis k, of cell i with these indices under input j, is at
    start_k + Σ_d index_d strides_kd + column_kj, or where tables are for some cells only, at start_k + offset_ki + column_kj;
    else offset is empty. Where an axis moves, entries count from the own index.
    """

    first: Values
    last: Values
    start: Ints
    strides: Ints
    offset: Ints
    moves: Bools
    column: Ints


class Game(NamedTuple):
    """The cells in play, so many (`size`), of a grid with so many along each axis; strides are in cells. allowed (cells,
    inputs): empty where all are.

    On a grid some cells of which are halved (`gapcert_cells.Splits`) they are those of the last level, number `level`: the
    nodes start, start + 1, … with the numbers `flat` on their own grid. children: the first child of each node, or 0. Level 0
    is a grid as it is, and needs neither.
    """

    counts: Ints
    wraps: Bools
    strides: Ints
    packed: Packed
    allowed: Bools
    size: int
    level: int
    children: Ints
    start: int
    flat: Ints


def borrowing(function: _F) -> _F:
    """As `compiled`, for a function that makes no arrays.

    References to arrays are not counted, then. Numba counts them atomically, wherever an array gets another name, in inner
    loops too; there that costs more than what these do. Its option for that is undocumented; what is found does not depend on
    it.
    """
    options: Any = {"_nrt": False}
    return compiler(nogil=True, error_model="numpy", **options)(function)


@contextmanager
def together(threads: int) -> Iterator[Callable[[Callable[[int], None]], object]]:
    """A function that calls work(0) … work(threads − 1) at once, and returns after the last one.

    They run at the same time as far as they are compiled.
    """
    with ThreadPoolExecutor(threads) as pool:  # which starts threads when they are given something
        mapped = map if threads == 1 else pool.map
        yield lambda work: list(mapped(work, range(threads)))


def part(n: int, threads: int, own: int) -> tuple[int, int]:
    """(begin, end) of a thread's own part of 0 … n − 1."""
    return own * n // threads, (own + 1) * n // threads


def whole(number: int) -> Any:
    """The type of integers that so many are numbered with."""
    return np.int32 if number < 2**31 else np.int64


@compiled
def _strides(counts: Ints) -> Ints:
    out = np.ones(len(counts), np.int64)
    for k in range(len(counts) - 2, -1, -1):
        out[k] = out[k + 1] * counts[k + 1]
    return out


@borrowing
def _next(counts: Ints, index: Ints) -> None:
    k = len(counts) - 1
    while k >= 0:
        index[k] += 1
        if index[k] < counts[k]:
            return
        index[k] = 0
        k -= 1


@borrowing
def _unravel(strides: Ints, flat: int, index: Ints) -> None:
    for k in range(len(strides) - 1):
        index[k] = flat // strides[k]
        flat -= index[k] * strides[k]
    index[len(strides) - 1] = flat


@inlined
def _on(low: Ints, high: Ints, at: Ints, axes: int) -> bool:
    """`at` moves on to the next one of a box, in the order of C, along its first axes; False after the last one."""
    d = axes - 1
    while d >= 0:
        at[d] += 1
        if at[d] <= high[d]:
            return True
        at[d] = low[d]
        d -= 1
    return False


@inlined
def _range(count: int, wraps: bool, begin: int, end: int) -> tuple[int, int, bool]:
    """First and last cell along an axis, and whether they are in the grid; on an axis that wraps the first one is."""
    if wraps:
        turn = count if begin < 0 else (-count if begin >= count else 0)
        return begin + turn, end + turn, True
    return begin, end, begin >= 0 and end < count


@inlined
def _entry(packed: Any, i: int, index: Ints, k: int) -> int:
    """Where the entries of axis k begin for a cell."""
    if packed.offset.size:
        return int(packed.start[k] + packed.offset[k, i])
    at = packed.start[k]
    for d in range(len(index)):
        at += index[d] * packed.strides[k, d]
    return int(at)


@inlined
def _ends(game: Any, i: int, index: Ints, j: int, axes: int, a: Ints, b: Ints) -> bool:
    """First and last cell of a window along the first axes; False where it leaves the grid. Along one that wraps a is in it."""
    packed, inside = game.packed, True
    for k in range(axes):
        at = _entry(packed, i, index, k) + packed.column[k, j]
        own = index[k] if packed.moves[k] else 0
        a[k], b[k], within = _range(game.counts[k], game.wraps[k], own + packed.first[at], own + packed.last[at])
        inside = inside and within
    return inside


@inlined
def _window(game: Any, i: int, index: Ints, j: int, a: Ints, b: Ints) -> bool:
    """First and last cell of a window; False where it leaves the grid."""
    return _ends(game, i, index, j, len(game.counts), a, b)


@inlined
def _cell(game: Any, i: int, index: Ints) -> None:
    """The indices of cell i in play."""
    _unravel(game.strides, game.flat[i] if game.level else i, index)


@inlined
def _node(game: Any, c: Ints) -> tuple[int, int]:
    """The whole node that holds the cell c of the last level, and how many levels above it lies."""
    at, shift, counts = 0, game.level, game.counts
    for k in range(len(c)):
        i = c[k] if c[k] < counts[k] else c[k] - counts[k]
        at = at * (counts[k] >> game.level) + (i >> shift)
    while shift and game.children[at]:
        shift -= 1
        child = 0
        for k in range(len(c)):
            i = c[k] if c[k] < counts[k] else c[k] - counts[k]
            child = 2 * child + ((i >> shift) & 1)
        at = game.children[at] + child
    return at, shift


@inlined
def _row(counts: Ints, strides: Ints, c: Ints) -> int:
    """The first cell of the row of the last axis that c is in."""
    row = 0
    for k in range(len(c) - 1):
        row += (c[k] if c[k] < counts[k] else c[k] - counts[k]) * strides[k]
    return row


@inlined
def _skip(c: Ints, above: int) -> None:
    """c moves on to the last cell of its row in a node so many levels above; counts are multiples of its width."""
    c[len(c) - 1] |= (1 << above) - 1


@inlined
def _outside(game: Any, values: Values, level: int, work: Any) -> int:
    """From c on, the first node of a window whose value is not in [0, level), or −1. work: its first and last cell, and c."""
    a, b, c = work
    n = len(c) - 1
    while True:
        if game.level:
            q, above = _node(game, c)
            if values[q] < 0 or values[q] >= level:
                return q
            _skip(c, above)
        else:
            row, count = _row(game.counts, game.strides, c), game.counts[n]
            for z in range(c[n], b[n] + 1):
                q = row + (z if z < count else z - count)
                if values[q] < 0 or values[q] >= level:
                    return q
            c[n] = b[n]
        if not _on(a, b, c, n + 1):
            return -1


@borrowing
def _keep(bits: Bits, i: int, j: int) -> None:
    bits[i, j >> 3] |= 128 >> (j & 7)


@compiled
def _room(axes: int) -> Any:
    """Room for an index, and for a window and a cell of it."""
    return np.zeros(axes, np.int64), (np.zeros(axes, np.int64), np.zeros(axes, np.int64), np.zeros(axes, np.int64))
