"""Figures as data, and what leads in each."""

from __future__ import annotations

import sys

from gapcert.plugin import LazyPackage, homes

_HOME = homes(
    {
        "gapcert_figures.data": (
            "Axis Band Channel CompareFigure DiagnosisFigure Escape Figures GapFigure Lane LoopFigure PairFigure "
            "RecordedFigure Runs Slice Stretch WinningFigure drawn gap_figure held labelled loop_figure recorded_figure "
            "winning_figure"
        ),
        "gapcert_figures.diagnosis": "KINDS Correlation Course Law Signal Waterfall called per_second spoken",
        "gapcert_figures.playback": "Motion Playback channel_playback loop_playback state_playback",
    }
)

__all__ = sorted(_HOME)
sys.modules[__name__].__class__ = LazyPackage
