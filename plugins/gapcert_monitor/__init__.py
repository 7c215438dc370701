"""A certificate held against new logs and against a running system."""

from __future__ import annotations

import sys

from gapcert.plugin import LazyPackage, homes

_HOME = homes(
    {
        "gapcert_monitor.check": "Certified Check Monitor Observation check read_log",
    }
)

__all__ = sorted(_HOME)
sys.modules[__name__].__class__ = LazyPackage
