"""Backend `gymnasium`: closed forms, ends of episodes, precision, discrete actions, MuJoCo's own, and its user's mistakes."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from rod import query, semi_implicit

import gapcert as gc
from gapcert import Context, UsageError, registry
from gapcert.testing import SystemContract
from gapcert_gymnasium.config import GymnasiumConfig

pytestmark = [pytest.mark.needs("gymnasium"), pytest.mark.contract]


ROOT = Path(__file__).parents[2]
PENDULUM = {"env": "Pendulum-v1", "states": {"theta": "theta", "omega": "theta_dot"}, "inputs": {"torque": "torque"}}
CARTPOLE = {
    "env": "CartPole-v1",
    "states": {"x": "x", "v": "x_dot", "theta": "theta", "omega": "theta_dot"},
    "inputs": {"force": "force"},
}
CAR = {
    "env": "MountainCarContinuous-v0",
    "states": {"p": "position", "v": "velocity"},
    "inputs": {"push": "force"},
    "period": "1 s",
}
ACROBOT = {
    "env": "Acrobot-v1",
    "states": {"a": "theta1", "b": "theta2", "da": "theta1_dot", "db": "theta2_dot"},
    "inputs": {"torque": {"action": "torque", "levels": {0: -1, 1: 0, 2: 1}}},
}
INVERTED = {
    "env": "InvertedPendulum-v5",
    "states": {"x": "slider.position", "theta": "hinge.position", "v": "slider.velocity", "omega": "hinge.velocity"},
    "inputs": {"push": "slide"},
}
DRUM = {
    "env": "gym_drum:Drum-v0",
    "states": {"rate": "rate", "heat": "heat"},
    "inputs": {"torque": "torque"},
    "state": {"rate": {"unit": "rad/s"}, "heat": {"unit": "J"}},
    "action": {"torque": {"unit": "N*m"}},
    "attribute": "condition",
    "period": "0.1 s",
}
MODEL = {
    "kind": "equations",
    "states": {"theta": "rad", "omega": "rad/s"},
    "derivative": {"theta": "omega", "omega": "torque/J"},
    "period": "10 ms",
}
needs_mujoco = pytest.mark.needs("mujoco", "imageio")


def backend(section=PENDULUM, **options):
    from gapcert_gymnasium.system import GymnasiumBackend

    return GymnasiumBackend(GymnasiumConfig.model_validate(section | options))


class TestPendulum(SystemContract):
    def system(self):
        return backend(period="20 ms")


@pytest.mark.exam
class TestAcrobotWithHiddenRates(SystemContract):
    rows = 9

    def system(self):
        return backend(ACROBOT, states={"a": "theta1", "b": "theta2"})


class TestSinglePrecisionCar(SystemContract):
    rows = 9

    def system(self):
        return backend(CAR)

    def points(self, system):
        x, u = query(self.rows, 2)
        return (x * [0.5, 0.03] + [-0.4, 0]).astype(np.float32).astype(float), u


@needs_mujoco
class TestHopper(SystemContract):
    """On the ground: contacts, whose solver starts warm unless it is told not to."""

    rows = 7

    def system(self):
        states = {"z": "rootz.position", "vz": "rootz.velocity"}
        return backend({"env": "Hopper-v5", "states": states, "inputs": {"thigh": "action[0]"}})

    def points(self, system):
        x, u = query(self.rows, 2)
        return x * [0.02, 0.5] + [1.22, 0], u


# The physics


def test_pendulum_is_semi_implicit_euler_inside_its_limits():
    x, u = query(50, 2)
    b = backend(options={"g": 9.81})
    assert b.period == 0.05
    for g, given in ((9.81, None), (3.7, {"g": 3.7})):
        expected = semi_implicit(x, u, tau=0.05, gravity=(0.0, g))
        assert np.abs(b.step(x, u, parameters=given).x - expected).max() <= 1e-15
    fast, strong = np.array([[0.0, 7.9]]), np.array([[5.0]])
    assert b.step(fast, strong).x[0, 1] == 8.0


def test_cartpole_goes_on_where_an_episode_would_end():
    """Beyond 12 degrees and 2.4 m it is the same equation; the force is one of two."""
    x = np.array([[3.0, 1.0, 0.5, -1.0], [0.0, 0.0, 0.1, 0.0]])
    u = np.array([[7.0], [-2.0]])
    found = backend(CARTPOLE).rollout(x, np.repeat(u[:, None], 3, axis=1)).x
    for _ in range(3):
        force, m, big, half = 10 * np.sign(u[:, 0]), 0.1, 1.0, 0.5
        _, v, th, om = x.T
        temp = (force + m * half * om**2 * np.sin(th)) / (m + big)
        alpha = (9.8 * np.sin(th) - np.cos(th) * temp) / (half * (4 / 3 - m * np.cos(th) ** 2 / (m + big)))
        a = temp - m * half * alpha * np.cos(th) / (m + big)
        x = x + 0.02 * np.stack([v, a, om, alpha], axis=1)
    assert np.abs(found[:, -1] - x).max() < 1e-13


def test_masses_carry_what_follows_from_them():
    """CartPole keeps the sum of its masses beside them."""
    import gymnasium

    x, u = query(5, 4)
    heavy = backend(CARTPOLE).step(x, u, parameters={"masspole": 0.7}).x
    env = gymnasium.make("CartPole-v1").unwrapped
    env.masspole, env.total_mass, env.polemass_length = 0.7, 1.7, 0.35
    env.reset(seed=0)
    for k in range(5):
        env.state, env.steps_beyond_terminated = x[k], None
        env.step(int(u[k, 0] > 0))
        assert (heavy[k] == env.state).all()


def test_discrete_actions_take_the_nearest_level():
    b, x = backend(ACROBOT), np.full((5, 4), 0.1)
    found = b.step(x, np.array([[-0.6], [-0.4], [0.4], [0.6], [9.0]])).x[:, 3]
    assert found[1] == found[2]
    assert found[0] < found[1] < found[3] == found[4]
    two = backend(CARTPOLE, inputs={"force": {"action": "force", "levels": {1: 10}} | {"levels": {0: -10, 1: 10}}})
    assert (two.step(np.zeros((1, 4)), [[3.0]]).x == backend(CARTPOLE).step(np.zeros((1, 4)), [[10.0]]).x).all()


def test_single_precision_is_its_resolution():
    e = backend(CAR).resolution(np.array([0.5, 0.05]))
    assert 1e-8 < e[1] < e[0] < 3e-7
    x, u = np.array([[-0.5, 0.01]]), np.array([[0.3]])
    v = 0.01 + 0.3 * 0.0015 - 0.0025 * np.cos(-1.5)
    assert np.abs(backend(CAR).step(x, u).x - [[-0.5 + v, v]]).max() < 1e-7
    assert (backend().resolution(np.ones(2)) < 1e-14).all()


@needs_mujoco
def test_mujoco_environments_step_as_mujoco_does():
    import gymnasium
    import mujoco

    b = backend(INVERTED)
    assert b.period == 0.04
    x, u = query(10, 4)
    found = b.step(x, u).x
    env = gymnasium.make("InvertedPendulum-v5").unwrapped
    for k in range(10):
        data = mujoco.MjData(env.model)
        data.qpos[:], data.qvel[:], data.ctrl[:] = x[k, :2], x[k, 2:], u[k]
        mujoco.mj_step(env.model, data, nstep=2)
        assert np.abs(np.concatenate([data.qpos, data.qvel]) - found[k]).max() < 1e-9
    weightless = b.step(x, u, parameters={"gravity_z": 0.0}).x
    assert np.abs(weightless - found).max() > 1e-3


@needs_mujoco
def test_what_no_state_names_is_hidden_a_free_joint_too():
    b = backend({"env": "Ant-v5", "states": {"hip": "hip_1.position"}, "inputs": {"u": "action[0]"}})
    kinds = {h.name: h.kind for h in b.hidden}
    assert kinds["root.rotation"] == "quaternion"
    assert len(b.hidden_default) == 15 + 14 - 1
    assert b.step(np.zeros((2, 1)), np.ones((2, 1))).hidden.shape == (2, 28)


# An environment of the user's


@pytest.fixture
def drums(monkeypatch):
    import gymnasium

    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "data"))
    yield
    sys.modules.pop("gym_drum", None)
    gymnasium.registry.pop("Drum-v0", None)


def test_an_environment_of_the_users_needs_leave(drums):
    config = GymnasiumConfig.model_validate(DRUM)
    with pytest.raises(UsageError, match=r"imports a module.*--allow-code"):
        registry().build("backend", "gymnasium", config, Context())
    assert "gym_drum" not in sys.modules
    b = registry().build("backend", "gymnasium", config, Context(allow_code=True))
    x, u = query(4, 2)
    long = b.rollout(x, np.repeat(u[:, None], 6, axis=1)).x
    for _ in range(6):
        x = x + 0.1 * np.stack([u[:, 0] - 0.5 * x[:, 0], 0.5 * x[:, 0] ** 2], axis=1)
    assert np.abs(long[:, -1] - x).max() < 1e-14, "it goes on after three steps, and hot"
    assert [s.unit for s in b.states] == ["rad/s", "J"]


def test_its_attribute_has_to_be_its_state(drums):
    for change, message in (
        ({"attribute": "state"}, "'state' of Drum has shape"),
        ({"state": {"rate": {}}, "states": {"rate": "rate"}}, "expected 1 numbers"),
        ({"action": {"a": {}, "b": {}}, "inputs": {}}, "it names 2 numbers; expected 1"),
        ({"action": None}, "give both"),
        ({"state": None, "action": None}, "does not know what is the state of gym_drum.Drum"),
        ({"period": None}, "neither a model nor an environment"),
    ):
        with pytest.raises(UsageError, match=message):
            backend(DRUM | change)


# Mistakes


@pytest.mark.parametrize(
    ("section", "message"),
    [
        ({"env": "Pendulumm-v1"}, "cannot be made"),
        ({"env": "FrozenLake-v1"}, "does not know what is the state"),
        ({"options": {"weight": 3}}, "cannot be made.*weight"),
        ({"states": {"theta": "angle"}}, "has no 'angle'; it has theta, theta_dot"),
        ({"inputs": {"torque": "force"}}, "no action 'force'; it has torque"),
        ({"inputs": {"torque": {"action": "torque", "levels": {0: -1, 1: 1}}}}, "is continuous"),
    ],
)
def test_mistakes_are_told(section, message):
    with pytest.raises(UsageError, match=message):
        backend(**section)


def test_levels_and_periods_are_the_environments():
    with pytest.raises(UsageError, match=r"there is no action 5; expected some of \[0, 1\]"):
        backend(CARTPOLE, inputs={"force": {"action": "force", "levels": {0: -10, 5: 10}}})
    with pytest.raises(UsageError, match="the actions of CartPole-v1 are numbered; expected one input"):
        backend(CARTPOLE, inputs={})


@needs_mujoco
def test_a_period_that_cannot_be_set_is_refused():
    with pytest.raises(UsageError, match=r"steps by 0\.04 s"):
        backend(INVERTED, period="10 ms")


def test_units_are_checked_against_the_model():
    from gapcert_gymnasium.system import GymnasiumBackend

    section = MODEL | {"inputs": {"torque": "N"}, "parameters": {"J": "1 kg*m"}}
    model = gc.load_spec({"version": 1, "name": "x", "model": section}).build("model")
    with pytest.raises(UsageError, match=r"inputs.torque: the model gives it in N, but torque of Pendulum-v1 is in N\*m"):
        GymnasiumBackend(GymnasiumConfig.model_validate(PENDULUM), model=model)


def test_missing_package_is_told_in_one_line(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(gc.MissingDependency, match=r"needs gymnasium.*pip install 'gapcert\[gymnasium\]'"):
        registry().build("backend", "gymnasium", GymnasiumConfig.model_validate(PENDULUM), Context())


@pytest.mark.exam
def test_example_runs(tmp_path):
    spec = gc.load_spec(ROOT / "specs/pendulum_gymnasium.yaml", ("report.html=false", "report.rerun=false"))
    summary = gc.run(spec, out=tmp_path).summary
    assert all(e["met"] for e in summary["expectations"]), summary["expectations"]
