"""The largest value of γ on a domain, proved by branch and bound."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np

from gapcert.certification.thresholds import THRESHOLDS
from gapcert.contracts.gaps.gap import GapFunction
from gapcert.contracts.plugins.events import Pulse
from gapcert.contracts.systems.domain import Domain
from gapcert.numerics.arrays import Array
from gapcert.numerics.intervals import Interval


def supremum(
    gap: GapFunction,
    domain: Domain,
    tolerance: float = 1e-3,
    budget: int = 200_000,
    states: Sequence[int] | None = None,
    pulse: Pulse | None = None,
) -> tuple[Array, Array]:
    """(upper, lower), each (nx,): lower_i = a value that γ_i takes, upper_i ≥ sup_Z γ_i, and upper ≤ (1 + tolerance) lower.

    The boxes with the largest bounds are split first; those that do not meet Z are left out. Where `budget` boxes (per state)
    are spent before, upper is still proved, only less tight. `states` limits the answer to some states, in that order.
    `pulse` is told how many boxes were looked at, and by how much upper is still above lower.
    """
    seen = _Seen(pulse, [s.name for s in domain.states.axes])
    pieces = [(box, piece) for box, piece in gap.pieces(domain) if not domain.outside(box)[0]]
    first = np.concatenate([piece.gamma_over(box) for box, piece in pieces])
    wanted = range(domain.nx) if states is None else states
    found = [_over_pieces(pieces, first[:, i], domain, i, tolerance, budget, seen) for i in wanted]
    return np.array([upper for upper, _ in found]), np.array([lower for _, lower in found])


@final
@dataclass
class _Seen:
    """What a search tells: all boxes of all states so far, and the excess of the one that it is at."""

    pulse: Pulse | None
    names: Sequence[str]
    boxes: int = 0

    def add(self, count: int, i: int, upper: float, lower: float) -> None:
        self.boxes += count
        if self.pulse is not None:
            excess = upper / lower - 1 if lower > 0 else np.inf
            self.pulse(self.boxes, {f"γ of {self.names[i]}": upper, "proved to within": f"{excess:.2%}"})


def _over_pieces(
    pieces: Sequence[tuple[Interval, GapFunction]],
    first: Array,
    domain: Domain,
    i: int,
    tolerance: float,
    budget: int,
    seen: _Seen,
) -> tuple[float, float]:
    upper, lower = 0.0, 0.0
    # Largest bounds first: what those pieces reach settles most of the others unsplit.
    for k in np.argsort(-first, kind="stable"):
        box, piece = pieces[k]
        if first[k] <= lower * (1 + tolerance):
            return max(upper, float(first[k])), lower
        top, lower = _supremum(piece, box, domain, i, tolerance, budget, lower, seen)
        upper = max(upper, top)
    return upper, lower


def _supremum(
    gap: GapFunction, boxes: Interval, domain: Domain, i: int, tolerance: float, budget: int, lower: float, seen: _Seen
) -> tuple[float, float]:
    # One state at a time: cells that one state needs small would only multiply the work of the others.
    bound, settled = gap.gamma_of(boxes, i), 0.0
    lower = max(lower, _reached(gap, domain, boxes, i))
    spent = 1
    while True:
        # A box that cannot raise the answer by more than the tolerance is settled; its bound stays in the answer.
        pending = bound > lower * (1 + tolerance)
        settled = max(settled, bound[~pending].max(initial=0.0))
        boxes, bound = boxes[pending], bound[pending]
        if not len(boxes) or spent >= budget:
            return max(settled, bound.max(initial=0.0)), lower
        order = np.argsort(-bound, kind="stable")
        first, rest = order[: THRESHOLDS.supremum_batch], order[THRESHOLDS.supremum_batch :]
        loose, parents = boxes[first], np.tile(bound[first], 2)
        halves = loose.cut((gap.lipschitz(loose)[:, i] * (loose.hi - loose.lo)).argmax(axis=1))
        spent += len(halves)
        seen.add(len(halves), i, max(settled, float(bound[first[0]])), lower)
        if domain.relations:
            meets = ~domain.outside(halves)
            halves, parents = halves[meets], parents[meets]
        # A half lies inside its parent, so the parent's bound holds for it as well.
        tighter = np.minimum(gap.gamma_of(halves, i), parents)
        lower = max(lower, _reached(gap, domain, halves[np.argsort(-tighter)[: THRESHOLDS.supremum_probes]], i))
        boxes, bound = Interval.concatenate([boxes[rest], halves]), np.concatenate([bound[rest], tighter])


def _reached(gap: GapFunction, domain: Domain, boxes: Interval, i: int) -> float:
    """The largest γ_i over the centres and those corners that are farthest from the domain's centre, where most gaps peak;
    of points that a relation cuts off, over those next to them that it leaves.
    """
    corners = np.where(boxes.mid >= domain.interval.mid, boxes.hi, boxes.lo)
    z = np.concatenate([boxes.mid, corners])
    if domain.relations:
        both = Interval.concatenate([boxes, boxes])
        z = domain.inside(z, both)
        # What had to leave its box lies where another function may hold.
        z = z[((z >= both.lo) & (z <= both.hi)).all(axis=1)]
    return float(gap.gamma(z)[:, i].max(initial=0.0)) if len(z) else 0.0
