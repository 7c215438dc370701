"""Gymnasium's Pendulum-v1 as a third party's backend: its contract, its closed form, its traps, and a certificate."""

import sys
from pathlib import Path

import numpy as np
import pytest

import gapcert as gc
from gapcert.testing import SystemContract

sys.path.append(str(Path(__file__).parent / "gapcert_acme_gym"))

from gapcert_acme_gym.config import GymPendulumConfig

pytestmark = [pytest.mark.needs("gymnasium"), pytest.mark.contract]

MODEL = {
    "kind": "equations",
    "states": {"theta": {"unit": "rad", "kind": "angle"}, "omega": "rad/s"},
    "inputs": {"torque": "N*m"},
    "parameters": {"m": "1 kg", "l": "1 m", "g": "10 m/s^2"},
    "derivative": {"theta": "omega", "omega": "3*g/(2*l)*sin(theta) + 3*torque/(m*l**2)"},
    "integrator": "euler",
    "period": "50 ms",
}


def pendulum(*given):
    from gapcert_acme_gym.backend import GymPendulum

    return GymPendulum(*given)


class TestGymPendulum(SystemContract):
    def system(self):
        return type(pendulum()).from_config(GymPendulumConfig(gravity=9.81), None)


def test_is_semi_implicit_euler_inside_its_limits():
    x, u = np.random.default_rng(0).uniform(-1, 1, (50, 2)), np.random.default_rng(1).uniform(-1, 1, (50, 1))
    omega = x[:, 1] + 0.05 * (15 * np.sin(x[:, 0]) + 3 * u[:, 0])
    expected = np.stack([x[:, 0] + 0.05 * omega, omega], axis=1)
    assert np.abs(pendulum().step(x, u).x - expected).max() <= 1e-15


def test_limits_show():
    fast, strong = np.array([[0.0, 7.9]]), np.array([[5.0]])
    assert pendulum().step(fast, strong).x[0, 1] == 8.0
    rest = np.zeros((1, 2))
    assert (pendulum().step(rest, strong).x == pendulum().step(rest, np.array([[2.0]])).x).all()


def counting(x, u, parameters=None):
    """What goes wrong without care: the environment as `make` gives it counts its steps."""
    import gymnasium

    env, after = gymnasium.make("Pendulum-v1", max_episode_steps=10), np.empty_like(x)
    env.reset(seed=0)
    for k, (state, action) in enumerate(zip(x, u, strict=True)):
        env.unwrapped.state = state
        *_, truncated, _ = env.step(action)
        after[k] = env.unwrapped.state
        if truncated:
            env.reset(seed=0)
            after[k] = env.unwrapped.state
    return after


@pytest.mark.filterwarnings("ignore::UserWarning")  # gymnasium's own checker speaks of float64 actions
def test_step_counter_is_caught():
    contract, wrapped = TestGymPendulum(), pendulum()
    wrapped._step = counting
    contract.system = lambda: wrapped
    with pytest.raises(AssertionError, match="other bits"):
        contract.test_order_does_not_matter()


@pytest.mark.exam
def test_certificate(tmp_path):
    model = gc.registry().build("model", "equations", gc.registry().config("model", "equations").model_validate(MODEL))
    backend = pendulum()
    domain = gc.Domain.of(model, {"theta": (-1, 1), "omega": (-1, 1), "torque": (-1, 1)})
    certificate = gc.certify(model, backend, domain, folder=tmp_path, request=gc.Request("statistical", attack=20_000))
    assert certificate.claim.kind == "statistical"
    # θ gap = τ² |15 sin θ + 3 u|, ω gap = 0.
    assert certificate.states["theta"].gamma_max == pytest.approx(0.05**2 * (15 * np.sin(1) + 3), rel=0.3)
    assert not certificate.states["omega"].resolved
    assert certificate.attack["violations"] == 0
