"""Inputs that are no actuators: exact ones, ones that never act, and ones that a controller computes."""

import numpy as np
import pytest

import gapcert as gc
from gapcert.plugin import Recording, Trajectory

T = 0.01 * np.arange(1200)
SERVO = {
    "period": "0.01 s",
    "states": {"v": "m/s"},
    "inputs": {"u": "V", "gain": "1", "spare": "V"},
    "parameters": {"K": "0.5 m/s/V", "tau": "0.1 s"},
    "derivative": {"v": "(K*gain*u - v)/tau"},
}


def model():
    config = gc.registry().config("model", "equations").model_validate({"kind": "equations", **SERVO})
    return gc.registry().build("model", "equations", config, gc.Context(None))


def recorded(offset=0.0, feedback=False):
    """A drive to whose input something is added; its gain is switched, and a third input does nothing."""
    rng, v, rows = np.random.default_rng(1), 0.0, []
    gain, command = np.repeat(rng.choice([0.5, 1.0, 1.5], 12), 100), np.repeat(rng.uniform(-2, 2, 24), 50)
    for g, c in zip(gain, command, strict=True):
        y = v + 0.01 * rng.normal()
        u = 3 * (c / 2 - y) if feedback else c
        rows.append((y, u))
        v += (1 - np.exp(-0.1)) * (0.5 * g * (u + offset) - v)
    y, u = np.array(rows).T
    return Recording((Trajectory(T, {"v": y, "u": u, "gain": gain, "spare": 0.1 * np.sin(T)}, "log"),), {}, "zero")


INPUTS = ["input-gain", "input-offset", "input-saturation"]


def test_inputs_that_are_exact_or_never_act_are_no_suspects():
    found = gc.diagnose(model(), recorded(0.4), INPUTS, exact=["gain"], horizons=[1.0])
    assert [(c.effect, c.site) for c in found.causes] == [("input-offset", "u")]
    assert found.causes[0].parameters["offset"].value == pytest.approx(0.4, rel=0.05)
    assert {site for group in found.ambiguous_with for _, site in group} <= {"u"}
    assert "nothing was tried at spare, which moves nothing in these data" in found.assumptions
    nothing = gc.diagnose(model(), recorded(), INPUTS, exact=["gain"], horizons=[1.0])
    assert nothing.verdict == "nothing"
    assert {s.site for s in nothing.smallest} == {"u"}


def test_an_exact_input_has_to_be_an_input():
    with pytest.raises(gc.UsageError, match=r"diagnose.exact: 'v' is no input of the model; expected .* u, gain, spare"):
        gc.diagnose(model(), recorded(), INPUTS, exact=["v"], horizons=[1.0])


@pytest.mark.parametrize("feedback", [False, True])
def test_a_log_under_feedback_is_told(feedback):
    found = gc.diagnose(model(), recorded(feedback=feedback), ["input-offset"], horizons=[1.0])
    assert any(a.startswith("u is under feedback") for a in found.assumptions) == feedback
    assert found.verdict == "nothing"
