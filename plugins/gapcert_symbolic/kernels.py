"""Fixpoints over windows of cells, compiled: reach by watched successors, invariance by sweeps that look where cells have died.

Every function is made for a number of axes, so that loops over them unroll. Windows come as tables (`abstraction.Windows.packed`).
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numba import njit

_OPTIONS = {"nogil": True, "error_model": "numpy", "cache": True}


@cache
def reach(nx: int) -> Any:
    """Compiled for nx axes: see `solvers.reach_avoid`.

    Each pair of a cell and an input hangs on one successor that is not won yet: when that is won, the rest of the window is
    looked through for another. So a window is passed once, and no transition is stored.
    """
    window, advance = _window(nx), _advance(nx)

    @njit(**_OPTIONS)
    def run(counts, wraps, packed, values, bits, allowed, least, most, low, high):  # type: ignore[no-untyped-def]
        m, n, size = packed[5].shape[1], values.size, bits.shape[1]
        strides = np.ones(nx, np.int64)
        for k in range(nx - 2, -1, -1):
            strides[k] = strides[k + 1] * counts[k + 1]
        head, following = np.full(n, -1, np.int64), np.empty(n * m, np.int64)
        index, a, b, c = np.zeros(nx, np.int64), np.empty(nx, np.int64), np.empty(nx, np.int64), np.empty(nx, np.int64)
        fresh, later, number = np.empty(n, np.int64), np.empty(n, np.int64), 0
        for i in range(n):
            if values[i] == -1:
                near = True
                for k in range(nx):
                    near = near and (wraps[k] or (index[k] + least[k] <= high[k] and index[k] + most[k] >= low[k]))
                for j in range(m):
                    if allowed.size and not allowed[i, j]:
                        continue
                    if not window(counts, wraps, packed, index, j, a, b):
                        continue
                    found = np.int64(0)
                    for k in range(nx):
                        c[k] = a[k]
                        found += a[k] * strides[k]
                    if near:
                        found = advance(counts, strides, a, b, c, values, 1)
                    if found < 0:
                        bits[i, j >> 3] |= 128 >> (j & 7)
                        if values[i] == -1:
                            values[i] = -3
                            fresh[number] = i
                            number += 1
                    else:
                        following[i * m + j] = head[found]
                        head[found] = i * m + j
            _next(counts, index)
        for f in range(number):
            values[fresh[f]] = 1
        level = 1 if number else 0
        while number:
            won, number = number, 0
            for f in range(won):
                pair = head[fresh[f]]
                while pair >= 0:
                    after, i = following[pair], pair // m
                    value = values[i]
                    # A cell that was won before has its inputs; one that is won in this round may get further ones.
                    if value == -1 or value == level + 1:
                        j = pair - i * m
                        _unravel(strides, i, index)
                        window(counts, wraps, packed, index, j, a, b)
                        _unravel(strides, fresh[f], c)
                        for k in range(nx):
                            if c[k] < a[k]:
                                c[k] += counts[k]
                        found = advance(counts, strides, a, b, c, values, level + 1)
                        if found < 0:
                            bits[i, j >> 3] |= 128 >> (j & 7)
                            if value == -1:
                                values[i] = level + 1
                                later[number] = i
                                number += 1
                        else:
                            following[pair] = head[found]
                            head[found] = pair
                    pair = after
            level += 1 if number else 0
            fresh, later = later, fresh
        return level

    return run


@njit(**_OPTIONS)
def _next(counts, index):  # type: ignore[no-untyped-def]
    k = len(counts) - 1
    while k >= 0:
        index[k] += 1
        if index[k] < counts[k]:
            return
        index[k] = 0
        k -= 1


@njit(**_OPTIONS)
def _unravel(strides, flat, index):  # type: ignore[no-untyped-def]
    for k in range(len(strides) - 1):
        index[k] = flat // strides[k]
        flat -= index[k] * strides[k]
    index[len(strides) - 1] = flat


@cache
def _window(nx: int) -> Any:
    @njit(**_OPTIONS)
    def window(counts, wraps, packed, index, j, a, b):  # type: ignore[no-untyped-def]
        """First and last cell of each axis; False where the window leaves the grid. On an axis that wraps a is in the grid."""
        first, last, start, strides, moves, column = packed
        inside = True
        for k in range(nx):
            at = start[k] + column[k, j]
            for d in range(nx):
                at += index[d] * strides[k, d]
            own = index[k] if moves[k] else 0
            a[k], b[k] = own + first[at], own + last[at]
            if wraps[k]:
                turn = counts[k] if a[k] < 0 else (-counts[k] if a[k] >= counts[k] else 0)
                a[k], b[k] = a[k] + turn, b[k] + turn
            else:
                inside = inside and a[k] >= 0 and b[k] < counts[k]
        return inside

    return window


@cache
def _advance(nx: int) -> Any:
    @njit(**_OPTIONS)
    def advance(counts, strides, a, b, c, values, level):  # type: ignore[no-untyped-def]
        """From c on, the first cell of the window whose value is not in [0, level), or −1."""
        n = nx - 1
        while True:
            row = np.int64(0)
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
                return np.int64(-1)

    return advance


@cache
def invariance(nx: int) -> Any:
    """Compiled for nx axes: see `solvers.invariance`.

    A cell stays while the input remembered for it stays valid. Sweeps go on where, within the reach of a window, a cell has died.
    """
    window, advance = _window(nx), _advance(nx)

    @njit(**_OPTIONS)
    def run(counts, wraps, packed, alive, bits, allowed, least, most):  # type: ignore[no-untyped-def]
        """alive (cells,) int32, 0 where a cell is safe and −1 elsewhere; changed."""
        m, n = packed[5].shape[1], alive.size
        strides = np.ones(nx, np.int64)
        for k in range(nx - 2, -1, -1):
            strides[k] = strides[k + 1] * counts[k + 1]
        slab, rows = strides[0], counts[0]
        witness = np.full(n, -1, np.int64)
        index, a, b, c = np.zeros(nx, np.int64), np.empty(nx, np.int64), np.empty(nx, np.int64), np.empty(nx, np.int64)
        changed, before = np.ones(rows, np.bool_), np.ones(rows, np.bool_)
        sweeps, more = 0, True
        while more:
            sweeps, more = sweeps + 1, False
            before, changed = changed, before
            changed[:] = False
            for step in range(rows):
                row = step if sweeps % 2 else rows - 1 - step
                look = wraps[0]
                for r in range(max(0, row + least[0]), min(rows, row + most[0] + 1)):
                    look = look or before[r] or changed[r]
                if not look:
                    continue
                index[:] = 0
                index[0] = row
                for i in range(row * slab, (row + 1) * slab):
                    if alive[i] == 0:
                        kept = False
                        if witness[i] >= 0:
                            window(counts, wraps, packed, index, witness[i], a, b)
                            c[:] = a
                            kept = advance(counts, strides, a, b, c, alive, 1) < 0
                        if not kept:
                            # From the middle outwards: such inputs are the least likely to be lost later.
                            for t in range(m):
                                j = (m >> 1) + (-((t + 1) >> 1) if t % 2 else (t >> 1))
                                if allowed.size and not allowed[i, j]:
                                    continue
                                if window(counts, wraps, packed, index, j, a, b):
                                    c[:] = a
                                    if advance(counts, strides, a, b, c, alive, 1) < 0:
                                        witness[i], kept = j, True
                                        break
                        if not kept:
                            alive[i] = -1
                            changed[row] = more = True
                    _next(counts, index)
        index[:] = 0
        for i in range(n):
            if alive[i] == 0:
                for j in range(m):
                    if allowed.size and not allowed[i, j]:
                        continue
                    if window(counts, wraps, packed, index, j, a, b):
                        c[:] = a
                        if advance(counts, strides, a, b, c, alive, 1) < 0:
                            bits[i, j >> 3] |= 128 >> (j & 7)
            _next(counts, index)
        return sweeps

    return run
