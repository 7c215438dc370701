"""Robots whose joints have ends as the simulation: data that keep clear of them, data that do not, and domains."""

import numpy as np
import pytest

import gapcert as gc
import gapcert_engines
from gapcert.testing import multisine
from gapcert_diagnosis.data.dataset import Dataset
from gapcert_diagnosis.experiment import Limits
from gapcert_mujoco.config import MuJoCoConfig
from gapcert_report.words.summary import in_words

pytestmark = [pytest.mark.needs("mujoco"), pytest.mark.contract]


ROD = """<mujoco><compiler angle="radian"/><option timestep="0.002"/><worldbody>
  <body name="rod"><joint name="hinge" axis="0 1 0" armature="0.01" range="{}" margin="0.02"/>
    <inertial pos="0 0 -0.5" mass="1" diaginertia="0.09 0.09 0.001"/>
  </body></worldbody></mujoco>"""


def backend(folder, ends="-2 1.5"):
    from gapcert_mujoco.engine import MuJoCoEngine

    (folder / "robot.xml").write_text(ROD.format(ends))
    states = {"q": "hinge.position", "q_dot": "hinge.velocity"}
    config = {"kind": "mujoco", "robot": "robot.xml", "states": states, "inputs": {"u": "hinge"}, "period": "4 ms"}
    return gapcert_engines.EngineBackend(MuJoCoEngine(MuJoCoConfig.model_validate(config), folder=folder))


def recorded(system, size=2.0, noise=1e-3):
    """With more damping than the file says."""
    u = multisine(10.0, system.period, size, (0.1, 3.0), 3)
    x = system.rollout(np.array([[0.3, 0.0]]), u[None], parameters={"damping.hinge": np.array([0.05])}).x[0, :-1]
    y = x[:, 0] + noise * np.random.default_rng(0).standard_normal(len(x))
    return gc.Recording.of(np.arange(len(u)) * system.period, {"q": y, "u": u[:, 0]})


def test_a_joint_that_keeps_clear_of_its_ends_is_diagnosed(tmp_path):
    system = backend(tmp_path)
    model, log = gapcert_engines.EngineModel(system), recorded(system)
    # A constraint of MuJoCo's begins to act within its margin.
    assert model.within == {"q": (-1.98, 1.48)}
    found = gc.diagnose(model, log, horizons=[0.5])
    assert [c.native for c in found.causes] == ["damping.hinge"]
    left = min(1.98 + float(log.trajectories[0].channels["q"].min()), 1.48 - float(log.trajectories[0].channels["q"].max()))
    (said,) = found.summary()["assumptions"]
    assert said.startswith(f"no limit of a joint is reached: the data come no nearer than {left:.3g} rad (q, to ")
    assert "  assumed: " + said in list(in_words(found.summary() | {"sentence": found.sentence()}))
    assert found.extended_model.within == model.within
    low, high = Limits.of(model, Dataset.of(model, log)).outputs["q"]
    assert log.trajectories[0].channels["q"].min() <= low < high <= log.trajectories[0].channels["q"].max()


@pytest.mark.parametrize("ends", ["-0.6 0.6", "-0.45 2"])
def test_data_that_reach_an_end_are_refused(tmp_path, ends):
    system = backend(tmp_path, ends)
    with pytest.raises(gc.UsageError, match=r"q comes to .* rad from .*, where the robot file ends its range"):
        gc.diagnose(gapcert_engines.EngineModel(system), recorded(system, 3.0), horizons=[0.5])


def test_a_certificate_is_not_asked_where_a_joint_ends(tmp_path):
    system = backend(tmp_path)
    model = gapcert_engines.EngineModel(system)
    wide = gc.Domain.of(model, {"q": (-1, 1.6), "q_dot": (-1, 1), "u": (-1, 1)})
    with pytest.raises(gc.UsageError, match=r"domain\.q: .* -1 to 1\.6 rad, and the joint's range is -1\.98 to 1\.48"):
        gc.certify(model, system, wide, folder=tmp_path / "run")
