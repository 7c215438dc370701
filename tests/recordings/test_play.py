"""Experiments on a system: what is played, what is recorded of it, and a diagnosis of one model against another."""

import numpy as np
import pytest

import gapcert as gc
from gapcert_diagnosis.data.dataset import Dataset

SLIDE = {
    "kind": "equations",
    "coordinates": {"q": "m"},
    "inputs": {"F": "N"},
    "parameters": {"mass": {"value": "2 kg", "tolerance": "2 %"}},
    "mass_matrix": [["mass"]],
    "forces": {"q": "F"},
    "period": "10 ms",
}
REAL = SLIDE | {"parameters": {"mass": "2 kg", "c": "0.8 N/(m/s)"}, "forces": {"q": "F - c*q_dot"}}
SPEC = {
    "version": 1,
    "name": "slide",
    "model": SLIDE,
    "reality": REAL,
    "play": {"seconds": "8 s", "trajectories": 3, "inputs": {"F": [-3, 3]}, "start": {"q": ["-20 cm", "20 cm"], "q_dot": 0}},
    "diagnose": {"effects": "all", "hold_out": {"last": "33 %"}, "horizons": ["0.5 s"]},
    "report": {"html": False, "rerun": False},
}
RANGES = {"q": (-0.2, 0.2), "F": (-3.0, 3.0)}


@pytest.fixture(scope="module")
def slide():
    return gc.load_spec({"version": 1, "name": "slide", "model": REAL}).build("model")


def held(u):
    """Lengths of the stretches of constant u (T,), and their values; the last stretch may be cut short."""
    cuts = np.flatnonzero(np.diff(u)) + 1
    return np.diff(cuts), u[cuts]


def test_inputs_are_drawn_and_held_and_the_states_are_the_systems_own(slide):
    made = gc.play(slide, RANGES, seconds=20, trajectories=4, hold=(0.1, 0.5), seed=1)
    assert [tr.name for tr in made.trajectories] == ["0", "1", "2", "3"]
    assert (made.hold, made.period, made.units["q_dot"]) == ("zero", pytest.approx(0.01), "m/s")
    for tr in made.trajectories:
        times, levels = held(tr.channels["F"])
        assert 10 <= times.min() <= 15 <= times.max() <= 50
        assert np.abs(levels).max() <= 3
        assert levels.min() < -2
        assert levels.max() > 2
        assert tr.channels["q_dot"][0] == 0
        x = np.column_stack([tr.channels["q"], tr.channels["q_dot"]])
        assert np.array_equal(slide.rollout(x[:1], tr.channels["F"][None, :-1, None]).x[0], x)
    assert len({tr.channels["q"][0] for tr in made.trajectories}) == 4
    again = gc.play(slide, RANGES, seconds=20, trajectories=4, hold=(0.1, 0.5), seed=1)
    other = gc.play(slide, RANGES, seconds=20, trajectories=4, hold=(0.1, 0.5), seed=2)
    assert all(
        np.array_equal(a.channels["q"], b.channels["q"]) for a, b in zip(made.trajectories, again.trajectories, strict=True)
    )
    assert not np.array_equal(made.trajectories[0].channels["F"], other.trajectories[0].channels["F"])


