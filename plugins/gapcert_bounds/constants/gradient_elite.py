"""Gradient-elite: Lipschitz constants from the largest slopes seen, searched for around the steepest points."""

from __future__ import annotations

from typing import Any, final

import numpy as np

from gapcert.plugin import Array, LipschitzBound, LipschitzEstimator, LipschitzProblem, UsageError
from gapcert_bounds.thresholds import THRESHOLDS

from .bends import curvatures
from .slopes import Close, Curvature, around, estimate, inert, uniform


@final
class GradientElite(LipschitzEstimator):
    """L_ij = largest slope seen × safety, per state i and axis j; an estimate, never a bound.

    Slopes |g_i(z + δ e_j) − g_i(z)| / δ along each axis apart, in rounds, as the cross-entropy method has them: the first at
    random, each later one around the steepest pairs so far, ever closer to them, and in part at random again, since what
    no pair came near is not searched either. Pairs shrink with the rounds where the resolution allows it, since a slope over
    a distance falls short of the derivative at a corner of Z. What is seen is below the truth: without `safety` it always falls
    short, by little where the steep part is wide enough to be met.

    With `curvature`, half of the budget goes to second differences, searched for alike (`curvatures`).

    Both ends of a pair lie in Z, relations included; why slopes along single axes are enough is said at `WoodZhang`.
    """

    provenance = "estimated"

    def __init__(self, safety: float = 1.2, budget: int = 15_000, distance: float = 1e-2, curvature: bool = False) -> None:
        self.safety, self.budget, self.distance, self.curvature = safety, budget, distance, curvature

    def _pairs(self, axes: int) -> int:
        return self.budget // (2 * (2 if self.curvature else 1) * axes)

    def method(self, axes: int) -> str:
        """Its description in a certificate, for pairs along so many axes."""
        return f"gradient-elite ({self._pairs(axes)} pairs in {THRESHOLDS.elite_rounds} rounds per axis)"

    def bound(self, problem: LipschitzProblem) -> LipschitzBound:
        """UsageError where the pairs are too close for the resolution, or too few for the rounds."""
        names = {j: a.name for j, a in enumerate(problem.domain.axes) if j not in problem.held}
        count = self._pairs(len(names))
        least = 4 * (THRESHOLDS.elite_rounds - 1 + THRESHOLDS.elite_first)
        if count < least:
            raise UsageError(
                f"lipschitz gradient-elite: a budget of {self.budget} transitions is {count} pairs for each of "
                f"{len(names)} axes; give at least {2 * (2 if self.curvature else 1) * least * len(names)}"
            )
        pairs, values, diagnostics = dict[int, Close](), dict[int, tuple[Array, Array]](), dict[str, Any]()
        noise = 4 * problem.change_resolution
        for j, name in names.items():
            first, close, slope = self._search(problem, j, name, count, noise)
            seen = slope.max(axis=0)
            still = inert(problem, j, first, seen, noise, "gradient-elite")
            values[j] = np.where(still, first.hidden(noise), seen * self.safety), close.lower(noise)
            pairs[j] = close
            diagnostics[name] = {"inert": still.tolist(), "largest_slope": seen.tolist(), "pairs": len(slope)}
            diagnostics[name]["largest_slope_of_random_pairs"] = first.slope.max(axis=0).tolist()

        def bent() -> Curvature:
            each = self.budget // (6 * len(names))
            return curvatures(problem, names, each, self.distance, self.safety, "gradient-elite")

        method, bends = self.method(len(names)), bent if self.curvature else None
        return estimate(problem, pairs, values, diagnostics, method, self.safety, bends)

    def _search(self, problem: LipschitzProblem, j: int, name: str, count: int, noise: Array) -> tuple[Close, Close, Array]:
        """(pairs of the first round, all pairs, their slopes (n, nx), 0 where the resolution may fake them) along axis j."""
        rng = np.random.default_rng([problem.seed, j, 0xE117])
        each = count // (THRESHOLDS.elite_rounds - 1 + THRESHOLDS.elite_first)
        ends = uniform(problem, j, rng, count - (THRESHOLDS.elite_rounds - 1) * each, self.distance, "gradient-elite")
        first = close = Close.ask(problem, f"lipschitz-{name}-0", j, *ends)
        slope = close.slope
        for k in range(1, THRESHOLDS.elite_rounds):
            near = self._around(problem, j, rng, close, slope, noise, each - int(THRESHOLDS.elite_fresh * each), k)
            fresh = uniform(problem, j, rng, each - len(near[0]), self.distance, "gradient-elite")
            more = (np.concatenate(both) for both in zip(fresh, near, strict=True))
            close = close + Close.ask(problem, f"lipschitz-{name}-{k}", j, *more)
            slope = np.where(close.change * THRESHOLDS.noise_share > noise, close.slope, 0.0)
            slope[: len(first.start)] = first.slope
        return first, close, slope

    def _around(
        self,
        problem: LipschitzProblem,
        j: int,
        rng: np.random.Generator,
        close: Close,
        slope: Array,
        noise: Array,
        most: int,
        k: int,
    ) -> tuple[Array, Array]:
        """Both ends of up to `most` pairs around each state's elites, one-sided steps within Z."""
        domain = problem.domain
        state, z = around(problem, rng, (close.start + close.end) / 2, slope, most, k)
        longest = self.distance * domain.width[j]
        needed = noise / (THRESHOLDS.slope_faked * np.maximum(slope.max(axis=0), np.finfo(float).tiny))
        step = np.clip(np.maximum(needed[state], longest * max(THRESHOLDS.shortest_pair, 0.5**k)), None, longest)
        low, high = domain.chord(z, j)
        start, end = z.copy(), z.copy()
        ahead = z[:, j] + step <= high
        start[:, j] = np.where(ahead, z[:, j], np.maximum(z[:, j] - step, low))
        end[:, j] = np.where(ahead, np.minimum(z[:, j] + step, high), z[:, j])
        kept = (end[:, j] - start[:, j] > step / 2) & domain.contains(start) & domain.contains(end)
        return start[kept], end[kept]
