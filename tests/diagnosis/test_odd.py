"""Odd logs and specs: an answer or one sentence, and no number that is none."""

import numpy as np
import pytest

import gapcert as gc
from gapcert.plugin import Recording, Trajectory
from gapcert_diagnosis.data.dataset import Dataset
from gapcert_diagnosis.data.feedback import loops
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
