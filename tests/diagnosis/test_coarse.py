"""A model whose own step is too coarse for a fast mode is told from one that lacks a law."""

from dataclasses import replace

import numpy as np
import pytest
from exams.hide import hide
from scipy.linalg import expm

import gapcert as gc
from gapcert.testing import multisine
from gapcert_diagnosis.data.dataset import Dataset
from gapcert_diagnosis.fitting.fit import fit
from gapcert_diagnosis.fitting.hypothesis import Hypothesis
from gapcert_diagnosis.fitting.step_size import coarse, fastest, settled, stepped
from gapcert_diagnosis.testing import ROD, equations
from gapcert_report.pages.diagnosis import why_wrong
from gapcert_report.pictures.diagnosis import DiagnosisAlbum
from gapcert_report.words.summary import in_words

SHAFT = {
    "kind": "equations",
    "coordinates": {"a": "rad", "b": "rad"},
    "inputs": {"u": "N*m"},
    "parameters": {"J": "0.002 kg*m^2", "I": "0.05 kg*m^2", "k": "60 N*m"},
    "mass_matrix": [["J", "0"], ["0", "I"]],
    "bias": {"a": "k*(a - b)", "b": "k*(b - a)"},
    "forces": {"a": "u"},
    "period": "5 ms",
}


@pytest.fixture(scope="module")
def rung():
    """A light inertia on a stiff shaft, which rings for ever, simulated in steps of 0.1 ms; its resonance is at 28 Hz."""
    true = equations({**SHAFT, "integrator": "rk4", "substeps": 50})
    u = multisine(4.0, 0.005, 0.5, (0.2, 2.5), 4)
    return hide(true, [], x0=[0.02, 0.0, 0.0, 0.0], u=u, noise={"a": 3e-4, "b": 3e-4}, seed=1)


def told(recording, integrator, substeps, extra=()):
    model = equations({**SHAFT, "integrator": integrator, "substeps": substeps})
    windows = Dataset.of(model, recording).windows(160)
    return coarse(fit(Hypothesis(model), windows))


@pytest.mark.exam
def test_a_step_too_coarse_for_a_fast_mode_is_told(rung):
    (text,) = told(rung, "rk4", 1)
    assert text.startswith("step: with half of its step of 0.005 s the model moves ")
    assert text.endswith("set model.substeps to 4 or more, and see what stays")


@pytest.mark.exam
def test_a_fine_step_is_not(rung):
    assert told(rung, "rk4", 4) == ()


def test_half_a_step_that_shows_less_than_what_is_left_is_not(rung):
    (tr,) = rung.trajectories
    rng = np.random.default_rng(0)
    rough = {n: v if n == "u" else v + 0.05 * rng.standard_normal(len(v)) for n, v in tr.channels.items()}
    assert told(gc.Recording.of(tr.t, rough), "rk4", 1) == ()


def test_only_integrators_have_a_finer_step():
    fine = stepped(equations(ROD), 2)
    assert (fine.substeps, fine.period) == (2, equations(ROD).period)
    step = {"kind": "equations", "states": {"x": "m"}, "inputs": {"u": "m"}, "next": {"x": "u"}, "period": "1 s"}
    assert stepped(equations(step), 2) is None
    memory = {"z": {"unit": "N*m", "next": "0.9*z + 0.1*u"}}
    assert stepped(equations({**ROD, "memory": memory, "forces": {"q": "z"}}), 2) is None


@pytest.mark.parametrize(("integrator", "near"), [("euler", 0.05), ("semi_implicit", 0.02), ("rk4", 0.001)])
def test_the_fastest_rate_is_that_of_the_stiff_mode(integrator, near):
    """ω = √(k/J + k/I) = 176.6 rad/s, of which a quarter of 5 ms is 0.2208 rad."""
    model = equations({**SHAFT, "integrator": integrator, "substeps": 4})
    rate = fastest(model, np.zeros((1, 4)), np.zeros((1, 1)))
    assert rate == pytest.approx(0.00125 * np.sqrt(60 / 0.002 + 60 / 0.05), rel=near)


def test_an_error_of_order_one_without_a_fast_mode_is_not_told():
    """Data of the same first-order step, which half of it does not reproduce: the step is what made them."""
    model = equations({**ROD, "integrator": "semi_implicit"})
    recording = hide(model, [], x0=[1.0, 0.0], u=multisine(6.0, 0.01, 0.5, (0.2, 2.5), 4), noise={"q": 1e-5}, seed=1)
    windows = Dataset.of(model, recording).windows(100)
    found = fit(Hypothesis(model), windows)
    assert coarse(found) == ()
    half = fit(Hypothesis(stepped(model, 2)), windows)
    assert np.sqrt(half.chi.max()) > 1.5


