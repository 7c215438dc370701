"""Controllers run on a backend, with γ and without."""

from __future__ import annotations

import sys

from gapcert.plugin import LazyPackage

_HOME = {
    "Ahead": "gapcert_closed_loop.prediction",
    "ClosedLoop": "gapcert_closed_loop.closed_loop",
    "Foreseen": "gapcert_closed_loop.prediction",
    "Learned": "gapcert_closed_loop.parameter_sets",
    "Trace": "gapcert_closed_loop.closed_loop",
    "broken_sentence": "gapcert_closed_loop.failures",
    "closed_loop": "gapcert_closed_loop.closed_loop",
    "figures": "gapcert_closed_loop.parameter_sets",
    "followed": "gapcert_closed_loop.prediction",
    "foreseen": "gapcert_closed_loop.prediction",
}

__all__ = sorted(_HOME)
sys.modules[__name__].__class__ = LazyPackage
