"""Curvature proved by intervals: on the whole domain, and in slabs of each axis."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from gapcert import Array, Interval, Model
from gapcert.plugin import LipschitzBound, LipschitzProblem
from gapcert_bounds.thresholds import THRESHOLDS

Index = npt.NDArray[np.intp]


def proved(problem: LipschitzProblem, fhat: Model, whole: LipschitzBound, slabs: int, most: int) -> LipschitzBound:
    """`whole` with |∂²g_i/∂z_j²| on Z and in up to so many slabs of every axis; about so many boxes per axis.

    ∞ in a slab that may hold a kink, and along axes that are held.
    """
    parts = max(THRESHOLDS.curvature_parts, 4 * slabs)
    domain, columns, cut = problem.domain, list[Array](), list[tuple[Array, Array] | None]()
    for j, (low, high) in enumerate(zip(domain.low, domain.high, strict=True)):
        if j in problem.held:
            columns.append(np.full(domain.nx, np.inf))
            cut.append(None)
            continue
        cuts, width = np.linspace(low, high, parts + 1), domain.width[j]
        slight = THRESHOLDS.slight_curvature * whole.value[:, j] / width + problem.resolution / width**2
        found = _Search(problem, fhat, j, cuts, slight).run(max(1, most // parts))
        cuts, found = merged(cuts, found, whole.value[:, j], slabs)
        columns.append(found.max(axis=1))
        cut.append((cuts, found) if len(cuts) > 2 else None)
    several = tuple(cut) if any(c is not None for c in cut) else None
    return replace(whole, curvature=np.stack(columns, axis=1), slabs=several)


def merged(cuts: Array, found: Array, slope: Array, slabs: int) -> tuple[Array, Array]:
    """Neighbouring parts put together to at most so many slabs, those that make Σ size H^(1/3) least, and to fewer where that
    loses little: with nodes as dense as H^(1/3), what an interpolation misses follows its cube."""
    n, size = found.shape[1], np.diff(cuts)
    # Where there is no curvature the constant serves.
    weight = np.where(np.isinf(found), 4 * slope[:, None] / size, found)
    weight = weight / np.maximum(weight.max(axis=1, keepdims=True), np.finfo(float).tiny)
    price = np.full((n + 1, n + 1), np.inf)  # of a slab from one cut to another
    for a in range(n):
        price[a, a + 1 :] = np.cbrt(np.maximum.accumulate(weight[:, a:], axis=1).sum(axis=0)) * (cuts[a + 1 :] - cuts[a])
    best, before = [price[0]], [np.zeros(n + 1, dtype=np.intp)]
    for _ in range(1, min(slabs, n)):
        total = best[-1][:, None] + price
        best.append(total.min(axis=0))
        before.append(total.argmin(axis=0))
    costs = np.array([b[n] for b in best])
    ends = [n]
    for k in reversed(range(int(np.argmax(costs <= costs.min() * (1 + THRESHOLDS.slab_cost))) + 1)):
        ends.append(int(before[k][ends[-1]]))
    ends = ends[::-1]
    return cuts[ends], np.maximum.reduceat(found, ends[:-1], axis=1)


class _Search:
    """Boxes of all slabs of axis j, bisected where they hold the largest bound of their slab."""

    def __init__(self, problem: LipschitzProblem, fhat: Model, j: int, cuts: Array, slight: Array) -> None:
        self.problem, self.fhat, self.j = problem, fhat, j
        domain, n = problem.domain, len(cuts) - 1
        low, high = (np.tile(end, (n, 1)) for end in (domain.low, domain.high))
        low[:, j], high[:, j] = cuts[:-1], cuts[1:]
        self.boxes, self.slab = Interval(low, high), np.arange(n)
        self.width = high[0] - low[0]
        self.bound = self._bend(self.boxes).mag
        self.reached = np.tile(slight, (n, 1))
        self._meet(self.boxes, self.slab)

    def run(self, most: int) -> Array:
        """(nx, slabs): the largest bound in each slab, of at most so many boxes."""
        while True:
            chosen = self._chosen(most)
            if not len(chosen):
                out = np.zeros(self.reached.shape)
                np.maximum.at(out, self.slab, self.bound)
                return out.T
            halves, bound = self._halved(chosen)
            keep = np.delete(np.arange(len(self.boxes)), chosen)
            slab = np.tile(self.slab[chosen], 2)
            self._meet(halves, slab)
            self.boxes = Interval.concatenate([self.boxes[keep], halves])
            self.bound = np.concatenate([self.bound[keep], bound])
            self.slab = np.concatenate([self.slab[keep], slab])

    def _bend(self, boxes: Interval) -> Interval:
        """∂²(f̂ − f − p)/∂z_j² over boxes, (n, nx)."""
        p, j = self.problem, self.j
        known = self.fhat.curvature_enclosure(boxes, j) - p.model.curvature_enclosure(boxes, j)
        return known - p.predictor.curvature_over(boxes, j)

    def _meet(self, boxes: Interval, slab: Index) -> None:
        """Second derivatives that occur in the slabs for certain, at centres of boxes."""
        np.maximum.at(self.reached, slab, abs(self._bend(Interval.exact(boxes.mid))).lo)

    def _loose(self) -> Array:
        """(boxes, nx): bounds relative to the largest in their slab; 0 where they need not become smaller."""
        top = np.zeros(self.reached.shape)
        np.maximum.at(top, self.slab, self.bound)
        top, enough = top[self.slab], (self.reached * (1 + THRESHOLDS.curvature_near))[self.slab]
        share = np.divide(self.bound, top, out=np.ones_like(top), where=np.isfinite(top) & (top > 0))
        # Where one box of a slab has no bound, the others need none.
        share = np.where(np.isinf(top) & np.isfinite(self.bound), 0.0, share)
        return np.where(self.bound > enough, share, 0.0)

    def _chosen(self, most: int) -> Index:
        """The most urgent boxes of each slab, half as many as it has, as long as it has room."""
        urgency = self._loose().max(axis=1)
        count = np.bincount(self.slab, minlength=len(self.reached))
        room = np.clip(most - count, 0, np.maximum(1, count // 2))
        order = np.lexsort((-urgency, self.slab))
        rank = np.arange(len(order)) - np.searchsorted(self.slab[order], self.slab[order])
        chosen: Index = order[(rank < room[self.slab[order]]) & (urgency[order] > 0)]
        return chosen

    def _halved(self, chosen: Index) -> tuple[Interval, Array]:
        """(halves, their bounds), each box cut along the axis that gains most; along its widest where none gains."""
        boxes, bound, loose = self.boxes[chosen], self.bound[chosen], self._loose()[chosen]
        best, rows = np.full(len(chosen), np.inf), np.arange(len(chosen))
        axis, values = np.zeros(len(chosen), dtype=np.intp), np.zeros((2, *bound.shape))
        for k in range(boxes.lo.shape[1]):
            found = np.minimum(self._bend(boxes.cut(np.full(len(rows), k))).mag.reshape(2, *bound.shape), bound)
            left = np.divide(found, bound, out=np.ones_like(found), where=np.isfinite(bound) & (bound > 0))
            left = np.where(np.isinf(bound) & np.isfinite(found), 0.0, left)
            cost = np.round((left.mean(axis=0) * loose).sum(axis=1), 9) - 1e-9 * (boxes.width / self.width)[:, k]
            better = cost < best
            best, axis, values = (
                np.where(better, cost, best),
                np.where(better, k, axis),
                np.where(better[:, None], found, values),
            )
        return boxes.cut(axis), values.reshape(-1, bound.shape[1])
