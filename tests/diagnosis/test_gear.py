"""Play in the angle, as motor or link show it: two inertias by hand, whose gap ends throw nothing back."""

import numpy as np
import pytest

import gapcert as gc
from gapcert_diagnosis import diagnose
from gapcert_diagnosis.testing import equations

FINE = 100
ARM = {
    "kind": "equations",
    "coordinates": {"q": "rad"},
    "inputs": {"u": "N*m"},
    "parameters": {
        "J": {"value": "0.05 kg*m^2", "tolerance": "10 %"},
        "b": {"value": "0.06 N*m/(rad/s)", "tolerance": "20 %"},
    },
    "mass_matrix": [["J"]],
    "forces": {"q": "u - b*q_dot"},
    "period": "5 ms",
}
OTHERS = ["backlash", "coulomb-friction", "viscous-friction", "input-dead-zone", "input-lag", "parameter"]


def turned(width, link=0.02, dry=0.0, count=1800):
    """(q of the motor and of the link (T, 2), u (T,)): 0.051 kg·m² in all, `link` of it beyond the gap; dry: of both as one."""
    t, h, motor = np.arange(count) * 0.005, 0.005 / FINE, 0.051 - link
    u = 0.9 * np.sin(2.5 * t) + 0.6 * np.sin(6.1 * t + 1) + 0.4 * np.sin(13.7 * t)
    q, v, z, w, path = 0.0, 0.0, 0.0, 0.0, []
    for level in u.tolist():
        path.append((q, z))
        for _ in range(FINE):
            v, w = v + h * (level - 0.041 * v) / motor, w - h * 0.02 * w / link
            gap = q - z + h * (v - w)
            # The impulse that keeps the gap.
            knock = (gap - min(max(gap, -width / 2), width / 2)) / h * motor * link / 0.051
            v, w = v - knock / motor, w + knock / link
            if dry:
                v = w = float(np.sign(v)) * max(abs(v) - h * dry / 0.051, 0.0)
            q, z = q + h * v, z + h * w
    return np.array(path), u


def told(q, u, effects):
    q = q + 2e-4 * np.random.default_rng(3).standard_normal(len(q))
    recording = gc.Recording.of(np.arange(len(u)) * 0.005, {"q": q, "u": u}, hold="zero")
    return diagnose(equations(ARM), recording, effects)


@pytest.mark.exam
@pytest.mark.parametrize(("side", "share"), [(0, 0.02 / 0.051), (1, 0.031 / 0.051)], ids=["motor", "link"])
def test_play_is_found_from_either_side(side, share):
    path, u = turned(0.08)
    found = told(path[:, side], u, ["gear-play", *OTHERS])
    assert found.verdict == "causes"
    (cause,) = found.causes
    assert cause.effect == "gear-play"
    assert cause.parameters["width"].value == pytest.approx(0.08, rel=0.1)
    assert cause.parameters[("motor_shift", "link_shift")[side]].value == pytest.approx(share * 0.08, rel=0.03)


@pytest.mark.exam
@pytest.mark.parametrize("dry", [0.0, 0.1])
def test_what_has_no_play_is_told_none(dry):
    path, u = turned(0.0, dry=dry)
    assert [c.effect for c in told(path[:, 0], u, ["gear-play", *OTHERS]).causes] == ["coulomb-friction"] * bool(dry)
