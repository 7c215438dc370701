"""What lies under the noise of a measured channel: its floor, its absurd values, a smooth curve and its slope."""

from __future__ import annotations

import functools
import math
from typing import NamedTuple, final

import numpy as np
import numpy.typing as npt
from scipy.ndimage import convolve1d, maximum_filter1d, median_filter
from scipy.signal import savgol_coeffs, savgol_filter

from gapcert.plugin import Array, Bools
from gapcert_recordings.thresholds import THRESHOLDS

AROUND = 4  # samples of the cubic on either side


def noise_floor(y: Array, valid: Bools | None = None) -> float:
    """σ of white noise on a smooth signal y (T,): the k-th difference has variance C(2k, k)·σ² once k is high enough.

    The lowest order k = 2…7 within 3 % of the least value at higher orders; a plain minimum is 4 % low. Differences that
    touch a sample that is not valid take no part; NaN where none is left.
    """
    good = np.ones(len(y), dtype=bool) if valid is None else valid
    values = [_difference(y, good, k) for k in range(2, 8)]
    values = [v for v in values if not math.isnan(v)]
    for k, value in enumerate(values[:-1]):
        if value <= 1.03 * min(values[k + 1 :]):
            return value
    return values[-1] if values else math.nan


def _difference(y: Array, good: Bools, k: int) -> float:
    if len(y) <= k:
        return math.nan
    whole = np.convolve(good, np.ones(k + 1), "valid") > k + 0.5
    d = np.diff(y, k)[whole]
    return float(np.sqrt(np.mean(d**2) / math.comb(2 * k, k))) if len(d) else math.nan


def absurd(y: Array, valid: Bools) -> Bools:
    """Which of y (T,) are no measurements: far from the median of five, from a cubic through their neighbours, and from where
    the samples on either side lead.

    The first alone would take peaks for outliers, the second steps, both together the moment of a bounce. The worst is taken
    out first, so that its neighbours are not judged by it.
    """
    found = np.zeros(len(y), dtype=bool)
    if len(y) < THRESHOLDS.scatter_samples or valid.sum() < THRESHOLDS.least_scatter:
        return found
    low, high = np.quantile(y[valid], [0.1, 0.9])
    for _ in range(THRESHOLDS.outlier_rounds):
        left = valid & ~found
        size = _strangeness(filled_in(y, left), left, THRESHOLDS.least_outlier * float(high - low))
        worst = left & (size > 0) & (size >= maximum_filter1d(size, 2 * AROUND + 1, mode="nearest"))
        if not worst.any():
            break
        found |= worst
    return found


def _strangeness(y: Array, valid: Bools, least: float) -> Array:
    """The distance (T,) of each sample from a cubic through its neighbours; 0 for those that pass one of the tests."""
    at_cubic = _left(y, _BOTH)
    scatter = np.maximum(THRESHOLDS.outlier_scatter * _scatter(at_cubic, valid) / _amplified(_BOTH), least)
    strange = np.abs(at_cubic) > scatter
    if strange.any():
        strange &= np.abs(y - median_filter(y, 5, mode="nearest")) > scatter
        for side in (_left(y, _BEFORE), _left(y, _BEFORE[::-1])):
            strange &= np.abs(side) > np.maximum(THRESHOLDS.one_sided_scatter * _scatter(side, valid), least)
    return np.asarray(np.where(strange, np.abs(at_cubic), 0.0))


def _left(y: Array, weights: Array) -> Array:
    """y less a weighted sum of the samples around it."""
    half = len(weights) // 2
    return np.asarray(y - np.convolve(np.pad(y, half, mode="edge"), weights[::-1], "valid"))


def _predictor(rows: npt.NDArray[np.intp], degree: int) -> Array:
    """Weights at −AROUND…AROUND of the value at 0 of a least-squares polynomial through some of the rows."""
    weights = np.zeros(2 * AROUND + 1)
    weights[rows + AROUND] = np.linalg.pinv(np.vander(rows.astype(np.float64), degree + 1, increasing=True))[0]
    return weights


def _amplified(weights: Array) -> float:
    return math.sqrt(1 + float(weights @ weights))


