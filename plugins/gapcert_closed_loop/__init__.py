"""Controllers run on a backend, with γ and without."""

from __future__ import annotations

import sys

from gapcert.plugin import LazyPackage, homes

_HOME = homes(
    {
        "gapcert_closed_loop.closed_loop": "ClosedLoop Trace closed_loop",
        "gapcert_closed_loop.loop_audit": "broken_sentence",
        "gapcert_closed_loop.prediction": "Ahead Foreseen Learned figures followed foreseen",
    }
)

__all__ = sorted(_HOME)
sys.modules[__name__].__class__ = LazyPackage
