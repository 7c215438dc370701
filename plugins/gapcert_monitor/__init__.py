"""A certificate held against new logs and against a running system."""

from __future__ import annotations

import sys

from gapcert.plugin import LazyPackage

_HOME = {
    "Certified": "gapcert_monitor.check",
    "Check": "gapcert_monitor.check",
    "Monitor": "gapcert_monitor.check",
    "Observation": "gapcert_monitor.check",
    "check": "gapcert_monitor.check",
    "read_log": "gapcert_monitor.check",
}

__all__ = sorted(_HOME)
sys.modules[__name__].__class__ = LazyPackage
