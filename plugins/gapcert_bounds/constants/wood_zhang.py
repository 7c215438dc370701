"""Wood–Zhang: Lipschitz constants estimated from the largest slopes of batches of close pairs."""

from __future__ import annotations

from typing import Any, final

import numpy as np
import numpy.typing as npt

from gapcert import Array, UsageError
from gapcert.plugin import LipschitzBound, LipschitzEstimator, LipschitzProblem
from gapcert_bounds.thresholds import THRESHOLDS

from . import weibull
from .bends import curvatures
from .slopes import Close, inert, uniform
from .sweep import Curvature, estimate


@final
class WoodZhang(LipschitzEstimator):
    """L_ij = max(location, largest slope seen) × safety, per state i and axis j; an estimate, never a bound.

    Slopes |g_i(z + δ e_j) − g_i(z)| / δ at random z, with δ uniform in [½, 1] · distance · (width of axis j); the largest of
    each batch; a reverse Weibull distribution with shape ≥ 1 fitted to these by maximum likelihood; its location
    (Wood and Zhang 1996, Estimation of the Lipschitz constant of a function). As published (safety 1) it falls below the truth
    in a large share of all trials; where slopes have a long tail it runs away, and twice the largest slope is
    taken instead. Pairs are not shorter than half the distance, so that resolution does not pass for slope.

    With `curvature`, as many second differences are searched for as well, and the largest × safety bounds the curvature.

    Both ends of a pair lie in Z, relations included. Z is convex, so along the straight way between any z, z′ in Z, which stays
    in Z, |g_i(z) − g_i(z′)| ≤ Σ_j sup_Z |∂_j g_i| |z_j − z′_j|: slopes along single axes, within Z, are all that is needed.
    """

    provenance = "estimated"

    def __init__(
        self, safety: float = 1.2, pairs: int = 2500, batches: int = 50, distance: float = 1e-2, curvature: bool = False
    ) -> None:
        if pairs < 2 * batches:
            raise UsageError(
                f"lipschitz wood-zhang: {pairs} pairs make no {batches} batches; give at least {2 * batches} pairs"
            )
        self.safety, self.pairs, self.batches, self.distance = safety, pairs, batches, distance
        self.curvature = curvature

    def bound(self, problem: LipschitzProblem) -> LipschitzBound:
        """UsageError where the pairs are too close for the resolution."""
        names = {j: a.name for j, a in enumerate(problem.domain.axes) if j not in problem.held}
        pairs = {j: self._ask(problem, j, name) for j, name in names.items()}
        values, reports = dict[int, tuple[Array, Array]](), dict[str, Any]()
        for j, name in names.items():
            values[j], reports[name] = self._axis(problem, j, pairs[j])
        method = f"wood-zhang ({self.pairs} pairs in {self.batches} batches per axis)"

        def bent() -> Curvature:
            return curvatures(problem, names, self.pairs, self.distance, self.safety, "wood-zhang")

        return estimate(problem, pairs, values, reports, method, self.safety, bent if self.curvature else None)

    def _ask(self, problem: LipschitzProblem, j: int, name: str) -> Close:
        rng = np.random.default_rng([problem.seed, j, 0x12F])
        start, end = uniform(problem, j, rng, self.pairs, self.distance, "wood-zhang")
        return Close.ask(problem, f"lipschitz-{name}", j, start, end)

    def _axis(self, problem: LipschitzProblem, j: int, close: Close) -> tuple[tuple[Array, Array], dict[str, Any]]:
        """(estimates (nx,), proved lower bounds (nx,)), and diagnostics, for axis j."""
        noise, slope = 4 * problem.change_resolution, close.slope
        seen = slope.max(axis=0)
        still = inert(problem, j, close, seen, noise, "wood-zhang")

        maxima = np.stack([part.max(axis=0) for part in np.array_split(slope, self.batches)], axis=1)
        fit = weibull.fit(maxima)
        location = np.minimum(fit.location, THRESHOLDS.farthest_slope * seen)
        estimated = np.where(still, close.hidden(noise), np.maximum(location, seen) * self.safety)
        report = {
            "inert": still.tolist(),
            "largest_slope": seen.tolist(),
            **{field: _finite(getattr(fit, field), still) for field in ("location", "shape", "ks", "p_value")},
            "profile_limit_95": _finite(fit.upper, still),
            "note": "the profile limit is no confidence bound",
        }
        return (estimated, close.lower(noise)), report


def _finite(values: Array, inert: npt.NDArray[np.bool_]) -> list[float | None]:
    return [float(v) if np.isfinite(v) and not skip else None for v, skip in zip(values, inert, strict=True)]
