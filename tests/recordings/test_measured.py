"""Dirty logs: what is repaired, what is left out, and that it is told. The clean signal is known in each."""

import json
import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from gapcert import Parameter, Recording, Trajectory, UsageError
from gapcert.plugin import Extension
from gapcert_diagnosis.data.dataset import Dataset
from gapcert_diagnosis.fitting.fit import fit
from gapcert_diagnosis.fitting.hypothesis import Hypothesis
from gapcert_diagnosis.testing import ROD, equations
from gapcert_recordings.resampling import means, readings
from gapcert_recordings.smoothing import absurd, noise_floor, smoothed

PERIOD, NOISE = 0.005, 2e-3
T = np.arange(2400) * PERIOD


def motion(t):
    return np.sin(2 * np.pi * 0.7 * t) + 0.3 * np.sin(2 * np.pi * 1.9 * t + 1)


def speed(t):
    return 2 * np.pi * (0.7 * np.cos(2 * np.pi * 0.7 * t) + 0.3 * 1.9 * np.cos(2 * np.pi * 1.9 * t + 1))


def torque(t):
    return 2 * np.sin(2 * np.pi * 0.4 * t + 0.3) + np.sin(2 * np.pi * 1.3 * t)


def log(t=T, stamps=None, noise=NOISE, seed=0):
    """Columns of a log: sampled at t, and stamped with other times."""
    rng = np.random.default_rng(seed)
    return {"t": t if stamps is None else stamps, "q": motion(t) + noise * rng.standard_normal(len(t)), "u": torque(t)}


def recording(columns, **options):
    return Recording.of(columns["t"], {k: v for k, v in columns.items() if k != "t"}, **options)


@cache
def rod():
    return equations({**ROD, "period": "5 ms"})


def measured(columns, model=None, **options):
    return Dataset.of(model or rod(), recording(columns, **options))


def rows(columns, keep):
    return {k: v[keep] for k, v in columns.items()}


def rms(x):
    return float(np.sqrt(np.mean(np.square(x))))


def test_a_clean_log_is_taken_as_it_is():
    m = measured(log())
    assert np.array_equal(m.times[0], T)
    assert np.array_equal(m.outputs[0][:, 0], log()["q"])
    assert np.array_equal(m.inputs[0][:, 0], torque(T))
    assert m.weights[0].all()
    assert not m.offsets[0].any()
    assert m.log["dropped"] == m.log["duplicates"] == m.log["jitter"] == m.log["unused"] == 0
    assert not any(m.log[k] for k in ("gaps", "resets", "cuts", "outliers", "missing", "repaired"))
    assert m.log["hold"] == "undeclared"
    json.dumps(m.log)


def test_the_input_is_held_as_declared():
    fine = equations({**ROD, "period": "1 ms"})
    m = measured(log(), fine)
    u = torque(T)
    windows = m.windows(100)
    assert np.array_equal(windows.drive, np.repeat(windows.u, 5, axis=1))
    assert np.array_equal(windows.with_hold("zero").drive, windows.drive)
    first = windows.with_hold("first").drive[:, :-5]
    exact = np.interp((np.arange(len(T) * 5) + 0.5) * 1e-3, T, u)
    start = windows.place[3, 1] * 5 - m.history * 5
    assert np.allclose(first[3, :, 0], exact[start:][: first.shape[1]], atol=1e-12)
    assert np.array_equal(windows.take(np.array([3])).drive[0], windows.drive[3])
    assert np.array_equal(windows.head(50).drive, windows.drive[:, : (m.history + 50) * 5])
    assert measured(log(), fine, hold="first").hold == "first"


@pytest.mark.parametrize("hold", ["zero", "first"])
def test_means_are_exact_between_uneven_knots(hold):
    rng = np.random.default_rng(1)
    knots = np.sort(rng.uniform(0, 50, 40))
    u = rng.standard_normal((40, 2))
    edges = np.linspace(-1, 52, 160)
    fine = (np.arange(159_000) + 0.5) * (53 / 159_000) - 1
    for j in range(2):
        if hold == "first":
            values = np.interp(fine, knots, u[:, j])
        else:
            values = u[np.maximum(np.searchsorted(knots, fine, side="right") - 1, 0), j]
        slow = values.reshape(159, -1).mean(axis=1)
        assert np.allclose(means(knots, u, edges, hold)[:, j], slow, atol=5e-3)


