"""Set membership: which parameters may have made a step, given that the gap holds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np

from gapcert import Array, Interval
from gapcert.plugin import Bools
from gapcert_mpc.thresholds import THRESHOLDS

from .parameters import Family, tiled

TURN = Interval(np.nextafter(2 * np.pi, 0.0), np.nextafter(2 * np.pi, 7.0))


@final
@dataclass(frozen=True)
class Membership:
    """Θ ∩ {θ : x⁺ − f(x, u; θ) ∈ [l, u](x, u)} in boxes, rounded outwards.

    Interval Newton steps in each of the boxes that Θ is cut into: f(z; θ) ∈ f(z; c) + J (θ − c) with J ⊇ ∂f/∂θ over the box, so
    that row i gives θ_j ∈ c_j + (T_i − f_i(z; c) − Σ_{k≠j} J_ik (θ_k − c_k)) / J_ij, where T = x⁺ − [l, u](z). No θ that solves
    it is ever lost: what is dropped lies outside all rows' sets.
    """

    family: Family

    def updated(self, x: Array, u: Array, after: Array, theta: Interval) -> tuple[Interval, Bools]:
        """(Θ⁺ (n, nθ), refuted (n,)) after steps from x under u to `after`, row by row; refuted: no θ ∈ Θ makes the step, and Θ
        stays. Where (x, u) lies outside Z nothing is claimed, and Θ stays as well.
        """
        z, low, high = self._gap(x, u)
        known = self.family.problem.domain.zone.contains(z.mid)
        values = self.family.values(z, theta)
        # T, where f(z; θ*) lies.
        goal = self._turned(after, values.mid) - Interval(low, high)
        rows = np.flatnonzero(known & ~goal.contains(values).all(axis=1))
        lo, hi, refuted = theta.lo.copy(), theta.hi.copy(), np.zeros(len(x), dtype=bool)
        if len(rows):
            found, refuted[rows] = self._cut(z[rows], goal[rows], theta[rows])
            lo[rows], hi[rows] = found.lo, found.hi
        return Interval(lo, hi), refuted

    def _gap(self, x: Array, u: Array) -> tuple[Interval, Array, Array]:
        """z, on the turn on which the gap is known, and l and u there."""
        domain, gap = self.family.problem.domain, self.family.problem.gap
        assert gap is not None, "without a gap nothing is to be learned"
        z, nx = np.hstack([x, u]), x.shape[1]
        moved = self._turned(x, (domain.low[:nx] + domain.high[:nx]) / 2)
        boxes = Interval(np.hstack([moved.lo, u]), np.hstack([moved.hi, u]))
        low, high = (np.array(end) for end in gap.interval(z))
        turned = (boxes.lo < boxes.hi).any(axis=1)
        if turned.any():
            over = gap.interval_over(boxes[turned])
            low[turned], high[turned] = over.lo, over.hi
        return boxes, low, high

    def _turned(self, x: Array, near: Array) -> Interval:
        """States (n, nx), angles by the turn that is nearest to `near`."""
        angles = np.array([s.kind == "angle" for s in self.family.problem.model.states])
        turns = np.where(angles, np.round((x - near) / (2 * np.pi)), 0.0)
        moved = Interval.exact(x) - TURN * turns
        return Interval(np.where(turns != 0, moved.lo, x), np.where(turns != 0, moved.hi, x))

    def _cut(self, z: Interval, goal: Interval, theta: Interval) -> tuple[Interval, Bools]:
        """Hulls of what is left of the parts; a second time in those that are much smaller."""
        lo, hi, refuted = theta.lo.copy(), theta.hi.copy(), np.zeros(len(z), dtype=bool)
        rows = np.arange(len(z))
        for _ in range(2):
            old = Interval(lo[rows], hi[rows])
            new, empty = self._narrowed(z[rows], goal[rows], old)
            refuted[rows] |= empty
            lo[rows], hi[rows] = np.where(empty[:, None], old.lo, new.lo), np.where(empty[:, None], old.hi, new.hi)
            rows = rows[~empty & (hi[rows] - lo[rows] < 0.7 * (old.hi - old.lo)).any(axis=1)]
            if not len(rows):
                break
        # What was refuted in the second round began as it was given.
        lo[refuted], hi[refuted] = theta.lo[refuted], theta.hi[refuted]
        return Interval(lo, hi), refuted

    def _narrowed(self, z: Interval, goal: Interval, theta: Interval) -> tuple[Interval, Bools]:
        n, q = theta.shape
        parts = list(tiled(theta, max(1, int(THRESHOLDS.membership_boxes ** (1 / q) + 1e-9))))
        # Parts one after the other, in each of them all rows.
        again = np.tile(np.arange(n), len(parts))
        boxes = Interval(np.concatenate([a for a, _ in parts]), np.concatenate([b for _, b in parts]))
        lo, hi, left = self._newton(z[again], goal[again], boxes)
        shape = (len(parts), n, q)
        keep = left.reshape(len(parts), n, 1)
        least = np.where(keep, lo.reshape(shape), np.inf).min(axis=0)
        most = np.where(keep, hi.reshape(shape), -np.inf).max(axis=0)
        empty = np.asarray(~keep.any(axis=0))[:, 0]
        return Interval(np.where(empty[:, None], theta.lo, least), np.where(empty[:, None], theta.hi, most)), empty

    def _newton(self, z: Interval, goal: Interval, theta: Interval) -> tuple[Array, Array, Bools]:
        """One sweep over rows and parameters: (low, high, left), where left (n,) says that the box may hold a solution."""
        c = theta.mid
        rest, slopes = goal - self.family.values(z, Interval.exact(c)), self.family.slopes(z, theta)
        lo, hi, left = theta.lo.copy(), theta.hi.copy(), np.ones(len(c), dtype=bool)
        for i in range(rest.shape[1]):
            row = slopes[:, i]
            for j in range(c.shape[1]):
                others = [k for k in range(c.shape[1]) if k != j]
                apart = (row[:, others] * (Interval(lo[:, others], hi[:, others]) - c[:, others])).sum(-1)
                able = rest[:, i] - apart
                # A slope that may be 0 divides into the whole line; the row may be impossible all the same.
                reach = row[:, j] * (Interval(lo[:, j], hi[:, j]) - c[:, j])
                left &= (reach.lo <= able.hi) & (able.lo <= reach.hi)
                found = able / row[:, j] + c[:, j]
                least, most = np.maximum(lo[:, j], found.lo), np.minimum(hi[:, j], found.hi)
                left &= least <= most
                lo[:, j], hi[:, j] = np.where(left, least, lo[:, j]), np.where(left, most, hi[:, j])
        return lo, hi, left
