"""The envelope under constants that hold per convex cell: each cell has its own, of the samples in its closure alone."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any, final

import numpy as np
import numpy.typing as npt

from gapcert import Array, Domain, GapFunction, Interval
from gapcert.plugin import Cells, Predictor

from .envelope_gap import EnvelopeGap, rounding

Index = npt.NDArray[np.intp]
Ends = Callable[[EnvelopeGap, Interval], tuple[Interval, Interval]]

_BLOCK = 1 << 18  # cones that are looked at together


@final
class PiecewiseEnvelope(GapFunction):
    """u_i(z) = p_i(z) + min_k g_ki + Σ_j L_cij |z_j − z_kj| + J_ci + 2 e_i over the samples k in the closed cell c of z.

    l_i is its mirror. A sample on a shared face serves both cells; a point there belongs to the cell below (`Cells.locate`).
    Nothing is known of a cell without samples, which meets no point of Z: its band is infinite. Inside one cell this is an
    `EnvelopeGap` whose resolution is e_i + J_ci / 2.
    """

    family = "envelope"
    predictor: Predictor

    def __init__(self, z: Array, g: Array, cells: Cells, resolution: Array, predictor: Predictor) -> None:
        self.z, self.g, self.cells, self.resolution, self.predictor = z, g, cells, resolution, predictor
        members = cells.closures(z)
        self._members, self._counts = np.concatenate(members), np.array([len(m) for m in members])
        self._starts = np.cumsum(self._counts) - self._counts
        self._slack = 2 * resolution + cells.jumps

    def interval(self, z: Array) -> tuple[Array, Array]:
        cell = self.cells.locate(z)
        lower, upper = self._cones(z, cell)
        p, slack = self.predictor(z), self._slack[cell]
        return p + lower - slack - self._rounding(p, lower, cell), p + upper + slack + self._rounding(p, upper, cell)

    def interval_over(self, boxes: Interval) -> Interval:
        low, high = self.ends_over(boxes)
        return Interval(np.minimum(low.lo, high.lo), np.maximum(low.hi, high.hi))

    def ends_over(self, boxes: Interval) -> tuple[Interval, Interval]:
        return self._joined(boxes, EnvelopeGap.ends_over)

    def remainder_ends_over(self, boxes: Interval) -> tuple[Interval, Interval]:
        low, high = self._joined(boxes, EnvelopeGap.remainder_ends_over)
        # The whole rounds with the largest |g| of all cells, in the size of p at a point of the box.
        size = self.predictor.over(boxes).mag
        pad = 2 * rounding(size, size, np.abs(self.g).max(axis=0), self._slack.max(axis=0), self.z.shape[1])
        return Interval(low.lo - pad, low.hi + pad), Interval(high.lo - pad, high.hi + pad)

    def _joined(self, boxes: Interval, ends_of: Ends) -> tuple[Interval, Interval]:
        """The hull of what the envelopes have for the parts of each box that lie in their cells."""
        row, cell = self.cells.meeting(boxes)
        known = self._counts[cell] > 0
        # A cell without samples meets no point of Z, so a box that meets others as well is bounded by those.
        alone = np.bincount(row[known], minlength=len(boxes))[row] == 0
        row, cell = row[known | alone], cell[known | alone]
        reach, nx = self.cells.reach, self.g.shape[1]
        part = Interval(np.maximum(boxes.lo[row], reach.lo[cell]), np.minimum(boxes.hi[row], reach.hi[cell]))
        ends = np.empty((2, 2, len(row), nx))
        for c in np.unique(cell):
            own = np.flatnonzero(cell == c)
            if self._counts[c] == 0:
                ends[:, 0, own], ends[:, 1, own] = -np.inf, np.inf
                continue
            for side, found in enumerate(ends_of(self._inside(int(c)), part[own])):
                # The whole rounds with the largest |g| of all cells, at a point of the box as well.
                pad = 2 * self._rounding(found.mag, found.mag, cell[own])
                ends[side, 0, own], ends[side, 1, own] = found.lo - pad, found.hi + pad
        first = np.flatnonzero(np.diff(row, prepend=-1))
        low, high = np.minimum.reduceat(ends[:, 0], first, axis=1), np.maximum.reduceat(ends[:, 1], first, axis=1)
        return Interval(low[0], high[0]), Interval(low[1], high[1])

    def lipschitz(self, boxes: Interval) -> Array:
        row, cell = self.cells.meeting(boxes)
        first = np.flatnonzero(np.diff(row, prepend=-1))
        own = np.maximum.reduceat(self.cells.constants[cell], first)
        slope = (self.predictor.jacobian_over(boxes).mag + own) * (1 + 1e-12)
        inner = self.cells.reach
        # γ may jump where the box reaches over the side of a cell.
        crossed = (boxes.lo[row] <= inner.lo[cell]) | (boxes.hi[row] > inner.hi[cell])
        return np.where(np.logical_or.reduceat(crossed, first)[:, None, :], np.inf, slope)

    def pieces(self, domain: Domain) -> Iterator[tuple[Interval, GapFunction]]:
        for c in np.flatnonzero(self._counts).tolist():
            yield self.cells.boxes[c : c + 1], self._inside(c)

    def _inside(self, c: int) -> EnvelopeGap:
        """The envelope that this is inside cell c, which has samples."""
        rows = self._members[self._starts[c] : self._starts[c] + self._counts[c]]
        e = self.resolution + self.cells.jumps[c] / 2
        return EnvelopeGap(self.z[rows], self.g[rows], self.cells.constants[c], e, self.predictor)

    def arrays(self) -> dict[str, Array]:
        own = {"z": self.z, "g": self.g, "L": self.cells.worst, "e": self.resolution}
        return {**own, **self.cells.arrays(), **self.predictor.arrays()}

    @property
    def form(self) -> Mapping[str, Any]:
        return {"form": "envelope", "predictor": self.predictor.kind, "cells": len(self.cells)}

    def _rounding(self, p: Array, m: Array, cell: Index) -> Array:
        return rounding(p, m, np.abs(self.g).max(axis=0), self._slack[cell], self.z.shape[1])

    def _cones(self, z: Array, cell: Index) -> tuple[Array, Array]:
        """(lower, upper), each (n, nx): the extremes of g_k ∓ Σ_j L_cij |z_j − z_kj| over the samples of each point's cell."""
        nx = self.g.shape[1]
        lower, upper = np.full((len(z), nx), -np.inf), np.full((len(z), nx), np.inf)
        rows = np.flatnonzero(self._counts[cell])
        ends = np.cumsum(self._counts[cell[rows]])
        a = 0
        while a < len(rows):
            b = max(a + 1, int(np.searchsorted(ends, (ends[a - 1] if a else 0) + _BLOCK)))
            self._extremes(z, cell, rows[a:b], lower, upper)
            a = b
        return lower, upper

    def _extremes(self, z: Array, cell: Index, rows: Index, lower: Array, upper: Array) -> None:
        c = cell[rows]
        counts = self._counts[c]
        first = np.cumsum(counts) - counts
        sample = self._members[np.arange(counts.sum()) + np.repeat(self._starts[c] - first, counts)]
        owner, constants = np.repeat(np.arange(len(rows)), counts), self.cells.constants[c]
        apart = np.abs(z[rows][owner] - self.z[sample])
        for i in range(self.g.shape[1]):
            s = np.zeros(len(sample))
            for j in range(z.shape[1]):
                s += apart[:, j] * constants[owner, i, j]
            g = self.g[sample, i]
            lower[rows, i], upper[rows, i] = np.maximum.reduceat(g - s, first), np.minimum.reduceat(g + s, first)
