"""The envelope: the tightest band that samples and Lipschitz constants allow (McShane–Whitney), per axis and signed.

Constants hold on the whole domain, or per convex cell: then each cell has those of the samples in its closure alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any, final

import numpy as np

from gapcert.plugin import (
    AffinePredictor,
    Array,
    Cells,
    Domain,
    GapFamily,
    GapFunction,
    GapProblem,
    Interval,
    Ints,
    Predictor,
    UsageError,
)

from .cone import Cones
from .multilinear import made

_EPS = float(np.finfo(np.float64).eps)
_TINY = float(np.finfo(np.float64).tiny)
_BLOCK = 1 << 18  # cones that are looked at together

Ends = Callable[["EnvelopeGap", Interval], tuple[Interval, Interval]]


@final
class EnvelopeGap(GapFunction):
    """u_i(z) = p_i(z) + min_k g_ki + Σ_j L_ij |z_j − z_kj| + 2 e_i, and its mirror l_i.

    z (N, nz) and g (N, nx) are samples of the remainder r − p, lipschitz (nx, nz) its constants, resolution (nx,) the bound on
    the error of a computed remainder. Where two samples refute the constants, u < l between them: no residual passes there.
    """

    family = "envelope"
    predictor: Predictor

    def __init__(self, z: Array, g: Array, lipschitz: Array, resolution: Array, predictor: Predictor) -> None:
        self.z, self.g, self.lipschitz_values, self.resolution, self.predictor = z, g, lipschitz, resolution, predictor
        self._cones = Cones(z, g, lipschitz)
        self._one: dict[int, Cones] = {}
        moves = lipschitz.any(axis=0)
        slope = predictor.arrays().get("slope") if predictor.kind in ("none", "affine") else np.ones_like(lipschitz)
        self._active = np.flatnonzero(moves if slope is None else moves | slope.any(axis=0))
        self.rounded_with(np.abs(g).max(axis=0))

    def rounded_with(self, largest: Array) -> None:
        """The pad for rounding is that of samples up to `largest` (nx,)."""
        p, self._largest = self.predictor, largest
        affine = (p.offset, p.slope) if isinstance(p, AffinePredictor) else ()
        self._numbers = [part.tolist() for part in (*affine, largest, 2 * self.resolution)]

    def interval(self, z: Array) -> tuple[Array, Array]:
        if len(z) == 1 and len(self._numbers) == 4:
            return self._one_row(z[0])
        lower, upper = self._cones(z)
        p = self.predictor(z)
        low = p + lower - 2 * self.resolution - self._rounding(p, lower)
        return low, p + upper + 2 * self.resolution + self._rounding(p, upper)

    def _one_row(self, z: Array) -> tuple[Array, Array]:
        """`interval` of one point (nz,), to the same bits: beyond the cones there is too little to do for arrays."""
        values, low, high = z.tolist(), [], []
        lower, upper = self._cones.one_row(z)
        factor = (2 * len(values) + 8) * _EPS
        for p, slope, largest, slack, a, b in zip(*self._numbers, lower.tolist(), upper.tolist(), strict=True):
            for value, c in zip(values, slope, strict=True):
                p += value * c
            low.append(p + a - slack - (factor * (abs(p) + abs(a) + 2 * largest + slack) + _TINY))
            high.append(p + b + slack + (factor * (abs(p) + abs(b) + 2 * largest + slack) + _TINY))
        return np.array([low]), np.array([high])

    def gamma_of(self, boxes: Interval, i: int) -> Array:
        # |z_j − z_kj| ≤ |c_j − z_kj| + h_j over a box: the band at its centre c, widened by Σ_j L_ij h_j, holds for all of it.
        one = slice(i, i + 1)
        if i not in self._one:
            self._one[i] = Cones(self.z, self.g[:, one], self.lipschitz_values[one])
        lower, upper = self._one[i](boxes.mid)
        reach = (Interval.exact(boxes.rad)[:, None, :] * Interval.exact(self.lipschitz_values[one])).sum(-1).hi
        p, e = self.predictor.over(boxes)[:, one], self.resolution[one]
        # Twice: for rounding here, and for the rounding that `interval` adds at a point of the box.
        low, high = (2 * self._rounding(p.mag, np.abs(m) + reach, one) for m in (lower, upper))
        low, high = p.lo + (lower - reach) - 2 * e - low, p.hi + (upper + reach) + 2 * e + high
        return Interval.hull(low, high).mag[:, 0]

    def interval_over(self, boxes: Interval) -> Interval:
        return Interval.hull(*self.ends_over(boxes))  # where constants are refuted the ends may cross

    def ends_over(self, boxes: Interval) -> tuple[Interval, Interval]:
        if len(self._active) == self.z.shape[1] or len(boxes) < 2:
            return self._ends(boxes)
        # Boxes that differ only along axes on which nothing depends share one answer.
        ends = np.concatenate([boxes.lo[:, self._active], boxes.hi[:, self._active]], axis=1)
        _, first, same = np.unique(ends, axis=0, return_index=True, return_inverse=True)
        low, high = self._ends(boxes[first])
        return low[same.reshape(-1)], high[same.reshape(-1)]

    def remainder_ends_over(self, boxes: Interval) -> tuple[Interval, Interval]:
        # What is added at a point of the box is rounded in the size of p, which then is subtracted.
        size = self.predictor.over(boxes).mag
        pad = 4 * self._rounding(size, size) + self.predictor.error_over(boxes)
        low, high = self._tilted(boxes, *(Interval.exact(np.zeros((*size.shape, *k))) for k in ((), boxes.shape[1:])))
        return Interval(low.lo - pad, low.hi + pad), Interval(high.lo - pad, high.hi + pad)

    def _ends(self, boxes: Interval) -> tuple[Interval, Interval]:
        return self._tilted(boxes, self.predictor.over(Interval.exact(boxes.mid)), self.predictor.jacobian_over(boxes))

    def _tilted(self, boxes: Interval, p: Interval, slope: Interval) -> tuple[Interval, Interval]:
        """The ends around what is p at the boxes' centres and has these slopes over them: cones are tilted with its slope
        before they are bounded, so that what both share cancels.
        """
        centre, h = boxes.mid, boxes.rad
        lower, upper = self._cones(centre)
        reach, bent, tilt = (
            (Interval.exact(a) * Interval.exact(h)[:, None, :]).sum(-1).hi
            for a in (self.lipschitz_values, slope.rad, slope.mag)
        )
        # What `gamma_of` has, twice: sums of ends, and of several cones, round more often.
        pad = 4 * self._rounding(p.mag + tilt, np.maximum(np.abs(lower), np.abs(upper)) + reach)
        # What is added to the band in any case is not worth a cut.
        tops, least = [], (2 * self.resolution).tolist()
        for sign in (-1, 1):
            found = [self._cones.crest(i, sign, centre, h, sign * slope.mid[:, i], e) for i, e in enumerate(least)]
            tops.append(np.stack(found, axis=1) + bent + 2 * self.resolution + pad)
        least, most = p.lo + upper - reach - tilt - pad, p.hi + lower + reach + tilt + pad
        low, high = p.lo - tops[0], p.hi + tops[1]
        return Interval(low, np.maximum(low, most)), Interval(np.minimum(high, least), high)

    def _rounding(self, p: Array, m: Array, states: slice = slice(None)) -> Array:
        return rounding(p, m, self._largest[states], 2 * self.resolution[states], self.z.shape[1])

    def lipschitz(self, boxes: Interval) -> Array:
        slope = self.predictor.jacobian_over(boxes).mag
        return np.asarray((slope + self.lipschitz_values) * (1 + 1e-12))

    def arrays(self) -> dict[str, Array]:
        return {"z": self.z, "g": self.g, "L": self.lipschitz_values, "e": self.resolution, **self.predictor.arrays()}

    @property
    def form(self) -> Mapping[str, Any]:
        return {"form": "envelope", "predictor": self.predictor.kind}


def rounding(p: Array, m: Array, largest: Array, slack: Array, nz: int) -> Array:
    """What a computed band may err by: p and m (n, nx) are its predictor and cones, largest = max |g|, slack is added."""
    # A cone S + g with S = Σ_j L_j |Δ_j| takes 2 nz + 1 roundings of terms ≤ S + |g|, and S ≤ |m| + |g|; g itself came from
    # one subtraction, and adding p, the slack and this pad takes four more, of terms ≤ |p| + |m| + slack.
    size = np.abs(p) + np.abs(m) + 2 * largest + slack
    return np.asarray((2 * nz + 8) * _EPS * size + _TINY)


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
        self._nodes = list(zip(cells.axis.tolist(), cells.cut.tolist(), cells.child.tolist(), strict=True))
        self._single: dict[int, EnvelopeGap] = {}

    def interval(self, z: Array) -> tuple[Array, Array]:
        if len(z) == 1 and (one := self._around(z[0].tolist())) is not None:
            return one.interval(z)
        cell = self.cells.locate(z)
        lower, upper = self._cones(z, cell)
        p, slack = self.predictor(z), self._slack[cell]
        return p + lower - slack - self._rounding(p, lower, cell), p + upper + slack + self._rounding(p, upper, cell)

    def _around(self, z: list[float]) -> EnvelopeGap | None:
        """What answers at one point as the whole does, to the same bits; None in a cell without samples."""
        k = 0 if self._nodes else -1
        while k >= 0:
            axis, cut, child = self._nodes[k]
            k = child[z[axis] > cut]
        if (cell := -1 - k) not in self._single and self._counts[cell]:
            self._single[cell] = self._inside(cell)
            self._single[cell].rounded_with(np.abs(self.g).max(axis=0))
        return self._single.get(cell)

    def interval_over(self, boxes: Interval) -> Interval:
        return Interval.hull(*self.ends_over(boxes))

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
        return EnvelopeGap(self.z[rows], self.g[rows], self.cells.constants[c], self._slack[c] / 2, self.predictor)

    def arrays(self) -> dict[str, Array]:
        own = {"z": self.z, "g": self.g, "L": self.cells.worst, "e": self.resolution}
        return {**own, **self.cells.arrays(), **self.predictor.arrays()}

    @property
    def form(self) -> Mapping[str, Any]:
        return {"form": "envelope", "predictor": self.predictor.kind, "cells": len(self.cells)}

    def _rounding(self, p: Array, m: Array, cell: Ints) -> Array:
        return rounding(p, m, np.abs(self.g).max(axis=0), self._slack[cell], self.z.shape[1])

    def _cones(self, z: Array, cell: Ints) -> tuple[Array, Array]:
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

    def _extremes(self, z: Array, cell: Ints, rows: Ints, lower: Array, upper: Array) -> None:
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


@final
class Envelope(GapFamily):
    """Family `envelope`. `predictor`: "none", "affine", a Predictor, or an extended model."""

    name = "envelope"
    routes = ("dominate",)

    def __init__(self, predictor: Any = "affine") -> None:
        self.predictor = made(predictor)

    def fit(self, problem: GapProblem) -> GapFunction:
        if len(problem.samples) == 0:
            raise UsageError("envelope: there are no samples; give at least one")
        z, g, e = problem.samples.z, problem.remainder, problem.remainder_resolution
        if (cells := problem.lipschitz.cells) is not None:
            return PiecewiseEnvelope(z, g, cells, e, problem.predictor)
        return EnvelopeGap(z, g, problem.lipschitz.value, e, problem.predictor)
