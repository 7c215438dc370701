"""What authors of plugins find: the contracts, and what is needed to keep them. Imported on first use."""

from __future__ import annotations

import sys

from gapcert.lazy import LazyPackage

_HOME = {
    "Array": "gapcert.arrays",
    "Domain": "gapcert.domain",
    "Emit": "gapcert.events",
    "Event": "gapcert.events",
    "Function": "gapcert.functions",
    "GapFunction": "gapcert.gap",
    "GapProblem": "gapcert.gap",
    "Interval": "gapcert.intervals",
    "LazyPackage": "gapcert.lazy",
    "Predictor": "gapcert.gap",
    "Sloped": "gapcert.functions",
    "Undecided": "gapcert.errors",
    "UsageError": "gapcert.errors",
    "Zone": "gapcert.relation",
    "cut": "gapcert.interpolation",
    "highest": "gapcert.interpolation",
    "interpolate": "gapcert.interpolation",
    "joined": "gapcert.interpolation",
    "mean_value": "gapcert.functions",
    "on_curvature": "gapcert.interpolation",
    "registry": "gapcert.components",
    "rounding": "gapcert.interpolation",
    "silent": "gapcert.events",
}

__all__ = sorted(_HOME)
sys.modules[__name__].__class__ = LazyPackage
