"""What a straight line leaves out of F = f + p and of the gap, over a stage's box: is it as much as the tube counts?"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, final

import numpy as np

from gapcert.plugin import Array, Bools, Interval, Zone
from gapcert_verify import arithmetic as ar
from gapcert_verify.evaluator import Equations

from .gap_bounds import Gap

MOST = 400_000  # boxes that a stage's bound may be cut into
BATCH = 1 << 13  # of them at once, which a cache holds
SHRUNK = 64  # boxes over which slopes are averaged
SPARE = 1e-9  # of the frame: far below what a solver may miss a row by, which is counted as disturbance


@final
class Line:
    """x⁺ = A x + B u + d + w in the frame: is |w| ≤ c + G |F(z − ẑ)| for all z of the stage's box that Z has?

    s: the stage's arrays; frame: (middle, half); features: F (f, nz). Boxes that are cut are of y, states with inputs as the
    gap is stored in: where these are relative to the states, narrow boxes of (x, u) would be wide in them.
    """

    def __init__(
        self, s: Mapping[str, Array], frame: tuple[Array, Array], features: Array, zone: Zone, model: Equations, gap: Gap
    ) -> None:
        self.middle, self.half = frame
        self.d, self.c, self.centre = s["d"], s["c"], s["centre"]
        self.line, self.nx = np.concatenate([s["A"], s["B"]], axis=1), len(s["d"])
        self.zone, self.model, self.gap = zone, model, gap
        unit = (np.count_nonzero(features, axis=1) == 1) & (np.abs(features).max(axis=1, initial=0.0) == 1)
        self.along, self.across = s["G"][:, unit] @ np.abs(features[unit]), s["G"][:, ~unit]
        self.features = gap.stored(features[~unit] / self.half)
        self.box = self._out(Interval(s["low"][None], s["high"][None]))
        self.begin, self.steep = self._straight(Interval(s["low"], s["high"]))

    def proved(self, k: int) -> str:
        """ "" where it is; boxes are halved where the largest |w| may exceed what is counted, along what it depends on most."""
        whole = self.gap.boxes(self.box)
        # What inputs beyond their stored range mean is no question: relations of Z keep them out.
        low, high = whole.lo.copy(), whole.hi.copy()
        low[:, self.nx :] = np.maximum(low[:, self.nx :], self.gap.evidence.zone.low[self.nx :])
        high[:, self.nx :] = np.minimum(high[:, self.nx :], self.gap.evidence.zone.high[self.nx :])
        boxes, spent, least = [(low, high)], 0, 1e-12 / np.maximum(high - low, 1e-300)
        while boxes:
            low, high = boxes.pop()
            if (spent := spent + len(low)) > MOST:
                return f"stage {k}: that its bounds hold was not proved with {MOST:,} boxes"
            wrong, weight = self._wrong(Interval(low, high))
            low, high = low[wrong], high[wrong]
            if not len(low):
                continue
            if text := self._refuted(low / 2 + high / 2):
                return f"stage {k}: {text}"
            j, row = np.argmax((high - low) * (weight + least), axis=1), np.arange(len(low))
            below, above = high.copy(), low.copy()
            below[row, j] = above[row, j] = (low / 2 + high / 2)[row, j]
            parts = np.concatenate([low, above]), np.concatenate([below, high])
            boxes += [(parts[0][a : a + BATCH], parts[1][a : a + BATCH]) for a in range(0, len(parts[0]), BATCH)]
        return ""

    def _wrong(self, y: Interval) -> tuple[Bools, Array]:
        """(n,): of these boxes it is not proved; of such, how much w changes with each coordinate."""
        z, met = self._inputs(y)
        rows = np.flatnonzero(met & ~self.zone.outside(z))
        y, z = y[rows], z[rows]
        at, bent = self._model(z)
        away = self._into(z) - self._into(Interval.exact(z.mid))
        rest = self.gap.beyond(y, z) / Interval.exact(self.half[: self.nx])
        left = at + (bent * away[:, None]).sum(-1) + rest
        near, across = abs(self._into(z) - self.centre), self._across(y).lo
        # Of |J̄ − line| |z − ẑ| as much is counted as G has along the axes; the rest of G is left to the gap.
        more = self.along - self.steep
        gain = near.lo @ np.maximum(more, 0.0).T - near.hi @ np.maximum(-more, 0.0).T
        right = left.mag <= self.c + near.lo @ self.along.T + across + SPARE
        right |= (self.begin + rest).mag <= self.c + gain + across + SPARE
        some = ~right.all(axis=1)
        wrong, weight = np.zeros(len(met), dtype=bool), np.nan_to_num(bent.mag[some], nan=1e6, posinf=1e6) / self.half
        wrong[rows[some]] = True
        if self.gap.relative is not None:
            weight[..., self.nx :] /= np.abs(self.gap.relative.scale)
        if self.gap.left is not None:
            weight = weight + self.gap.left / self.half[: self.nx, None]
        return wrong, weight.max(axis=1)

    def _straight(self, ends: Interval) -> tuple[Interval, Array]:
        """(begin (nx,), steep (nx, nz)): |w| ≤ |begin + rest| + steep |z − ẑ| in the box, rest being what p leaves at z.

        F(z) − F(ẑ) = J̄ (z − ẑ) with J̄ in the mean of F′ over the box shrunk to m/M about ẑ, m = 1 … M.
        """
        z = Interval.exact(self._out(Interval.exact(self.centre[None])).mid)
        begin = self._model(z)[0][0]
        if not ((ends.lo <= self.centre) & (self.centre <= ends.hi)).all():
            return begin, np.full(self.line.shape, np.inf)
        shrunk = z + Interval.hull(self.box - z, 0.0) * ((np.arange(SHRUNK) + 1) / SHRUNK)[:, None]
        steep = (self._model(shrunk)[1].sum(0) / float(SHRUNK)).mag
        # z is ẑ as near as floats are.
        return begin + Interval.around(0.0, steep @ abs(self._into(z) - self.centre).hi[0]), steep

    def _refuted(self, y: Array) -> str:
        """Points at which more is left out for certain."""
        z = self._inputs(Interval.exact(y))[0].mid
        z = z[(z >= self.box.lo).all(axis=1) & (z <= self.box.hi).all(axis=1) & self.zone.related(z)]
        exact = Interval.exact(z)
        own = self.gap.boxes(exact)
        left = self._model(exact)[0] + self.gap.beyond(own, exact) / Interval.exact(self.half[: self.nx])
        room = self.c + abs(self._into(exact) - self.centre).hi @ self.along.T + self._across(own).hi
        over = np.argwhere(np.maximum(left.lo, -left.hi) > room + 2 * SPARE)
        if not len(over):
            return ""
        return f"at {z[over[0, 0]].tolist()} state {over[0, 1]} goes farther from the line than the tube counts"

    def _model(self, z: Interval) -> tuple[Interval, Interval]:
        """(at (n, nx), bent (n, nx, nz)): F − line at the boxes' middles, and F′ − line in them, in the frame."""
        point = Interval.exact(z.mid)
        slope, offset = self.gap.affine
        values, bent = list[Interval](), list[Interval]()
        for k in range(self.nx):
            f = ar.known(self.model.over(point.lo, point.hi, self.model.terms[k]))
            J = ar.known(self.model.slopes(z.lo, z.hi, self.model.terms[k]))
            p = (point * Interval.exact(slope[k])).sum(-1) + float(offset[k])
            value = (Interval(*f) + p - float(self.middle[k])) / float(self.half[k])
            values.append(value - ((self._into(point) * Interval.exact(self.line[k])).sum(-1) + float(self.d[k])))
            own = (Interval(*J) + Interval.exact(slope[k])) * Interval.exact(self.half) / float(self.half[k])
            bent.append(own - Interval.exact(self.line[k]))
        return Interval.stack(values, axis=1), Interval.stack(bent, axis=1)

    def _across(self, y: Interval) -> Interval:
        """Contains Σ_f G_f |F_f (z − ẑ)| of the features that are no axes, (n, nx); F of y rounds far below SPARE."""
        at = self.gap.boxes(self._out(Interval.exact(self.centre[None])))
        far = abs(((y - at)[:, None] * Interval.exact(self.features)).sum(-1))
        return Interval(far.lo @ self.across.T, far.hi @ self.across.T)

    def _inputs(self, y: Interval) -> tuple[Interval, Any]:
        """(boxes of (x, u) within the stage's that contain those of y, (n,): is there any)."""
        z, c = y, self.gap.relative
        if c is not None:
            u = (y[:, self.nx :] - (y[:, None, : self.nx] * Interval.exact(c.slope)).sum(-1)) / Interval.exact(c.scale)
            z = Interval.concatenate([y[:, : self.nx], u], axis=1)
        low, high = np.maximum(z.lo, self.box.lo), np.minimum(z.hi, self.box.hi)
        return Interval(np.minimum(low, high), np.maximum(low, high)), (low <= high).all(axis=1)

    def _out(self, zeta: Interval) -> Interval:
        return Interval.exact(self.middle) + zeta * Interval.exact(self.half)

    def _into(self, z: Interval) -> Interval:
        return (z - self.middle) / Interval.exact(self.half)
