"""What recordings need before they are used: looks, rows of equal distance, transitions, experiments."""

from __future__ import annotations

import sys

from gapcert.plugin import LazyPackage

_HOME = {
    "Table": "gapcert_recordings.inspect",
    "Transitions": "gapcert_recordings.transitions",
    "axes": "gapcert_recordings.transitions",
    "inspect": "gapcert_recordings.inspect",
    "play": "gapcert_recordings.experiment",
}

__all__ = sorted(_HOME)
sys.modules[__name__].__class__ = LazyPackage
