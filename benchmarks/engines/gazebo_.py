"""Gazebo's physics against a loop in C++ over its own calls, exported by the shim."""

from __future__ import annotations

import numpy as np

from engines.case import MODELS, PERIOD, Array, Engine, Peer
from gapcert_gazebo.shim import shim
from gapcert_gazebo.world import opened


def peer(substeps: int) -> Peer:
    """What a user would write in C++: no Python, no checks, nothing that another robot would need."""
    path = MODELS / "pendulum.sdf"
    handle = opened(path.read_text(), ("", "", ""), round(PERIOD / substeps * 1e9), str(path))

    def run(x: Array, u: Array) -> Array:
        after = np.empty_like(x)
        shim().bare(handle, len(x), substeps, x.ctypes.data, u.ctypes.data, after.ctypes.data)
        return after

    return Peer("bare C++ loop over SetPosition, SetVelocity, SetForce, Step, GetPosition, GetVelocity", run, run)


ENGINE = Engine("gazebo", peer, tiles=1, options={"robot": MODELS / "pendulum.sdf"})
