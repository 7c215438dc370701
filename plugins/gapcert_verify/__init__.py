"""Certificates checked again from their stored data, by code that no fit uses."""

from __future__ import annotations

import sys

from gapcert.plugin import LazyPackage, homes

_HOME = homes(
    {
        "gapcert_verify.evidence": "Evidence bounds load",
        "gapcert_verify.verify": "verify_run",
    }
)

__all__ = sorted(_HOME)
sys.modules[__name__].__class__ = LazyPackage
