"""Networks and proofs of their slopes and ranges: a kit of gap families."""

from __future__ import annotations

import sys

from gapcert.plugin import LazyPackage, homes

_HOME = homes(
    {
        "gapcert_networks.bounds": "NetworkBound NetworkCertifier Proposal",
        "gapcert_networks.network": "Network",
        "gapcert_networks.network_constant": "proved_balanced",
        "gapcert_networks.network_local": "LocalBound local_bound",
        "gapcert_networks.theorem1_network": "raised",
    }
)

__all__ = sorted(_HOME)
sys.modules[__name__].__class__ = LazyPackage
