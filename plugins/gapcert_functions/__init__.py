"""Functions with bounds over boxes, and how they are lifted above an envelope: a kit of gap families."""

from __future__ import annotations

import sys

from gapcert.plugin import LazyPackage

_HOME = {
    "Band": "gapcert_functions.multilinear_bands",
    "Cones": "gapcert_functions.lifting",
    "DominatingGap": "gapcert_functions.dominating",
    "Expression": "gapcert_functions.expression",
    "Factor": "gapcert_functions.products",
    "Part": "gapcert_functions.lifting",
    "Side": "gapcert_functions.lifting",
    "Table": "gapcert_functions.lifting",
    "Term": "gapcert_functions.products",
    "WeightedSum": "gapcert_functions.sums",
    "band": "gapcert_functions.dominating",
    "dominate": "gapcert_functions.dominating",
    "lift": "gapcert_functions.lifting",
    "weighted": "gapcert_functions.sums",
}

__all__ = sorted(_HOME)
sys.modules[__name__].__class__ = LazyPackage
