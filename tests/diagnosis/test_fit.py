"""Fits: weights, uneven times, late outputs, hidden states, motions that stick or blow up."""

from dataclasses import replace

import numpy as np
import pytest

from gapcert import Parameter, Recording, UsageError
from gapcert.plugin import Extension, Memory
from gapcert.testing import multisine
from gapcert_diagnosis.data.dataset import Dataset
from gapcert_diagnosis.fitting import fit as fitting
from gapcert_diagnosis.fitting.fit import carried, fit, followed, stepped
from gapcert_diagnosis.fitting.hypothesis import Hypothesis, between
from gapcert_diagnosis.testing import ROD, equations
from gapcert_diagnosis.thresholds import THRESHOLDS

SIGMA, T = 1e-3, 1000
DRY = Extension("dry", "q", (Parameter("fc", 0.0, "N*m"),), dry_friction="fc")
VISCOUS = Extension("viscous", "q", (Parameter("c", 0.0, "N*m*s"),), force="-c*{v}")
SQUARE = Extension("square", "q", (Parameter("d", 0.0, "N*m*s**2"),), force="-d*{v}*sqrt({v}**2)")
LATE = Extension("late", "q", (Parameter("d", 0.0, "s", low=0.0),), output_delay="d")


def recorded(extensions=(), parameters=None, fine=20, noise=SIGMA, torque=2.0, seed=0, offsets=None):
    """(model, recording) at 10 ms, from `fine` steps per sample; with offsets, sampled that much off the grid."""
    model, step = (equations({**ROD, "period": f"{10 / k} ms", "integrator": "rk4"}).extend(extensions) for k in (1, fine))
    u = multisine(T * 0.01, 0.01, torque, (0.2, 2.5), 4 + seed)
    x = step.fast_rollout(np.array([[0.3, 0.0]]), u[None, :-1].repeat(fine, axis=1), parameters=parameters).x[0]
    at = fine * np.arange(T) + (0 if offsets is None else np.round(offsets / 5e-4).astype(int))
    y = x[np.clip(at, 0, len(x) - 1), 0] + noise * np.random.default_rng(seed).standard_normal(T)
    return model, Recording.of(np.arange(T) * 0.01, {"q": y, "u": u[:, 0]})


def free(model, *rows):
    """A hypothesis of (name, value, low, high, step) without priors."""
    columns = [np.array(c, dtype=np.float64) for c in list(zip(*rows, strict=True))[1:]]
    return Hypothesis(model, tuple(r[0] for r in rows), *columns, np.full(len(rows), np.inf))


@pytest.mark.parametrize("torque", [1.0, 4.0])
def test_a_motion_that_sticks_and_turns_is_fitted_to_the_noise(torque):
    for seed in range(3):
        model, recording = recorded((DRY, VISCOUS), {"fc": 0.3, "c": 0.05}, torque=torque, seed=seed)
        windows = Dataset.of(model, recording).windows(120)
        h = free(model, ("fc", 0.0, 0.0, 5.0, 0.01), ("c", 0.0, -1.0, 5.0, 0.01))
        found = [fit(h, windows, theta=np.array(first)) for first in ([0.05, 0.0], [0.6, 0.0])]
        assert found[0].chi[0] == pytest.approx(1, abs=0.1)
        np.testing.assert_allclose(found[0].theta, [0.3, 0.05], atol=3e-3)
        squares = [float(np.sum(f.residual**2)) for f in found]
        assert abs(squares[0] - squares[1]) < 6  # from both sides, to the same minimum
        np.testing.assert_allclose(found[0].theta, found[1].theta, atol=1e-3)


def test_samples_off_the_grid_are_compared_where_they_were_taken():
    offsets = np.random.default_rng(1).uniform(-0.003, 0.003, T)
    model, recording = recorded(offsets=offsets, noise=2e-4)
    even = Dataset.of(model, recording).windows(100)
    assert not even.offset.any()
    at = np.stack([np.round(offsets / 5e-4)[s : s + 100] * 5e-4 for _, s in even.place.tolist()])
    assert fit(Hypothesis(model), replace(even, offset=at)).residual.std() * even.measured.sigma[0] < 2.4e-4
    assert fit(Hypothesis(model), even).residual.std() * even.measured.sigma[0] > 2e-3


