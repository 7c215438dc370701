"""Invariance by erosion, 64 cells at a time: an axis shifts all windows alike, and others depend on each other in an order.

A pair is valid if its window, a product of ranges, is alive: ∀ q_1 ∈ W_1 … ∀ q_n ∈ W_n. Ranges are eroded one axis after
another. Before that of axis k those are eroded on which W_k depends, since until then an index is the successor's: so the order
is topological. Inputs that share a range share its erosion.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import final

import numpy as np
import numpy.typing as npt

from gapcert.plugin import Bools, Ints
from gapcert_cells import Along
from gapcert_symbolic.cells.abstraction import Windows
from gapcert_symbolic.kernels.kernels import Bits, borrowing, compiled, inlined, part, together

from .problem import Problem, Solution

Words = npt.NDArray[np.uint64]
ALL = np.uint64(2**64 - 1)
Shared = Callable[[Callable[[int, int], None]], None]
"""Calls a function with (begin, end) of parts of all rows, each in a thread."""


def order(windows: Windows) -> tuple[int, ...] | None:
    """Axes as they can be eroded, the last along bits: it moves, and no window depends on it. None where there is no order."""
    axes, wraps = windows.axes, windows.grid.wraps
    free = [k for k, axis in enumerate(axes) if axis.moves and not wraps[k] and not any(k in a.on for a in axes)]
    if not free:
        return None
    # The longest fills its words best.
    last = max(free, key=lambda k: windows.grid.counts[k])
    done, left = list[int](), [k for k in range(len(axes)) if k != last]
    while left:
        ready = [k for k in left if set(axes[k].on) <= {*done, k}]
        if not ready:
            return None
        # Windows with few columns first: what follows is done once for each.
        k = min(ready, key=lambda k: axes[k].first.shape[1])
        done.append(k)
        left.remove(k)
    return (*done, last)


def solve(problem: Problem) -> Solution | None:
    """Invariance, where axes can be eroded one after another."""
    if (found := order(windows := problem.windows())) is None:
        return None
    alive, bits, rounds = invariance(windows, problem.safe, found, problem.threads)
    return Solution(np.where(alive, 0, -1).astype(np.int32), bits, rounds)


def invariance(windows: Windows, safe: Bools, order: tuple[int, ...], threads: int = 1) -> tuple[Bools, Bits, int]:
    """(the greatest set of safe cells that can be kept, all valid inputs of its cells packed, rounds)."""
    layout = _Layout.of(windows, order[-1])
    alive, rounds, all_inputs = layout.packed(safe), 0, np.arange(windows.inputs)
    with together(threads) as each:

        def shared(work: Callable[[int, int], None]) -> None:
            each(lambda own: work(*part(len(alive), threads, own)))

        while True:
            rounds += 1
            kept = np.zeros_like(alive)
            for valid, inputs in _leaves(windows, layout, alive, order, all_inputs, shared):
                for j in inputs if windows.allowed is not None else inputs[:1]:
                    kept |= _offered(windows, layout, valid, int(j))
            kept &= alive
            if np.array_equal(kept, alive):
                break
            alive = kept
        bits = np.zeros((windows.grid.size, (windows.inputs + 7) // 8), dtype=np.uint8)
        for valid, inputs in _leaves(windows, layout, alive, order, all_inputs, shared):
            for j in map(int, inputs):
                given = _offered(windows, layout, valid, j) & alive, layout.base, layout.step, bits, j
                shared(functools.partial(_spread, *given))
    return layout.unpacked(alive), bits, rounds


def _offered(windows: Windows, layout: _Layout, valid: Words, j: int) -> Words:
    return valid if windows.allowed is None else valid & layout.packed(windows.allowed[:, j])


def _leaves(
    windows: Windows, layout: _Layout, marked: Words, order: tuple[int, ...], inputs: Ints, shared: Shared
) -> Iterator[tuple[Words, Ints]]:
    """(cells whose windows are marked, the inputs for which they are): one pair per group of inputs with the same windows."""
    k, rest = order[0], order[1:]
    axis = windows.axes[k]
    for column in np.unique(axis.column[inputs]):
        own = inputs[axis.column[inputs] == column]
        first, last = (np.ascontiguousarray(end[:, column], dtype=np.int64) for end in (axis.first, axis.last))
        row, out = layout.rows(windows, axis), np.empty_like(marked)
        if rest:
            at = layout.others.index(k)
            n, stride, wraps = layout.counts[at], layout.strides[at], windows.grid.wraps[k]
            shared(functools.partial(_along, marked, out, n, stride, wraps, axis.moves, row, first, last))
            yield from _leaves(windows, layout, out, rest, own, shared)
        else:
            shared(functools.partial(_shifted, marked, out, row, first, last))
            yield out, own


@final
@dataclass(frozen=True)
class _Layout:
    """Cells as rows of bits along one axis: rows are the cells of the other axes in C order, padded to whole words.

    counts, strides of the other axes in rows; base (rows,) the number of the first cell of a row in the grid, step that from
    one bit to the next.
    """

    along: int
    shape: tuple[int, ...]
    others: tuple[int, ...]
    counts: tuple[int, ...]
    strides: tuple[int, ...]
    base: Ints
    step: int

    @classmethod
    def of(cls, windows: Windows, along: int) -> _Layout:
        shape = windows.grid.counts
        others = tuple(k for k in range(len(shape)) if k != along)
        counts = tuple(shape[k] for k in others)
        strides = tuple(math.prod(counts[i + 1 :]) for i in range(len(counts)))
        steps = [math.prod(shape[k + 1 :]) for k in range(len(shape))]
        index = np.indices(counts).reshape(len(counts), math.prod(counts))
        base = np.array([steps[k] for k in others], dtype=np.int64) @ index
        return cls(along, shape, others, counts, strides, base, steps[along])

    def packed(self, cells: Bools) -> Words:
        rows = np.moveaxis(cells.reshape(self.shape), self.along, -1).reshape(len(self.base), -1)
        spare = -rows.shape[1] % 64
        padded = np.pad(rows, [(0, 0), (0, spare)]) if spare else rows
        return np.ascontiguousarray(np.packbits(padded, axis=1, bitorder="little")).view(np.uint64)

    def unpacked(self, words: Words) -> Bools:
        rows = np.unpackbits(words.view(np.uint8), axis=1, count=self.shape[self.along], bitorder="little")
        whole = rows.reshape(*self.counts, self.shape[self.along])
        return np.ascontiguousarray(np.moveaxis(whole, -1, self.along)).astype(bool).ravel()

    def rows(self, windows: Windows, axis: Along) -> Ints:
        """The row of the axis' table for each row of bits."""
        at = np.zeros(len(self.base), dtype=np.int64)
        for d in axis.on:
            i = self.others.index(d)
            at = at * windows.grid.counts[d] + np.arange(len(self.base)) // self.strides[i] % self.counts[i]
        return at