def test_lost_samples_count_for_nothing_and_the_input_goes_on():
    keep = np.random.default_rng(2).random(len(T)) > 0.05
    keep[[0, -1]] = True
    m = measured(rows(log(), keep))
    assert len(m.outputs) == 1
    assert np.allclose(m.times[0], T)
    assert np.array_equal(m.weights[0][:, 0] == 1, keep)
    assert m.log["dropped"] == (~keep).sum()
    assert rms(m.inputs[0][:, 0] - torque(T)) < 2e-3
    assert rms(m.outputs[0][:, 0] - motion(T)) < 1.1 * NOISE
    assert m.sigma[0] == pytest.approx(NOISE, rel=0.05)
    assert m.log["missing"] == {"q": (~keep).sum()}


def test_a_gap_cuts_a_trajectory_and_both_sides_are_used():
    keep = (T < 4) | (T >= 4.15)
    m = measured(rows(log(), keep))
    assert [len(y) for y in m.outputs] == [800, 1570]
    assert m.source == (0, 0)
    (gap,) = m.log["gaps"]
    assert gap["at"] == pytest.approx(3.995)
    assert gap["seconds"] == pytest.approx(0.155)
    windows = m.windows(100)
    assert set(windows.trajectory.tolist()) == {0}
    assert set(windows.place[:, 0].tolist()) == {0, 1}
    late = windows.t >= 4
    assert late.any()
    assert (windows.t[late] >= 4.15 + 0.1 - 1e-9).all()


def test_an_input_that_moved_unseen_cuts_a_trajectory():
    columns = log()
    columns["u"] = np.where(np.arange(len(T)) < 1000, 0.0, 1.0)
    keep = ~np.isin(np.arange(len(T)), [500, 501, 1000])
    m = measured(rows(columns, keep))
    assert [len(y) for y in m.outputs] == [1000, 1399]
    assert m.log["cuts"][0]["at"] == pytest.approx(4.995)
    assert m.log["dropped"] == 2


def test_uneven_times_are_used_where_they_are_true():
    rng = np.random.default_rng(3)
    true = T + 0.3 * PERIOD * rng.uniform(-1, 1, len(T))
    m = measured(log(true))
    assert len(m.outputs) == 1
    seen = m.weights[0][:, 0] == 1
    assert seen.mean() > 0.99
    assert rms(m.outputs[0][seen, 0] - motion(m.times[0] + m.offsets[0])[seen]) < 1.1 * NOISE
    assert rms(m.outputs[0][seen, 0] - motion(m.times[0])[seen]) > 1.5 * NOISE  # without the offsets
    assert m.sigma[0] == pytest.approx(NOISE, rel=0.1)
    assert m.log["jitter"] == pytest.approx(0.3 * PERIOD / math.sqrt(3), rel=0.1)
    assert m.log["stamps"] == "used"
    # The input changed when it was stamped, not when the grid says.
    fine = (np.arange(len(m.times[0]) * 50) + 0.5) * PERIOD / 50 + m.times[0][0]
    held = torque(true)[np.maximum(np.searchsorted(true, fine, side="right") - 1, 0)].reshape(-1, 50).mean(axis=1)
    assert rms(m.drives["zero"][0][:, 0] - held) < 2e-3
    assert rms(m.states[0][:, 1] - speed(m.times[0])) < 0.03 * rms(speed(T))


def test_times_of_arrival_are_ignored():
    stamps = T + 0.3 * PERIOD * np.random.default_rng(4).uniform(-1, 1, len(T))
    m = measured(log(T, stamps))
    assert m.log["stamps"] == "ignored"
    assert not m.offsets[0].any()
    assert m.sigma[0] == pytest.approx(NOISE, rel=0.1)


