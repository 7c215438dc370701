"""Hidden effects act as they are named, and the recording shows what was commanded."""

import numpy as np
import pytest
from exams.hide import hide

from gapcert import UsageError
from gapcert.testing import chirp, multisine, steps
from gapcert_diagnosis.testing import ROD, equations

FINE = {**ROD, "integrator": "semi_implicit", "period": "1 ms"}
STILL = np.zeros((300, 1))


def motion(effects, u=STILL, x0=(0.3, 0.0), noise=0.0):
    return hide(equations(FINE), effects, x0=x0, u=u, noise={"q": noise, "q_dot": 0.0}, seed=0, decimate=10).trajectories[0]


def test_dry_friction_sticks_at_rest_and_lets_go():
    held = motion([("coulomb-friction", "q", {"level": 1.5})])  # gravity pulls with 1.45 N·m
    assert np.array_equal(held.channels["q"], np.full(300, 0.3))
    slipping = motion([("coulomb-friction", "q", {"level": 1.4})])
    assert slipping.channels["q"][-1] < 0.3
    assert slipping.channels["q_dot"][-1] == pytest.approx(0, abs=1e-15)  # it stopped again, off the equilibrium


def test_friction_takes_the_energy_that_its_law_says():
    drag = motion([("viscous-friction", "q", {"coefficient": 0.05})]).channels
    free = motion([]).channels

    def energy(c):
        return c["q_dot"] ** 2 / 6 + 9.81 / 2 * (1 - np.cos(c["q"]))

    lost = 0.01 * np.cumsum(0.05 * drag["q_dot"] ** 2)
    assert (energy(free) - energy(drag))[-1] == pytest.approx(lost[-1], rel=0.02)


def test_faults_of_the_input_do_not_show_in_the_recording():
    u = steps(3.0, 0.01, 1.0, 0.2, seed=1)
    late = motion([("input-delay", "u", {"delay": 0.05}), ("input-gain", "u", {"gain": 2.0})], u)
    shifted = motion([], np.concatenate([np.zeros((5, 1)), 2 * u[:-5]]))
    assert np.array_equal(late.channels["u"], u[:, 0])
    assert np.allclose(late.channels["q"], shifted.channels["q"], atol=1e-12)


def test_noise_is_that_of_the_seed_and_on_its_channel_alone():
    clean, noisy = motion([]), motion([], noise=1e-3)
    assert np.std(noisy.channels["q"] - clean.channels["q"]) == pytest.approx(1e-3, rel=0.1)
    assert np.array_equal(noisy.channels["q_dot"], clean.channels["q_dot"])
    assert np.array_equal(noisy.channels["q"], motion([], noise=1e-3).channels["q"])


def test_an_unknown_effect_is_refused():
    with pytest.raises(UsageError, match=r"cannot hide 'stribeck'; it knows .*coulomb-friction"):
        motion([("stribeck", "q", {})])


def test_inputs_stay_within_their_amplitude():
    signals = multisine(5.0, 0.01, 2.0, (0.2, 3.0), 0), steps(5.0, 0.01, 2.0, 0.3, 0), chirp(5.0, 0.01, 2.0, (0.1, 5.0))
    for u in signals:
        assert u.shape == (500, 1)
        assert 1 < np.abs(u).max() <= 2.0
