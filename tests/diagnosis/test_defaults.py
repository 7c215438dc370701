"""On what an answer is judged where a spec does not say."""

import numpy as np
import pytest

import gapcert as gc
from gapcert.plugin import Recording, Trajectory
from gapcert_diagnosis.data.defaults import last_quarter, usual_horizons


def recorded(*channels, seconds, samples=4000, jitter=0.0):
    t = np.linspace(0, seconds, samples)
    t = t + jitter * np.random.default_rng(0).uniform(-0.5, 0.5, samples) * t[1]
    return Recording((Trajectory(t, {f"y{k}": c(t) for k, c in enumerate(channels)}, "log"),))


def sine(period, offset=0.0):
    return lambda t: offset + np.sin(2 * np.pi * t / period)


def judged(recording, names=("y0",)):
    return usual_horizons(recording, recording.split(last_quarter(recording))[1], names)


@pytest.mark.parametrize("period", [0.016, 0.7, 40.0, 5400.0])
@pytest.mark.parametrize("jitter", [0.0, 0.9])
def test_horizons_follow_the_motion(period, jitter):
    found = judged(recorded(sine(period, 7.0), seconds=60 * period, jitter=jitter))
    assert found == pytest.approx((period, 3 * period), rel=0.06)


def test_the_slowest_output_counts():
    assert judged(recorded(sine(0.5), sine(3.0), seconds=120), ("y0", "y1", "absent")) == pytest.approx((3, 9), rel=0.06)


def test_noise_and_missing_values_do_not_hide_the_motion():
    rng = np.random.default_rng(1)

    def noisy(t):
        y = np.sin(2 * np.pi * t / 2.0) + 0.3 * rng.normal(size=len(t))
        y[rng.random(len(t)) < 0.1] = np.nan
        return y

    assert judged(recorded(noisy, seconds=80)) == pytest.approx((2, 6), rel=0.06)


def test_times_that_are_missing_say_nothing():
    recording = recorded(sine(2.0), seconds=80)
    (tr,) = recording.trajectories
    tr.t[[5, -1]] = np.nan
    assert judged(recording) == pytest.approx((2, 6), rel=0.06)


@pytest.mark.parametrize("seconds", [1.6, 3.0, 10.0])
def test_short_logs_have_short_horizons_that_fit(seconds):
    recording = recorded(lambda t: t**2, seconds=seconds, samples=400)
    (horizon,) = judged(recording)
    assert 2 * horizon <= seconds / 4


def test_of_many_trajectories_the_last_ones_are_held_out():
    def runs(n, name="run {}"):
        return Recording(tuple(Trajectory(np.arange(50) * 0.02, {"y": np.zeros(50)}, name.format(k)) for k in range(n)))

    assert last_quarter(runs(7)) == {"last": 0.25}
    assert last_quarter(runs(10)) == {"trajectories": ["run 8", "run 9"]}
    assert last_quarter(runs(10, "run")) == {"last": 0.25}
    fitted, held = runs(10).split(last_quarter(runs(10)))
    assert (len(fitted.trajectories), len(held.trajectories)) == (8, 2)


def test_a_spec_needs_neither(tmp_path):
    t = np.arange(1500) * 0.01
    u = np.sign(np.sin(2 * np.pi * 0.31 * t)) + 0.5 * np.sign(np.sin(2 * np.pi * 0.83 * t))
    y, rows = 0.0, []
    for at, now in zip(t, u, strict=True):
        rows.append((at, y + 1e-4 * np.random.default_rng(int(1000 * at)).normal(), now))
        y = now * 1.7 + (y - now * 1.7) * np.exp(-0.01 / 0.25)
    np.savetxt(tmp_path / "log.csv", rows, "%.7g", ",", header="t,y,u", comments="")
    (tmp_path / "gain.yaml").write_text(
        """
version: 1
name: gain
model: {kind: equations, states: {y: V}, inputs: {u: V}, parameters: {tau: 0.25 s}, derivative: {y: (u - y)/tau}}
recording: {kind: csv, files: [log.csv], columns: {y: y, u: u}, hold: zero}
diagnose: {effects: [input-gain, input-offset]}
report: {html: false, rerun: false}
"""
    )
    found = gc.run(tmp_path / "gain.yaml", out=tmp_path / "runs").diagnosis
    assert [(c.effect, c.site) for c in found.causes] == [("input-gain", "u")]
    assert found.causes[0].parameters["gain"].value == pytest.approx(1.7, rel=0.01)
    horizons = sorted(map(float, found.gain))
    assert 0.1 < horizons[0] < 4
    assert horizons[-1] < 15 / 4
