"""The robot file of the measured double pendulum is its published equations."""

from pathlib import Path

import numpy as np
import pytest

import gapcert as gc

pytestmark = [pytest.mark.contract, pytest.mark.needs("mujoco")]

FOLDER = Path(__file__).parents[2] / "specs" / "diagnose"
SHORT = 1e-6


def accelerations(name, x, u, *overrides):
    model = gc.load_spec(FOLDER / f"{name}.yaml", overrides).build("model")
    assert model.period == SHORT
    return (model.step(x, u).x[:, 2:] - x[:, 2:]) / SHORT


def test_its_accelerations_are_those_of_the_equations():
    rng = np.random.default_rng(0)
    x, u = rng.normal(size=(64, 4)) * [2, 2, 8, 8], rng.normal(size=(64, 2))
    published = accelerations("double_pendulum_c0", x, u, f"model.period={SHORT} s")
    file = accelerations("double_pendulum_c0_mjcf", x, u, f"model.of.period={SHORT} s", "model.of.substeps=1")
    assert np.abs(published).std() > 10
    np.testing.assert_allclose(file, published, rtol=0, atol=1e-4 * np.abs(published).std())
