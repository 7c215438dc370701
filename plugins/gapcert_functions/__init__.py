"""Functions with bounds over boxes, and how they are lifted above an envelope: a kit of gap families."""

from __future__ import annotations

import sys

from gapcert.plugin import LazyPackage, homes

_HOME = homes(
    {
        "gapcert_functions.bounded_function": "Function Sloped mean_value",
        "gapcert_functions.dominating": "DominatingGap band dominate",
        "gapcert_functions.expression": "Expression",
        "gapcert_functions.lifting": "Band Cones Part Side Table lift",
        "gapcert_functions.sums": "Factor Term WeightedSum weighted",
    }
)

__all__ = sorted(_HOME)
sys.modules[__name__].__class__ = LazyPackage
