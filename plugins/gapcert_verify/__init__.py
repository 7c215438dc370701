"""Certificates checked again from their stored data, by code that no fit uses."""

from __future__ import annotations

import sys

from gapcert.plugin import LazyPackage

_HOME = {
    "Evidence": "gapcert_verify.evidence",
    "bounds": "gapcert_verify.evidence",
    "load": "gapcert_verify.evidence",
    "verify_run": "gapcert_verify.verify",
    "zone": "gapcert_verify.evidence",
}

__all__ = sorted(_HOME)
sys.modules[__name__].__class__ = LazyPackage