def test_missing_samples_do_not_count():
    model, recording = recorded()
    windows = Dataset.of(model, recording).windows(100)
    whole = fit(Hypothesis(model), windows)
    weight = np.where(np.random.default_rng(0).random(windows.y.shape) < 0.1, 0.0, 1.0)
    hurt = replace(windows, weight=weight, y=np.where(weight == 0, np.where(windows.y > 0, 1e3, np.nan), windows.y))
    holed = fit(Hypothesis(model), hurt)
    assert holed.chi[0] == pytest.approx(whole.chi[0], abs=0.05)
    assert holed.counts[0] == weight.sum()
    assert holed.whiteness[0] == pytest.approx(whole.whiteness[0], abs=0.1)
    np.testing.assert_allclose(holed.start, whole.start, atol=0.02)
    assert holed.score(holed) < whole.score(holed) + 100


def test_a_delay_of_an_output_is_found():
    model, recording = recorded((LATE,), noise=2e-4)
    shift = 0.013
    tr = recording.trajectories[0]
    y = tr.channels["q"]
    moved = between(y[None, None, :, None], np.full((1, 1, 1, 1), -shift / 0.01))[0, 0, :, 0]
    windows = Dataset.of(model, Recording.of(tr.t, {"q": moved, "u": tr.channels["u"]})).windows(100)
    fitted = fit(free(model, ("d", 0.0, 0.0, 0.1, 0.001)), windows)
    assert fitted.theta[0] == pytest.approx(shift, abs=2e-4)


def test_between_samples_a_cubic_is_exact_and_goes_on_beyond_the_ends():
    t = np.arange(9.0)
    y = (t**3 - 4 * t**2 + t)[None, None, :, None].repeat(2, axis=0)
    ahead = np.random.default_rng(0).uniform(-1.5, 1.5, (2, 1, 9, 1))
    at = t[:, None] + ahead
    np.testing.assert_allclose(between(y, ahead), at**3 - 4 * at**2 + at, atol=1e-11)
    short = between(np.array([[[[1.0], [3.0]]]]), np.full((1, 1, 1, 1), 0.5))
    assert short.ravel().tolist() == [2.0, 4.0]


@pytest.mark.parametrize("shape", [(1, 3, 9, 1), (1, 1, 1, 1), (9, 2), (4, 3, 1, 2), (4, 1, 9, 1)])
def test_signals_of_one_clock_or_of_many_are_looked_up_alike(shape):
    rng = np.random.default_rng(1)
    y, ahead = rng.standard_normal((4, 3, 9, 2)), rng.uniform(-2.0, 2.0, shape)
    each = np.broadcast_to(ahead, y.shape)
    for i, w, c in np.ndindex(4, 3, 2):
        alone = between(y[i : i + 1, w : w + 1, :, c : c + 1], each[i : i + 1, w : w + 1, :, c : c + 1])
        np.testing.assert_array_equal(between(y, ahead)[i, w, :, c], alone[0, 0, :, 0])


def test_hidden_states_begin_as_the_history_left_them():
    lag = Extension(
        "lag",
        "u",
        (Parameter("tau", 0.05, "s", low=0.0),),
        input="slow",
        memory=(Memory("slow", "N*m", "slow + (1 - exp(-{h}/tau))*({u} - slow)"),),
    )
    model, recording = recorded((lag,), fine=1, noise=1e-4)
    fitted = fit(free(model, ("tau", 0.02, 0.001, 0.5, 0.002)), Dataset.of(model, recording).windows(100))
    assert fitted.chi[0] < 1.3
    assert fitted.theta[0] == pytest.approx(0.05, abs=2e-3)


