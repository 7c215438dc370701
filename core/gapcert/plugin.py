"""What authors of plugins find: the contracts, and what is needed to keep them. Imported on first use."""

from __future__ import annotations

import sys

from gapcert.lazy import LazyPackage

_HOME = {
    "ANYWHERE": "gapcert.policies",
    "Answer": "gapcert.command",
    "Array": "gapcert.arrays",
    "Automaton": "gapcert.automaton",
    "Bools": "gapcert.arrays",
    "Box": "gapcert.domain",
    "Controller": "gapcert.control",
    "DAMAGE": "gapcert.damage",
    "Domain": "gapcert.domain",
    "Ellipsoid": "gapcert.region",
    "Emit": "gapcert.events",
    "Event": "gapcert.events",
    "Function": "gapcert.functions",
    "GapFunction": "gapcert.gap",
    "GapProblem": "gapcert.gap",
    "Goal": "gapcert.goal",
    "Interval": "gapcert.intervals",
    "Ints": "gapcert.arrays",
    "LazyPackage": "gapcert.lazy",
    "MOST": "gapcert.automaton",
    "MissingDependency": "gapcert.errors",
    "Options": "gapcert.command",
    "POLICIES": "gapcert.policies",
    "Policy": "gapcert.policies",
    "Polytope": "gapcert.region",
    "Predictor": "gapcert.gap",
    "Sloped": "gapcert.functions",
    "TURN": "gapcert.region",
    "Undecided": "gapcert.errors",
    "UsageError": "gapcert.errors",
    "Zone": "gapcert.relation",
    "by_order": "gapcert.policies",
    "clipped": "gapcert.errors",
    "cut": "gapcert.interpolation",
    "efforts": "gapcert.policies",
    "harmless": "gapcert.errors",
    "highest": "gapcert.interpolation",
    "interpolate": "gapcert.interpolation",
    "joined": "gapcert.interpolation",
    "known": "gapcert.policies",
    "load": "gapcert.components",
    "mean_value": "gapcert.functions",
    "npz_bytes": "gapcert.atomic_files",
    "on_curvature": "gapcert.interpolation",
    "registry": "gapcert.components",
    "rounding": "gapcert.interpolation",
    "silent": "gapcert.events",
    "smallest": "gapcert.automaton",
    "turned": "gapcert.region",
    "write_atomic": "gapcert.atomic_files",
}

__all__ = sorted(_HOME)
sys.modules[__name__].__class__ = LazyPackage
