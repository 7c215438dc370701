"""The largest value of γ on a domain, proved by branch and bound."""

from __future__ import annotations

import numpy as np

from gapcert.domain import Domain
from gapcert.gap import GapFunction
from gapcert.intervals import Interval
from gapcert.system import Array

_BATCH = 2048
_PROBES = 64


def supremum(gap: GapFunction, domain: Domain, tolerance: float = 1e-3, budget: int = 200_000) -> tuple[Array, Array]:
    """(upper, lower), each (nx,): lower_i = a value that γ_i takes, upper_i ≥ sup_Z γ_i, and upper ≤ (1 + tolerance) lower.

    The boxes with the largest bounds are split first. Where `budget` boxes (per state) are spent before, upper is still proved,
    only less tight.
    """
    found = [_supremum(gap, domain, i, tolerance, budget) for i in range(domain.nx)]
    return np.array([upper for upper, _ in found]), np.array([lower for _, lower in found])


def _supremum(gap: GapFunction, domain: Domain, i: int, tolerance: float, budget: int) -> tuple[float, float]:
    # One state at a time: cells that one state needs small would only multiply the work of the others.
    boxes = domain.interval
    bound, lower, settled = gap.gamma_over(boxes)[:, i], _reached(gap, domain, boxes, i), 0.0
    spent = 1
    while True:
        # A box that cannot raise the answer by more than the tolerance is settled; its bound stays in the answer.
        pending = bound > lower * (1 + tolerance)
        settled = max(settled, bound[~pending].max(initial=0.0))
        boxes, bound = boxes[pending], bound[pending]
        if not len(boxes) or spent >= budget:
            return max(settled, bound.max(initial=0.0)), lower
        order = np.argsort(-bound, kind="stable")
        first, rest = order[:_BATCH], order[_BATCH:]
        halves = split(boxes[first], gap.lipschitz(boxes[first])[:, i])
        spent += len(halves)
        # A half lies inside its parent, so the parent's bound holds for it as well.
        tighter = np.minimum(gap.gamma_over(halves)[:, i], np.tile(bound[first], 2))
        lower = max(lower, _reached(gap, domain, halves[np.argsort(-tighter)[:_PROBES]], i))
        boxes, bound = Interval.concatenate([boxes[rest], halves]), np.concatenate([bound[rest], tighter])


def split(boxes: Interval, weight: Array) -> Interval:
    """Each box cut in two across the axis with the largest weight_j · width_j; weight (n, nz); the lower halves come first."""
    axis = (weight * (boxes.hi - boxes.lo)).argmax(axis=1)
    rows = np.arange(len(boxes))
    low, high = boxes.lo.copy(), boxes.hi.copy()
    low[rows, axis] = high[rows, axis] = boxes.mid[rows, axis]
    return Interval.concatenate([Interval(boxes.lo, high), Interval(low, boxes.hi)])


def _reached(gap: GapFunction, domain: Domain, boxes: Interval, i: int) -> float:
    """The largest γ_i over the centres and those corners that are farthest from the domain's centre, where most gaps peak."""
    corners = np.where(boxes.mid >= domain.interval.mid, boxes.hi, boxes.lo)
    return float(gap.gamma(np.concatenate([boxes.mid, corners]))[:, i].max())