def test_a_trial_that_blows_up_is_one_that_failed():
    wild = Extension("wild", "q", (Parameter("a", 0.0, "N*m*s^3"),), force="a*{v}**3")
    model, recording = recorded((wild,))
    h = free(model, ("a", 0.0, -1e9, 1e9, 1.0))  # one difference step is unstable
    with np.errstate(all="raise"):
        fitted = fit(h, Dataset.of(model, recording).windows(100))
    assert np.isfinite(fitted.residual).all()
    assert np.isfinite(fitted.covariance).all()
    assert abs(fitted.theta[0]) < 0.1


def test_numbers_that_blow_up_on_other_windows_are_told_and_raise_nothing():
    model, recording = recorded((VISCOUS,), {"c": 0.05})
    windows = Dataset.of(model, recording).windows(100)
    h = free(model, ("c", 0.0, -1e9, 5.0, 0.01))
    assert followed(h, np.array([0.05]), windows).chi[0] == pytest.approx(1, abs=0.1)
    found = followed(h, np.array([-1e9]), windows)
    assert np.isfinite(found.residual).all()
    assert found.chi.min() > 1e9
    with pytest.raises(UsageError, match="the simulation blows up"):
        fit(h.holding(np.array([-1e9])), windows)


def test_difference_steps_follow_the_residual_where_damping_is_slight():
    model, recording = recorded((VISCOUS, SQUARE), {"c": 2e-3, "d": 1e-3}, torque=0.0, noise=1e-6, fine=1)
    windows = Dataset.of(model, recording).windows(500)
    h = free(model, ("c", 0.0, -1.0, 5.0, 0.05), ("d", 0.0, -1.0, 5.0, 0.05))
    found = fit(h, windows, theta=np.array([3e-3, 0.0]))
    np.testing.assert_allclose(found.theta, [2e-3, 1e-3], rtol=0.02)
    assert found.chi[0] < 1.5


def test_a_bristle_is_bent_by_the_fitted_motion_and_not_by_noise(monkeypatch):
    bend = "sign({v}) + (s - sign({v}))*exp(-abs({v})*{h}/d)"
    numbers = (Parameter("f", 0.4, "N*m"), Parameter("d", 0.1, "rad", low=1e-6))
    bristle = Extension("bristle", "q", numbers, force=f"-f*({bend})", memory=(Memory("s", "1", bend),))
    model, recording = recorded((bristle,), fine=1, noise=0.05)
    windows, start = Dataset.of(model, recording).windows(50), np.array([[0.3, 0.0]])
    u = recording.trajectories[0].channels["u"][None, :-1, None]
    x = model.fast_rollout(start, u).x[0]
    true = [model.fast_rollout(start, u[:, :k], every=k).hidden[0] for _, k in windows.place.tolist()]
    h = Hypothesis(model)
    motion = np.stack([x[k : k + 50] for _, k in windows.place.tolist()])
    off = []
    traced, reached = windows.retraced(motion)
    for seen in (windows, h.led(traced, np.empty(0), motion[:, 0], ~reached)):
        bent = h.hidden(seen, np.empty((1, 0)))
        off.append(np.abs(bent - true))
    assert reached.tolist() == [False, *[True] * (len(windows) - 1)]
    assert off[1].max() < 1e-3 < 0.02 < min(off[0][0].max(), off[0][1:].max())
    fitted = [fit(h, windows)]
    monkeypatch.setattr("gapcert_diagnosis.fitting.fit.THRESHOLDS", replace(THRESHOLDS, retraced_memories=0))
    fitted.append(fit(h, windows))
    near, far = (np.mean((f.start - motion[:, 0]) ** 2) for f in fitted)
    assert near < far


def test_one_step_from_a_fit_shows_how_well_other_simulations_fit():
    model, recording = recorded((VISCOUS, SQUARE), {"c": 0.1, "d": 0.03})
    windows = Dataset.of(model, recording).windows(120)
    plain, right, huge = (
        Hypothesis(model, ("c",), *np.array([[0.0], [-1.0], [5.0], [0.01], [np.inf]]), fixed={"d": d})
        for d in (0.0, 0.03, -1e9)
    )
    base = fit(plain, windows)
    own, found, broken = stepped(base, [plain, right, huge])
    assert broken is None
    assert own.chi[0] == pytest.approx(base.chi[0], rel=1e-3)
    assert base.chi[0] > 1.5
    assert found.chi[0] == pytest.approx(fit(right, windows).chi[0], rel=0.15)
    np.testing.assert_allclose(found.theta, [0.1], atol=0.01)


