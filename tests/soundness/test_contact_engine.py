"""A real contact: a ball that MuJoCo lets fall on a plane, against free flight."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import gapcert as gc
from gapcert.certification.samples.executors import threads
from gapcert_bounds.constants.piecewise import Piecewise
from gapcert_bounds.constants.wood_zhang import WoodZhang
from gapcert_verify.verify import verify_run

pytestmark = pytest.mark.contract

BALL = """
<mujoco><option timestep="0.005" integrator="Euler"/><worldbody><geom type="plane" size="5 5 1"/>
<body pos="0 0 0.1"><joint type="slide" axis="0 0 1"/>
<geom type="sphere" size="0.1" mass="1"/></body></worldbody>
<actuator><motor joint="0"/></actuator></mujoco>""".replace("<joint type", '<joint name="0" type')
STATES, INPUTS = (gc.StateSpec("height", "m"), gc.StateSpec("speed", "m/s")), (gc.StateSpec("push", "N"),)
PERIOD, SUBSTEPS = 0.05, 10


class Ball(gc.Backend):
    """Height above the floor and vertical speed; every query starts from a state that is reset as a whole."""

    def __init__(self):
        self.states, self.inputs, self.period, self.substeps = STATES, INPUTS, PERIOD, SUBSTEPS

    def _step(self, x, u, **options: Any):
        import mujoco

        model = mujoco.MjModel.from_xml_string(BALL)
        data, out = mujoco.MjData(model), np.empty_like(x)
        for k in range(len(x)):
            mujoco.mj_resetData(model, data)
            data.qpos[0], data.qvel[0], data.ctrl[0] = x[k, 0], x[k, 1], u[k, 0]
            mujoco.mj_step(model, data, nstep=SUBSTEPS)
            out[k] = data.qpos[0], data.qvel[0]
        return out


@pytest.fixture(scope="module")
def flight():
    config = (
        gc.registry()
        .config("model", "equations")
        .model_validate(
            {
                "kind": "equations",
                "states": {"height": "m", "speed": "m/s"},
                "inputs": {"push": "N"},
                "parameters": {"m": "1 kg", "g": "9.81 m/s^2", "tau": "0.05 s"},
                "next": {"height": "height + tau*speed + 0.55*tau**2*(push/m - g)", "speed": "speed + tau*(push/m - g)"},
                "period": "50 ms",
            }
        )
    )
    return gc.registry().build("model", "equations", config)


@pytest.mark.exam
def test_a_falling_ball_is_certified_per_cell(flight, tmp_path):
    pytest.importorskip("mujoco")
    domain = gc.Domain.of(flight, {"height": (0.0, 0.3), "speed": (-3.0, 3.0), "push": (-2.0, 2.0)})
    request = gc.Request("statistical", attack=50_000)
    made = {
        name: gc.certify(flight, Ball(), domain, lipschitz=estimator, folder=tmp_path / name, executor=threads, request=request)
        for name, estimator in (("cells", Piecewise()), ("one", WoodZhang()))
    }
    ours, flat = made["cells"], made["one"]
    ours.save(tmp_path / "cells")
    assert ours.holds
    assert ours.claim.kind == "statistical"
    assert verify_run(tmp_path / "cells")["verdict"] == "holds"
    assert not flat.holds or all(flat.states[s].gamma_mean > 1.5 * ours.states[s].gamma_mean for s in ("height", "speed"))
