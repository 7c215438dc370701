"""Networks and proofs of their slopes and ranges: a kit of gap families."""

from __future__ import annotations

import sys

from gapcert.plugin import LazyPackage

_HOME = {
    "LocalBound": "gapcert_networks.network_local",
    "Network": "gapcert_networks.network",
    "NetworkBound": "gapcert_networks.bounds",
    "NetworkCertifier": "gapcert_networks.bounds",
    "Proposal": "gapcert_networks.bounds",
    "local_bound": "gapcert_networks.network_local",
    "proved_balanced": "gapcert_networks.scaling",
    "raised": "gapcert_networks.theorem1_network",
}

__all__ = sorted(_HOME)
sys.modules[__name__].__class__ = LazyPackage
