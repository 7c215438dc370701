"""What happens within a period of an input that is held: on an oven whose element is as fast as the log."""

import numpy as np
import pytest
from scipy.linalg import expm

import gapcert as gc
from gapcert_diagnosis import diagnose
from gapcert_diagnosis.data.dataset import Dataset
from gapcert_diagnosis.fitting.hypothesis import within
from gapcert_diagnosis.fitting.step_size import paced, quickened
from gapcert_diagnosis.testing import equations

H, FINE = 6.5, 26
OVEN = {
    "kind": "equations",
    "states": {"T1": "K", "T2": "K"},
    "inputs": {"P": "W"},
    "period": f"{H} s",
    "integrator": "rk4",
    "parameters": {
        "C1": {"value": "5.04 J/K", "tolerance": "2 %"},
        "C2": {"value": "29.8 J/K", "tolerance": "2 %"},
        "k": {"value": "0.757 W/K", "tolerance": "2 %"},
        "U": {"value": "0.191 W/K", "tolerance": "2 %"},
    },
    "derivative": {"T1": "(P - k*(T1 - T2))/C1", "T2": "(k*(T1 - T2) - U*T2)/C2"},
}
SLOPES = np.array([[-0.755 / 5.03, 0.755 / 5.03, 1 / 5.03], [0.755 / 30.2, -(0.755 + 0.1926) / 30.2, 0.0], [0.0, 0.0, 0.0]])
STEP = expm(SLOPES * H / FINE)


def temperatures(power):
    """Exact ones (T·FINE, 2), from cold on, under power (T·FINE,) in steps of H / FINE."""
    x, out = np.zeros(2), np.empty((len(power), 2))
    for k, p in enumerate(power):
        out[k], x = x, STEP[:2, :2] @ x + STEP[:2, 2] * p
    return out


def levels(count, seed=5):
    return np.repeat(np.random.default_rng(seed).uniform(1, 9, count // 3 + 1), 3)[:count]


def logged(shown, u, hold="zero", noise=0.002):
    rng = np.random.default_rng(1)
    y = shown + noise * np.std(shown, axis=0) * rng.standard_normal(shown.shape)
    return gc.Recording.of(H * np.arange(len(u)), {"T1": y[:, 0], "T2": y[:, 1], "P": u}, hold=hold)


def test_a_motion_is_followed_between_steps_as_its_input_bends_it():
    model, u = paced(equations(OVEN | {"substeps": 8}), 8), levels(40)
    true = {"C1": 5.03, "C2": 30.2, "k": 0.755, "U": 0.1926}
    truth, power = temperatures(np.repeat(u, FINE)), np.repeat(u, 8)[None, :, None]
    states, at = truth[::FINE], np.arange(1, 39)[:, None] - 6 / FINE * np.ones(2)
    x = model.fast_rollout(states[:1], power[:, :-1], parameters=true).x
    found = within(model, x, power, 8 * at[None], (0, 1), true, None)[0]
    exact = truth[np.arange(1, 39) * FINE - 6]
    assert np.abs(found - exact).max() < 1e-4 * np.std(truth)
    straight = np.stack([np.interp(at[:, 0], np.arange(40), states[:, i]) for i in (0, 1)], axis=1)
    assert np.abs(straight - exact).max() > 1e-2 * np.std(truth)


def test_periods_are_as_short_as_a_held_input_asks_for():
    u = levels(300)
    shown, model = temperatures(np.repeat(u, FINE))[::FINE], equations(OVEN | {"substeps": 4})

    def period(**log):
        return quickened(model, Dataset.of(model, logged(shown, u, **log)).windows(30)).period

    assert period() < H / 2
    assert period(noise=0.3) == H
    assert period(hold=None) == H


@pytest.mark.exam
def test_a_limited_rate_is_seen_at_once_where_the_input_goes_straight():
    """A damper's force follows its speed: half a period of a ramp is several floors of it."""
    model = equations(
        {
            "kind": "equations",
            "states": {"x": "m"},
            "inputs": {"v": "m/s"},
            "parameters": {"k": "6000 N/m", "c": {"value": "1080 N*s/m", "tolerance": "2 %"}},
            "derivative": {"x": "v"},
            "outputs": {"x": "x", "F": "k*x + c*v"},
            "period": "5 ms",
        }
    )
    t, fine, rng = np.arange(1600) * 0.005, np.arange(160_000) * 5e-5, np.random.default_rng(2)
    v = 0.15 * np.sin(2 * np.pi * (0.5 * t + 0.4 * t**2))
    asked, acts = np.interp(fine, t, v), np.zeros(len(fine))
    for k in range(1, len(fine)):
        acts[k] = acts[k - 1] + np.clip(asked[k] - acts[k - 1], -3.0 * 5e-5, 3.0 * 5e-5)
    x = np.concatenate([[0.0], np.cumsum((acts[1:] + acts[:-1]) / 2) * 5e-5])
    shown = {
        "x": x[::100] + 1e-4 * rng.standard_normal(1600),
        "F": (6000 * x + 1080 * acts)[::100] + 2 * rng.standard_normal(1600),
    }
    recording = gc.Recording.of(t, shown | {"v": v}, hold="first")
    assert quickened(model, Dataset.of(model, recording).windows(100)).period < 2e-3
    suspects = ["input-rate-limit", "input-lag", "input-gain", "input-saturation"]
    found = diagnose(model, recording, suspects, horizons=[0.4])
    (cause,) = found.causes
    assert (cause.effect, cause.flags) == ("input-rate-limit", ())
    assert cause.parameters["rate"].value == pytest.approx(3.0, rel=0.02)


@pytest.mark.exam
@pytest.mark.parametrize("name", ["sensor-delay", "input-lag"])
def test_a_quarter_of_a_period_is_told_by_kind_and_size(name):
    u = levels(700)
    power, late = np.repeat(u, FINE), 6
    if name == "input-lag":
        kept, left = np.empty_like(power), np.exp(-1 / late)
        reached = 0.0
        for k, level in enumerate(power):
            new = level + (reached - level) * left
            # Its exact mean over a step.
            kept[k], reached = level + (reached - level) * late * (1 - left), new
        power = kept
    shown = temperatures(power)[::FINE]
    if name == "sensor-delay":
        shown[1:, 0] = temperatures(power)[FINE - late :: FINE, 0][: len(u) - 1]
    suspects = ["sensor-delay", "sensor-lag", "input-delay", "input-lag", "external-push", "parameter"]
    (cause,) = diagnose(equations(OVEN), logged(shown, u), suspects).causes
    assert (cause.effect, cause.site) == (name, "T1" if name == "sensor-delay" else "P")
    (number,) = cause.parameters.values()
    assert number.value == pytest.approx(late * H / FINE, rel=0.03)
    assert cause.flags == ()
