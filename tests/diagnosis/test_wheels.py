"""Bases on wheels that slip sideways in turns, simulated by hand in fine steps."""

import numpy as np
import pytest

import gapcert as gc
from gapcert_diagnosis import diagnose
from gapcert_diagnosis.testing import equations

CAR = {
    "states": {"x": "m", "y": "m", "theta": "rad", "v": "m/s"},
    "inputs": {"a": "m/s", "w": "rad/s"},
    "parameters": {"tau": {"value": "0.25 s", "tolerance": "2 %"}},
    "derivative": {"x": "v*cos(theta)", "y": "v*sin(theta)", "theta": "w", "v": "(a - v)/tau"},
}
TWO_WHEELS = {
    "states": {"x": "m", "y": "m", "theta": "rad"},
    "inputs": {"left": "m/s", "right": "m/s"},
    "parameters": {"track": {"value": "0.5 m", "tolerance": "2 %"}},
    "derivative": {"x": "(left + right)/2*cos(theta)", "y": "(left + right)/2*sin(theta)", "theta": "(right - left)/track"},
}


def told(base, sideways, turning=1.0):
    """The diagnosis of a base that moves sideways by sideways(its speed, its rate of turning)."""
    rng, h, fine, count, hold = np.random.default_rng(3), 0.02, 5, 1200, 60
    speed, rate = (np.repeat(rng.uniform(-s, s, count // hold), hold) for s in (1.6, 1.1))
    car, path, s, v = base is CAR, [], np.zeros(3), 0.0
    for target, commanded in zip(speed, turning * rate, strict=True):
        path.append([*s, v] if car else s)
        for _ in range(fine):
            d = h / fine
            arrived = target + (v - target) * np.exp(-d / 0.25) if car else target
            v, mean, heading = arrived, (v + arrived) / 2 if car else target, s[2] + commanded * d / 2
            aside = sideways(mean, commanded)
            along = mean * np.array([np.cos(heading), np.sin(heading)]) + aside * np.array([-np.sin(heading), np.cos(heading)])
            s = s + d * np.array([*along, commanded])
    u = np.stack([speed, rate] if car else [speed - 0.25 * rate, speed + 0.25 * rate], axis=1)
    y = np.array(path) + 0.003 * rng.standard_normal((count, 4 if car else 3))
    model = equations({"kind": "equations", "integrator": "rk4", "period": "20 ms", **base})
    names = [*(o.name for o in model.outputs), *(i.name for i in model.inputs)]
    return diagnose(model, gc.Recording.of(np.arange(count) * h, dict(zip(names, [*y.T, *u.T], strict=True)), hold="zero"))


def slips(base, number, value, sideways):
    found = told(base, sideways)
    assert [(c.effect, c.site) for c in found.causes] == [("side-slip", "x")]
    assert found.causes[0].parameters[number].value == pytest.approx(value, rel=0.03)
    assert not found.ambiguous_with


def test_tyres_slip():
    slips(TWO_WHEELS, "compliance", 0.11, lambda v, w: -0.11 * v * abs(v) * w)


def test_the_log_may_follow_a_point_ahead_of_the_axle():
    slips(TWO_WHEELS, "ahead", 0.06, lambda v, w: 0.06 * w)


@pytest.mark.exam
def test_a_car_that_takes_time_to_its_speed_slips_as_well():
    slips(CAR, "compliance", 0.11, lambda v, w: -0.11 * v * abs(v) * w)
    slips(CAR, "ahead", -0.06, lambda v, w: -0.06 * w)


def test_a_base_that_rolls_along_its_heading_does_not_slip():
    assert told(TWO_WHEELS, lambda v, w: 0.0).verdict == "nothing"


@pytest.mark.exam
def test_nor_does_one_that_turns_too_fast():
    (cause,) = told(CAR, lambda v, w: 0.0, turning=1.1).causes
    assert (cause.effect, cause.site) == ("input-gain", "w")
