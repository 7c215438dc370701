"""Which simulator? A matrix of certificates, and backend against backend."""

from __future__ import annotations

import sys

from gapcert.plugin import LazyPackage, homes

_HOME = homes(
    {
        "gapcert_compare.compare": "Comparison closed",
    }
)

__all__ = sorted(_HOME)
sys.modules[__name__].__class__ = LazyPackage
