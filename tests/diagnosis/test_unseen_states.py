"""A state that no output shows: what depends on it is set aside, in words, and the rest is found as if it were not there."""

import warnings

import numpy as np
import pytest

import gapcert as gc
from gapcert.plugin import Recording, Trajectory
from gapcert_diagnosis.data.dataset import Dataset
from gapcert_diagnosis.fitting.hypothesis import Hypothesis
from gapcert_diagnosis.testing import equations

H, N = 0.005, 2400
NUMBERS = {"J": {"value": "0.002 kg*m^2", "tolerance": "5 %"}, "b": "0.004 N*m*s/rad", "k": "0.08 N*m/A"}
FORMS = {
    "coordinate": {
        "coordinates": {"phi": "rad"},
        "mass_matrix": [["J"]],
        "forces": {"phi": "k*i - b*phi_dot"},
        "outputs": {"phi_dot": "phi_dot"},
    },
    "rates": {
        "states": {"phi": "rad", "w": "rad/s"},
        "derivative": {"phi": "w", "w": "(k*i - b*w)/J"},
        "outputs": {"w": "w"},
    },
    "alone": {"states": {"w": "rad/s"}, "derivative": {"w": "(k*i - b*w)/J"}, "outputs": {"w": "w"}},
}


@pytest.fixture(scope="module")
def measured():
    """(t, current, speed) of a drive with dry friction of 0.03 N·m, in small steps of another integrator."""
    rng, w, speeds = np.random.default_rng(8), 0.0, []
    current = rng.normal(size=N // 60).repeat(60) * 1.2
    for i in current:
        speeds.append(w)
        for _ in range(20):
            h, push = H / 20, 0.08 * i - 0.004 * w
            free = w + h * push / 0.002
            w = float(np.sign(free) * max(abs(free) - h * 0.03 / 0.002, 0.0))
    return H * np.arange(N), current, np.array(speeds) + 0.02 * rng.normal(size=N)


@pytest.mark.parametrize("form", FORMS)
def test_friction_is_found_without_the_angle(measured, form):
    t, current, speed = measured
    data = {"kind": "equations", "period": f"{H} s", "inputs": {"i": "A"}, "parameters": NUMBERS, **FORMS[form]}
    model = gc.registry().build(
        "model", "equations", gc.registry().config("model", "equations").model_validate(data), gc.Context(None)
    )
    (name,) = FORMS[form]["outputs"]
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        found = gc.diagnose(model, Recording((Trajectory(t, {name: speed, "i": current}, "log"),), {}, "zero"))
    (cause,) = found.causes
    level = cause.parameters["level"].value * (1.0 if form == "coordinate" else 0.002)
    assert cause.effect == "coulomb-friction"
    assert level == pytest.approx(0.03, rel=0.01)
    told = [a for a in found.assumptions if "were not tried" in a]
    assert bool(told) == (form != "alone")
    assert all("dahl-friction" in a and "as no output shows how it moves" in a for a in told)


def test_where_no_state_is_shown_windows_begin_where_the_model_gets_to():
    """At rest a tension has no slope in the angle: from there no fit would find out which way a pendulum swings."""
    section = {"kind": "equations", "states": {"q": "rad", "w": "rad/s"}, "inputs": {"T": "N*m"}, "period": "20 ms"}
    section |= {"parameters": {"m": "0.8 kg", "l": "0.6 m", "d": "0.3 N*m*s/rad", "g": "9.81 m/s^2"}, "integrator": "rk4"}
    section |= {"derivative": {"q": "w", "w": "(T - d*w - m*g*l*sin(q))/(m*l**2)"}, "outputs": {"S": "m*g*cos(q) + m*l*w**2"}}
    model, t = equations(section), 0.02 * np.arange(400)
    torque = 2.5 * np.sin(3.1 * t)[:, None]
    x = model.fast_rollout(np.zeros((1, 2)), torque[None, :-1]).x[0]
    tension = model.output(x, torque)[:, 0] + 0.01 * np.random.default_rng(0).normal(size=len(t))
    log = Recording((Trajectory(t, {"S": tension, "T": torque[:, 0]}, "log"),), {}, "zero")
    windows = Dataset.of(model, log).windows(50)
    assert not windows.start.any()
    found = Hypothesis(model).guessed(windows, np.empty(0), windows.start)
    np.testing.assert_allclose(found, x[windows.place[:, 1]], atol=1e-9)


def test_a_push_is_found_where_nothing_is_measured():
    """In the element of an oven, hundreds of kelvins from where a state that is not known would be guessed to be."""
    rng, h, x, shown = np.random.default_rng(3), 10.0, np.array([343.0, 330.0]), []
    power = np.repeat(rng.uniform(1, 5, 30), 30)
    for k, p in enumerate(power):
        shown.append(x[1])
        for _ in range(40):
            pushed = -0.11 if 3200 <= k * h < 3330 else 0.0
            flow = 0.15 * (x[0] - x[1])
            x = x + h / 40 * np.array([(p - flow) / 2.4 + pushed, (flow - 0.07 * (x[1] - 293)) / 9.3])
    model = equations(
        {"kind": "equations", "states": {"T1": "K", "T2": "K"}, "inputs": {"P": "W"}, "period": "10 s"}
        | {"outputs": {"T2": "T2"}, "derivative": {"T1": "(P - k*(T1 - T2))/C1", "T2": "(k*(T1 - T2) - U*(T2 - Ta))/C2"}}
        | {
            "parameters": {
                "C1": {"value": "2.42 J/K", "tolerance": "2 %"},
                "C2": "9.3 J/K",
                "k": "0.15 W/K",
                "U": "0.07 W/K",
                "Ta": "293 K",
            }
        }
    )
    seen = np.array(shown) + 0.01 * rng.standard_normal(len(shown))
    recording = gc.Recording.of(h * np.arange(len(seen)), {"T2": seen, "P": power}, hold="zero")
    (cause,) = gc.diagnose(model, recording, ["external-push", "parameter"], horizons=[400.0]).causes
    assert (cause.effect, cause.site) == ("external-push", "T1")
    assert cause.parameters["time"].value == pytest.approx(3200, abs=10)
