"""Invariance where f is affine under each input: windows in closed form, no table; what dies takes its predecessors along.

In units of cells a successor along axis k lies in [low_jk, high_jk] + β_jk · i, i the indices of the cell, so that its window
is ⌊low_jk + β_jk · i⌋ … ⌊high_jk + β_jk · i⌋. Which cells leave the grid under an input is an interval of each row of the last
axis, and the cells whose windows hold a given one are those with β_jk · i in an interval for each k: a parallelepiped.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gapcert import Array, Interval, UsageError
from gapcert.plugin import Bools, Ints
from gapcert_symbolic.cells.abstraction import EPS, kept
from gapcert_symbolic.cells.bounds import ROUNDING, Bound, Grown
from gapcert_symbolic.cells.gaps import Disturbance
from gapcert_symbolic.cells.grid import Grid, combined
from gapcert_symbolic.kernels.kernels import Bits, _on, compiled, inlined
from gapcert_symbolic.thresholds import THRESHOLDS

from .problem import Problem, Solution

Marks = npt.NDArray[np.int8]
Counts = tuple[int, ...]  # a tuple: loops over axes are unrolled, which halves the time
PAD = 1e-7  # of a cell, above all rounding of indices
STRETCH = 256


class Maps(NamedTuple):
    """slope β (m, n, n), in cells per cell; low, high (m, n), of the first cell; inverse (m, n, n) = β⁻¹, of which an image in
    the grid errs by less than `spare` cells.
    """

    slope: Array
    low: Array
    high: Array
    inverse: Array
    spare: float


def solve(problem: Problem) -> Solution | None:
    """Invariance, where f is affine under each of few inputs."""
    if problem.dynamics is None or (found := maps(*problem.dynamics)) is None:
        return None
    return Solution(*invariance(found, problem.dynamics.grid, problem.safe), 1)


def maps(bound: Bound, grid: Grid, axes: tuple[Array, ...], added: Disturbance | None, allowed: Bools | None) -> Maps | None:
    """None where f is not known to be affine, up to `axis_leak` cells over the grid, with slopes that can be inverted; or where
    inputs are many, the gap differs between cells, or tables are small.
    """
    points, n = combined(axes), len(grid.counts)
    if len(points) > THRESHOLDS.affine_inputs or any(grid.wraps) or grid.frame is not None or allowed is not None:
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
    if not (leak <= THRESHOLDS.axis_leak).all() or not (number := float(np.linalg.cond(beta).max())) < 1e6:
        return None
    # Where all axes move with the own cell their tables are small, and many cells are looked at at once.
    if (np.abs(np.einsum("jkk->jk", beta) - 1) * np.array(grid.counts) <= THRESHOLDS.axis_leak).all():
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
    # What stays exactly where it is stays in its cell: ⌊1/2 + i⌋ = i, though a bound on it touches the cells beside.
    still = kept(bound, points, added)
    beta[still], low[still], high[still] = np.eye(n)[np.nonzero(still)[1]], 0.5, 0.5
    number = float(np.linalg.cond(beta).max())
    # β⁻¹ errs by some n eps cond(β) of its size, which times that of what it is applied to is cond(β) times the indices.
    spare = 1e-3 + 64 * n * EPS * number**2 * float((np.abs(low) + np.abs(high) + counts).max())
    return Maps(beta, low, high, np.asarray(np.linalg.inv(beta), dtype=np.float64), spare)


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
    """(0 for the cells of the greatest set of safe cells that can be kept, −1 for others; all valid inputs, packed).

    The inputs take the place of `safe` where a byte holds them: large grids have no room for both.
    """
    planes, counts = safe.view(np.uint8)[None], grid.counts
    if len(found.low) > 8:
        planes = np.empty(((len(found.low) + 7) // 8, grid.size), dtype=np.uint8)
    _keep_inside(counts, found, safe, planes)
    dead = np.empty(grid.size, dtype=np.int32 if grid.size < 2**31 else np.int64)
    _die(counts, found, planes, dead, _lost(planes, dead))
    # One byte per cell is what a large grid has room for.
    values: Marks = np.asarray(planes.any(axis=0) if len(planes) > 1 else planes[0] > 0).view(np.int8)
    np.subtract(values, 1, out=values)
    return values, np.ascontiguousarray(planes.T)


@inlined
def _shift(counts: Counts, slope: Array, j: int, index: Ints, shift: Array) -> None:
    """shift: β_k · i of the first cell of a row of the last axis, in one order, so that a window is the same number wherever
    it is asked for.
    """
    for k in range(len(counts)):
        shift[k] = 0.0
        for d in range(len(counts) - 1):
            shift[k] += slope[j, k, d] * index[d]


@inlined
def _fits(counts: Counts, tail: Array, shift: Array, a: Array, b: Array, begin: Array, end: Array, z: int) -> bool:
    fits = True
    for k in range(len(counts)):
        at = shift[k] + tail[k] * z
        fits = fits and a[k] + at >= begin[k] and b[k] + at < end[k]
    return fits


@inlined
def _cells(
    counts: Counts, tail: Array, flip: Array, shift: Array, a: Array, b: Array, begin: Array, end: Array
) -> tuple[int, int]:
    """First and last cell z of a row, β·i = shift + tail·z, with a + β·i ≥ begin and b + β·i < end on all axes. flip: 1 / tail.

    Each of these is monotone in z, in floating point too, so that no cell between the two is missing.
    """
    width = counts[len(counts) - 1]
    low, high = 0.0, width - 1.0
    for k in range(len(counts)):
        p, q, slope = begin[k] - a[k] - shift[k] - PAD, end[k] - b[k] - shift[k] + PAD, tail[k]
        if slope > 0:
            low, high = max(low, p * flip[k]), min(high, q * flip[k])
        elif slope < 0:
            low, high = max(low, q * flip[k]), min(high, p * flip[k])
        elif not p <= 0 <= q:
            high = -1.0
    # A little more, without what rounding decides.
    first = int(np.ceil(min(low - PAD, float(width)))) if low > PAD else 0
    last = int(np.floor(max(high + PAD, -1.0))) if high < width - 1 - PAD else width - 1
    while first <= last and not _fits(counts, tail, shift, a, b, begin, end, first):
        first += 1
    while first <= last and not _fits(counts, tail, shift, a, b, begin, end, last):
        last -= 1
    return first, last


@compiled
def _copy(a: Any, b: Any) -> None:
    for i in range(len(a)):
        b[i] = a[i]


@compiled
def _mark(plane: Bits, safe: Bools, value: np.uint8) -> None:
    for i in range(len(plane)):
        plane[i] |= value if safe[i] else np.uint8(0)


@compiled
def _keep_inside(counts: Counts, maps: Any, safe: Bools, planes: Bits) -> None:
    """The inputs under which a safe cell stays in the grid: ⌊low + β·i⌋ ≥ 0 and ⌊high + β·i⌋ < counts."""
    slope, low, high, n = maps.slope, maps.low, maps.high, len(counts)
    rows, width = len(safe) // counts[n - 1], counts[n - 1]
    index, shift, none, ends = np.zeros(n, np.int64), np.empty(n), np.zeros(n), np.array(counts, np.float64)
    tail, own, nothing = slope[:, :, n - 1].copy(), np.empty(width, np.bool_), np.zeros(width, np.uint8)
    flip = 1 / tail
    for row in range(rows):
        rest, begin = row, row * width
        _copy(safe[begin : begin + width], own)
        for b in range(len(planes)):
            _copy(nothing, planes[b, begin : begin + width])
        for k in range(n - 2, -1, -1):
            index[k] = rest % counts[k]
            rest //= counts[k]
        for j in range(len(low)):
            _shift(counts, slope, j, index, shift)
            first, last = _cells(counts, tail[j], flip[j], shift, low[j], high[j], none, ends)
            if first <= last:
                _mark(planes[j >> 3, begin + first : begin + last + 1], own[first : last + 1], np.uint8(128 >> (j & 7)))


@compiled
def _all(planes: Bits) -> bool:
    """Has every cell an input?"""
    least = np.uint8(255)
    for i in range(planes.shape[1]):
        some = planes[0, i]
        for b in range(1, len(planes)):
            some |= planes[b, i]
        least = min(least, some)
    return bool(least > 0)


@inlined
def _left(planes: Bits, i: int) -> bool:
    """Has a cell an input?"""
    left = False
    for b in range(len(planes)):
        left = left or planes[b, i] != 0
    return left


@compiled
def _lost(planes: Bits, dead: Any) -> int:
    """How many cells have no input, their numbers in `dead`."""
    number, size = 0, planes.shape[1]
    for begin in range(0, size, STRETCH):
        # Many are looked at together before each is.
        end = min(size, begin + STRETCH)
        for i in range(end if _all(planes[:, begin:end]) else begin, end):
            if not _left(planes, i):
                dead[number] = i
                number += 1
    return number


@compiled
def _die(counts: Counts, maps: Any, planes: Bits, dead: Any, number: int) -> None:
    """Inputs that may lead to a dead cell are no longer valid, and cells without any die; until nothing changes.

    Dead cells that follow each other along the last axis are taken at once.
    """
    (slope, low, high, inverse, spare), n, done = maps, len(counts), 0
    index, first, last, shift = np.zeros(n, np.int64), np.zeros(n, np.int64), np.zeros(n, np.int64), np.empty(n)
    begin, end, tail = np.zeros(n), np.zeros(n), slope[:, :, n - 1].copy()
    flip = 1 / tail
    while done < number:
        rest, length = dead[done], 1
        for k in range(n - 1, -1, -1):
            begin[k] = rest % counts[k]
            rest //= counts[k]
            end[k] = begin[k] + 1
        room = counts[n - 1] - begin[n - 1]
        while done + length < number and length < room and dead[done + length] == dead[done] + length:
            length += 1
        done, end[n - 1] = done + length, begin[n - 1] + length
        for j in range(len(low)):
            # β·i lies in (begin − high, end − low): a box about its image under β⁻¹, in which rows are narrowed.
            some = True
            for d in range(n - 1):
                middle, half = 0.0, 0.0
                for k in range(n):
                    middle += inverse[j, d, k] * (begin[k] + end[k] - low[j, k] - high[j, k]) / 2
                    half += abs(inverse[j, d, k]) * (high[j, k] - low[j, k] + end[k] - begin[k]) / 2
                first[d] = max(0, int(np.ceil(middle - half - spare)))
                last[d] = min(counts[d] - 1, int(np.floor(middle + half + spare)))
                some = some and first[d] <= last[d]
                index[d] = first[d]
            while some:
                _shift(counts, slope, j, index, shift)
                # ⌊high + β·i⌋ ≥ begin and ⌊low + β·i⌋ < end: the window holds one of the cells.
                own = _cells(counts, tail[j], flip[j], shift, high[j], low[j], begin, end)
                row = 0
                for k in range(n - 1):
                    row = (row + index[k]) * counts[k + 1]
                number = _lose(planes, row + own[0], row + own[1], j, dead, number)
                some = _on(first, last, index, n - 1)


@inlined
def _lose(planes: Bits, first: int, last: int, j: int, dead: Any, number: int) -> int:
    """Cells first … last lose input j; those without any are written down."""
    byte, value = j >> 3, np.uint8(128 >> (j & 7))
    for i in range(first, last + 1):
        if planes[byte, i] & value:
            planes[byte, i] ^= value
            if not _left(planes, i):
                dead[number] = i
                number += 1
    return number
