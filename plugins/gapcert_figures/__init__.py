"""Figures as data, and what leads in each."""

from __future__ import annotations

import sys

from gapcert.plugin import LazyPackage

_HOME = {
    "Axis": "gapcert_figures.data",
    "Band": "gapcert_figures.data",
    "Channel": "gapcert_figures.data",
    "CompareFigure": "gapcert_figures.data",
    "Correlation": "gapcert_figures.diagnosis",
    "Course": "gapcert_figures.diagnosis",
    "DiagnosisFigure": "gapcert_figures.data",
    "Escape": "gapcert_figures.data",
    "Figures": "gapcert_figures.data",
    "GapFigure": "gapcert_figures.data",
    "KINDS": "gapcert_figures.diagnosis",
    "Lane": "gapcert_figures.data",
    "Law": "gapcert_figures.diagnosis",
    "LoopFigure": "gapcert_figures.data",
    "Motion": "gapcert_figures.playback",
    "PairFigure": "gapcert_figures.data",
    "Playback": "gapcert_figures.playback",
    "RecordedFigure": "gapcert_figures.recording",
    "Runs": "gapcert_figures.data",
    "Signal": "gapcert_figures.diagnosis",
    "Slice": "gapcert_figures.data",
    "Stretch": "gapcert_figures.recording",
    "Waterfall": "gapcert_figures.diagnosis",
    "WinningFigure": "gapcert_figures.data",
    "called": "gapcert_figures.diagnosis",
    "channel_playback": "gapcert_figures.playback",
    "drawn": "gapcert_figures.data",
    "gap_figure": "gapcert_figures.data",
    "loop_figure": "gapcert_figures.data",
    "loop_playback": "gapcert_figures.playback",
    "recorded_figure": "gapcert_figures.recording",
    "spoken": "gapcert_figures.diagnosis",
    "state_playback": "gapcert_figures.playback",
    "winning_figure": "gapcert_figures.data",
}

__all__ = sorted(_HOME)
sys.modules[__name__].__class__ = LazyPackage
