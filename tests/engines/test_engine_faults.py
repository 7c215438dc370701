"""What goes wrong with engines by default, planted raw: the gates before a certificate catch each of them."""

from __future__ import annotations

import numpy as np
import pytest

import gapcert as gc
from gapcert.certification.gates.entry import responses
from gapcert.certification.gates.purity import purity
from gapcert.certification.samples.executors import threads
from gapcert.contracts.gaps.lipschitz import Residual

pytestmark = pytest.mark.contract

PERIOD = 0.005
ROD = """<?xml version="1.0"?>
<robot name="rod">
  <link name="base"><inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
  <link name="rod">
    <inertial>
      <origin xyz="0 0 -0.5"/><mass value="1"/>
      <inertia ixx="0.0833333333333" ixy="0" ixz="0" iyy="0.0833333333333" iyz="0" izz="1e-5"/>
    </inertial>
  </link>
  <joint name="hinge" type="continuous">
    <parent link="base"/><child link="rod"/><origin xyz="0 0 2"/><axis xyz="0 1 0"/>
  </joint>
</robot>
"""
MODEL = {
    "kind": "equations",
    "states": {"theta": {"unit": "rad", "kind": "angle"}, "omega": "rad/s"},
    "inputs": {"torque": "N*m"},
    "parameters": {"m": "1 kg", "l": "1 m", "g": "9.81 m/s^2", "tau": "5 ms"},
    "derivative": {"theta": "omega", "omega": "-3*g/(2*l)*sin(theta) + 3*torque/(m*l**2)"},
    "integrator": "semi_implicit",
    "period": "5 ms",
}
RANGES = {"theta": (-0.2, 0.2), "omega": (-0.25, 0.25), "torque": (-1.0, 1.0)}


@pytest.fixture(scope="module")
def model():
    return gc.load_spec({"version": 1, "name": "rod", "model": MODEL}).build("model")


class Raw(gc.Backend):
    """PyBullet as a beginner calls it, one switch wrong."""

    def __init__(self, path, model, *, motor=True, inertia=True, step=PERIOD):
        import pybullet

        self.states, self.inputs, self.period, self.engine = model.states, model.inputs, PERIOD, pybullet
        self.client = pybullet.connect(pybullet.DIRECT)
        flags = pybullet.URDF_USE_INERTIA_FROM_FILE if inertia else 0
        self.body = pybullet.loadURDF(str(path), useFixedBase=True, flags=flags, physicsClientId=self.client)
        pybullet.setGravity(0, 0, -9.81, self.client)
        pybullet.setTimeStep(step, self.client)
        pybullet.changeDynamics(self.body, -1, linearDamping=0, angularDamping=0, physicsClientId=self.client)
        if not motor:
            pybullet.setJointMotorControl2(self.body, 0, pybullet.VELOCITY_CONTROL, force=0, physicsClientId=self.client)

    def _step(self, x, u, **options):
        p, out = self.engine, np.empty_like(x)
        for k in range(len(x)):
            p.resetJointState(self.body, 0, x[k, 0], x[k, 1], self.client)
            p.setJointMotorControl2(self.body, 0, p.TORQUE_CONTROL, force=u[k, 0], physicsClientId=self.client)
            p.stepSimulation(self.client)
            out[k] = p.getJointState(self.body, 0, self.client)[:2]
        return out


@pytest.fixture
def raw(tmp_path, model):
    pytest.importorskip("pybullet")
    path = tmp_path / "rod.urdf"
    path.write_text(ROD)
    made = []

    def make(**switches):
        made.append(Raw(path, model, **switches))
        return made[-1]

    yield make
    for system in made:
        system.engine.disconnect(system.client)


def told(system, model):
    return responses(Residual(system, model), gc.Domain.of(model, RANGES), 0)


def test_a_clean_engine_passes(raw, model):
    assert told(raw(motor=False), model) == []


