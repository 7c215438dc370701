"""What recordings need before they are used: looks, rows of equal distance, transitions, experiments."""

from __future__ import annotations

import sys

from gapcert.plugin import LazyPackage

_HOME = {
    "JITTER": "gapcert_recordings.resampling",
    "Log": "gapcert_recordings.resampling",
    "Piece": "gapcert_recordings.resampling",
    "Table": "gapcert_recordings.inspect",
    "Transitions": "gapcert_recordings.transitions",
    "axes": "gapcert_recordings.transitions",
    "inspect": "gapcert_recordings.inspect",
    "pieces": "gapcert_recordings.resampling",
    "play": "gapcert_recordings.experiment",
    "repairs": "gapcert_recordings.repairs",
}

__all__ = sorted(_HOME)
sys.modules[__name__].__class__ = LazyPackage
