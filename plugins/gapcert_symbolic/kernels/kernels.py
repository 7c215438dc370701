"""Reach over windows of cells, compiled: by watched successors.

`packed` are the tables of windows (`abstraction.Windows.packed`); cells are numbered in C order. Values are 0 or more for cells
that are won, and negative for others.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from gapcert.plugin import Bools, Ints, compiler

Values = npt.NDArray[np.int32]
Bits = npt.NDArray[np.uint8]

compiled = compiler(nogil=True, error_model="numpy")
# Put in by LLVM where it is called, and by compiled functions alone: called from Python it would crash.
inlined = compiler(nogil=True, error_model="numpy", _nrt=False, forceinline=True, no_cpython_wrapper=True)
_F = TypeVar("_F", bound=Callable[..., Any])


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


@borrowing
def _window(counts: Ints, wraps: Bools, packed: Any, index: Ints, j: int, a: Ints, b: Ints) -> bool:
    """First and last cell of each axis; False where the window leaves the grid. On an axis that wraps a is in the grid."""
    first, last, start, strides, moves, column = packed
    inside = True
    for k in range(len(counts)):
        at = start[k] + column[k, j]
        for d in range(len(counts)):
            at += index[d] * strides[k, d]
        own = index[k] if moves[k] else 0
        a[k], b[k], within = _range(counts[k], wraps[k], own + first[at], own + last[at])
        inside = inside and within
    return inside


@borrowing
def _advance(counts: Ints, strides: Ints, a: Ints, b: Ints, c: Ints, values: Values, level: int) -> int:
    """From c on, the first cell of the window whose value is not in [0, level), or −1."""
    n = len(counts) - 1
    while True:
        row = 0
        for k in range(n):
            row += (c[k] if c[k] < counts[k] else c[k] - counts[k]) * strides[k]
        for z in range(c[n], b[n] + 1):
            q = row + (z if z < counts[n] else z - counts[n])
            if values[q] < 0 or values[q] >= level:
                return q
        c[n] = a[n]
        d = n - 1
        while d >= 0:
            c[d] += 1
            if c[d] <= b[d]:
                break
            c[d] = a[d]
            d -= 1
        if d < 0:
            return -1


@borrowing
def _keep(bits: Bits, i: int, j: int) -> None:
    bits[i, j >> 3] |= 128 >> (j & 7)


@compiled
def _watch(
    counts: Ints,
    wraps: Bools,
    packed: Any,
    values: Values,
    bits: Bits,
    allowed: Bools,
    near: tuple[Ints, Ints],
    head: Any,
    following: Any,
    won: Any,
) -> int:
    """Hang every pair on the first cell of its window that is not won; those that have none win, and their number is returned.

    near: index ranges of the cells whose windows may touch cells that are won. won: their numbers.
    """
    strides, m, number = _strides(counts), packed[5].shape[1], 0
    index, a, b, c = np.zeros((4, len(counts)), np.int64)
    for i in range(len(values)):
        if values[i] == -1:
            close = True
            for k in range(len(counts)):
                close = close and near[0][k] <= index[k] <= near[1][k]
            for j in range(m):
                if (allowed.size and not allowed[i, j]) or not _window(counts, wraps, packed, index, j, a, b):
                    continue
                found = 0
                for k in range(len(counts)):
                    c[k] = a[k]
                    found += a[k] * strides[k]
                if close:
                    found = _advance(counts, strides, a, b, c, values, 1)
                if found < 0:
                    _keep(bits, i, j)
                    if values[i] == -1:
                        values[i], won[number] = -3, i
                        number += 1
                else:
                    following[i * m + j], head[found] = head[found], i * m + j
        _next(counts, index)
    for f in range(number):
        values[won[f]] = 1
    return number


@compiled
def _round(
    counts: Ints,
    wraps: Bools,
    packed: Any,
    values: Values,
    bits: Bits,
    level: int,
    head: Any,
    following: Any,
    won: Any,
    later: Any,
) -> int:
    """Of the pairs that hang on the cells `won`, those whose windows are won in fewer than `level` steps win; others hang on
    another cell then. How many cells win, their numbers in `later`.
    """
    strides, m, number = _strides(counts), packed[5].shape[1], 0
    index, a, b, c = np.zeros((4, len(counts)), np.int64)
    for q in won:
        pair = head[q]
        while pair >= 0:
            after, i = following[pair], pair // m
            value = values[i]
            # A cell that was won before has its inputs; one that is won in this round may get further ones.
            if value == -1 or value == level:
                j = pair - i * m
                _unravel(strides, i, index)
                _window(counts, wraps, packed, index, j, a, b)
                _unravel(strides, q, c)
                for k in range(len(counts)):
                    if c[k] < a[k]:
                        c[k] += counts[k]
                found = _advance(counts, strides, a, b, c, values, level)
                if found >= 0:
                    following[pair], head[found] = head[found], pair
                else:
                    _keep(bits, i, j)
                    if value == -1:
                        values[i], later[number] = level, i
                        number += 1
            pair = after
    return number


@compiled
def reach(
    counts: Ints,
    wraps: Bools,
    packed: Any,
    values: Values,
    bits: Bits,
    allowed: Bools,
    near: tuple[Ints, Ints],
    head: Any,
    following: Any,
) -> int:
    """values: 0 for targets, −1 for cells to be won, less for others; changed, and bits filled. The largest value is returned.

    Each pair of a cell and an input hangs on one successor that is not won yet: when that is won, the rest of the window is
    looked through for another. So a window is passed once, and no transition is stored. head (cells,), −1 everywhere, and
    following (pairs,) hold these lists: integers that can number all pairs.
    """
    won, later = np.empty(len(values), head.dtype), np.empty(len(values), head.dtype)
    number, level = _watch(counts, wraps, packed, values, bits, allowed, near, head, following, won), 0
    while number:
        level += 1
        number = _round(counts, wraps, packed, values, bits, level + 1, head, following, won[:number], later)
        won, later = later, won
    return level


@borrowing
def _valid(
    counts: Ints, wraps: Bools, packed: Any, strides: Ints, values: Values, index: Ints, j: int, a: Ints, b: Ints, c: Ints
) -> bool:
    """Is the window inside the grid and won?"""
    if not _window(counts, wraps, packed, index, j, a, b):
        return False
    for k in range(len(counts)):
        c[k] = a[k]
    return _advance(counts, strides, a, b, c, values, 1) < 0
