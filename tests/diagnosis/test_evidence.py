"""Noise floor, windows, fits and scores: the parts that a diagnosis stands on."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from gapcert import Recording, UsageError
from gapcert.testing import multisine
from gapcert_diagnosis.data.dataset import Dataset
from gapcert_diagnosis.fitting.fit import Fit, fit
from gapcert_diagnosis.fitting.hypothesis import Hypothesis
from gapcert_diagnosis.search.candidates import Candidate, Library
from gapcert_diagnosis.search.criterion import agreement, better, falls, noise
from gapcert_diagnosis.search.fitted_sets import FittedSets
from gapcert_diagnosis.testing import ROD, equations
from gapcert_effects.forces import ConstantForce
from gapcert_effects.friction import CoulombFriction, ViscousFriction
from gapcert_effects.inputs import InputDelay
from gapcert_recordings.smoothing import noise_floor

SEMI = {**ROD, "integrator": "semi_implicit"}
LOOSE = {**SEMI, "parameters": {**SEMI["parameters"], "m": {"value": "1 kg", "tolerance": "2 %"}}}
T = 1000


def simulated(section=SEMI, noise=1e-3, seed=0, torque=2.0, parameters=None, channels=("q",)):
    model = equations(section)
    u = multisine(T * model.period, model.period, torque, (0.2, 2.5), 4)
    x = model.rollout(np.array([[0.3, 0.0]]), u[None, :-1], parameters=parameters).x[0]
    y = x + noise * np.random.default_rng(seed).standard_normal(x.shape)
    t = np.arange(T) * model.period
    return model, Recording.of(t, {**{c: y[:, ["q", "q_dot"].index(c)] for c in channels}, "u": u[:, 0]})


@pytest.mark.parametrize("sigma", [1e-4, 1e-3, 1e-2])
def test_the_noise_floor_sees_through_a_smooth_signal(sigma):
    t = np.arange(4000) * 0.005
    signal = np.sin(2 * np.pi * t) + 0.02 * np.sin(2 * np.pi * 8 * t)
    found = [noise_floor(signal + sigma * np.random.default_rng(k).standard_normal(4000)) for k in range(20)]
    assert np.mean(found) == pytest.approx(sigma, rel=0.02)
    assert np.std(np.diff(signal)) / math.sqrt(2) > 10 * sigma or sigma == 1e-2  # first differences would not do


def test_windows_lie_side_by_side_and_keep_their_history():
    model, recording = simulated()
    measured = Dataset.of(model, recording)
    windows = measured.windows(100)
    assert len(windows) == 9
    assert windows.y.shape == (9, 100, 1)
    assert measured.history == 10
    assert windows.u.shape == (9, 110, 1)
    assert np.allclose(windows.t, 0.1 + np.arange(9))
    earlier, later = windows.guard()
    assert earlier.t.max() < later.t.min()
    assert len(later) == 2


def test_a_velocity_that_is_not_measured_is_guessed_from_the_position():
    model, recording = simulated(noise=1e-5)
    states = Dataset.of(model, recording).states[0]
    truth = np.gradient(recording.trajectories[0].channels["q"], model.period)
    assert np.sqrt(np.mean((states[:, 1] - truth) ** 2)) < 0.05 * np.std(truth)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda c, t: (t * 1.05, c), r"samples are 0.0105 s apart, the model steps by 0.01 s.*set the model's period"),
        (lambda c, t: (t * 0.5, c), r"samples are 0.005 s apart"),
        (lambda c, t: (t, {"q": c["q"]}), r"no channel for the input 'u' \(there are q\)"),
        (lambda c, t: (t, {"u": c["u"]}), r"no output is measured; add one of q, q_dot"),
        (lambda c, t: (t, {**c, "current": c["u"]}), r"'current' is no input or output of the model; there are q, q_dot, u"),
        (lambda c, t: (t, {**c, "q": 0 * t}), r"'q' never changes"),
    ],
)
def test_refuses_what_the_model_cannot_be_compared_with(change, says):
    model, recording = simulated()
    tr = recording.trajectories[0]
    t, channels = change(dict(tr.channels), tr.t)
    with pytest.raises(UsageError, match=says):
        Dataset.of(model, Recording.of(t, channels))


def test_a_sample_may_take_several_model_periods():
    fine = equations({**SEMI, "period": "2 ms"})
    u = np.repeat(multisine(8.0, 0.01, 2.0, (0.2, 2.5), 4), 5, axis=0)
    x = fine.rollout(np.array([[0.3, 0.0]]), u[None, :-1]).x[0][::5]
    recording = Recording.of(np.arange(len(x)) * 0.01, {"q": x[:, 0], "u": u[::5, 0]})
    measured = Dataset.of(fine, recording)
    assert measured.repeat == 5
    assert fit(Hypothesis(fine), measured.windows(100)).chi[0] < 1e-6


def test_starts_are_free_and_their_noise_does_not_reach_the_parameters():
    model, recording = simulated()
    measured = Dataset.of(model, recording)
    windows = measured.windows(100)
    fitted = fit(Hypothesis(model), windows)
    assert fitted.chi[0] == pytest.approx(1, abs=0.1)
    guess = Hypothesis(model).simulate(windows, np.empty((1, 0)), windows.start[None])[0]
    assert np.mean(((guess - windows.y) / measured.sigma) ** 2) > 10  # without the fit of the starts


@pytest.mark.parametrize("effect", [ViscousFriction(), CoulombFriction(), ConstantForce(), InputDelay()])
def test_intervals_hold_the_truth_when_nothing_is_hidden(effect):
    inside = []
    for seed in range(4):
        model, recording = simulated(seed=seed)
        measured = Dataset.of(model, recording)
        search = FittedSets(Library(model, measured, [effect]), measured.windows(100))
        c = search.library.candidates[0]
        fitted = search.fit((c,), ((), search.nothing))
        inside.append(abs(fitted.theta[0]) <= 1.5 * fitted.interval()[0])
        assert better(fitted, search.nothing) < search.library.charge()
    assert sum(inside) >= 3


def test_uncertain_parameters_are_nuisances_within_three_tolerances():
    model, recording = simulated(LOOSE, parameters={"m": np.array([1.03])})
    measured = Dataset.of(model, recording)
    library = Library(model, measured, [ViscousFriction()])
    nothing = FittedSets(library, measured.windows(100)).nothing
    assert nothing.hypothesis.names == ("m",)
    assert nothing.hypothesis.charged == 0
    assert nothing.theta[0] == pytest.approx(1.03, abs=0.002)
    found = library.extended((), {"m": float(nothing.theta[0])})
    assert found.parameters[0].value == nothing.theta[0]
    assert library.extended((), {"m": float(nothing.theta[0])}) is found
    assert library.extended((), {"m": 1.01}).parameters[0].value == 1.01
    model, recording = simulated(LOOSE, parameters={"m": np.array([1.3])})
    far = FittedSets(Library(model, Dataset.of(model, recording), []), Dataset.of(model, recording).windows(100)).nothing
    assert far.theta[0] == pytest.approx(1.06)
    assert far.chi[0] > 10


def test_a_fit_stays_within_bounds():
    model, recording = simulated()
    measured = Dataset.of(model, recording)
    extended = model.extend([ViscousFriction().extension("q", model)])
    h = Hypothesis(extended, ("viscous_friction_q",), *(np.array([v]) for v in (0.5, 0.2, 1.0, 0.01, np.inf)))
    fitted = fit(h, measured.windows(100))
    assert fitted.theta[0] == 0.2  # the truth is 0, outside
    assert h.holding(np.array([0.7])).fixed == {"viscous_friction_q": 0.7}


def residuals(rho, n=40_000, seed=0):
    e = np.random.default_rng(seed).standard_normal(n)
    for k in range(1, n):
        e[k] = rho * e[k - 1] + math.sqrt(1 - rho**2) * e[k]
    model = equations(SEMI)
    return seen(Hypothesis(model), e.reshape(1, n, 1))


def seen(h, r):
    """A fit that leaves r (W, L, ny)."""
    return Fit(h, np.empty(0), np.empty((len(r), 2)), r, 0.0, np.empty((0, 0)), SimpleNamespace(weight=np.ones_like(r)))


@pytest.mark.parametrize("rho", [0.0, 0.5, 0.9])
def test_coloured_residuals_count_for_less(rho):
    assert residuals(rho).whiteness[0] == pytest.approx((1 - rho) / (1 + rho), abs=0.02)


def test_a_little_above_the_floor_is_noise_however_many_samples_tell():
    plain = residuals(0.0)
    above = (replace(plain, residual=plain.residual * s) for s in (1.015, 1.05))
    assert [noise(fitted) for fitted in (plain, *above)] == [True, True, False]


def test_coloured_residuals_leave_wider_intervals():
    white, coloured = (replace(residuals(rho), theta=np.zeros(1), covariance=np.eye(1)) for rho in (0.0, 0.8))
    assert white.interval()[0] == pytest.approx(1.96, rel=0.02)
    assert coloured.interval()[0] == pytest.approx(3 * 1.96, rel=0.1)


def test_where_a_law_is_plainly_missing_windows_count_and_samples_do_not():
    size = np.random.default_rng(0).uniform(20, 60, 12)
    size[0] = 2000  # one window that nothing fits, and that the second law fits less badly
    noise = np.random.default_rng(1).standard_normal((12, 200, 1))

    def fitted(factor):
        return seen(Hypothesis(equations(SEMI)), noise * np.sqrt(size * factor)[:, None, None])

    plain, most = fitted(np.ones(12)), fitted(np.full(12, 0.7))
    one = fitted(np.r_[0.2, np.full(11, 1.02)])
    assert better(one, most) > 0 > better(one, most, cautious=True)
    assert better(most, plain, cautious=True) <= agreement(falls(most, plain)) ** 2 + 1e-9
    assert agreement(falls(most, plain)) > 10 > 3 > agreement(falls(one, plain))
    calm = fitted(1 / size)
    assert (
        better(calm, plain, cautious=True) == better(calm, plain) > 100
    )  # where the closer fit is at the noise, samples count


def test_the_score_charges_for_parameters_and_not_below_the_floor():
    plain = residuals(0.0)
    charged = Hypothesis(plain.hypothesis.model, ("a",), *(np.array([v]) for v in (0.0, -1.0, 1.0, 0.1, np.inf)))
    more = replace(plain, hypothesis=charged, theta=np.zeros(1), covariance=np.eye(1))
    assert better(more, plain) == pytest.approx(-math.log(40_000))
    tiny, tinier = (replace(plain, residual=plain.residual * s) for s in (0.1, 1e-6))
    assert better(tinier, tiny) == 0


def test_a_motion_that_blows_up_does_not_take_others_with_it():
    unstable = equations(
        {**SEMI, "parameters": {**SEMI["parameters"], "a": "0 N*m*s^3"}, "forces": {"q": "u + a*q_dot**3"}, "period": "10 ms"}
    )
    _, recording = simulated()
    windows = Dataset.of(unstable, recording).windows(100)
    h = Hypothesis(unstable, ("a",), *(np.array([v]) for v in (0.0, -1e9, 1e9, 1.0, np.inf)))
    y = h.simulate(windows, np.array([[0.0], [1e6]]), np.tile(windows.start, (2, 1, 1)))
    assert np.isfinite(y[0]).all()
    assert not np.isfinite(y[1]).all()


def test_candidates_are_named_once():
    model, recording = simulated()
    library = Library(model, Dataset.of(model, recording), [ViscousFriction(), InputDelay()])
    assert [c.key for c in library.candidates] == [("viscous-friction", "q"), ("input-delay", "u")]
    assert library.names(Candidate(ViscousFriction(), "q")) == ("viscous_friction_q",)