@pytest.mark.fault("the clock of a log is set back", shows="a new piece begins there")
def test_a_clock_that_is_set_back_starts_a_new_piece():
    stamps = np.where(np.arange(len(T)) < 1200, T, T - 6.0)
    m = measured(log(T, stamps))
    assert [len(y) for y in m.outputs] == [1200, 1200]
    assert m.log["resets"] == [{"trajectory": "0", "at": pytest.approx(5.995), "to": 0.0}]
    assert m.times[1][0] == pytest.approx(6.0)
    assert m.source == (0, 0)


@pytest.mark.fault("samples out of order or twice", shows="they are dropped and counted")
def test_a_sample_out_of_order_or_twice_is_dropped():
    stamps = T.copy()
    stamps[[700, 701]] = stamps[[701, 700]]
    stamps[900] = stamps[899]
    m = measured(log(T, stamps))
    assert len(m.outputs) == 1
    assert m.log["duplicates"] == 2
    assert m.log["resets"] == []
    assert m.weights[0].sum() == len(T) - 2


def test_outliers_count_for_nothing():
    columns = log()
    rng = np.random.default_rng(5)
    hit = np.sort(rng.choice(np.arange(5, len(T) - 5), 12, replace=False))
    columns["q"][hit] += rng.choice([-1, 1], 12) * rng.uniform(20, 500, 12) * NOISE
    m = measured(columns)
    assert np.array_equal(np.flatnonzero(m.weights[0][:, 0] == 0), hit)
    assert m.log["outliers"] == {"q": 12}
    assert m.sigma[0] == pytest.approx(NOISE, rel=0.05)
    assert rms(m.outputs[0][:, 0] - motion(T)) < 1.1 * NOISE
    assert rms(m.states[0][:, 1] - speed(T)) < 0.03 * rms(speed(T))


@pytest.mark.parametrize("noise", [0.0, 1e-5, 2e-3, 2e-2])
@pytest.mark.parametrize("kind", ["smooth", "kinks", "steps", "fast", "quantised"])
def test_nothing_real_is_taken_for_an_outlier(kind, noise):
    y = {
        "smooth": motion(T),
        "kinks": np.abs(motion(T)),
        "steps": np.sign(motion(T)),
        "fast": np.sin(2 * np.pi * (1 + 2 * T) * T / 2) + 0.2 * np.sin(2 * np.pi * 40 * T),
        "quantised": np.round(motion(T) / 0.05) * 0.05,
    }[kind]
    y = y + noise * np.random.default_rng(6).standard_normal(len(T))
    assert absurd(y, np.ones(len(T), dtype=bool)).sum() == 0


def test_missing_values_and_a_block_without_any():
    columns = log()
    columns["q"][[300, 301, 302]] = np.nan
    columns["q"][1000:1200] = np.nan
    columns["u"][1500] = np.nan
    m = measured(columns)
    assert m.log["missing"] == {"q": 203}
    assert np.isfinite(m.outputs[0]).all()
    assert np.isfinite(m.states[0]).all()
    assert m.inputs[0][1500, 0] == pytest.approx(torque(T)[1500], abs=0.01)
    windows = m.windows(100)
    assert (windows.weight.mean(axis=(1, 2)) >= 0.5).all()
    assert windows.weight.min() == 0  # three of a hundred are no reason to leave a window out
    assert len(windows) == measured(log()).windows(100).y.shape[0] - 2


@pytest.mark.parametrize("kind", ["real", "angle"])
def test_what_a_logger_fills_holes_with_is_missing(kind):
    columns = log()
    columns["q"][300:339] = columns["q"][900] = -9999.0
    model = equations({**ROD, "coordinates": {"q": {"unit": "rad", "kind": kind}}, "period": "5 ms"})
    m = measured(columns, model)
    assert m.log["missing"] == {"q": 40}
    assert m.log["outliers"] == {}
    assert rms((m.outputs[0][:, 0] - motion(T))[m.weights[0][:, 0] > 0]) < 1.1 * NOISE


