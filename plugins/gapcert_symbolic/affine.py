"""Invariance where f is affine under each input: windows in closed form, no table; what dies takes its predecessors along.

In units of cells a successor along axis k lies in [low_jk, high_jk] + β_jk · i, i the indices of the cell, so that its window
is ⌊low_jk + β_jk · i⌋ … ⌊high_jk + β_jk · i⌋. Which cells leave the grid under an input is an interval of each row of the last
axis, and the cells whose windows hold a given one are those with β_jk · i in an interval for each k: a parallelepiped.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

import numpy as np
import numpy.typing as npt
from numba import njit

from gapcert import Interval, UsageError

from .abstraction import EPS, Disturbance
from .bounds import Bound, Grown
from .grid import Array, Bools, Grid, Ints, corners
from .kernels import compiled
from .structure import LEAK, ROUNDING

Bits = npt.NDArray[np.uint8]
Marks = npt.NDArray[np.int8]
inlined = njit(inline="always", error_model="numpy")
PAD = 1e-7  # of a cell, above all rounding of indices
INPUTS = 64  # above, tables are shared by inputs and pay


@final
@dataclass(frozen=True)
class Maps:
    """slope β (m, n, n), in cells per cell; low, high (m, n), of the first cell; inverse (m, n, n) = β⁻¹."""

    slope: Array
    low: Array
    high: Array
    inverse: Array


def maps(bound: Bound, grid: Grid, axes: tuple[Array, ...], added: Disturbance | None, allowed: Bools | None) -> Maps | None:
    """None where f is not known to be affine, up to LEAK cells over the grid, with slopes that can be inverted; or where inputs
    are many, the gap differs between cells, or tables are small.
    """
    points, n = corners(list(axes), list(axes))[0], len(grid.counts)
    if len(points) > INPUTS or any(grid.wraps) or grid.frame is not None or allowed is not None:
        return None
    if added is not None and added.r.lo.shape[:2] != (1, 1):
        return None
    low, high = grid.hull
    hull = [np.repeat(end[None], len(points), axis=0) for end in (low, high)]
    z = Interval(np.concatenate([hull[0], points], axis=1), np.concatenate([hull[1], points], axis=1))
    if (told := known(bound, points)) is None:
        try:
            told = bound.model.jacobian_enclosure(z)
        except UsageError:
            return None
    slope = told[:, :n, :n]
    widths = grid.widths
    # Replacing the slope by its middle costs half its width over the grid.
    leak = (slope.rad * (high - low)).sum(axis=-1) / widths
    beta = np.asarray(slope.mid * widths / widths[:, None])
    if not (leak <= LEAK).all() or not (np.linalg.cond(beta) < 1e6).all():
        return None
    # Where all axes move with the own cell their tables are small, and many cells are looked at at once.
    if (np.abs(np.einsum("jkk->jk", beta) - 1) * np.array(grid.counts) <= LEAK).all():
        return None
    cell = [np.repeat(end, len(points), axis=0) for end in grid.cells(0, 1)]
    box = bound.over(cell[0], cell[1], points)
    lo, hi = box.lo, box.hi
    if added is not None:
        lo, hi = lo + added.r.lo[0, 0], hi + added.r.hi[0, 0]
    origin, counts = np.asarray(grid.box.low), np.array(grid.counts)
    size = np.maximum(np.abs(grid.box.low), np.abs(grid.box.high)) / widths + np.abs([lo, hi]).max(axis=0) / widths
    # A difference, a quotient, and n products and sums of indices err by a few ulp each.
    slack = 2 * leak + (16 + 4 * n) * EPS * (size + np.abs(beta) @ counts + counts)
    low, high = (lo - origin) / widths - slack, (hi - origin) / widths + slack
    return Maps(beta, low, high, np.asarray(np.linalg.inv(beta), dtype=np.float64))


def known(bound: Bound, points: Array) -> Interval | None:
    """Slopes in floating point, for a bound that is computed in it too; None where they vary, or are not told."""
    found = [bound.model.constant_slopes(u) for u in points] if isinstance(bound, Grown) else []
    told = [s for s in found if s is not None]
    if not told or len(told) < len(points):
        return None
    slope = np.stack(told)[:, :, : len(bound.model.states)]
    error = ROUNDING * np.abs(slope).max(axis=-1, keepdims=True)
    return None if np.isnan(slope).any() else Interval(slope - error, slope + error)


def invariance(found: Maps, grid: Grid, safe: Bools) -> tuple[Marks, Bits]:
    """(0 for the cells of the greatest set of safe cells that can be kept, −1 for others; all valid inputs, packed)."""
    bits = np.zeros((grid.size, (len(found.low) + 7) // 8), dtype=np.uint8)
    counts = np.array(grid.counts)
    _keep_inside(counts, found.slope, found.low, found.high, safe, bits)
    dead = np.empty(grid.size, dtype=np.int32 if grid.size < 2**31 else np.int64)
    number = _lost(bits, dead)
    _die(counts, found.slope, found.low, found.high, found.inverse, bits, dead, number)
    # One byte per cell is what a large grid has room for.
    values: Marks = np.asarray(bits.any(axis=1) if bits.shape[1] > 1 else bits[:, 0] > 0).view(np.int8)
    np.subtract(values, 1, out=values)
    return values, bits


@inlined
def _between(slope: float, at: float, low: float, high: float, ends: Array) -> None:
    """ends: narrowed to the numbers i with low ≤ at + slope·i ≤ high, and a little more."""
    low, high = low - PAD, high + PAD
    if slope > 0:
        ends[0], ends[1] = max(ends[0], (low - at) / slope), min(ends[1], (high - at) / slope)
    elif slope < 0:
        ends[0], ends[1] = max(ends[0], (high - at) / slope), min(ends[1], (low - at) / slope)
    elif not low <= at <= high:
        ends[1] = -1.0


@inlined
def _cells(ends: Array, width: int) -> tuple[int, int]:
    """The numbers of 0 … width − 1 between these ends, and a little more."""
    first = int(np.ceil(min(max(ends[0] - PAD, 0.0), float(width))))
    last = int(np.floor(min(max(ends[1] + PAD, -1.0), width - 1.0)))
    return first, last


@inlined
def _shift(slope: Array, j: int, index: Ints, k: int) -> float:
    """β_k · i, in one order, so that a window is the same number wherever it is asked for."""
    total = 0.0
    for d in range(len(index)):
        total += slope[j, k, d] * index[d]
    return total


@compiled
def _inside(counts: Ints, slope: Array, low: Array, high: Array, j: int, index: Ints) -> bool:
    for k in range(len(counts)):
        at = _shift(slope, j, index, k)
        if np.floor(low[j, k] + at) < 0 or np.floor(high[j, k] + at) >= counts[k]:
            return False
    return True


@compiled
def _keep_inside(counts: Ints, slope: Array, low: Array, high: Array, safe: Bools, bits: Bits) -> None:
    """Set the bit of each input under which a safe cell stays in the grid."""
    n = len(counts)
    rows, width = len(safe) // counts[n - 1], counts[n - 1]
    index, ends = np.zeros(n, np.int64), np.empty(2)
    for row in range(rows):
        rest = row
        for k in range(n - 2, -1, -1):
            index[k] = rest % counts[k]
            rest //= counts[k]
        for j in range(len(low)):
            ends[0], ends[1], index[n - 1] = 0.0, width - 1.0, 0
            for k in range(n):
                # Both floors are inside; what rounding decides is looked at below.
                _between(slope[j, k, n - 1], _shift(slope, j, index, k), -low[j, k], counts[k] - high[j, k], ends)
            first, last = _cells(ends, width)
            index[n - 1] = first
            while first <= last and not _inside(counts, slope, low, high, j, index):
                first += 1
                index[n - 1] = first
            index[n - 1] = last
            while first <= last and not _inside(counts, slope, low, high, j, index):
                last -= 1
                index[n - 1] = last
            value = np.uint8(128 >> (j & 7))
            for i in range(row * width + first, row * width + last + 1):
                if safe[i]:
                    bits[i, j >> 3] |= value


@compiled
def _lost(bits: Bits, dead: Any) -> int:
    """How many cells have no input, their numbers in `dead`."""
    number = 0
    for i in range(len(bits)):
        left = False
        for b in range(bits.shape[1]):
            left = left or bits[i, b] != 0
        if not left:
            dead[number] = i
            number += 1
    return number


@compiled
def _die(counts: Ints, slope: Array, low: Array, high: Array, inverse: Array, bits: Bits, dead: Any, number: int) -> None:
    """Inputs that may lead to a dead cell are no longer valid, and cells without any die; until nothing changes."""
    n, done = len(counts), 0
    index, ends = np.zeros(n, np.int64), np.empty(2)
    begin, end, cell = np.zeros(n, np.int64), np.zeros(n, np.int64), np.zeros(n, np.int64)
    while done < number:
        rest = dead[done]
        done += 1
        for k in range(n - 1, -1, -1):
            cell[k] = rest % counts[k]
            rest //= counts[k]
        for j in range(len(low)):
            # β·i lies in (q − high, q + 1 − low): a box about its image under β⁻¹, in which rows are narrowed.
            some = True
            for d in range(n - 1):
                middle, half = 0.0, 0.0
                for k in range(n):
                    middle += inverse[j, d, k] * (cell[k] + 0.5 - (low[j, k] + high[j, k]) / 2)
                    half += abs(inverse[j, d, k]) * (high[j, k] - low[j, k] + 1) / 2
                begin[d] = max(0, int(np.floor(middle - half - 1e-6)))
                end[d] = min(counts[d] - 1, int(np.ceil(middle + half + 1e-6)))
                some = some and begin[d] <= end[d]
                index[d] = begin[d]
            while some:
                index[n - 1] = 0
                ends[0], ends[1] = 0.0, counts[n - 1] - 1.0
                for k in range(n):
                    at = _shift(slope, j, index, k)
                    _between(slope[j, k, n - 1], at, cell[k] - high[j, k], cell[k] + 1 - low[j, k], ends)
                number = _lose(counts, slope, low, high, index, ends, cell, j, bits, dead, number)
                d = n - 2
                while d >= 0:
                    index[d] += 1
                    if index[d] <= end[d]:
                        break
                    index[d] = begin[d]
                    d -= 1
                some = d >= 0


@inlined
def _lose(
    counts: Ints,
    slope: Array,
    low: Array,
    high: Array,
    index: Ints,
    ends: Array,
    cell: Ints,
    j: int,
    bits: Bits,
    dead: Any,
    number: int,
) -> int:
    """Of a row, between about `ends`, the cells whose windows hold `cell` lose input j."""
    n, row = len(counts), 0
    for k in range(n - 1):
        row = (row + index[k]) * counts[k + 1]
    first, last = _cells(ends, counts[n - 1])
    value = np.uint8(128 >> (j & 7))
    for i in range(first, last + 1):
        if bits[row + i, j >> 3] & value:
            index[n - 1] = i
            meets = True
            for k in range(n):
                at = _shift(slope, j, index, k)
                meets = meets and np.floor(low[j, k] + at) <= cell[k] <= np.floor(high[j, k] + at)
            if meets:
                bits[row + i, j >> 3] &= ~value
                left = False
                for b in range(bits.shape[1]):
                    left = left or bits[row + i, b] != 0
                if not left:
                    dead[number] = row + i
                    number += 1
    return number
