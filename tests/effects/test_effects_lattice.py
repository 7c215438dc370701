"""A sensor's resolution is read off the values, with noise before or after the rounding; nothing else looks like one."""

import itertools

import numpy as np
import pytest

import gapcert as gc

T = np.arange(4000) * 0.005
WAY = np.sin(2.1 * T) + 0.5 * np.sin(5.3 * T + 1)


def seen(y):
    found = gc.registry().build("effect", "sensor-quantisation").seen_in(np.asarray(y))
    return None if found is None else found["resolution"]


def noise(sigma, seed=0):
    return sigma * np.random.default_rng(seed).standard_normal(len(T))


@pytest.mark.parametrize(
    ("step", "where"), [*itertools.product([0.31, 0.11, 0.02, 0.004], ["none", "before"]), (0.11, "after"), (0.004, "after")]
)
def test_a_resolution_is_seen(step, where):
    before, after = (step / 8 * noise(1.0) if where == w else 0.0 for w in ("before", "after"))
    assert seen(step * np.round((WAY + before) / step) + after) == pytest.approx(step, rel=2e-3)


def test_missing_values_and_an_offset_do_not_matter():
    y = 0.02 * np.round(WAY / 0.02) + 0.0137
    y[100:200] = np.nan
    assert seen(y) == pytest.approx(0.02, rel=1e-3)


@pytest.mark.parametrize("seed", range(20))
def test_noise_is_no_lattice(seed):
    assert seen(WAY + noise(10 ** -(1.5 + 0.1 * seed), seed)) is None


def test_neither_is_rest_nor_a_smooth_motion_nor_a_fine_rounding():
    rest = np.where(np.arange(len(T)) % 1000 < 700, np.round(2 * WAY) / 3, WAY)
    assert seen(rest + noise(1e-3)) is None
    assert seen(np.where(T < 14, 0.0, WAY) + noise(1e-3)) is None
    assert seen(WAY) is None
    assert seen(np.round(WAY + noise(1e-3), 6)) is None
    assert seen(np.zeros(4000)) is None
    assert seen(WAY[:40]) is None
    assert seen(np.array([0.0, 0.31, 1.0])[np.digitize(WAY, [-0.5, 0.5])]) is None


def test_three_exact_levels_are_enough():
    assert seen(np.round(WAY)) == pytest.approx(1.0, rel=1e-9)
