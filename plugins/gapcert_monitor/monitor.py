"""γ watched online."""

from __future__ import annotations

from typing import NamedTuple, final

import numpy as np

from gapcert.plugin import Array
from gapcert_monitor.thresholds import THRESHOLDS
from gapcert_recordings import axes

from .certified import Certified


def rate_limit(k: int, n: int, confidence: float = THRESHOLDS.confidence) -> float:
    """One-sided upper limit of a probability of which k of n independent trials were hits (Clopper and Pearson 1934)."""
    from scipy.stats import beta

    return 1.0 if k >= n else float(beta.ppf(confidence, k + 1, n - k))


@final
class Observation(NamedTuple):
    """One transition: did it begin in Z, r (nx,), γ (nx,) (∞ outside Z), and is |r_i| > γ_i for some i?"""

    inside: bool
    residual: Array
    gamma: Array
    violated: bool


@final
class Monitor:
    """γ watched online: `step` takes one measured transition of one period, and counts."""

    def __init__(self, certified: Certified) -> None:
        axes(certified.model)
        self._certified = certified
        self.points = self.outside = self.violations = 0

    def step(self, x: Array, u: Array, x_next: Array) -> Observation:
        """x (nx,), u (nu,), held for the period, and x_next (nx,)."""
        at, given, after = (np.asarray(v, dtype=np.float64).reshape(1, -1) for v in (x, u, x_next))
        c = self._certified
        z = c.points(at, given)
        r = c.residual(at, given, after)
        if not c.zone.contains(z)[0]:
            self.outside += 1
            return Observation(False, r[0], np.full(r.shape[1], np.inf), False)
        low, high = c.band(z)
        gamma = np.maximum(np.abs(low), np.abs(high))
        # A value that is not a number does not confirm γ.
        violated = not bool((np.abs(r) <= gamma).all())
        self.points += 1
        self.violations += violated
        return Observation(True, r[0], gamma[0], violated)

    @property
    def rate(self) -> float | None:
        """Violations per transition that began in Z."""
        return self.violations / self.points if self.points else None

    @property
    def rate_limit(self) -> float | None:
        """Upper limit of the rate at 95 %, if transitions were independent."""
        return rate_limit(self.violations, self.points) if self.points else None
