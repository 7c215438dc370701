"""Wood–Zhang: Lipschitz constants estimated from the largest slopes of batches of close pairs."""

from __future__ import annotations

from typing import Any, final

import numpy as np
import numpy.typing as npt

from gapcert import LipschitzBound, LipschitzEstimator, LipschitzProblem, UsageError
from gapcert_bounds import weibull

Array = npt.NDArray[np.float64]

_NOISE = 0.1  # share of the largest slope that the resolution may fake
_FARTHEST = 2.0  # times the largest slope: maxima whose fitted end lies beyond show no end at all


@final
class WoodZhang(LipschitzEstimator):
    """L_ij = max(location, largest slope seen) × safety, per state i and axis j; an estimate, never a bound.

    Slopes |g_i(z + δ e_j) − g_i(z)| / δ at random z, with δ uniform in [½, 1] · distance · (width of axis j); the largest of
    each batch; a reverse Weibull distribution with shape ≥ 1 fitted to these by maximum likelihood; its location
    (Wood and Zhang 1996, Estimation of the Lipschitz constant of a function). As published (safety 1) it falls below the truth
    in a large share of all trials; where slopes have a long tail it runs away, and twice the largest slope is
    taken instead. Pairs are not shorter than half the distance, so that resolution does not pass for slope.

    Both ends of a pair lie in Z, relations included. Z is convex, so along the straight way between any z, z′ in Z, which stays
    in Z, |g_i(z) − g_i(z′)| ≤ Σ_j sup_Z |∂_j g_i| |z_j − z′_j|: slopes along single axes, within Z, are all that is needed.
    """

    provenance = "estimated"

    def __init__(self, safety: float = 1.2, pairs: int = 2500, batches: int = 50, distance: float = 1e-2) -> None:
        if pairs < 2 * batches:
            raise UsageError(
                f"lipschitz wood-zhang: {pairs} pairs make no {batches} batches; give at least {2 * batches} pairs"
            )
        self.safety, self.pairs, self.batches, self.distance = safety, pairs, batches, distance

    def bound(self, problem: LipschitzProblem) -> LipschitzBound:
        """UsageError where the pairs are too close for the resolution."""
        names = {j: a.name for j, a in enumerate(problem.domain.axes) if j not in problem.held}
        values, lowers, reports, steep = zip(*(self._axis(problem, j, name) for j, name in names.items()), strict=True)
        diagnostics = dict(zip(names.values(), reports, strict=True))
        method = f"wood-zhang ({self.pairs} pairs in {self.batches} batches per axis)"
        samples = 2 * self.pairs * len(names)
        pairs = np.stack(steep, axis=1)
        value, lower = np.zeros((2, problem.domain.nx, len(problem.domain.axes)))
        value[:, list(names)], lower[:, list(names)] = np.stack(values, axis=1), np.stack(lowers, axis=1)
        return LipschitzBound(value, lower, "estimated", method, self.safety, samples, steep=pairs, diagnostics=diagnostics)

    def _axis(self, problem: LipschitzProblem, j: int, name: str) -> tuple[Array, Array, dict[str, Any], Array]:
        """Estimates (nx,), proved lower bounds (nx,), diagnostics and each state's steepest pair (nx, 2, nz) for axis j."""
        start, end = self._pairs(problem, j)
        length = end[:, j] - start[:, j]
        moved, resolution = problem.change(f"lipschitz-{name}", start, end)
        change, noise = np.abs(moved), 4 * resolution
        slope = change / length[:, None]
        seen = slope.max(axis=0)
        inert = self._inert(problem, j, name, change, seen, noise, float(length.min()))

        maxima = np.stack([part.max(axis=0) for part in np.array_split(slope, self.batches)], axis=1)
        fit = weibull.fit(maxima)
        # What an inert state may hide: the noise itself, and whatever change was seen above it.
        change_max = change.max(axis=0)
        hidden = (noise + np.where(change_max > noise, change_max, 0.0)) / length.min()
        location = np.minimum(fit.location, _FARTHEST * seen)
        estimate = np.where(inert, hidden, np.maximum(location, seen) * self.safety)
        lower = (np.maximum(change - noise, 0) / length[:, None]).max(axis=0) * (1 - 1e-12)
        report = {
            "inert": inert.tolist(),
            "largest_slope": seen.tolist(),
            **{field: _finite(getattr(fit, field), inert) for field in ("location", "shape", "ks", "p_value")},
            "profile_limit_95": _finite(fit.upper, inert),
            "note": "the profile limit is no confidence bound",
        }
        k = slope.argmax(axis=0)
        return estimate, lower, report, np.stack([start[k], end[k]], axis=1)

    def _pairs(self, problem: LipschitzProblem, j: int) -> tuple[Array, Array]:
        """Both ends (pairs, nz), inside Z; their realised distance along axis j is what slopes are divided by."""
        rng = np.random.default_rng([problem.seed, j, 0x12F])
        domain = problem.domain
        if domain.relations:
            return self._chords(problem, j, rng)
        delta = domain.width[j] * self.distance * (0.5 + 0.5 * rng.random(self.pairs))
        start = domain.draw(self.pairs, rng)
        start[:, j] = domain.low[j] + rng.random(self.pairs) * (domain.width[j] - delta)
        end = start.copy()
        end[:, j] = np.minimum(start[:, j] + delta, domain.high[j])
        return start, end

    def _chords(self, problem: LipschitzProblem, j: int, rng: np.random.Generator) -> tuple[Array, Array]:
        """Pairs on chords of Z along axis j, those of points drawn from Z that are long enough."""
        domain, starts, ends, found = problem.domain, list[Array](), list[Array](), 0
        for _ in range(100):
            z = domain.draw(self.pairs, rng)
            delta = domain.width[j] * self.distance * (0.5 + 0.5 * rng.random(self.pairs))
            low, high = domain.chord(z, j)
            start = z.copy()
            start[:, j] = low + rng.random(self.pairs) * (high - low - delta)
            end = start.copy()
            end[:, j] = start[:, j] + delta
            both = (high - low > delta) & domain.contains(start) & domain.contains(end)
            starts.append(start[both])
            ends.append(end[both])
            found += int(both.sum())
            if found >= self.pairs:
                return np.concatenate(starts)[: self.pairs], np.concatenate(ends)[: self.pairs]
        raise UsageError(
            f"lipschitz wood-zhang: {found} of {100 * self.pairs} points of the domain have room for a pair along "
            f"'{domain.axes[j].name}' within the relations; give a smaller distance"
        )

    def _inert(
        self, problem: LipschitzProblem, j: int, name: str, change: Array, seen: Array, noise: Array, length: float
    ) -> npt.NDArray[np.bool_]:
        """Which states do not change along axis j beyond the resolution; UsageError where longer pairs would tell."""
        drowned = noise / length > _NOISE * seen
        hidden = drowned & (change.max(axis=0) > noise)
        for i in np.flatnonzero(hidden):
            needed = 2 * noise[i] / (_NOISE * seen[i] * problem.domain.width[j])
            if needed <= 1:
                state = problem.domain.axes[i].name
                raise UsageError(
                    f"lipschitz wood-zhang: pairs along '{name}' are too close for '{state}': the largest "
                    f"slope seen is {seen[i]:.3g}, and rounding alone can fake {noise[i] / length:.3g}; "
                    f"set distance: {_round_up(needed):g}"
                )
        return np.asarray(drowned)


def _round_up(x: float) -> float:
    """x to two digits, not smaller."""
    unit = 10.0 ** (np.floor(np.log10(x)) - 1)
    return float(min(1.0, np.ceil(x / unit) * unit))


def _finite(values: Array, inert: npt.NDArray[np.bool_]) -> list[float | None]:
    return [float(v) if np.isfinite(v) and not skip else None for v, skip in zip(values, inert, strict=True)]
