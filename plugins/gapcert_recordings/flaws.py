"""Sensors that are not what they seem: stuck, at the end of their range, or slower than the log."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from gapcert.plugin import Array
from gapcert_recordings.thresholds import THRESHOLDS


def flaws(t: Array, values: Array) -> Iterator[str]:
    """Of one column, in words; rows that are missing count for nothing."""
    there = np.isfinite(values)
    t, values = t[there], values[there]
    if len(values) < THRESHOLDS.flaw_samples:
        return
    if np.ptp(values) == 0:
        yield f"never changes (it is {values[0]:.4g} throughout)"
        return
    first = np.flatnonzero(np.diff(values, prepend=np.nan) != 0)
    lengths, sizes = np.diff(first, append=len(values)), values[first]
    for word, end in (("least", values.min()), ("greatest", values.max())):
        held = lengths[sizes == end]
        if _clipped(values, first[(sizes == end) & (lengths >= THRESHOLDS.clipped_samples)]):
            share = 100 * held.sum() / len(values)
            yield f"stays at its {word} value, {end:.4g}, in {share:.2g} % of the samples: it is saturated, or meets a stop"
    usual = int(np.median(lengths))
    if usual > 1 and len(first) > THRESHOLDS.flaw_samples and np.mean(lengths == usual) > THRESHOLDS.even_runs:
        yield f"has a value of its own in every {usual} samples only: it comes at a lower rate, or is held"
    elif np.mean(lengths == 1) > THRESHOLDS.even_runs and lengths.max() >= THRESHOLDS.stuck_samples:
        k = int(np.argmax(lengths))
        last = first[k] + lengths[k] - 1
        if sizes[k] not in (values.min(), values.max()):
            yield f"is stuck at {sizes[k]:.4g} from {t[first[k]]:.4g} s to {t[last]:.4g} s"


def _clipped(values: Array, entered: Array) -> bool:
    """Do stretches at an end begin at speed? What comes to rest slows down before."""
    entered = entered[entered >= 2]
    if len(entered) == 0:
        return False
    before = np.abs(values[entered - 1] - values[entered - 2])
    return bool(np.median(before) > THRESHOLDS.clipped_speed * np.sqrt(np.mean(np.diff(values) ** 2)))
