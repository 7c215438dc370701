"""Windows whose fit went to a wrong valley, led back: their starts are found on short stretches that grow."""

from __future__ import annotations

from typing import Any

import numpy as np

from gapcert_diagnosis.data.dataset import Windows
from gapcert_diagnosis.thresholds import THRESHOLDS

from .fit import Fit, fit


def rescued(fitted: Fit, windows: Windows) -> Fit:
    """The fit again from better starts of the windows that stand out, where that makes it better; else as it was.

    A start velocity that is off by the noise of a difference can lead a long window over an unstable equilibrium or around
    another turn; over a short one it cannot.
    """
    energy = np.mean(fitted.residual**2, axis=(1, 2))
    lost: Any = np.flatnonzero(energy > THRESHOLDS.lost_window * max(1.0, float(np.median(energy))))
    if not len(lost):
        return fitted
    some, fixed = windows.take(lost), fitted.hypothesis.holding(fitted.theta)
    start = some.start
    for part in THRESHOLDS.restart_parts:
        head = some.head(max(THRESHOLDS.window_samples, windows.length // part))
        start = fit(fixed, head, start=start).start
    starts = fitted.start.copy()
    starts[lost] = start
    again = fit(fitted.hypothesis, windows, theta=fitted.theta, start=starts)
    return again if np.sum(again.residual**2) + again.prior < np.sum(fitted.residual**2) + fitted.prior else fitted
