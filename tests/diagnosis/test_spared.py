"""What comes after the answer may fail, and costs its own part only."""

import sys

import numpy as np
import pytest

import gapcert as gc
from gapcert.plugin import Recording, Trajectory
from gapcert_diagnosis import experiment
from gapcert_diagnosis.testing import ROD, equations

H = 0.0041  # twelve seconds hold 2,927 samples, which four does not divide


def late(delay=0.03):
    """A rod that is driven late, which a late sensor looks like, in a log of an odd period."""
    rng, n = np.random.default_rng(4), 3001
    model = equations({**ROD, "period": f"{H} s"})
    u = 0.4 * rng.normal(size=n // 20 + 1).repeat(20)[:n, None]
    back = round(delay / H)
    pushed = np.concatenate([np.zeros((back, 1)), u[: n - back]])
    y = model.rollout(np.zeros((1, model.nx)), pushed[None]).x[0, :n, 0]
    t = H * np.arange(n)
    return model, Recording((Trajectory(t, {"q": y + 1e-3 * rng.normal(size=n), "u": u[:, 0]}, "log"),), {}, "zero")


def diagnosed():
    return gc.diagnose(*late(), effects=["input-delay", "sensor-delay", "viscous-friction"], horizons=[1.0])


@pytest.fixture(scope="module")
def whole():
    return diagnosed()


def test_any_period_is_as_good_as_a_round_one(whole):
    assert whole.causes[0].effect in ("input-delay", "sensor-delay")
    assert whole.causes[0].parameters["delay"].value == pytest.approx(0.03, abs=0.004)
    assert whole.warnings == ()


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 127, 128, 2927])
def test_what_comes_back_is_as_long_as_what_it_is_made_of(count):
    shape = np.ones((count, 2))
    back = experiment._returning(shape)
    assert back.shape == shape.shape
    assert abs(back.sum(axis=0)).max() <= 3


@pytest.mark.parametrize(
    ("name", "part"),
    [
        pytest.param("told_apart", "experiment", marks=pytest.mark.exam),
        ("figure", "pictures"),
        pytest.param("evidence", "tests of the", marks=pytest.mark.exam),
    ],
)
def test_a_defect_after_the_answer_leaves_it_standing(whole, monkeypatch, name, part):
    def broken(*given):
        raise ZeroDivisionError("no such thing")

    module = sys.modules["gapcert_diagnosis.diagnose"]
    owner = module.leftover if name == "evidence" else module
    monkeypatch.setattr(owner, name, broken)
    found = diagnosed()
    assert [(c.effect, c.site, c.parameters) for c in found.causes] == [(c.effect, c.site, c.parameters) for c in whole.causes]
    (told,) = found.warnings
    assert told.startswith(f"the {part}")
    assert "(ZeroDivisionError: no such thing); please report it; the answer stands" in told
    assert found.summary()["warnings"] == [told]


@pytest.mark.parametrize("limits", [{"nobody": [0, 1]}, {"u": [1, 1]}])
def test_what_was_asked_wrongly_is_refused_before_the_search(monkeypatch, limits):
    monkeypatch.setattr(sys.modules["gapcert_diagnosis.diagnose"], "_settled", None)
    with pytest.raises(gc.UsageError, match="experiment"):
        gc.diagnose(*late(), effects=["input-delay"], horizons=[1.0], experiment={"limits": limits})


def test_pushes_that_cannot_be_looked_for_are_told_so(whole, monkeypatch):
    def refused(*given):
        raise gc.UsageError("recording: 3 windows are too few")

    monkeypatch.setattr(sys.modules["gapcert_diagnosis.diagnose"], "_listed", refused)
    found = diagnosed()
    assert found.warnings == ("pushes could not be looked for (recording: 3 windows are too few); the answer stands",)
    assert [c.effect for c in found.causes] == [c.effect for c in whole.causes]


def test_what_cannot_be_tested_is_not_called_explained(whole, monkeypatch):
    def broken(*given):
        raise np.linalg.LinAlgError("no such thing")

    monkeypatch.setattr(sys.modules["gapcert_diagnosis.diagnose"].leftover, "left", broken)
    found = diagnosed()
    assert found.verdict == "unexplained"
    assert [(c.effect, c.site) for c in found.causes] == [(c.effect, c.site) for c in whole.causes]
    assert found.warnings[0].startswith("the test of what is left could not be made (LinAlgError: no such thing)")
    assert found.sentence()
    assert all(c["partial"] for c in found.summary()["causes"])