@pytest.mark.parametrize(
    "y",
    [
        np.where(T < 3, 0.0, 5 * (1 - np.exp(3 - T))),
        np.where(np.arange(len(T)) % 500 < 3, 4.0, 0.0) + 1e-3 * np.cos(T) * (np.arange(len(T)) % 500 >= 3) + 0.02 * np.sin(T),
        np.where(T < 3, 0.0, 1.0),
        np.where(T < 3, 0.0, 5 + 1e-3 * np.sin(T)),
    ],
    ids=["rest, then motion", "bumps that differ", "two places", "a rest at zero"],
)
def test_nothing_real_is_taken_for_a_fill(y):
    assert np.isfinite(readings(y)).all()


def test_an_input_that_is_missing_for_long_cuts_a_trajectory():
    columns = log()
    columns["u"][1000:1100] = np.nan
    m = measured(columns)
    assert [len(y) for y in m.outputs] == [1000, 1300]
    assert m.log["gaps"][0]["seconds"] == pytest.approx(0.505)
    assert m.log["unused"] == pytest.approx(0.495)


def test_an_absurd_input_is_replaced():
    columns = log()
    columns["u"][[400, 900]] = [1e4, -1e4]
    m = measured(columns)
    assert m.log["repaired"] == {"u": 2}
    assert rms(m.inputs[0][:, 0] - torque(T)) < 1e-3


def test_pulses_of_an_input_that_rests_between_them_are_real():
    columns = log()
    columns["u"] = np.zeros(len(T))
    columns["u"][::400] = 50.0
    assert measured(columns).log["repaired"] == {}


def test_a_fast_log_is_thinned_without_a_shift():
    fine = np.arange(12_000) * 1e-3
    m = measured(log(fine), every=0.005)
    assert m.period == 0.005
    assert np.allclose(m.times[0], T)
    assert np.array_equal(m.outputs[0][:, 0], log(fine)["q"][::5])
    assert np.allclose(m.inputs[0][:, 0], torque(fine).reshape(-1, 5).mean(axis=1))
    assert not m.offsets[0].any()
    assert m.sigma[0] == pytest.approx(NOISE, rel=0.05)
    straight = np.interp((np.arange(12_000) + 0.5) * 1e-3, fine, torque(fine)).reshape(-1, 5).mean(axis=1)
    assert np.allclose(m.drives["first"][0][:-1, 0], straight[:-1], atol=1e-12)


def test_a_period_that_the_log_does_not_divide():
    fine = np.arange(7000) * 0.0016
    m = measured(log(fine), every=0.005)
    assert np.abs(m.offsets[0]).max() <= 0.0008 + 1e-12
    assert rms(m.outputs[0][:, 0] - motion(m.times[0] + m.offsets[0])) < 1.1 * NOISE
    assert rms(m.outputs[0][:, 0] - motion(m.times[0])) > 1.2 * NOISE


def test_starts_follow_the_band_of_the_signal():
    for fs, band, share in ((200, 1.0, 0.04), (1000, 1.0, 0.03), (600, 60.0, 0.05)):
        t = np.arange(12 * fs) / fs
        y = np.sin(2 * np.pi * band * t) + 0.005 * np.random.default_rng(7).standard_normal(len(t))
        curve = smoothed(y, np.ones(len(t), dtype=bool), np.zeros(len(t)), 1 / fs)
        exact = 2 * np.pi * band * np.cos(2 * np.pi * band * t)
        assert rms((curve.slope - exact)[50:-50]) < share * rms(exact)
        assert curve.noise == pytest.approx(0.005, rel=0.05)


