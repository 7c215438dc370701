"""Bands that fresh points or recordings have set: route calibrate."""

from __future__ import annotations

import sys

from gapcert.plugin import LazyPackage

_HOME = {
    "CalibratedRecording": "gapcert_calibrate.recording_certificate",
    "calibrate_recording": "gapcert_calibrate.recording_certificate",
}

__all__ = sorted(_HOME)
sys.modules[__name__].__class__ = LazyPackage