def test_the_default_motor_is_told(raw, model):
    found = told(raw(), model)
    assert [f.partition(";")[0] for f in found] == [
        f"{name} of f̂ does not answer to torque at all, and that of f does" for name in ("theta", "omega")
    ]


def test_the_missing_inertia_flag_is_told(raw, model):
    assert any("torque moves omega of f̂ 1.3 times as far" in f for f in told(raw(motor=False, inertia=False), model))


def test_one_step_of_another_length_is_told(raw, model):
    assert any("torque moves omega of f̂ 0.83 times as far" in f for f in told(raw(motor=False, step=1 / 240), model))


# --- contacts: what engines remember between queries


class Box(gc.Backend):
    """A box that slides on the ground in PyBullet: pose and velocity are reset, contact caches are not (unless `restore`)."""

    def __init__(self, restore):
        import pybullet as p

        self.states, self.inputs = (gc.StateSpec("x", "m"),), (gc.StateSpec("vx", "m/s"),)
        self.period, self.restore, self.engine = 0.05, restore, p
        c = self.client = p.connect(p.DIRECT)
        p.setGravity(0, 0, -9.81, c)
        ground = p.createCollisionShape(p.GEOM_PLANE, physicsClientId=c)
        p.createMultiBody(0, ground, physicsClientId=c)
        shape = p.createCollisionShape(p.GEOM_BOX, halfExtents=[0.1, 0.1, 0.1], physicsClientId=c)
        self.body = p.createMultiBody(1, shape, basePosition=[0, 0, 0.1], physicsClientId=c)
        p.setTimeStep(1 / 240, c)
        p.stepSimulation(c)
        self.snapshot = p.saveState(c)

    def _step(self, x, u, **options):
        p, c, out = self.engine, self.client, np.empty_like(x)
        for k in range(len(x)):
            if self.restore:
                p.restoreState(self.snapshot, physicsClientId=c)
            p.resetBasePositionAndOrientation(self.body, [x[k, 0], 0, 0.1], [0, 0, 0, 1], c)
            p.resetBaseVelocity(self.body, [u[k, 0], 0, 0], [0, 0, 0], c)
            for _ in range(12):
                p.stepSimulation(c)
            out[k, 0] = p.getBasePositionAndOrientation(self.body, c)[0][0]
        return out

    def __reduce__(self):
        return Box, (self.restore,)


SLIDE = {"x": (-0.01, 0.01), "vx": (-1.0, 1.0)}


@pytest.mark.fault("an engine answers by its contact cache", shows="refused, with the difference")
def test_contact_caches_that_are_not_restored_are_refused():
    pytest.importorskip("pybullet")
    leaky, clean = Box(False), Box(True)
    try:
        with pytest.raises(gc.UsageError, match=r"not a function of \(x, u\).*in another order.*x by .* of its mean move"):
            purity("backend", leaky, gc.Domain.of(leaky, SLIDE), threads, 0)
        assert "agreed bit for bit" in purity("backend", clean, gc.Domain.of(clean, SLIDE), threads, 0)
    finally:
        for system in (leaky, clean):
            system.engine.disconnect(system.client)


SLIDER = """
<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    <geom type="plane" size="9 9 1"/>
    <body pos="0 0 0.1"><freejoint/><geom type="box" size="0.1 0.1 0.1" mass="1"/></body>
  </worldbody>
</mujoco>
"""


class Slider(gc.Backend):
    """The same in MuJoCo, with positions and velocities set and the solver's warm start left as it was (unless `reset`)."""

    def __init__(self, reset):
        import mujoco

        self.states, self.inputs = (gc.StateSpec("x", "m"),), (gc.StateSpec("vx", "m/s"),)
        self.period, self.reset, self.engine = 0.05, reset, mujoco
        self.model = mujoco.MjModel.from_xml_string(SLIDER)
        self.data = mujoco.MjData(self.model)

    def _step(self, x, u, **options):
        m, d, out = self.model, self.data, np.empty_like(x)
        for k in range(len(x)):
            if self.reset:
                self.engine.mj_resetData(m, d)
            d.qpos[:] = [x[k, 0], 0, 0.099, 1, 0, 0, 0]
            d.qvel[:] = [u[k, 0], 0, 0, 0, 0, 0]
            self.engine.mj_step(m, d, 25)
            out[k, 0] = d.qpos[0]
        return out

    def __reduce__(self):
        return Slider, (self.reset,)


