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