def test_a_fit_ends_where_the_slopes_say_that_nothing_is_left(monkeypatch):
    """At the minimum of a straight problem, without slopes there for a step that gains nothing."""
    model, recording = recorded((VISCOUS,), {"c": 0.05})
    windows = Dataset.of(model, recording).windows(100)
    h = free(model, ("c", 0.0, -1.0, 5.0, 0.01))
    best = fit(h, windows)
    made, plain = [], fitting._linearise
    monkeypatch.setattr(fitting, "_linearise", lambda *given: made.append(given[0]) or plain(*given))
    again = fit(h, windows, theta=1.02 * best.theta, start=best.start)
    assert sum(len(h.names) for h in made) == 1
    assert np.sum(again.residual**2) - np.sum(best.residual**2) < 0.02
    assert abs(again.theta[0] - best.theta[0]) < 0.1 * best.interval()[0]


def test_windows_whose_start_has_nothing_to_gain_are_not_rolled_out(monkeypatch):
    model, recording = recorded((VISCOUS,), {"c": 0.05})
    windows = Dataset.of(model, recording).windows(100)
    best = fit(Hypothesis(model, fixed={"c": 0.05}), windows)
    start, rows, plain = best.start.copy(), [], fitting._residual
    start[3] += 0.05
    monkeypatch.setattr(fitting, "_residual", lambda h, w, *given: rows.append(len(w)) or plain(h, w, *given))
    again = fit(best.hypothesis, windows, start=start)
    assert rows[0] == len(windows)
    assert set(rows[2:]) == {1}
    np.testing.assert_allclose(again.start, best.start, atol=1e-4)


def test_where_a_law_is_plainly_missing_no_last_hundredth_is_searched_for(monkeypatch):
    model, recording = recorded((DRY, SQUARE), {"fc": 0.3, "d": 0.1}, noise=1e-5)
    windows = Dataset.of(model, recording).windows(100)
    h = free(model, ("c", 0.0, -1.0, 5.0, 0.01))
    h = replace(h, model=model.extend((VISCOUS,)))
    squares, made, plain = [], [], fitting._linearise
    monkeypatch.setattr(fitting, "_linearise", lambda *given: made.append(len(squares)) or plain(*given))
    for rough in (1e-4, 0.0):
        monkeypatch.setattr(fitting, "THRESHOLDS", replace(fitting.THRESHOLDS, rough_step_fall=rough))
        squares.append(float(np.sum(fit(h, windows, iterations=40).residual ** 2)))
    assert squares[1] > 100 * windows.y.size
    assert made.count(0) < made.count(1)
    assert squares[0] == pytest.approx(squares[1], rel=3e-3)


def test_starts_are_carried_to_windows_that_begin_alike_and_found_for_others(monkeypatch):
    model, recording = recorded((VISCOUS,), {"c": 0.05})
    windows = Dataset.of(model, recording).windows(100)
    h = free(model, ("c", 0.0, -1.0, 5.0, 0.01))
    whole, some = fit(h, windows), fit(h, windows.take(np.arange(len(windows)) < 7))
    led, plain = [], fitting.followed
    monkeypatch.setattr(fitting, "followed", lambda *given: led.append(len(given[2])) or plain(*given))
    start = carried(h, some.theta, some, windows, windows.start)
    assert led == [len(windows) - 7]
    np.testing.assert_array_equal(start[:7], some.start)
    np.testing.assert_allclose(start, whole.start, atol=0.02)
    assert np.abs(windows.start - whole.start).max() > 4 * np.abs(start - whole.start).max()
    np.testing.assert_array_equal(carried(h, some.theta, some, windows.take(np.arange(7)), windows.start[:7]), some.start)
