"""MuJoCo against one call to its C loop, which neither sets states nor returns them."""

from __future__ import annotations

import mujoco
import numpy as np

from engines.case import MODELS, PERIOD, Array, Engine, Peer


def peer(substeps: int) -> Peer:
    """mj_step(model, data, nstep=n · substeps): the engine with no Python at all. `answer` is a loop with a reset per row."""
    spec = mujoco.MjSpec.from_file(str(MODELS / "pendulum.urdf"))
    spec.compiler.boundinertia = 1e-15
    model = spec.compile()
    model.opt.timestep = PERIOD / substeps
    data = mujoco.MjData(model)

    def run(x: Array, u: Array) -> None:
        mujoco.mj_resetData(model, data)
        mujoco.mj_step(model, data, nstep=len(x) * substeps)

    def answer(x: Array, u: Array) -> Array:
        out = np.empty_like(x)
        for k in range(len(x)):
            mujoco.mj_resetData(model, data)
            data.qpos[0], data.qvel[0] = x[k]
            data.qfrc_applied[:] = u[k]
            mujoco.mj_step(model, data, nstep=substeps)
            out[k] = data.qpos[0], data.qvel[0]
        return out

    return Peer("one mj_step(model, data, nstep=n) call, in C", run, answer)


ENGINE = Engine("mujoco", peer, tiles=256, options={})