def test_the_noise_floor_leaves_out_what_is_not_valid():
    y = motion(T) + NOISE * np.random.default_rng(8).standard_normal(len(T))
    valid = np.random.default_rng(9).random(len(T)) > 0.1
    assert noise_floor(np.where(valid, y, 1e3), valid) == pytest.approx(NOISE, rel=0.1)
    assert math.isnan(noise_floor(y, np.zeros(len(T), dtype=bool)))


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: measured(log(np.arange(2400) * 1e-3)), r"samples are 0.001 s apart.*add `every: 0.005 s` to the recording"),
        (lambda: measured(log(), every=0.002), r"recording.every: found 0.002 s, but samples are 0.005 s apart"),
        (lambda: measured(log(), every=0.012), r"add `every: 0.015 s`"),
        (lambda: measured(log(T, np.tile(T[:80], 30))), r"time is set back more than 20 times"),
        (lambda: measured({**log(), "q": np.where(np.arange(2400) % 5, np.nan, 1.0)}), r"no stretch is long and whole enough"),
        (lambda: measured({**log(), "u": np.where(T < 0.01, 1.0, np.nan)}), r"input 'u' is missing nearly everywhere"),
    ],
)
def test_refuses_what_cannot_be_repaired(make, says):
    with pytest.raises(UsageError, match=says):
        make()


def test_pieces_keep_the_trajectory_they_are_from():
    channels = {k: v for k, v in log().items() if k != "t"}
    whole = Trajectory(T, channels, "a")
    torn = Trajectory(np.where(T < 6, T, T + 1), channels, "b")
    m = Dataset.of(rod(), Recording((whole, torn)))
    assert m.source == (0, 1, 1)
    windows = m.windows(100)
    earlier, later = windows.guard()
    assert set(later.trajectory.tolist()) == {0, 1}
    assert later.t[later.trajectory == 1].min() > earlier.t[earlier.trajectory == 1].max()


def swing(u, friction, h=5e-4):
    """Angles of a rod of 1 kg and 1 m, by leapfrog."""
    q, v, out = 0.3, 0.0, [0.3]
    for k in range(len(u)):
        for half in (0, 1):
            v += h / 2 * 3 * (float(u[k]) - friction * v - 4.905 * math.sin(q))
            q += h * v * (1 - half)
        out.append(q)
    return np.array(out)


def dirty(t, q, u, seed=0):
    """Times, outputs and inputs of a log with every flaw at once."""
    rng = np.random.default_rng(seed)
    keep = (rng.random(len(t)) > 0.05) & ((t < 3) | (t > 3.15))
    q = np.where(rng.random(len(t)) < 0.005, q + rng.choice([-1, 1], len(t)) * rng.uniform(0.5, 5, len(t)), q)
    q[(t > 7) & (t < 7.4)] = np.nan
    t = np.where(t < 9, t, t - 9)
    return t[keep], q[keep], u[keep]


@pytest.mark.parametrize("flaws", ["none", "all"])
def test_a_dirty_log_gives_the_same_numbers(flaws):
    friction, rng = 0.08, np.random.default_rng(11)
    extended = rod().extend([Extension("viscous-friction", "q", (Parameter("c", 0.0, "N*m*s"),), force="-c*{v}")])
    true = T + (0.3 * PERIOD * rng.uniform(-1, 1, len(T)) if flaws == "all" else 0)
    true[0] = 0.0
    nodes = np.round(true / 5e-4).astype(int)
    u = torque(T)
    held = u[np.searchsorted(nodes, np.arange(nodes[-1]), side="right") - 1]
    x = swing(held, friction)[nodes]
    t, q = nodes * 5e-4, x + NOISE * rng.standard_normal(len(T))
    t, q, u = dirty(t, q, u) if flaws == "all" else (t, q, u)
    m = Dataset.of(extended, Recording.of(t, {"q": q, "u": u}))
    h = Hypothesis(extended, ("c",), *(np.array([v]) for v in (0.0, -1.0, 1.0, 0.01, np.inf)))
    windows = m.windows(100)
    assert len(windows) >= (15 if flaws == "all" else 23)
    assert fit(h, windows).theta[0] == pytest.approx(friction, rel=0.03)
    if flaws == "all":
        blind = replace(windows, weight=np.ones_like(windows.weight), y=np.where(windows.weight == 0, 3.0, windows.y))
        assert abs(fit(h, blind).theta[0] / friction - 1) > 0.1