def test_a_pause_follows_every_drawn_input(slide):
    (tr,) = gc.play(slide, RANGES, seconds=20, trajectories=1, hold=(0.1, 0.3), pause=0.5).trajectories
    times, levels = held(tr.channels["F"])
    assert (levels == 0).tolist() == [True, False] * (len(levels) // 2) + [True] * (len(levels) % 2)
    assert set(times[::2]) == {50}
    assert times[1::2].max() <= 30


def test_drawn_inputs_keep_the_relations(slide):
    relations = (
        gc.plugin.Relation("F + q_dot <= 0", (0.0, 1.0, 1.0), 0.0),
        gc.plugin.Relation("F >= -1", (0.0, 0.0, -1.0), 1.0),
    )
    (tr,) = gc.play(slide, RANGES, seconds=30, trajectories=1, hold=(0.1, 0.2), relations=relations).trajectories
    force, speed = tr.channels["F"], tr.channels["q_dot"]
    new = np.flatnonzero(np.diff(force[:-1])) + 1
    assert len(new) > 100
    assert (force[new] <= -speed[new] + 1e-12).all()
    assert (force[new] >= -1).all()


def test_an_input_stays_where_the_relations_leave_no_other(slide):
    """At speeds that no force of the range suits: the one before is kept, here the first, which is none."""
    relations = (
        gc.plugin.Relation("F >= 10", (0.0, 0.0, -1.0), -10.0),
        gc.plugin.Relation("F <= q_dot", (0.0, -1.0, 1.0), 0.0),
    )
    (tr,) = gc.play(slide, RANGES, seconds=2, trajectories=1, hold=(0.1, 0.2), relations=relations).trajectories
    assert (tr.channels["F"] == 0).all()


def test_the_resolution_of_the_system_is_the_noise_of_the_recording(slide):
    made = gc.play(slide, RANGES, seconds=8, trajectories=2, hold=(0.01, 0.02), channels=["q"])
    assert made.names == ("q", "F")
    assert 0 < made.noise["q"] < 1e-14
    mm = made.converted({"q": "mm"})
    assert mm.noise["q"] == pytest.approx(1e3 * made.noise["q"])
    measured = Dataset.of(slide, made)
    assert measured.sigma[0] == pytest.approx(1e-5 * measured.spread[0])
    assert measured.log["outliers"] == measured.log["repaired"] == {}
    # The states that windows start from are what the system had, not a smooth curve through it.
    assert np.array_equal(measured.states[0][:, 0], made.trajectories[0].channels["q"])


def test_a_noisy_system_leaves_its_noise_to_be_estimated(slide):
    noisy = gc.load_spec(
        {"version": 1, "name": "noisy", "backend": {"kind": "stochastic", "of": REAL, "sensor_noise": {"q": "1 mm"}}}
    ).build("backend")
    made = gc.play(noisy, RANGES, seconds=8, trajectories=2)
    assert made.noise == {}
    assert Dataset.of(slide, made).sigma[0] > 1e-4


@pytest.mark.parametrize(
    ("ranges", "options", "says"),
    [
        ({"q": (0, 1)}, {}, "no range for the input 'F'"),
        (RANGES | {"p": (0, 1)}, {}, "'p' is no state or input; there are q, q_dot, F"),
        (RANGES | {"F": (1, -1)}, {}, r"F = \[1, -1\]; expected two numbers, the smaller one first"),
        (RANGES, {"seconds": 0.1}, "expected at least 0.16 s; play for longer"),
        (RANGES, {"hold": (0.2, 0.1)}, "expected two positive times"),
    ],
)
def test_what_cannot_be_played_is_refused(slide, ranges, options, says):
    with pytest.raises(gc.UsageError, match=says):
        gc.play(slide, ranges, **options)


@pytest.mark.run
def test_one_model_is_diagnosed_against_another(tmp_path):
    run = gc.run(SPEC, out=tmp_path / "runs")
    (cause,) = run.summary["causes"]
    assert (cause["effect"], cause["site"]) == ("viscous-friction", "q")
    assert cause["parameters"]["coefficient"]["value"] == pytest.approx(0.8, rel=1e-3)
    gain = run.summary["gain"]["0.5"]["q"]
    assert gain["after"] < 1e-3 * gain["before"]
    assert "recertified" not in run.summary


@pytest.mark.exam
def test_the_reality_is_what_the_models_are_certified_against(tmp_path):
    asked = {
        "domain": {"q": [-0.2, 0.2], "q_dot": [-1, 1], "F": [-3, 3]},
        "sampling": {"kind": "adaptive", "budget": 200},
        "lipschitz": {"residual": {"kind": "interval"}},
        "certificate": {"claim": "empirical", "violation": 0.01, "confidence": 0.99},
        "play": {"seconds": "8 s", "trajectories": 3},
    }
    again = gc.run(SPEC | asked, out=tmp_path / "runs").summary["recertified"]
    before, after = (again[k]["states"]["q_dot"]["gamma_mean"] for k in ("before", "after"))
    assert after < 0.01 * before


def test_a_model_without_a_period_has_that_of_the_reality(tmp_path):
    timeless = {k: v for k, v in SLIDE.items() if k != "period"}
    run = gc.run(SPEC | {"model": timeless, "diagnose": SPEC["diagnose"] | {"effects": ["viscous-friction"]}}, out=tmp_path)
    assert run.diagnosis.extended_model.period == 0.01


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"recording": {"kind": "csv", "files": ["a.csv"], "time": "t", "columns": {}}}, "'reality' stands beside 'recording'"),
        ({"reality": None}, "'play' needs 'reality'"),
        ({"reality": None, "play": None}, "'diagnose' needs 'recording'"),
        ({"reality": REAL | {"inputs": {"G": "N"}, "forces": {"q": "G - c*q_dot"}}}, "reality"),
        ({"play": {"start": {"q": [1, 2, 3]}}}, "play"),
        ({"compare": {"backends": {"a": REAL}}}, "reality"),
    ],
)
def test_sections_that_do_not_fit_are_refused(changes, says):
    spec = {k: v for k, v in (SPEC | changes).items() if v is not None}
    with pytest.raises(gc.SpecError, match=says):
        gc.load_spec(spec)