def test_the_answer_warns_of_it_in_summary_words_and_page(rung, tmp_path):
    found = gc.diagnose(equations(SHAFT | {"substeps": 4}), rung, ["viscous-friction"], horizons=[0.3])
    assert (found.warnings, found.assumptions) == ((), ())
    found = replace(found, warnings=("step: too coarse",))
    summary = found.summary()
    assert summary["warnings"] == ["step: too coarse"]
    assert "  warning: step: too coarse" in list(in_words(summary))
    assert "Warning: step: too coarse." in str(why_wrong(summary, DiagnosisAlbum(), tmp_path))


def test_sub_steps_are_halved_until_the_rollout_stands_still(rung):
    found = gc.diagnose(equations(SHAFT), rung, ["viscous-friction"], horizons=[0.3])
    assert (found.verdict, found.extended_model.substeps) == ("nothing", 4)
    (told,) = found.assumptions
    assert told.startswith(
        "the model is simulated in sub-steps of 0.00125 s (4 in a period, 1 as stated), as its fastest mode has "
    )


def winding(tau):
    """An axle behind a winding whose time constant is tau, as a model of plain `derivative`."""
    return {
        "kind": "equations",
        "states": {"w": "rad/s", "i": "A"},
        "inputs": {"V": "V"},
        "parameters": {"tau": f"{tau!r} s", "R": "2 ohm", "K": "0.05 N*m/A", "J": "3e-4 kg*m^2"},
        "derivative": {"w": "K*i/J", "i": "((V - K*w)/R - i)/tau"},
        "period": "6 ms",
    }


def wound(tau, drag=0.0, seed=0):
    """A log of it, winding and axle stepped exactly; drag in N·m·s/rad."""
    A = np.array([[-drag / 3e-4, 0.05 / 3e-4, 0.0], [-0.05 / 2 / tau, -1 / tau, 1 / 2 / tau], [0.0, 0.0, 0.0]])
    step, rng = expm(A * 0.006), np.random.default_rng(seed)
    u = multisine(7.2, 0.006, 4.0, (0.2, 3.0), seed)
    x, rows = np.zeros(3), []
    for (level,) in u:
        x[2] = level
        rows.append(x[:2])
        x = step @ x
    w, i = np.array(rows).T + rng.standard_normal((2, len(u))) * [[0.05], [0.004]]
    return gc.Recording.of(0.006 * np.arange(len(u)), {"w": w, "i": i, "V": u[:, 0]})


@pytest.mark.exam
@pytest.mark.parametrize("tau", [0.0009, 0.0015, 0.008])
def test_a_winding_faster_than_the_log_is_no_trouble(tau):
    names = ["viscous-friction", "coulomb-friction", "input-gain"]
    assert gc.diagnose(equations(winding(tau)), wound(tau), names, horizons=[0.5]).verdict == "nothing"
    found = gc.diagnose(equations(winding(tau)), wound(tau, drag=5e-4, seed=1), names, horizons=[0.5])
    assert [(c.effect, c.site) for c in found.causes] == [("viscous-friction", "w")]
    assert found.extended_model.substeps in (1, 2, 4, 8, 16)


def test_one_that_no_explicit_integrator_follows_is_told_in_a_sentence():
    with pytest.raises(gc.UsageError, match="has a time constant of 1e-05 s") as error:
        gc.diagnose(equations(winding(1e-5)), wound(0.002), ["input-gain"], horizons=[0.5])
    assert "sub-steps between two; expected 128 at most; put the value that the fast state settles to" in str(error.value)


def test_sub_steps_that_suffice_and_those_of_a_simulator_are_kept(rung):
    model = equations({**SHAFT, "substeps": 8})
    assert settled(model, Dataset.of(model, rung).windows(160)) == (model, ())
    ringing = equations({**SHAFT, "integrator": "semi_implicit"})
    log = hide(ringing, [], x0=[0.02, 0.0, 0.0, 0.0], u=np.zeros((400, 1)), noise={"a": 0.0, "b": 0.0}, seed=1)
    assert settled(ringing, Dataset.of(ringing, log).windows(160)) == (ringing, ())
