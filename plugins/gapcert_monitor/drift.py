"""Does a residual change along a log? A trend beside a function of z, against errors that neighbours may share."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.stats import t as student

from gapcert import Array
from gapcert_monitor.thresholds import THRESHOLDS


def drift(r: Array, gamma: Array, z: Array) -> dict[str, Any] | None:
    """How much r (n,), without what is known of it, changes along the log: its slope over time beside a function of z (n, nz),
    quadratic and of higher degree in each axis. {"change", "error", "samples", "trend"}; None with too few points, or where
    time is nearly such a function: then what r is as a function of z, which need not be one, would look like a trend.

    A trend is sure where two errors of the slope agree on it, and told where it is at least `drift_share` of the median γ.
    One takes what is left for an AR(1) process, whose ρ is at the upper end of what is likely: n transitions tell as much as
    n (1 − ρ) / (1 + ρ) independent ones, `samples`. The other takes nothing for granted but that what is slow is about as
    large at the `drift_waves` lowest frequencies as at that of a trend: of white noise it makes an exact t-test. Frequencies
    of which z explains most tell nothing, and are not counted.
    """
    n = len(r)
    if n < THRESHOLDS.drift_points or not np.isfinite(r).all():
        return None
    known = _known(z)
    k = known.shape[1] + 1
    if n < 4 * k:
        return None
    time = np.linspace(-0.5, 0.5, n)
    time, left = (v - known @ (known.T @ v) for v in (time, r))
    size = float(time @ time)
    # The mean square of time is 1/12; of what z leaves of it much is lost where the log goes through Z once.
    if 12 * size < n * THRESHOLDS.drift_apart:
        return None
    change = float(time @ left) / size
    left = left - change * time
    samples = _independent(left, k)
    if (freedom := samples - k) < THRESHOLDS.drift_freedom:
        return {"change": change, "error": None, "samples": samples, "trend": False}
    # n − k of its n squares are left by k regressors where samples are independent; of fewer, k take a larger share.
    errors = [(float(np.sqrt(left @ left / freedom)), freedom), _slow(left, known, time)]
    level, unit = (1 + THRESHOLDS.drift_level) / 2, abs(change) * float(np.sqrt(size))
    sure = all(f >= 1 and unit > e * student.ppf(level, f) for e, f in errors)
    told = bool(sure and abs(change) > THRESHOLDS.drift_share * np.median(gamma))
    return {"change": change, "error": max(e for e, _ in errors) / float(np.sqrt(size)), "samples": samples, "trend": told}


def _known(z: Array) -> Array:
    """An orthonormal basis (n, k), at its points, of functions of z that are quadratic, and of `drift_degree` in each axis."""
    middle, half = (z.max(axis=0) + z.min(axis=0)) / 2, np.ptp(z, axis=0) / 2
    w = (z - middle)[:, half > 0] / half[half > 0]
    first, second = np.triu_indices(w.shape[1])
    powers = [w**d for d in range(3, THRESHOLDS.drift_degree + 1)]
    basis, size, _ = np.linalg.svd(
        np.hstack([np.ones((len(w), 1)), w, w[:, first] * w[:, second], *powers]), full_matrices=False
    )
    return np.asarray(basis[:, size > 1e-9 * size[0]])


def _independent(left: Array, k: int) -> float:
    """How many independent samples tell as much of a mean as what k regressors have left, (n,).

    ρ̂ of neighbours errs by √((1 − ρ²) / n) and is too small by about (k + (k + 2) ρ) / n [Kendall 1954 for k = 1].
    """
    n = len(left)
    found = float(left[1:] @ left[:-1]) / max(float(left @ left), np.finfo(float).tiny)
    rho = found + (k + (k + 2) * abs(found)) / n + THRESHOLDS.drift_doubt * float(np.sqrt(max(1 - found**2, 0.0) / n))
    return n * (1 - rho) / (1 + rho) if 0 < rho < 1 else n * float(rho <= 0)


def _slow(left: Array, known: Array, time: Array) -> tuple[float, int]:
    """The standard deviation of what is left along each of the lowest cosines that the regressors leave, and how many these
    are, whose share left is `drift_apart` or more.
    """
    n = len(left)
    waves = np.cos(np.pi * np.outer(np.arange(n) + 0.5, np.arange(1, THRESHOLDS.drift_waves + 1)) / n) * np.sqrt(2 / n)
    regressors = np.column_stack([known, time / np.linalg.norm(time)])
    basis, size, _ = np.linalg.svd(waves - regressors @ (regressors.T @ waves), full_matrices=False)
    basis = basis[:, size**2 >= THRESHOLDS.drift_apart]
    count = basis.shape[1]
    return (float(np.sqrt(np.mean((basis.T @ left) ** 2))) if count else 0.0), count
