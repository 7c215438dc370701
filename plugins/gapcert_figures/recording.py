"""What is drawn of a calibration on a recording: the scores of its held windows, and the one that set the band."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, final

import numpy as np

from gapcert.plugin import Array, pretty

if TYPE_CHECKING:
    from gapcert_calibrate import CalibratedRecording

SHOWN = 400  # transitions of a stretch


@final
@dataclass(frozen=True)
class Stretch:
    """One state's residual r in [low, high] at times t (n,), in s from the beginning of the stretch."""

    state: str
    unit: str
    t: Array
    residual: Array
    low: Array
    high: Array


@final
@dataclass(frozen=True)
class RecordedFigure:
    """Scores of the held windows in order, (n,), of which the one of `rank` (from 1) set the band; and its transitions."""

    scores: Array
    rank: int
    at: float
    stretches: tuple[Stretch, ...]


def recorded_figure(made: CalibratedRecording) -> RecordedFigure:
    """Of the window that set the band, the stretch around the transition that did."""
    held, order = made.held, np.argsort(made.scores, kind="stable")
    rows = np.flatnonzero(held.window == np.unique(held.window)[order[made.rank - 1]])
    rows = rows[np.argsort(held.t[rows], kind="stable")]
    low, high = made.gap.interval(held.z[rows])
    r = held.r[rows]
    # The score's transition touches the band: nowhere is less left, in scales.
    peak = int(np.argmin((np.minimum(r - low, high - r) / made.scale).min(axis=1)))
    first = max(0, min(peak - SHOWN // 2, len(rows) - SHOWN))
    part = slice(first, first + SHOWN)
    t = held.t[rows][part]
    stretches = (
        Stretch(s.name, pretty(s.unit), t - t[0], r[part, i], low[part, i], high[part, i])
        for i, s in enumerate(made.model.states)
    )
    return RecordedFigure(made.scores[order], made.rank, float(t[0]), tuple(stretches))
