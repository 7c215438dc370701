"""What recordings need before they are used: looks, rows of equal distance, transitions, experiments."""

from __future__ import annotations

import sys

from gapcert.plugin import LazyPackage, homes

_HOME = homes(
    {
        "gapcert_recordings.copies": "Copies Copy",
        "gapcert_recordings.experiment": "play",
        "gapcert_recordings.inspect": "Column Table flawed in_words inspect not_numbers sentence",
        "gapcert_recordings.resampling": "JITTER Log Piece pieces repairs",
        "gapcert_recordings.transitions": "Transitions axes",
    }
)

__all__ = sorted(_HOME)
sys.modules[__name__].__class__ = LazyPackage
