"""Wood–Zhang: Lipschitz constants estimated from the largest slopes of batches of close pairs, by extreme value theory."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

import numpy as np

from gapcert.plugin import Array, Bools, LipschitzBound, LipschitzEstimator, LipschitzProblem, UsageError
from gapcert_bounds.thresholds import THRESHOLDS

from .bends import curvatures
from .slopes import Close, Curvature, estimate, inert, uniform

_DROP = 1.352771727047702  # half the 90 % quantile of χ²₁: the one-sided 95 % limit


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

    def method(self, axes: int) -> str:
        """Its description in a certificate, for pairs along so many axes."""
        return f"wood-zhang ({self.pairs} pairs in {self.batches} batches per axis)"

    def bound(self, problem: LipschitzProblem) -> LipschitzBound:
        """UsageError where the pairs are too close for the resolution."""
        names = {j: a.name for j, a in enumerate(problem.domain.axes) if j not in problem.held}
        pairs = {j: self._ask(problem, j, name) for j, name in names.items()}
        values, reports = dict[int, tuple[Array, Array]](), dict[str, Any]()
        for j, name in names.items():
            values[j], reports[name] = self._axis(problem, j, pairs[j])

        def bent() -> Curvature:
            return curvatures(problem, names, self.pairs, self.distance, self.safety, "wood-zhang")

        return estimate(problem, pairs, values, reports, self.method(len(names)), self.safety, bent if self.curvature else None)

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
        fit = ReverseWeibull.fit(maxima)
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


def _finite(values: Array, inert: Bools) -> list[float | None]:
    return [float(v) if np.isfinite(v) and not skip else None for v, skip in zip(values, inert, strict=True)]


@final
@dataclass(frozen=True)
class ReverseWeibull:
    """P(X ≤ x) = exp(−((location − x) / scale)^shape) for x ≤ location; all fields (m,), one entry per fitted sample.

    `upper` is where the profile likelihood of the location has fallen to its one-sided 95 % level (∞ where it never does); it
    is no confidence bound where the distribution itself is wrong. `ks` and `p_value`: Kolmogorov–Smirnov distance to the fit,
    and its asymptotic p-value for given parameters, thus optimistic for fitted ones.
    """

    location: Array
    scale: Array
    shape: Array
    upper: Array
    ks: Array
    p_value: Array

    @classmethod
    def fit(cls, x: Array) -> ReverseWeibull:
        """Maximum likelihood with shape ≥ 1 for each row of x (m, n).

        Below shape 1 the likelihood grows without bound as the location approaches the largest value. The location is profiled:
        for a given one the other two follow from a monotone equation. A row without spread gets its own value as location.
        """
        top, spread = x.max(axis=1), np.ptp(x, axis=1)
        flat = spread <= 1e-12 * np.abs(top)
        unit = np.where(flat[:, None], np.linspace(0, 1, x.shape[1]), (top[:, None] - x) / np.where(flat, 1.0, spread)[:, None])

        offsets = np.concatenate([[0.0], np.geomspace(1e-6, THRESHOLDS.farthest_end, 121)])
        grid = np.broadcast_to(offsets, (len(x), len(offsets)))
        likelihood = _profile(unit, grid)[0]
        best = _refine(unit, grid, likelihood)
        peak, shape, scale = (v[:, 0] for v in _profile(unit, best[:, None]))
        upper = _limit(unit, grid, likelihood, peak)

        # exp(−(y / scale)^shape) at the ordered y = location − x; largest y first is smallest x first.
        y = np.sort(unit + best[:, None], axis=1)[:, ::-1]
        cdf = np.exp(-((y / scale[:, None]) ** shape[:, None]))
        ks, p = _kolmogorov(cdf)
        nan = np.where(flat, np.nan, 1.0)
        return cls(
            location=np.where(flat, top, top + best * spread),
            scale=np.where(flat, 0.0, scale * spread),
            shape=shape * nan,
            upper=top + np.where(flat, 0.0, upper) * spread,
            ks=ks * nan,
            p_value=p * nan,
        )


def _profile(unit: Array, offsets: Array) -> tuple[Array, Array, Array]:
    """(log-likelihood, shape, scale), each (m, k), at locations that lie `offsets` (m, k) above the largest value."""
    # At offset 0 the largest value has y = 0; only shape 1 keeps its likelihood finite and positive there.
    y = unit[:, None, :] + offsets[:, :, None]
    n = unit.shape[1]
    top = y.max(axis=2, keepdims=True)
    y = y / top
    log_y = np.log(np.maximum(y, 1e-300))
    mean_log = log_y.mean(axis=2)
    shape = _shape(log_y, mean_log)
    shape = np.where(offsets > 0, shape, 1.0)
    power = np.exp(shape[:, :, None] * log_y).mean(axis=2)
    # log-likelihood of y / top, less n log top for the change of unit.
    with np.errstate(invalid="ignore"):
        interior = n * (np.log(shape) - np.log(power) + (shape - 1) * mean_log - 1)
    at_one = -n * (np.log(y.mean(axis=2)) + 1)
    likelihood = np.where(shape > 1, interior, at_one) - n * np.log(top[:, :, 0])
    return likelihood, shape, power ** (1 / shape) * top[:, :, 0]


def _shape(log_y: Array, mean_log: Array) -> Array:
    """The k ≥ 1 that maximises the likelihood: Σ y^k log y / Σ y^k − 1/k = mean log y, whose left side grows with k."""
    # With the largest log y = 0, the left side is close to 0 at 1000 / |mean log y|, and the root lies below.
    low, high = np.ones_like(mean_log), 1e3 * np.maximum(1.0, 1 / np.maximum(-mean_log, 1e-12))
    for _ in range(48):
        k = np.sqrt(low * high)
        weight = np.exp(k[:, :, None] * log_y)
        above = (weight * log_y).sum(axis=2) / weight.sum(axis=2) - 1 / k > mean_log
        low, high = np.where(above, low, k), np.where(above, k, high)
    return np.asarray(low)


def _refine(unit: Array, grid: Array, likelihood: Array) -> Array:
    """(m,) offset of the largest likelihood, searched around the best grid point on finer and finer grids."""
    rows = np.arange(len(unit))
    for _ in range(4):
        k = likelihood.argmax(axis=1)
        low, high = grid[rows, np.maximum(k - 1, 0)], grid[rows, np.minimum(k + 1, grid.shape[1] - 1)]
        grid = np.concatenate([grid[rows, k][:, None], np.linspace(low, high, 17, axis=1)], axis=1)
        likelihood = _profile(unit, grid)[0]
    return np.asarray(grid[rows, likelihood.argmax(axis=1)])


def _limit(unit: Array, grid: Array, likelihood: Array, peak: Array) -> Array:
    """(m,) the largest offset whose profile likelihood is within the 95 % level of the peak, from above; ∞ beyond the grid."""
    rows, columns = np.arange(len(unit)), grid.shape[1]
    inside = likelihood >= (peak - _DROP)[:, None]
    last = np.where(inside.any(axis=1), columns - 1 - inside[:, ::-1].argmax(axis=1), 0)
    low, high = grid[rows, last], grid[rows, np.minimum(last + 1, columns - 1)]
    fine = np.linspace(low, high, 65, axis=1)
    within = _profile(unit, fine)[0] >= (peak - _DROP)[:, None]
    end = fine[rows, np.minimum(within.sum(axis=1), 64)]
    return np.asarray(np.where(last == columns - 1, np.inf, end))


def _kolmogorov(cdf: Array) -> tuple[Array, Array]:
    """(distance, asymptotic p-value with Stephens' correction) of each row of ascending fitted probabilities (m, n)."""
    from scipy.special import kolmogorov

    n = cdf.shape[1]
    steps = np.arange(n + 1) / n
    distance = np.maximum((steps[1:] - cdf).max(axis=1), (cdf - steps[:-1]).max(axis=1))
    return distance, np.asarray(kolmogorov((np.sqrt(n) + 0.12 + 0.11 / np.sqrt(n)) * distance))