@pytest.mark.fault("an engine answers by its last query (warm start)", shows="refused, with the difference")
def test_a_warm_start_that_leaks_is_refused():
    pytest.importorskip("mujoco")
    with pytest.raises(gc.UsageError, match=r"not a function of \(x, u\).*differ by up to \d.*e-(0[7-9]|1\d): x by"):
        purity("backend", Slider(False), gc.Domain.of(Slider(False), SLIDE), threads, 0)
    assert "agreed bit for bit" in purity("backend", Slider(True), gc.Domain.of(Slider(True), SLIDE), threads, 0)


# --- hidden state, from a spec


SPEC = {
    "version": 1,
    "name": "held",
    "model": {**MODEL, "states": {"theta": "rad"}, "derivative": {"theta": "3*tau*torque/(m*l**2)"}},
    "backend": {
        "kind": "pybullet",
        "robot": "rod.urdf",
        "fixed_base": True,
        "states": {"theta": "hinge.position"},
        "inputs": {"torque": "hinge"},
    },
    "domain": {"theta": ["-0.2 rad", 0.2], "torque": [-1, 1]},
    "sampling": {"kind": "adaptive", "budget": 60},
    "lipschitz": {"residual": {"kind": "wood-zhang", "pairs": 200, "batches": 20}},
    "certificate": {"claim": "statistical", "violation": 0.05, "confidence": 0.9},
    "report": {"html": False, "rerun": False},
}


@pytest.fixture
def run(tmp_path, monkeypatch):
    pytest.importorskip("pybullet")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rod.urdf").write_text(ROD)

    def call(**more):
        return gc.run({**SPEC, **more}, out=tmp_path / "runs", executor="threads")

    return call


def test_a_position_alone_is_refused_by_default(run):
    with pytest.raises(gc.UsageError, match=r"hidden state \(hinge\.velocity\).*From \(x, u\) = .* it steps to .*, and to"):
        run()


def test_a_certificate_from_rest_fails_in_motion(run):
    made = run(hidden="default")
    hidden = made.summary["certificate"]["hidden"]
    assert made.summary["verdict"] == "fails"
    assert made.exit_code == 1
    assert made.summary["reason"].startswith("γ of the default hidden state does not hold for others")
    assert (hidden["mode"], hidden["harmless"]) == ("default", False)
    assert abs(hidden["attack"]["witness"]["residual"]) > hidden["attack"]["witness"]["gamma"]


def test_ranges_of_a_spec_are_drawn_from_in_their_units(run):
    made = run(hidden={"sample": {"ranges": {"hinge.velocity": ["-0.25 rad/s", 0.25]}, "safety": 1.0}})
    hidden = made.summary["certificate"]["hidden"]
    assert made.summary["verdict"] == "holds"
    # θ⁺ = θ + τ ω + …: half the difference between the two ends of the range.
    assert hidden["bound"]["theta"] == pytest.approx(PERIOD * 0.25, rel=1e-2)
    assert "hinge.velocity ∈ [-0.25, 0.25]" in made.summary["reason"]


def test_visited_states_of_a_spec(run):
    made = run(hidden={"sample": {"visited": {"runs": 20, "steps": 12, "near": 4}}})
    assert made.summary["certificate"]["hidden"]["mode"] == "sample"
    assert "one of the 4 nearest of" in made.summary["reason"]


