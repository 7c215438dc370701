"""What is kept of a round too large to keep: per coarse cell, the samples with the smallest and the largest residual."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import final

import numpy as np
import numpy.typing as npt

from gapcert.contracts.systems.domain import Cover, Domain, Points
from gapcert.numerics.arrays import Array, Ints

Kept = npt.NDArray[np.void]

_PENDING = 1 << 16


@final
@dataclass(frozen=True)
class Extremes:
    """Per coarse cell and state i, the first point with the smallest r_i and the first with the largest: ≤ 2 nx records
    (number in its round, r) per cell.

    cells: coarse cells per axis of the domain; z is in cell ⌊(z_j − low_j) · cells_j / width_j⌋ of axis j. Reducing is
    associative: the extremes of a union are those of its parts' extremes, ties going to the lower number, so they depend
    neither on chunks nor on who computes them.
    """

    domain: Domain
    cells: tuple[int, ...]

    @classmethod
    def default_cells(cls, counts: tuple[int, ...]) -> tuple[int, ...]:
        """As many cells on each axis as keep their product below 65,537, and no more than grid points."""
        each = max(1, int(65_536 ** (1 / len(counts)) + 1e-9))
        return tuple(min(n, each) for n in counts)

    def cell(self, z: Array) -> Ints:
        """The numbers (n,) of the cells of points z (n, nz)."""
        number = np.zeros(len(z), np.int64)
        for j, n in enumerate(self.cells):
            position = ((z[:, j] - self.domain.low[j]) * (n / self.domain.width[j])).astype(np.int64)
            number = number * n + np.minimum(position, n - 1)
        return number

    def of_chunk(self, first: int, cell: Ints, r: Array) -> Kept:
        """The records kept of points first, first + 1, … in given cells (n,), with residuals r (n, nx)."""
        rows = _extreme_rows(cell, r, int(np.prod(self.cells)))
        return _records(first + rows, r[rows])

    def merge(self, points: Points | Cover, parts: Iterable[Kept], nx: int) -> Kept:
        """The records kept of all parts, given in the order of the points; memory is that of the result and two parts."""
        kept, pending, size = _records(np.empty(0, np.int64), np.empty((0, nx))), list[Kept](), 0
        for part in parts:
            pending.append(part)
            size += len(part)
            if size > max(_PENDING, len(kept)):
                kept, pending, size = self._reduce(points, np.concatenate([kept, *pending])), [], 0
        return self._reduce(points, np.concatenate([kept, *pending]))

    def _reduce(self, points: Points | Cover, records: Kept) -> Kept:
        return records[_extreme_rows(self.cell(points.at(records["index"])), records["r"], int(np.prod(self.cells)))]


def _records(index: Ints, r: Array) -> Kept:
    out = np.empty(len(index), dtype=[("index", "<i8"), ("r", "<f8", (r.shape[1],))])
    out["index"], out["r"] = index, r
    return out


def _extreme_rows(cell: Ints, r: Array, cells: int) -> Ints:
    """Ascending rows that hold, for some cell and state, the first smallest or the first largest r_i. cell (n,), r (n, nx)."""
    if not len(cell):
        return np.empty(0, np.int64)
    # Neighbours mostly share their cell: each run of one cell is reduced at once, then the runs of a cell.
    starts = np.flatnonzero(np.diff(cell, prepend=-1))
    ends, of_run = np.append(starts[1:], len(cell)), cell[starts]
    keep = []
    for better, worst in ((np.minimum, np.inf), (np.maximum, -np.inf)):
        best = better.reduceat(r, starts, axis=0)
        for i in range(r.shape[1]):
            top = np.full(cells, worst)
            better.at(top, of_run, best[:, i])
            hits = np.flatnonzero(best[:, i] == top[of_run])
            run = hits[_firsts(of_run[hits], cells)]
            keep.append(_first_equal(r[:, i], starts[run], ends[run], best[run, i]))
    return np.unique(np.concatenate(keep))


def _firsts(group: Ints, groups: int) -> Ints:
    """The first position of each group that occurs, by group."""
    first = np.full(groups, len(group))
    np.minimum.at(first, group, np.arange(len(group)))
    return first[first < len(group)]


def _first_equal(values: Array, starts: Ints, ends: Ints, wanted: Array) -> Ints:
    """For each span, the first position in it whose value is the wanted one, which occurs there."""
    length = ends - starts
    before = np.cumsum(length) - length
    position = np.repeat(starts - before, length) + np.arange(length.sum())
    span = np.repeat(np.arange(len(starts)), length)
    found = np.flatnonzero(values[position] == wanted[span])
    return position[found[_firsts(span[found], len(starts))]]
