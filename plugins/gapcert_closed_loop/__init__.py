"""Controllers run on a backend, with γ and without."""

from __future__ import annotations

import sys

from gapcert.plugin import LazyPackage

_HOME = {
    "ClosedLoop": "gapcert_closed_loop.closed_loop",
    "closed_loop": "gapcert_closed_loop.closed_loop",
}

__all__ = sorted(_HOME)
sys.modules[__name__].__class__ = LazyPackage
