"""Constants and gap families: bounds of a residual from samples and slopes."""

from __future__ import annotations

import sys

from gapcert.plugin import LazyPackage, homes

_HOME = homes({
    "gapcert_bounds.families.multilinear": "MultilinearPredictor",
    "gapcert_bounds.families.stored": "calibrated stored",
})  # fmt: skip

__all__ = sorted(_HOME)
sys.modules[__name__].__class__ = LazyPackage