def test_augmented_states_have_ranges_in_the_domain(run):
    made = run(hidden="augment", domain={**SPEC["domain"], "hinge.velocity": ["-0.25 rad/s", 0.25]})
    assert list(made.summary["certificate"]["states"]) == ["theta", "hinge.velocity"]
    assert made.summary["certificate"]["hidden"]["names"] == ["hinge.velocity"]
    assert made.summary["verdict"] == "holds"
    with pytest.raises(gc.UsageError, match=r"add hinge\.velocity: \[low, high\]"):
        run(hidden="augment")
    with pytest.raises(gc.SpecError, match="'speed' is no hidden state of the backend"):
        run(hidden="augment", domain={**SPEC["domain"], "speed": [-1, 1]})
    with pytest.raises(gc.SpecError, match="unit 'm' does not fit; expected rad/s"):
        run(hidden="augment", domain={**SPEC["domain"], "hinge.velocity": ["-1 m", 1]})


@pytest.mark.parametrize(
    ("section", "message"),
    [
        ("augmnt", "found 'augmnt'; expected refuse, augment, default or a mapping with sample"),
        ({"sample": {}}, "expected either `ranges: "),
        ({"sampel": {}}, "unknown key 'sampel'"),
        ({"sample": {"visited": {"steps": 1}}}, "hidden.sample.visited.steps"),
        ({"sample": {"ranges": {"a": [0, 1]}, "safety": 0.5}}, "hidden.sample.safety"),
    ],
)
def test_faults_of_the_section_are_told(run, section, message):
    with pytest.raises(gc.SpecError) as told_:
        run(hidden=section)
    assert message in str(told_.value)


SLIDER_ARM = """<?xml version="1.0"?>
<robot name="arm">
  <link name="base"><inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
  <link name="cart">
    <inertial><mass value="0.05"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>
  </link>
  <joint name="rail" type="prismatic">
    <parent link="base"/><child link="cart"/><axis xyz="1 0 0"/><limit lower="1" upper="-1" effort="9" velocity="9"/>
    <dynamics damping="1"/>
  </joint>
</robot>
"""


@pytest.mark.exam
def test_loops_of_a_spec_count_what_was_not_covered(run, tmp_path):
    (tmp_path / "arm.urdf").write_text(SLIDER_ARM)
    model = {
        "kind": "equations",
        "states": {"p": "m"},
        "inputs": {"F": "N"},
        "parameters": {"d": "1 N*s/m"},
        "derivative": {"p": "F/d"},
        "integrator": "euler",
        "period": "0.2 s",
    }
    backend = {
        "kind": "pybullet",
        "robot": "arm.urdf",
        "fixed_base": True,
        "substeps": 20,
        "states": {"p": "rail.position"},
        "inputs": {"F": "rail"},
    }
    outside = {}
    for reach in (1.2, 0.2):
        made = run(
            name=f"arm-{10 * reach:g}",
            model=model,
            backend=backend,
            domain={"p": [-1, 1], "F": [-1, 1]},
            hidden={"sample": {"ranges": {"rail.velocity": [-reach, reach]}, "safety": 1.0}},
            controller={
                "kind": "symbolic",
                "goal": {"invariance": {"p": [-1, 1]}},
                "cells": {"p": 40},
                "inputs": {"F": 9},
            },
            closed_loop={"steps": 30, "starts": 5},
        )
        outside[reach] = made.summary["closed_loop"]["hidden_outside"]
        # Each of the 20 sub-steps leaves 0.8 of the speed (and Bullet's drag a little less): Σ 0.8^k · 10 ms over k = 1, …, 20.
        travelled = 0.01 * 0.8 * (1 - 0.8**20) / 0.2
        assert made.summary["certificate"]["hidden"]["bound"]["p"] == pytest.approx(travelled * reach, rel=1e-2)
    # Speeds end near F/d, at most 1 m/s.
    assert outside[1.2] == 0
    assert 0.3 < outside[0.2] <= 1