def test_a_range_in_the_wrong_unit_is_refused_where_it_stands(tmp_path):
    with pytest.raises(gc.SpecError, match=r"play.*F|N.*rad"):
        gc.run(SPEC | {"play": {"inputs": {"F": ["0 rad", "1 rad"]}}}, out=tmp_path)


LAGGING = {
    "kind": "equations",
    "states": {"p": "m"},
    "inputs": {"u": "m/s"},
    "derivative": {"p": "u"},
    "integrator": "euler",
    "period": "300 ms",
    "substeps": 15,
}
LATE = LAGGING | {
    "parameters": {"T": "0.08 s"},
    "derivative": {"p": "r*T/h*(1 - exp(-h/T)) + u*(1 - T/h*(1 - exp(-h/T)))"},
    "memory": {"r": {"unit": "m/s", "next": "u + (r - u)*exp(-h/T)"}},
}
WITHIN = SPEC | {
    "name": "within",
    "model": LAGGING,
    "reality": LATE,
    "domain": {"p": [-1, 1], "u": [-1, 1]},
    "play": {"seconds": "9 s", "trajectories": 6, "every": "20 ms", "hold": ["0.3 s", "0.9 s"], "pause": "0.6 s"},
    "diagnose": {"effects": ["input-lag", "input-rate-limit"], "hold_out": {"last": "25 %"}, "horizons": ["0.3 s"]},
}


def test_a_reality_is_looked_at_within_a_period_and_certified_from_rest(tmp_path):
    asked = {
        "hidden": "default",
        "sampling": {"kind": "adaptive", "budget": 100},
        "certificate": {"claim": "empirical", "violation": 0.05, "confidence": 0.95},
    }
    run = gc.run(WITHIN | asked, out=tmp_path / "runs")
    (cause,) = run.summary["causes"]
    assert (cause["effect"], cause["site"]) == ("input-lag", "u")
    assert cause["parameters"]["time_constant"]["value"] == pytest.approx(0.08, rel=1e-4)
    extended = run.diagnosis.extended_model
    assert (extended.period, extended.substeps, len(extended.hidden)) == (pytest.approx(0.3), 15, 1)
    saved = gc.load_spec(run.summary["extended_model"]).build("model")
    truth = gc.load_spec({"version": 1, "name": "late", "model": LATE}).build("model")
    x, u, r = np.zeros((3, 1)), np.array([[1.0], [-0.5], [0.2]]), np.array([[0.0], [0.7], [-0.3]])
    for model in (extended, saved):
        found, right = model.step(x, u, hidden=r), truth.step(x, u, hidden=r)
        assert found.x == pytest.approx(right.x, abs=1e-5)
        assert found.hidden == pytest.approx(right.hidden, abs=1e-5)
    before, after = (run.summary["recertified"][k]["states"]["p"]["gamma_mean"] for k in ("before", "after"))
    assert after < 1e-3 * before


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"play": {"every": "70 ms"}}, "0.07 s is no whole fraction of the model's period, 0.3 s"),
        ({"model": LAGGING | {"substeps": 4}}, "model has 4 substeps, which 15 looks in a period do not divide"),
        ({"reality": LATE | {"substeps": 1}}, "reality has 1 substeps"),
    ],
)
def test_a_period_that_cannot_be_looked_into_is_refused(changes, says, tmp_path):
    with pytest.raises(gc.SpecError, match=says):
        gc.run(WITHIN | changes, out=tmp_path)


def test_with_hidden_state_at_its_default_a_model_remembers_its_own(tmp_path):
    late = {k: v for k, v in WITHIN.items() if k not in ("diagnose", "play", "reality")}
    late |= {"name": "late", "model": LATE, "backend": LATE, "certificate": {"claim": "empirical", "violation": 0.05}}
    with pytest.raises(gc.UsageError, match=r"the model has hidden state \(r\)"):
        gc.run(late, out=tmp_path)
    states = gc.run(late | {"hidden": "default"}, out=tmp_path).summary["certificate"]["states"]
    assert states["p"]["gap_mean"] == 0
