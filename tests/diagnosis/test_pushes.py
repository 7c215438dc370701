"""Pushes from outside: found in plain equations of state too, beside other laws, and against repetitions of a command."""

import numpy as np
import pytest

import gapcert as gc
from gapcert.testing import multisine
from gapcert_diagnosis.testing import equations

PERIOD, FINE = 0.005, 10
MOTOR = {
    "kind": "equations",
    "period": f"{PERIOD} s",
    "states": {"angle": "rad", "speed": "rad/s"},
    "inputs": {"U": "V"},
    "parameters": {"a": {"value": "9 1/s", "tolerance": "3 %"}, "b": {"value": "60 rad/s^2/V", "tolerance": "3 %"}},
    "derivative": {"angle": "speed", "speed": "b*U - a*speed"},
}
U = multisine(9.0, PERIOD, 1.5, (0.3, 3.0), 7)
EFFECTS = ["external-push", "coulomb-friction", "viscous-friction", "input-gain"]


def run(pushes=(), law=lambda angle, speed: 0.0, seed=0):
    """(n, 2) from rest: pushes are (from, for, rad/s²)."""
    x, rows, h = np.zeros(2), [], PERIOD / FINE
    for k, u in enumerate(U[:, 0]):
        rows.append(x.copy())
        for s in range(FINE):
            t = k * PERIOD + s * h
            force = sum(f for a, d, f in pushes if a <= t < a + d)
            x = x + h * np.array([x[1], 60 * u - 9.2 * x[1] + force + law(*x)])
    rows = np.array(rows)
    return rows + 3e-3 * np.std(rows, axis=0) * np.random.default_rng(seed).standard_normal(rows.shape)


def recording(*runs):
    t = np.arange(len(U)) * PERIOD
    own = [{"angle": y[:, 0], "speed": y[:, 1], "U": U[:, 0]} for y in runs]
    return gc.Recording(tuple(gc.Trajectory(t + 2.0, c, f"{i}.csv") for i, c in enumerate(own)), {}, "zero")


def find(*runs, effects=EFFECTS):
    return gc.diagnose(equations(MOTOR), recording(*runs), effects, hold_out={"last": 0.25}, horizons=[0.5])


def test_pushes_at_a_state_equation_are_a_cause_and_a_list():
    given = [(1.5, 0.1, 400.0), (4.0, 0.06, -500.0), (7.9, 0.15, 300.0)]
    found = find(run(given))
    assert (found.verdict, [(c.effect, c.site) for c in found.causes]) == ("causes", [("external-push", "speed")])
    listed = found.summary()["pushes"]
    assert [(p["trajectory"], p["site"], p["sign"], p["unit"]) for p in listed] == [
        ("0.csv", "speed", s, "rad/s") for s in (1, -1, 1)
    ]
    for p, (t, duration, rate) in zip(listed, given, strict=True):
        assert p["t"] == pytest.approx(t + 2, abs=0.02)
        assert p["t"] + p["duration"] == pytest.approx(t + duration + 2, abs=0.02)
        assert p["size"] == pytest.approx(abs(rate) * duration, rel=0.03)
        assert 0 < p["high"] - p["low"] < 0.2 * p["size"]
    last = found.residual["speed"]
    assert last.after < 1.2 * last.noise_floor < 0.1 * last.before
    assert len([p for p in found.extended_model.parameters if p.name.startswith("external_push")]) == 9


@pytest.mark.exam
def test_nothing_is_no_push_and_another_cause_is_found_between_pushes():
    assert find(run()).pushes == ()
    found = find(run([(2.0, 0.1, 500.0), (5.0, 0.1, -400.0)], lambda _, v: -12 * np.tanh(30 * v)))
    assert {c.effect for c in found.causes} == {"external-push", "coulomb-friction"}
    assert len(found.pushes) == 2


@pytest.mark.exam
def test_a_push_is_what_differs_from_repetitions_of_the_command():
    def law(angle, speed):
        return 8 * np.cos(speed / 2)

    pushed, others = run([(3.0, 0.1, 250.0)], law, 1), [run((), law, s) for s in (2, 3, 4)]
    found = find(others[0], pushed, *others[1:])
    assert found.verdict == "unexplained"
    (push,) = found.pushes
    assert (push.trajectory, push.site, push.sign) == ("1.csv", "speed", 1)
    assert push.t + push.duration / 2 == pytest.approx(5.05, abs=0.03)
    assert push.size == pytest.approx(25, rel=0.1)
    assert "Pushes from outside: +2" in found.sentence()