@borrowing
def _along(
    marked: Words,
    out: Words,
    n: int,
    stride: int,
    wraps: bool,
    moves: bool,
    row: Ints,
    first: Ints,
    last: Ints,
    begin: int,
    end: int,
) -> None:
    """Rows all of whose windows along an axis of n rows, `stride` apart, are marked; windows that leave it have none."""
    width = marked.shape[1]
    for r in range(begin, end):
        own = r // stride % n
        shift = own if moves else 0
        a, b, here = first[row[r]] + shift, last[row[r]] + shift, r - own * stride
        inside = wraps or (a >= 0 and b < n)
        for w in range(width):
            word = ALL if inside else np.uint64(0)
            for q in range(a, b + 1 if inside else a):
                word &= marked[here + (q if q < n else (q - n if q < 2 * n else q - 2 * n)) * stride, w]
            out[r, w] = word


@compiled
def _shifted(marked: Words, out: Words, row: Ints, first: Ints, last: Ints, begin: int, end: int) -> None:
    """Bits i with i + first … i + last marked: bits beyond a row are not."""
    width = marked.shape[1]
    own, other = np.empty(width, np.uint64), np.empty(width, np.uint64)
    for r in range(begin, end):
        for w in range(width):
            own[w] = marked[r, w]
        have, length = 1, last[row[r]] - first[row[r]] + 1
        while have < length:
            more = min(have, length - have)
            _moved(own, more, other)
            for w in range(width):
                own[w] &= other[w]
            have += more
        _moved(own, first[row[r]], other)
        for w in range(width):
            out[r, w] = other[w]


@inlined
def _moved(words: Words, by: int, out: Words) -> None:
    """Bit i of `out` is bit i + by of `words`, 0 where there is none."""
    width, whole, part = len(words), by >> 6, np.uint64(by & 63)
    rest = np.uint64(64) - part
    for w in range(width):
        low = w + whole
        value = words[low] >> part if 0 <= low < width else np.uint64(0)
        if part and 0 <= low + 1 < width:
            value |= words[low + 1] << rest
        out[w] = value


@borrowing
def _spread(marked: Words, base: Ints, step: int, bits: Bits, j: int, begin: int, end: int) -> None:
    """Set the bit of input j for the marked cells."""
    byte, value = j >> 3, np.uint8(128 >> (j & 7))
    for r in range(begin, end):
        for w in range(marked.shape[1]):
            word = marked[r, w]
            i = base[r] + 64 * w * step
            while word:
                if word & np.uint64(1):
                    bits[i, byte] |= value
                word >>= np.uint64(1)
                i += step
