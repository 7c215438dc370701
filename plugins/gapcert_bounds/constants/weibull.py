"""Three-parameter reverse Weibull distribution by maximum likelihood, many samples at once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np

from gapcert import Array
from gapcert_bounds.thresholds import THRESHOLDS

_DROP = 1.352771727047702  # half the 90 % quantile of χ²₁: the one-sided 95 % limit


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


def fit(x: Array) -> ReverseWeibull:
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
    return ReverseWeibull(
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
