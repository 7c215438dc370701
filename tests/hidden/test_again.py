"""A model that a diagnosis extended is diagnosed once more: silence where it has all of the cause, and else the rest of it."""

import warnings

import pytest
from exams.hide import hide

import gapcert as gc
from gapcert.testing import multisine

PERIOD = 0.004
STAGE = {
    "kind": "equations",
    "coordinates": {"q": "m"},
    "inputs": {"F": "N"},
    "parameters": {"m": "2 kg"},
    "mass_matrix": [["m"]],
    "forces": {"q": "F"},
    "period": f"{PERIOD} s",
}
LEVEL = 1.5


def stage(level):
    """As `gapcert extend` writes it."""
    own = {
        "parameters": STAGE["parameters"] | {"coulomb_friction_q": f"{level} N"},
        "dry_friction": {"q": "coulomb_friction_q"},
    }
    return gc.load_spec({"version": 1, "name": "stage", "model": STAGE | own}).build("model")


@pytest.fixture(scope="module")
def log():
    F = multisine(12.0, PERIOD, 6.0, (0.1, 1.5), seed=5)
    return hide(stage(LEVEL), x0=[0.0, 0.0], u=F, noise={"q": 2e-4}, seed=7)


@pytest.mark.parametrize("level", [LEVEL, pytest.param(1.2, marks=pytest.mark.exam)])
def test_a_cause_that_is_there_is_asked_for_its_rest(log, level):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = gc.diagnose(stage(level), log, "all", horizons=[0.5])
    if level == LEVEL:
        assert found.verdict == "nothing"
        return
    (cause,) = found.causes
    assert (cause.effect, cause.site) == ("coulomb-friction", "q")
    assert cause.parameters["level"].value == pytest.approx(LEVEL - level, abs=0.01)
    assert {p.name: p.value for p in found.extended_model.parameters}["coulomb_friction_q_2"] == cause.parameters["level"].value
