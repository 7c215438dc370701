"""Pairs of a cell and an input where windows repeat: found from the first cell of their windows, not stored.

Along axes on which no window depends, and which do not wrap, all windows move with the own cell. So the pairs whose window
begins at a given cell are the same for all cells of a class: those that agree in the other axes.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from gapcert.plugin import Bools, Ints
from gapcert_symbolic.kernels.kernels import _next, _strides, _window, compiled
from gapcert_symbolic.thresholds import THRESHOLDS

from .abstraction import Windows

SHAPES = 1 << 18  # cells in all shapes of windows together


class Inverse(NamedTuple):
    """Groups start[c] … start[c + 1] − 1 are of the windows that are watched at a cell of class c, by the own cell.

    Group g has the entries entry[g] … entry[g + 1] − 1, which differ in their windows; entry e is for the inputs
    input[first[e]:first[e + 1]]. back: the number of the watched cell less that of the own cell; lows: the same along the axes
    that are free. Its window is the cells[begin[s]:begin[s + 1]] of its shape s, counted from the watched cell, which is left
    out; reach (shapes, 2, axes): how far that goes before and beyond the watched cell. margin (2, axes): how far from the
    grid's ends no window and no own cell is outside along an axis that is free. counts, free, strides, steps (axes,): cells
    along each axis, whether it is free, and what a cell further along it adds to the number of a cell and to its class.
    """

    start: Ints
    entry: Ints
    first: Ints
    back: Any
    lows: Any
    input: Any
    shape: Any
    begin: Ints
    cells: Any
    reach: Ints
    margin: Ints
    counts: Ints
    free: Bools
    strides: Ints
    steps: Ints


@compiled
def _relative(game: Any, free: Bools, index: Ints, j: int, a: Ints, b: Ints) -> bool:
    """Window of a cell that is 0 along the free axes; False where it leaves the grid from every cell of the class."""
    _window(game, 0, index, j, a, b)
    counts, wraps, fits = game.counts, game.wraps, True
    for k in range(len(counts)):
        if free[k]:
            fits = fits and a[k] > -counts[k] and b[k] < counts[k]
        elif not wraps[k]:
            fits = fits and a[k] >= 0 and b[k] < counts[k]
    return fits


@compiled
def _far(counts: Ints, wraps: Bools, index: Ints, a: Ints, b: Ints, k: int) -> int:
    """Is the last cell of the window nearer to the own cell than the first?"""
    ahead = a[k] + b[k] - 2 * index[k]
    return int(-counts[k] < ahead < 0 or ahead > counts[k]) if wraps[k] else int(ahead < 0)


@compiled
def _tally(game: Any, free: Bools, some: Ints, classes: int) -> tuple[Ints, Ints, Ints]:
    """Start of each class, the widest window along each axis, and the margins. some (axes,): counts, and 1 where free."""
    counts, wraps, n, m = game.counts, game.wraps, len(game.counts), game.packed.column.shape[1]
    strides, start = _strides(some), np.zeros(classes + 1, np.int64)
    most, margin = np.ones(n, np.int64), np.zeros((2, n), np.int64)
    index, a, b = np.zeros((3, n), np.int64)
    for _ in range(classes):
        for j in range(m):
            if _relative(game, free, index, j, a, b):
                at = 0
                for k in range(n):
                    most[k] = max(most[k], b[k] - a[k] + 1)
                    low, high = min(a[k], 0), max(b[k], 0)
                    watched = b[k] if _far(counts, wraps, index, a, b, k) else a[k]
                    if free[k]:
                        margin[0, k], margin[1, k] = max(margin[0, k], watched - low), max(margin[1, k], high - watched)
                    else:
                        at += watched % counts[k] * strides[k]
                start[at + 1] += 1
        _next(some, index)
    for c in range(classes):
        start[c + 1] += start[c]
    return start, most, margin


@compiled
def _fill(game: Any, free: Bools, some: Ints, most: Ints, place: Ints, known: Any, entries: Any, seen: Ints) -> int:
    """Fill the entries (back, lows, input, shape) and `seen` (shapes, 2 axes): extent, and cells up to where it wraps."""
    counts, wraps, n, m, shapes = game.counts, game.wraps, len(game.counts), game.packed.column.shape[1], 0
    back, lows, inputs, shape = entries
    narrow = _strides(some)
    index, a, b, c = np.zeros((4, n), np.int64)
    for _ in range(len(place) - 1):
        for j in range(m):
            if _relative(game, free, index, j, a, b):
                at, flat, key, f = 0, 0, 0, 0
                for k in range(n):
                    size, far = b[k] - a[k] + 1, _far(counts, wraps, index, a, b, k)
                    key = (key * most[k] + size - 1) * 2 + far
                    if wraps[k]:
                        key = key * most[k] + min(size, counts[k] - a[k]) - 1
                    c[k] = b[k] if far else a[k]
                    if not free[k]:
                        c[k] = c[k] % counts[k]
                        at += c[k] * narrow[k]
                    flat += (c[k] - index[k]) * game.strides[k]
                e = place[at]
                place[at] = e + 1
                for k in range(n):
                    if free[k]:
                        lows[e, f] = c[k]
                        f += 1
                if known[key] < 0:
                    known[key] = shapes
                    if shapes < len(seen):
                        for k in range(n):
                            seen[shapes, 0, k] = b[k] - a[k] + 1
                            seen[shapes, 1, k] = counts[k] - a[k] if wraps[k] else counts[k]
                            seen[shapes, 2, k] = _far(counts, wraps, index, a, b, k)
                    shapes += 1
                back[e], inputs[e], shape[e] = flat, j, known[key]
        _next(some, index)
    return shapes


@compiled
def _grouped(start: Ints, back: Any, shape: Any) -> Any:
    """Entries of each class, ordered by own cell and shape, with those that differ in the input alone put together: where those
    of a class start, and of a cell; where the inputs of an entry start in the order, which is the last.
    """
    starts, entry, first = np.zeros(len(start), np.int64), np.zeros(len(back) + 1, np.int64), np.zeros(len(back) + 1, np.int64)
    order, groups, entries = np.zeros(len(back), np.int64), 0, 0
    for c in range(len(start) - 1):
        begin, end = start[c], start[c + 1]
        keys = np.empty(end - begin, np.int64)
        for t in range(begin, end):
            keys[t - begin] = np.int64(back[t]) * SHAPES + shape[t]
        sorted_ = np.argsort(keys, kind="mergesort")
        for t in range(begin, end):
            order[t] = begin + sorted_[t - begin]
        for t in range(begin, end):
            e, before = order[t], order[t - 1]
            other = t == begin or back[e] != back[before]
            if other:
                entry[groups] = entries
                groups += 1
            if other or shape[e] != shape[before]:
                first[entries] = t
                entries += 1
        starts[c + 1] = groups
    entry[groups], first[entries] = entries, len(back)
    return starts, entry[: groups + 1], first[: entries + 1], order


def inverse(windows: Windows, whole: Any) -> Inverse | None:
    """Entries with numbers of the type `whole`; None where classes are too small for it to pay."""
    grid, n = windows.grid, len(windows.axes)
    used = {d for axis in windows.axes for d in axis.on} | {k for k, axis in enumerate(windows.axes) if not axis.moves}
    free = np.array([k not in used and not wraps for k, wraps in enumerate(grid.wraps)])
    classes = math.prod(c for c, own in zip(grid.counts, free, strict=True) if not own)
    if grid.size < THRESHOLDS.class_cells * classes:
        return None
    game, counts, wraps = windows.game, np.array(grid.counts), np.array(grid.wraps)
    some = np.where(free, 1, counts)
    start, most, margin = _tally(game, free, some, classes)
    keys, size = 2**n * math.prod(int(w) for w in most) * math.prod(int(w) for w in most[wraps]), int(start[-1])
    if keys > SHAPES:
        return None
    back, lows = np.empty(size, whole), np.empty((size, int(free.sum())), np.int32)
    entries = (back, lows, *np.empty((2, size), np.int32))
    known, seen = np.full(keys, -1, np.int32), np.empty((min(keys, size), 3, n), np.int64)
    shapes = _fill(game, free, some, most, start.copy(), known, entries, seen)
    begin, cells = np.zeros(shapes + 1, np.int64), []
    strides = game.strides
    reach = np.stack([seen[:shapes, 2], 1 - seen[:shapes, 2]], axis=1) * (seen[:shapes, :1] - 1)
    for s, (size, split, far) in enumerate(seen[:shapes]):
        at = np.indices(size).reshape(n, -1).T
        where = np.where(at < split, at, at - counts) @ strides
        first = int(np.ravel_multi_index(tuple(far * (size - 1)), tuple(size)))
        # Corners first: they are the last to be won, and so a pair changes its place least often.
        order = np.argsort(-((at == 0) | (at == size - 1)).sum(axis=1), kind="stable")
        cells.append((where - where[first])[order[order != first]])
        begin[s + 1] = begin[s] + len(cells[-1])
    flat = np.concatenate([*cells, np.empty(0, np.int64)]).astype(whole)
    starts, entry, first, order = _grouped(start, back, entries[3])
    kept, inputs = order[first[:-1]], entries[2][order]
    back, lows, shape = back[kept], lows[kept], entries[3][kept]
    steps = np.where(free, 0, _strides(some))
    return Inverse(starts, entry, first, back, lows, inputs, shape, begin, flat, reach, margin, counts, free, strides, steps)
