"""Which solver finds the multipliers of a network, and what it proposes where its end point lies too near the boundary."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import final

import numpy as np
from scipy.linalg import LinAlgError

from gapcert import Array
from gapcert_lipsdp.thresholds import THRESHOLDS
from gapcert_networks import NetworkCertifier, Proposal

from . import interior, spectraplex

MIXED = tuple(10.0 ** (k / 2) for k in range(-22, -3))  # of ρ, what the start adds to it in what is proposed


@final
class LipSDP(NetworkCertifier):
    """The best constant of diagonal multipliers: one hidden layer and one output by the dual, others by interior points."""

    name = "lipsdp"

    def __init__(self, tolerance: float = THRESHOLDS.interior_gap) -> None:
        self.tolerance = tolerance

    def propose(self, weights: Sequence[Array]) -> tuple[Iterable[Proposal], float]:
        # Extreme weights may overflow on the way; a proposal that is no number proves nothing.
        with np.errstate(all="ignore"):
            if len(weights) == 2 and len(weights[1]) == 1:
                one = spectraplex.solved(weights[0], weights[1][0])
                better = spectraplex.enlarged(weights[0], weights[1][0], one.multipliers)
                return [Proposal((t,), rho) for rho, t in better], one.lower**2
            return self._deep(weights)

    def _deep(self, weights: Sequence[Array]) -> tuple[Iterable[Proposal], float]:
        values, rho = interior.first_multipliers(weights)
        start = Proposal(tuple(np.full(len(w), v) for w, v in zip(weights, values, strict=False)), THRESHOLDS.start_above * rho)
        try:
            found = interior.solved(weights, self.tolerance)
        except LinAlgError:
            return [start], 0.0
        return _mixed(found, start), found.dual


def _mixed(found: interior.Solved, start: Proposal) -> Iterator[Proposal]:
    """From the solver's end, on the boundary of what holds, towards the start, which is inside."""
    for more in (*MIXED, np.inf):
        share = min(1.0, more * found.rho / start.square)
        both = zip(found.multipliers, start.multipliers, strict=True)
        mixed = tuple((1 - share) * end + share * first for end, first in both)
        yield Proposal(mixed, (1 - share) * found.rho + share * start.square)
