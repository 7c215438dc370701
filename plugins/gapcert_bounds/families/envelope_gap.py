"""The envelope: the tightest band that samples and Lipschitz constants allow (McShane–Whitney), per axis and signed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, final

import numpy as np

from gapcert import Array, GapFunction, Interval
from gapcert.plugin import Predictor

from .cone import Cones

_EPS = float(np.finfo(np.float64).eps)
_TINY = float(np.finfo(np.float64).tiny)


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
        self._largest = np.abs(g).max(axis=0)

    def interval(self, z: Array) -> tuple[Array, Array]:
        lower, upper = self._cones(z)
        p = self.predictor(z)
        low = p + lower - 2 * self.resolution - self._rounding(p, lower)
        return low, p + upper + 2 * self.resolution + self._rounding(p, upper)

    def gamma_of(self, boxes: Interval, i: int) -> Array:
        if i not in self._one:
            part = slice(i, i + 1)
            self._one[i] = Cones(self.z, self.g[:, part], self.lipschitz_values[part])
        return self._over(boxes, self._one[i](boxes.mid), slice(i, i + 1)).mag[:, 0]

    def interval_over(self, boxes: Interval) -> Interval:
        low, high = self.ends_over(boxes)
        # Where constants are refuted the ends may cross.
        return Interval(np.minimum(low.lo, high.lo), np.maximum(low.hi, high.hi))

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
        # What `_over` has, twice: sums of ends, and of several cones, round more often.
        pad = 4 * self._rounding(p.mag + tilt, np.maximum(np.abs(lower), np.abs(upper)) + reach)
        # What is added to the band in any case is not worth a cut.
        tops, least = [], (2 * self.resolution).tolist()
        for sign in (-1, 1):
            found = [self._cones.crest(i, sign, centre, h, sign * slope.mid[:, i], e) for i, e in enumerate(least)]
            tops.append(np.stack(found, axis=1) + bent + 2 * self.resolution + pad)
        least, most = p.lo + upper - reach - tilt - pad, p.hi + lower + reach + tilt + pad
        low, high = p.lo - tops[0], p.hi + tops[1]
        return Interval(low, np.maximum(low, most)), Interval(np.minimum(high, least), high)

    def _over(self, boxes: Interval, cones: tuple[Array, Array], states: slice) -> Interval:
        """The band of some states over boxes, from their cones at the boxes' centres.

        Over a box |z_j − z_kj| ≤ |c_j − z_kj| + h_j, so the band at its centre c widened by Σ_j L_ij h_j holds for all of it.
        """
        lower, upper = cones
        reach = (Interval.exact(boxes.rad)[:, None, :] * Interval.exact(self.lipschitz_values[states])).sum(-1).hi
        p, e = self.predictor.over(boxes)[:, states], self.resolution[states]
        # Twice: for rounding here, and for the rounding that `interval` adds at a point of the box.
        low, high = (2 * self._rounding(p.mag, np.abs(m) + reach, states) for m in (lower, upper))
        low, high = p.lo + (lower - reach) - 2 * e - low, p.hi + (upper + reach) + 2 * e + high
        return Interval(np.minimum(low, high), np.maximum(low, high))

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
