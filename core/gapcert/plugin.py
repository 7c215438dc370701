"""What authors of plugins find: the contracts, and what is needed to keep them. Imported on first use."""

from __future__ import annotations

import sys

from gapcert.lazy import LazyPackage

_HOME = {
    "LazyPackage": "gapcert.lazy",
}

__all__ = sorted(_HOME)
sys.modules[__name__].__class__ = LazyPackage
