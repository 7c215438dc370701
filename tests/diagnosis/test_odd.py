"""Odd logs and specs: an answer or one sentence, and no number that is none."""

from dataclasses import replace

import numpy as np
import pytest

import gapcert as gc
from gapcert.plugin import Recording, Trajectory
from gapcert_diagnosis.data.dataset import Dataset
from gapcert_diagnosis.data.feedback import loops
from gapcert_diagnosis.figure import _Axis, _carried
from gapcert_diagnosis.fitting.fit import fit
from gapcert_diagnosis.fitting.hypothesis import Hypothesis
from gapcert_diagnosis.fitting.rollout_error import Stretches
from gapcert_diagnosis.residual.adequacy import close
from gapcert_diagnosis.testing import equations

OVEN = {
    "kind": "equations",
    "states": {"T": "K"},
    "inputs": {"P": "W"},
    "parameters": {"C": {"value": "30 J/K", "tolerance": "3 %"}, "U": "0.3 W/K", "Ta": "290 K"},
    "derivative": {"T": "(P - U*(T - Ta))/C"},
    "period": "2 s",
}


def heated(section=OVEN, held=20, count=400, stamps=2.0):
    """An oven that is heated in steps, which last so many samples."""
    rng, model, T, y = np.random.default_rng(5), equations(OVEN), 290.0, []
    power = rng.uniform(0, 20, count // held + 1).repeat(held)[:count]
    for p in power:
        y.append(T + 0.02 * rng.standard_normal())
        T += 2.0 * (p - 0.3 * (T - 290)) / 34
    t = stamps * np.arange(count)
    return equations(section) if section is not OVEN else model, Recording(
        (Trajectory(t, {"T": np.array(y), "P": power}, "log"),)
    )


def test_a_state_that_runs_away_unseen_leaves_an_answer():
    away = {"states": {"T": "K", "z": "1"}, "derivative": OVEN["derivative"] | {"z": "z/r"}}
    found = gc.diagnose(*heated(OVEN | away | {"parameters": OVEN["parameters"] | {"r": "5e-4 s"}}), ["coulomb-friction"])
    assert found.verdict in ("unexplained", "nothing")


def test_times_in_another_unit_are_refused_before_memory_runs_out():
    with pytest.raises(gc.UsageError, match=r"samples are 200000 s apart, 100,000 steps of the model, 2 s; expected 10,000"):
        Dataset.of(*heated(stamps=2e5))


def test_an_input_that_jumps_at_every_other_sample():
    model, recording = heated(held=2)
    assert loops(model, Dataset.of(model, recording)) == ()


@pytest.mark.parametrize("unit", ["", {"unit": ""}])
def test_an_empty_unit_is_none(unit):
    """Of a coordinate too, whose velocity is per second then."""
    free = {
        "kind": "equations",
        "coordinates": {"q": unit},
        "parameters": {"k": "4 1/s^2"},
        "mass_matrix": [["1"]],
        "period": "10 ms",
    }
    model = equations({**free, "bias": {"q": "k*q"}})
    assert [s.unit for s in model.states] == ["1", "1/s"]


def test_a_period_of_a_second_makes_no_state_a_position():
    """The slope of a state by itself is about 1 then, as that of a position by a speed in s."""
    basin = {"states": {"h": "m"}, "inputs": {"q": "m^3/s"}, "derivative": {"h": "(q - c*sqrt(max(h, 0)))/A"}, "period": "1 s"}
    basin |= {"kind": "equations", "parameters": {"c": {"value": "0.02 m^2.5/s", "tolerance": "3 %"}, "A": "0.3 m^2"}}
    rng, h, y = np.random.default_rng(1), 0.6, []
    flow = rng.uniform(0, 0.03, 40).repeat(15)
    for q in flow:
        y.append(h + 2e-3 * rng.standard_normal())
        h += (q - 0.012 * h - 0.004 * np.sin(9 * h)) / 0.3
    recording = Recording((Trajectory(1.0 * np.arange(600), {"h": np.array(y), "q": flow}, "log"),))
    found = gc.diagnose(equations(basin), recording, ["coulomb-friction"])
    assert found.verdict == "unexplained"
    assert found.warnings == ()
    assert found.unexplained.correction is not None
    assert "{q}" not in found.unexplained.correction.extension.force


def test_a_parameter_where_nothing_has_a_coordinate_is_drawn_at_an_input():
    rng, x, y = np.random.default_rng(3), 0.0, []
    u = rng.uniform(-1, 1, 30).repeat(20)
    for v in u:
        y.append(x + 3e-3 * rng.standard_normal())
        x = 0.9 * x + 0.14 * v
    step = {"kind": "equations", "states": {"x": "1"}, "inputs": {"u": "1"}, "next": {"x": "a*x + b*u"}, "period": "50 ms"}
    model = equations(step | {"parameters": {"a": 0.9, "b": {"value": 0.1, "tolerance": "5 %"}}})
    recording = Recording((Trajectory(0.05 * np.arange(600), {"x": np.array(y), "u": u}, "log"),))
    found = gc.diagnose(model, recording, ["parameter"])
    assert [(c.effect, c.site) for c in found.causes] == [("parameter", "b")]
    assert found.warnings == ()
    assert found.figure.laws


def test_nothing_carries_a_law_that_runs_away():
    axis = _Axis("x", "m", np.linspace(0, 1, 60).reshape(2, 30))
    assert _carried(axis.values**2, axis) > 0.9
    for wild in (np.nan, np.inf, 1e200):
        assert _carried(np.where(axis.values > 0.5, wild, axis.values), axis) == 0.0


def test_a_simulation_that_runs_away_is_excused_by_no_noise():
    """Its rollouts, moved by noise, run away as far: that says nothing for it."""
    rng, x, y = np.random.default_rng(2), 0.5, []
    for _ in range(600):
        y.append(x + 1e-3 * rng.standard_normal())
        x += 0.02 * (np.sin(len(y) / 40) - x)
    away = {"kind": "equations", "states": {"x": "1"}, "derivative": {"x": "(k*x**3 - x)/T"}, "period": "20 ms"}
    model = equations(away | {"parameters": {"k": 2, "T": "1 s"}})
    recording = Recording((Trajectory(0.02 * np.arange(600), {"x": np.array(y)}, "log"),))
    measured = Dataset.of(model, recording)
    windows = measured.windows(40)
    fitted = fit(Hypothesis(model), windows)
    judge = Stretches.of(measured, 4.0)
    assert np.isfinite(judge.floors(fitted)).all()
    assert all(np.isfinite(list(vars(g).values())).all() for g in judge.gains(fitted, fitted, 0).values())
    quiet = replace(fitted, residual=0.1 * fitted.residual / np.sqrt(fitted.chi))
    assert judge.error(fitted) > 2
    assert not close(judge, quiet, 0)