_BOTH = _predictor(np.delete(np.arange(-AROUND, AROUND + 1), AROUND), 3)
_BEFORE = _predictor(np.arange(-AROUND, 0), 2)


def _scatter(r: Array, valid: Bools) -> Array:
    """1.4826 times the median of |r| (T,) in the block around each sample, the largest of three neighbouring blocks."""
    count = -(-len(r) // THRESHOLDS.scatter_samples)
    blocks = np.full(count * THRESHOLDS.scatter_samples, np.inf)
    blocks[: len(r)] = np.where(valid, np.abs(r), np.inf)
    blocks = np.sort(blocks.reshape(count, THRESHOLDS.scatter_samples), axis=1)
    there = np.isfinite(blocks).sum(axis=1)
    medians = np.where(there > 0, blocks[np.arange(count), np.maximum(there - 1, 0) // 2], 0.0)
    return np.asarray(1.4826 * np.repeat(maximum_filter1d(medians, 3, mode="nearest"), THRESHOLDS.scatter_samples)[: len(r)])


def filled_in(y: Array, valid: Bools) -> Array:
    """y (T,) with straight lines where it is not valid."""
    if valid.all():
        return y
    rows = np.arange(len(y))
    return np.asarray(np.interp(rows, rows[valid], y[valid])) if valid.any() else np.zeros_like(y)


@final
class Curve(NamedTuple):
    """Values and slopes (T,) of a smooth curve at even times; noise: the floor about it."""

    value: Array
    slope: Array
    noise: float


def smoothed(y: Array, valid: Bools, offset: Array, period: float) -> Curve:
    """A smooth curve through y (T,), measured `offset` (T,) s after even times; its width follows the signal's band.

    A local polynomial of degree 3 or 5 leaves (1 − c₀)·σ² of white noise and all of its own bias. Of the filters whose
    residual over (1 − c₀) is about that of all sharper ones, the one with the least noise in its slope is taken: the bias
    grows with the eighth power of the width, so that is sharp.
    """
    at = filled_in(y, valid)
    width, degree = _filter(at, valid, period)
    # Moving the samples to their even times takes the slope, which takes the samples.
    for _ in range(3 if offset.any() or not valid.all() else 1):
        value = savgol_filter(at, width, degree)
        slope = savgol_filter(at, width, degree, deriv=1, delta=period)
        at = np.where(valid, y - slope * offset, value)
    return Curve(value, slope, noise_floor(at, valid))


def _filter(y: Array, valid: Bools, period: float) -> tuple[int, int]:
    """(width, degree)."""
    reach = min(max(2, round(THRESHOLDS.widest_smooth / period)), (len(y) - 1) // 2)
    widest = min(5, len(y) - 1 + len(y) % 2)
    best, least = (widest, min(3, widest - 1)), math.inf
    most = 1 + THRESHOLDS.smooth_bias + 1.5 / math.sqrt(len(y))  # sums of squares scatter by sqrt(2/n)
    for degree, half in _filters(reach):
        width = 2 * half + 1
        weights = _weights(width, degree)
        left = _middle((y - convolve1d(y, weights, mode="constant")) ** 2, valid, half) / (1 - float(weights[half]))
        if left <= most * least:
            best = (width, degree)
        least = min(least, left)
        if left > 30 * least:
            break
    return best


_weights = functools.cache(savgol_coeffs)


def _middle(square: Array, valid: Bools, half: int) -> float:
    """The mean away from the ends, where the filter is not its own."""
    inner = slice(half, len(square) - half)
    chosen = square[inner][valid[inner]]
    return float(np.mean(chosen)) if len(chosen) else math.inf


@functools.cache
def _filters(reach: int) -> tuple[tuple[int, int], ...]:
    """(degree, half width), those with the noisiest slope first."""
    widths = sorted({min(reach, round(2 * 1.25**k)) for k in range(40)})
    every = [(degree, half) for half in widths for degree in (3, 5) if 2 * half + 1 > degree + 1]
    noise = {f: float(np.sum(savgol_coeffs(2 * f[1] + 1, f[0], deriv=1) ** 2)) for f in every}
    return tuple(sorted(every, key=lambda f: -noise[f]))
