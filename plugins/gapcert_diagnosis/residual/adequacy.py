"""Are rollouts of a fit over held-out data as close as noise lets them be, or as they have to be?"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.signal import lfilter

from gapcert.plugin import Array, difference
from gapcert_diagnosis.fitting.fit import Fit, followed, lag_one
from gapcert_diagnosis.fitting.rollout_error import Stretches
from gapcert_diagnosis.thresholds import THRESHOLDS


def close(judge: Stretches, fitted: Fit, seed: int, share: float = 0.0) -> bool:
    """Is every channel within 1.5 of what noise makes of the fitted windows, and of these rollouts?

    share: or with an error of these that is such a share of the measured motion, as standard deviations.
    """
    error, measured, limit = judge.floors(fitted), judge.windows.measured, THRESHOLDS.loud_channel
    near = error <= share * measured.spread / measured.sigma
    least = np.sqrt(fitted.chi) <= limit
    if (near | (least & (error <= limit))).all() or not (near | least).all():
        return bool((near | least).all())
    # Noise that makes more of rollouts than motions differ by excuses nothing: the simulation runs away.
    most = THRESHOLDS.unlike_motion * measured.spread / measured.sigma
    return bool((near | (error <= np.minimum(limit * by_noise(judge, fitted, seed), most))).all())


def blind(judge: Stretches, fitted: Fit, seed: int) -> bool:
    """Do windows leave noise, and rollouts more than noise makes of them?"""
    error, least = judge.floors(fitted), THRESHOLDS.longer_error
    if (np.sqrt(fitted.chi) > THRESHOLDS.loud_channel).any() or (error <= least).all():
        return False
    return bool((error > least * by_noise(judge, fitted, seed)).any())


def by_noise(judge: Stretches, fitted: Fit, seed: int) -> Array:
    """Root mean square error (ny,), in noise floors, of rollouts of a fit against itself, from starts that noise has moved and
    with numbers as uncertain as they are.

    The noise of each channel has the size and the colour of what the fit leaves.
    """
    h, w, rng = fitted.hypothesis, judge.windows, np.random.default_rng(seed)
    start, none, sigma = judge.start(fitted), np.empty((1, 0)), w.measured.sigma
    true = h.holding(fitted.theta).simulate(w, none, start[None])[0]
    chi, rho = np.maximum(fitted.chi, 1.0), np.clip(lag_one(fitted.residual), 0.0, THRESHOLDS.noise_colours[-1])
    fresh, values = np.sqrt(1 - rho**2), np.linalg.eigh(fitted.covariance)
    wide = values[1] * np.sqrt(np.maximum(values[0], 0.0) * float(chi.mean() / fitted.whiteness.min()))
    total = np.zeros(len(chi))
    for _ in range(THRESHOLDS.start_draws):
        noise = rng.standard_normal(true.shape) * fresh
        noise[:, 0] /= fresh
        noise = np.stack([lfilter([1.0], [1.0, -r], noise[..., c], axis=1) for c, r in enumerate(rho)], axis=-1)
        theta = np.clip(fitted.theta + wide @ rng.standard_normal(len(fitted.theta)), h.low, h.high)
        seen = replace(w, y=true + noise * np.sqrt(chi) * sigma).head(judge.lead)
        moved = h.holding(theta).simulate(w, none, followed(h, theta, seen, start).start[None])[0]
        off = difference(w.measured.channels, moved, true)[:, judge.lead :] / sigma
        total += np.mean(np.clip(np.nan_to_num(off, nan=1e6), -1e6, 1e6) ** 2, axis=(0, 1))
    return np.asarray(np.sqrt(chi + total / THRESHOLDS.start_draws))
