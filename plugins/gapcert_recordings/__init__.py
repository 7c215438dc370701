"""What recordings need before they are used: looks, rows of equal distance, transitions, experiments."""

from __future__ import annotations

import sys

from gapcert.plugin import LazyPackage

_HOME = {
    "Column": "gapcert_recordings.inspect",
    "JITTER": "gapcert_recordings.resampling",
    "Log": "gapcert_recordings.resampling",
    "Piece": "gapcert_recordings.resampling",
    "Table": "gapcert_recordings.inspect",
    "Transitions": "gapcert_recordings.transitions",
    "axes": "gapcert_recordings.transitions",
    "in_words": "gapcert_recordings.inspect",
    "inspect": "gapcert_recordings.inspect",
    "not_numbers": "gapcert_recordings.inspect",
    "pieces": "gapcert_recordings.resampling",
    "play": "gapcert_recordings.experiment",
    "repairs": "gapcert_recordings.repairs",
    "sentence": "gapcert_recordings.inspect",
}

__all__ = sorted(_HOME)
sys.modules[__name__].__class__ = LazyPackage
