"""Bands that fresh points or recordings have set: route calibrate."""

from __future__ import annotations

import sys

from gapcert.plugin import LazyPackage, homes

_HOME = homes(
    {
        "gapcert_calibrate.recording_certificate": "CalibratedRecording calibrate_recording",
    }
)

__all__ = sorted(_HOME)
sys.modules[__name__].__class__ = LazyPackage
