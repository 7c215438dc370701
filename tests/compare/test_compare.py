"""Simulator against simulator: planted differences are named and nothing else is, and each certificate has its row."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import gapcert as gc
from gapcert.certification.samples.executors import threads
from gapcert.cli.main import main
from gapcert.contracts.plugins.events import silent
from gapcert.run.build import Build
from gapcert.spec.spec import load_spec
from gapcert_compare.compare import closed
from gapcert_compare.laboratory import Laboratory, peers
from gapcert_compare.pairs import Meeting, Pairs
from gapcert_compare.settings import Change, Trial, candidates, explain
from gapcert_figures.data import Figures
from gapcert_report.words.compare import coarse, groups, sentences

URDF = str(Path(__file__).parents[2] / "specs" / "models" / "pendulum.urdf")
MODEL = {
    "kind": "equations",
    "states": {"theta": {"unit": "rad", "kind": "angle"}, "omega": "rad/s"},
    "inputs": {"torque": "N*m"},
    "parameters": {"m": "1 kg", "l": "1 m", "g": "9.81 m/s^2"},
    "derivative": {"theta": "omega", "omega": "-3*g/(2*l)*sin(theta) + 3*torque/(m*l**2)"},
    "integrator": "euler",
    "period": "5 ms",
}
SEMI = MODEL | {"integrator": "semi_implicit"}
REORDERED = SEMI | {"derivative": {"theta": "omega", "omega": "3*torque/(m*l**2) - 3*g/l*sin(theta/2)*cos(theta/2)"}}
DRAG = SEMI | {
    "parameters": MODEL["parameters"] | {"c": "0.02 1/s"},
    "derivative": {"theta": "omega", "omega": MODEL["derivative"]["omega"] + " - c*omega"},
}
BULLET = {
    "kind": "pybullet",
    "robot": URDF,
    "states": {"theta": "hinge.position", "omega": "hinge.velocity"},
    "inputs": {"torque": "hinge"},
}
CLEAN = BULLET | {"linear_damping": 0, "angular_damping": 0}
KEYS = {"backend", "family", "lipschitz", "seed", "tightness", "samples", "cpu_s", "claim", "violations"}


def spec(backends, pairs=None, **more):
    return {
        "version": 1,
        "name": "small",
        "model": MODEL,
        "domain": {"theta": [-0.2, 0.2], "omega": [-0.25, 0.25], "torque": [-1, 1]},
        "sampling": {"kind": "adaptive", "budget": 40, "executor": "threads"},
        "compare": {
            "backends": backends,
            "families": ["envelope"],
            "lipschitz": ["interval"],
            "pairs": {"points": 200, "rollouts": 2, "steps": 20, "cells": 8} | (pairs or {}),
        },
        "report": {"rerun": False},
        **more,
    }


@pytest.fixture
def meet(tmp_path):
    """What is found between the first two backends of a comparison; the matrix is left out."""

    def between(a, b, **pairs):
        loaded = load_spec(spec({"a": a, "b": b}, pairs))
        build, asked = Build(loaded, None, tmp_path, False), loaded.config.sections["compare"]
        model = build.make("model")
        found, _ = peers(build, asked, model)
        domain = gc.Domain.of(model, loaded.config.domain)
        laboratory = Laboratory(tmp_path / "pairs", domain, asked, 0, threads, 100_000, silent)
        return Pairs(build, model, laboratory, silent).between(found["a"], found["b"])

    return between


# --- how far apart


def test_the_same_physics_in_other_words_agrees_and_nothing_is_named(meet):
    pair = meet(SEMI, REORDERED).summary
    assert 0 < pair["max"] <= 1e-15
    assert not pair["resolved"]
    assert pair["explained_by"] == []
    assert pair["first_differing_step"]["bits"] >= 1
    assert pair["first_differing_step"]["resolved"] is None


def test_rounding_adds_up_along_a_rollout_and_is_no_difference(meet):
    found = meet(SEMI, REORDERED, rollouts=10, steps=2000)
    first = found.summary["first_differing_step"]
    assert first["bits"] < 100
    assert first["resolved"] is None
    assert found.drift[-1] > 10 * found.drift[10] > 0


def test_a_backend_agrees_with_itself_to_the_last_bit(meet):
    pair = meet(SEMI, SEMI).summary
    assert pair["mean"] == pair["max"] == 0
    assert pair["first_differing_step"]["bits"] is None


def test_mean_and_largest_difference_and_where(meet):
    """Semi-implicit minus explicit Euler is τ² |a| in θ and nothing in ω, largest where θ and the torque are opposite."""
    found = meet(SEMI, MODEL, points=4000)
    pair = found.summary
    a = lambda theta, torque: -14.715 * np.sin(theta) + 3 * torque  # noqa: E731
    where = pair["where"]
    assert pair["state"] == "theta"
    assert pair["max"] == pytest.approx(0.005**2 * abs(a(where["theta"], where["torque"])), rel=1e-9)
    assert 0.9 * 0.005**2 * abs(a(0.2, -1)) < pair["max"] < 0.005**2 * abs(a(0.2, -1))
    theta, torque = np.random.default_rng(1).uniform([-0.2, -1], [0.2, 1], (100_000, 2)).T
    assert pair["mean"] == pytest.approx(0.005**2 * np.abs(a(theta, torque)).mean(), rel=0.05)
    assert not pair["states"]["omega"]["resolved"]
    assert pair["first_differing_step"] == {"bits": 1, "resolved": 1, "steps": 20, "rollouts": 2}
    # The map goes through the worst point: over theta (columns), at its torque; omega (rows) does not matter.
    centres = -0.2 + 0.4 * (2 * np.arange(8) + 1) / 16
    expected = 0.005**2 * np.abs(a(centres, where["torque"]))
    assert np.allclose(found.slice, expected, rtol=1e-9)
    assert found.drift.shape == (21,)
    assert found.drift[0] == 0 < found.drift[1]


def test_the_axes_of_the_map_can_be_chosen(meet):
    found = meet(SEMI, MODEL, axes=["torque", "theta"])
    assert np.ptp(found.slice, axis=1).min() > 1e-6, "the torque is on the columns"


def test_a_difference_below_resolution_is_told_from_one_above(meet):
    """One part in 1e13 of the torque is about 1e-14 · 0.015: below 4 ulp of 0.25 on both sides; one in 1e9 is above."""
    factor = lambda c: SEMI | {"derivative": MODEL["derivative"] | {"omega": f"-3*g/(2*l)*sin(theta) + {c}*torque/(m*l**2)"}}  # noqa: E731
    assert not meet(SEMI, factor("3.0000000000000004")).summary["resolved"]
    assert meet(SEMI, factor("3.00000001")).summary["resolved"]


def test_backends_that_do_not_fit_are_set_apart_with_the_reason(meet):
    pair = meet(SEMI, SEMI | {"period": "10 ms"}).summary
    assert "period is 0.01 s" in pair["refused"]
    assert (pair["mean"], pair["max"], pair["where"], pair["explained_by"]) == (None, None, None, [])


# --- which setting


@pytest.mark.parametrize(
    ("one", "other", "setting", "on"),
    [
        (SEMI, MODEL, "integrator", {"a", "b"}),
        (SEMI, SEMI | {"substeps": 5}, "substeps", {"a", "b"}),
        (SEMI, SEMI | {"parameters": MODEL["parameters"] | {"g": "9.5 m/s^2"}}, "parameters.g", {"a", "b"}),
    ],
)
def test_a_planted_setting_is_named(meet, one, other, setting, on):
    entries = meet(one, other).summary["explained_by"]
    assert {e["setting"] for e in entries} == {setting}
    assert {e["on"] for e in entries} == on, "either side may be changed to the other's value"
    assert all(e["closes"] and e["reduction"] > 1 - 1e-9 for e in entries)


@pytest.mark.exam
@pytest.mark.parametrize(
    ("planted", "setting", "was", "value"),
    [
        ({"linear_damping": 0.04, "angular_damping": 0.04}, "damping", 0.04, 0.0),
        ({"substeps": 10}, "substeps", 10, 1),
        ({"gravity": [0, 0, -9.0]}, "gravity", [0, 0, -9.0], [0, 0, -9.81]),
        ({"use_inertia_from_file": False}, "use_inertia_from_file", False, True),
        ({"joint_damping": 0.05}, "joint_damping", 0.05, 0.0),
    ],
)
def test_a_setting_of_pybullet_is_named_against_bare_equations(meet, planted, setting, was, value):
    pytest.importorskip("pybullet", reason="needs the pybullet extra")
    assert not meet(SEMI, CLEAN).summary["resolved"]
    entries = [e for e in meet(SEMI, CLEAN | planted).summary["explained_by"] if e["on"] == "b"]
    assert (entries[0]["setting"], entries[0]["was"], entries[0]["value"]) == (setting, was, value)
    assert entries[0]["closes"]
    assert entries[0]["reduction"] > 1 - 1e-6


@pytest.mark.exam
def test_two_causes_are_both_named(meet):
    pytest.importorskip("pybullet", reason="needs the pybullet extra")
    first, *rest = meet(SEMI, BULLET | {"substeps": 5}).summary["explained_by"]
    assert first["closes"]
    assert {c["setting"] for c in first["changes"] if c["on"] == "b"} >= {"damping"}
    assert "substeps" in first["setting"]
    assert {e["setting"] for e in rest} <= {"damping", "substeps"}
    assert all(not e["closes"] and 0.01 < e["reduction"] < 0.99 for e in rest)


def test_another_equation_is_named_as_such(meet):
    entries = meet(SEMI, DRAG).summary["explained_by"]
    assert {e["setting"] for e in entries} == {"derivative.omega"}


@pytest.mark.exam
def test_what_no_setting_closes_is_not_called_explained(meet):
    """No cause makes a torque depend on the sine of forty times the angle."""
    pytest.importorskip("pybullet", reason="needs the pybullet extra")
    law = "-3*g/(2*l)*sin(theta) + 3*torque/(m*l**2)*(1 + 0.2*sin(theta*40))"
    pair = meet(SEMI | {"derivative": MODEL["derivative"] | {"omega": law}}, CLEAN).summary
    assert pair["resolved"]
    assert not closed(pair)
    assert not any(e["closes"] for e in pair["explained_by"])


def test_the_reduction_is_what_a_second_run_with_the_change_finds(meet):
    other = SEMI | {"integrator": "rk4"}
    pair = meet(SEMI, other, least=0.001).summary
    for entry in pair["explained_by"]:
        a, b = ((c | entry["options"]) if entry["on"] == name else c for name, c in (("a", SEMI), ("b", other)))
        again = meet(a, b).summary
        left = np.mean([again["states"][n]["mean"] / (s["mean"] / s["relative"]) for n, s in pair["states"].items()])
        assert entry["reduction"] == pytest.approx(1 - left / pair["relative"], abs=1e-9)


def trial(means, closing=()):
    def attempt(changes):
        names = frozenset(c.setting for c in changes)
        return Trial(changes, means.get(names, 1.0), names in closing)

    return attempt


CHANGES = [Change("a", name, {name: 1}, {name: 0}) for name in ("useless", "noisy", "half", "rest")]
BOTH = frozenset({"half", "rest"})


def test_changes_within_noise_or_below_the_least_share_are_not_named():
    attempt = trial({frozenset({"noisy"}): 0.97})
    assert explain(CHANGES, attempt, 1.0, least=0.05, noise=0.0) == []
    assert explain(CHANGES, attempt, 1.0, least=0.01, noise=0.05) == []
    assert [e["setting"] for e in explain(CHANGES, attempt, 1.0, least=0.01, noise=0.0)] == ["noisy"]


def test_a_combination_stands_first_with_its_parts_and_without_bystanders():
    means = {frozenset({"half"}): 0.5, frozenset({"rest"}): 0.6, frozenset({"noisy"}): 0.9, BOTH: 0.0}
    entries = explain(CHANGES, trial(means, {BOTH}), 1.0, least=0.01, noise=0.0)
    assert [(e["setting"], e["reduction"]) for e in entries] == [("half + rest", 1.0), ("half", 0.5), ("rest", 0.4)]


def test_one_change_that_closes_leaves_nothing_else_to_name():
    alone = frozenset({"half"})
    entries = explain(CHANGES, trial({alone: 0.0, frozenset({"rest"}): 0.4}, {alone}), 1.0, least=0.01, noise=0.0)
    assert [e["setting"] for e in entries] == ["half"]


def test_candidates_are_declared_borrowed_and_default_each_once(tmp_path):
    loaded = load_spec(spec({"a": SEMI | {"substeps": 3}, "b": SEMI | {"substeps": 7}}))
    build = Build(loaded, None, tmp_path, False)
    found, _ = peers(build, loaded.config.sections["compare"], build.make("model"))
    tried = [c.options["substeps"] for c in candidates(found["a"], found["b"]) if c.setting == "substeps"]
    assert sorted(tried) == [1, 2, 5, 7, 10], "7 is the partner's, 1 also the default, 3 what is there already"


# --- the matrix


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    asked = spec({"euler": MODEL, "semi": SEMI, "again": REORDERED, "slow": SEMI | {"period": "10 ms"}}, seed=3)
    asked["compare"] |= {"lipschitz": ["interval", {"kind": "wood-zhang", "safety": 1.2}], "seeds": [0, 1]}
    asked["report"] = {"rerun": True}
    return gc.run(asked, out=tmp_path_factory.mktemp("runs"))


def test_every_combination_has_its_row(done):
    rows = done.summary["rows"]
    assert len(rows) == 4 * 1 * 2 * 2
    assert all(r.keys() >= KEYS for r in rows)
    combinations = {(r["backend"], r["family"], r["lipschitz"], r["seed"]) for r in rows}
    assert len(combinations) == len(rows)
    good = [r for r in rows if r["backend"] == "semi"]
    assert all(1 <= r["tightness"] < 1.1 and r["violations"] == 0 and r["samples"] >= 39 and r["cpu_s"] > 0 for r in good)
    assert all(r["states"]["theta"]["resolved"] and not r["states"]["omega"]["resolved"] for r in good)
    assert all(r["states"]["omega"]["tightness"] is None for r in good)


def test_a_gap_below_the_resolution_has_no_tightness(done):
    rows = [r for r in done.summary["rows"] if r["backend"] == "euler"]
    assert all(r["tightness"] is None and not r["resolved"] for r in rows)


def test_a_refused_row_carries_its_reason_and_stops_nothing(done):
    refused = [r for r in done.summary["rows"] if "refused" in r]
    assert {r["backend"] for r in refused} == {"slow"}
    assert all("period" in r["refused"] and r["claim"] is None for r in refused)


def test_the_answer_is_in_the_summary(done):
    s = done.summary
    assert (s["verdict"], done.exit_code) == ("explained", 0)
    assert s["backends"]["semi"] == {
        "kind": "equations",
        "agrees_with": ["again"],
        "differs_from": ["euler"],
        "separated_by": ["integrator"],
    }
    assert s["agree"]["pairs"] == 1
    assert 0 < s["agree"]["max"] <= 1e-15
    assert s["differ"] == {"pairs": 2, "explained": 2}
    assert [(p["a"], p["b"]) for p in s["pairs"] if "refused" in p] == [("euler", "slow"), ("semi", "slow"), ("again", "slow")]


def read(folder, name):
    with open(folder / f"{name}.csv", encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def test_tables_are_written(done):
    rows, pairs, settings = (read(done.folder, name) for name in ("rows", "pairs", "settings"))
    assert len(rows) == 16
    assert float(rows[4]["tightness"]) == done.summary["rows"][4]["tightness"]
    assert rows[-1]["refused"] == done.summary["rows"][-1]["refused"]
    assert [float(p["max"]) for p in pairs if p["max"]] == [p["max"] for p in done.summary["pairs"] if "refused" not in p]
    assert float(pairs[0]["where theta"]) == done.summary["pairs"][0]["where"]["theta"]
    assert {s["setting"] for s in settings} == {"integrator"}
    assert float(settings[0]["reduction"]) > 0.999


def test_the_report_says_it(done):
    page = (done.folder / "report.html").read_text(encoding="utf-8")
    cause = "integrator euler → semi_implicit of euler"
    for text in ("semi and again give one answer", cause, "not resolved", "period is 0.01 s"):
        assert text in page, text
    assert page.count("<figure") >= 5
    figures = Figures.load(done.folder).compare
    assert {(p.a, p.b) for p in figures.pairs if p.values.size} == {("euler", "semi"), ("euler", "again")}


def test_the_same_spec_again_makes_no_row_and_no_sample_again(done):
    before = {p: p.stat().st_mtime_ns for p in done.folder.rglob("*") if p.suffix == ".npy" or p.name == "row.json"}
    again = gc.run(load_spec(json.loads((done.folder / "spec.json").read_text())), out=done.folder.parent)
    assert before
    assert {p: p.stat().st_mtime_ns for p in before} == before
    assert again.summary["digest"] == done.summary["digest"]
    assert again.summary["rows"] == done.summary["rows"]


def test_another_question_in_a_row_is_not_taken_over(done, tmp_path):
    """A kept row is of this question: another backend under the same name makes its own."""
    from gapcert_compare.compare import cells, row

    loaded = load_spec(spec({"semi": SEMI}))
    build = Build(loaded, None, tmp_path, False)
    model = build.make("model")
    (cell,) = cells(build, loaded.config.sections["compare"], ["semi"])
    first = row(cell, model, tmp_path, silent)
    assert row(cell, model, tmp_path, silent) == first
    path = tmp_path / cell.place / "row.json"
    data = json.loads(path.read_text())
    path.write_text(json.dumps({"question": "another", "row": data["row"] | {"tightness": 7.0}}))
    assert row(cell, model, tmp_path, silent)["tightness"] == first["tightness"]


# --- the command


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def write(path, data):
    Path(path).write_text(json.dumps(data))
    return str(path)


QUICK = {"rollouts": 0, "cells": 0, "points": 50}
BARE = {"html": False, "rerun": False}


@pytest.mark.run
def test_the_command_prints_the_contract(folder, capsys):
    path = write("c.yaml", spec({"euler": MODEL, "semi": SEMI}, QUICK, report=BARE))
    assert main(["compare", path, "--json", "--quiet"]) == 0
    out, err = capsys.readouterr()
    found = json.loads(out)
    assert all(r.keys() >= KEYS for r in found["rows"])
    (pair,) = found["pairs"]
    assert pair.keys() >= {"a", "b", "mean", "max", "where", "explained_by"}
    assert all(e.keys() >= {"setting", "value", "reduction"} for e in pair["explained_by"])
    assert "integrator euler → semi_implicit of euler" in err


@pytest.mark.parametrize(("expected", "code"), [({"differ.pairs": 1}, 0), ({"verdict": "agree"}, 1)])
def test_expectations_decide_the_exit_code(folder, expected, code):
    path = write("c.yaml", spec({"euler": MODEL, "semi": SEMI}, QUICK, expect=expected, report=BARE))
    assert main(["compare", path, "--quiet"]) == code


def test_a_spec_without_a_comparison_is_sent_to_run(folder, capsys):
    data = spec({"semi": SEMI})
    del data["compare"]
    path = write("c.yaml", data | {"backend": SEMI, "certificate": {"claim": "empirical"}})
    assert main(["compare", path]) == 2
    assert "no compare: section" in capsys.readouterr().err


@pytest.fixture
def without_pybullet(monkeypatch):
    from gapcert.contracts.plugins.component import Component

    missing = Component.missing
    reason = "backend 'pybullet' needs pybullet, which is not installed; run: pip install 'gapcert[pybullet]'"
    monkeypatch.setattr(Component, "missing", lambda c: reason if c.name == "pybullet" else missing(c))
    return reason


def test_a_backend_that_is_not_installed_is_listed_and_stops_nothing(folder, without_pybullet, capsys):
    path = write("c.yaml", spec({"semi": SEMI, "bullet": BULLET, "euler": MODEL}, QUICK))
    assert main(["compare", path, "--json", "--quiet"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["unavailable"] == [{"backend": "bullet", "reason": without_pybullet}]
    assert len(found["pairs"]) == 1
    assert {r["backend"] for r in found["rows"]} == {"semi", "euler"}
    assert without_pybullet.replace("'", "&#x27;") in (Path(found["run_dir"]) / "report.html").read_text()
    assert read(Path(found["run_dir"]), "rows")[-1]["unavailable"] == without_pybullet


def test_a_required_backend_that_is_not_installed_is_an_error(folder, without_pybullet, capsys):
    data = spec({"semi": SEMI, "bullet": BULLET}, QUICK)
    data["compare"]["require"] = ["bullet"]
    assert main(["compare", write("c.yaml", data), "--quiet"]) == 3
    assert "pip install" in capsys.readouterr().err


# --- the section


BROKEN = """\
version: 1
name: broken
model:
  kind: equations
  states: {theta: {unit: rad, kind: angle}, omega: rad/s}
  inputs: {torque: N*m}
  derivative: {theta: omega, omega: torque/(1 kg*m**2)}
  period: 5 ms
domain: {theta: [-0.2, 0.2], omega: [-0.25, 0.25], torque: [-1, 1]}
backend: {kind: equations}
gap: {kind: envelope}
compare:
  backends:
    one: {kind: equation}
    Two: {kind: equations, states: {theta: rad}, next: {theta: theta}, period: 5 ms}
  families: [envelop, {kind: constant, predicter: none}]
  lipschitz: []
  seeds: [-1]
  require: [three]
  pairs: {point: 3, axes: [theta, omga]}
"""
PLACES = [
    ("10:1", "move it to compare.backends"),
    ("14:17", "did you mean 'equations'?"),
    ("15:5", "lower-case letters"),
    ("15:28", "nothing for 'omega'"),
    ("16:3", "stands beside the section 'gap'"),
    ("16:14", "did you mean 'envelope'?"),
    ("16:40", "did you mean 'predictor'?"),
    ("17:14", "a list of at least one"),
    ("18:11", "greater than or equal to 0"),
    ("20:11", "did you mean 'points'?"),
    ("20:35", "did you mean 'omega'?"),
]


@pytest.fixture(scope="module")
def told():
    with pytest.raises(gc.SpecError) as error:
        load_spec(BROKEN)
    return str(error.value)


@pytest.mark.parametrize(("place", "words"), PLACES)
def test_errors_stand_where_they_are(told, place, words):
    block = next((b for b in told.split("<text>:") if b.startswith(f"{place}:") and words in b), None)
    assert block is not None, told


def test_a_required_backend_must_be_one(told):
    data = spec({"semi": SEMI})
    data["compare"]["require"] = ["semy"]
    with pytest.raises(gc.SpecError, match="did you mean 'semi'"):
        load_spec(data)


def test_entries_of_one_kind_are_told_apart_by_their_options():
    data = spec({"semi": SEMI})
    data["compare"]["families"] = ["constant", {"kind": "envelope", "predictor": "none"}, {"kind": "envelope"}]
    assert list(load_spec(data).config.sections["compare"].families) == ["constant", "envelope predictor=none", "envelope"]


def test_a_robot_that_is_not_there_is_found_before_anything_runs():
    with pytest.raises(gc.SpecError, match=r"compare.backends.b.robot: no file"):
        load_spec(spec({"b": BULLET | {"robot": "nowhere.urdf"}}))


def test_a_backend_that_cannot_be_built_is_told_at_its_place(tmp_path):
    pytest.importorskip("pybullet", reason="needs the pybullet extra")
    wrong = BULLET | {"inputs": {"torque": "hing"}}
    with pytest.raises(gc.SpecError, match=r"compare.backends.b: .*did you mean 'hinge'"):
        gc.run(spec({"a": SEMI, "b": wrong}), out=tmp_path)


def test_the_schema_knows_the_section():
    from gapcert.spec.schema import schema

    properties = schema()["else"]["properties"]["compare"]["properties"]
    assert {"backends", "families", "lipschitz", "seeds", "require", "pairs"} == set(properties)


def test_labels_of_a_pair_do_not_change_its_numbers(meet):
    """a against b is b against a."""
    one, other = meet(SEMI, MODEL).summary, meet(MODEL, SEMI).summary
    assert (one["mean"], one["max"], one["where"]) == (other["mean"], other["max"], other["where"])


def test_a_peer_that_is_stochastic_is_set_apart(tmp_path):
    from gapcert_compare.laboratory import misfit

    loaded = load_spec(spec({"a": SEMI}))
    build = Build(loaded, None, tmp_path, False)
    model = build.make("model")
    found, _ = peers(build, loaded.config.sections["compare"], model)
    system = found["a"].system
    system.capabilities = frozenset({"seed"})
    assert "stochastic" in misfit(model, system)
    assert replace(found["a"], apart=misfit(model, system)).apart


def words(agreeing, resolution=1e-15):
    """The sentences about a, b and c, of which those that stand together agree, and the groups that they are told in."""
    names = ("a", "b", "c")
    pairs = [
        {"a": x, "b": y, "max": 0.01, "relative": 0.2, "resolved": x + y not in agreeing, "explained_by": [],
         "states": {"x": {"resolution": resolution}}}
        for x, y in ("ab", "ac", "bc")
    ]  # fmt: skip
    agree = {n: [o for o in names if "".join(sorted(n + o)) in agreeing and o != n] for n in names}
    summary = {"backends": {n: {"agrees_with": agree[n]} for n in names}, "pairs": pairs}
    return list(sentences(summary)), groups(summary), coarse(summary)


def test_simulators_give_one_answer_only_where_each_agrees_with_each():
    assert words(("ab", "ac", "bc"))[1:] == ([["a", "b", "c"]], [])
    said, together, alone = words(("ab",))
    assert (together, alone) == ([["a", "b"], ["c"]], [])
    assert said[0].startswith("a and b give one answer")
    said, together, alone = words(("ab", "bc"), resolution=0.5)
    assert (sorted(together), alone) == ([["a"], ["b"], ["c"]], ["b"])
    assert not [s for s in said if "one answer" in s]
    assert said[0].startswith("c differs from a")
    assert said[1].startswith(
        "b cannot be told from a and c, which differ: what its own solver may leave undone, up to 0.5 a step"
    )


class Loose(gc.System):
    """x⁺ = x + τ u + c, from a solver that may leave half a unit undone."""

    def __init__(self, c):
        self.states, self.inputs, self.period, self.c = (gc.StateSpec("x"),), (gc.StateSpec("u"),), 0.1, c
        self.hidden, self.hidden_default, self.capabilities = (), (), frozenset()

    def _step(self, x, u, **options):
        return gc.plugin.Step(x + 0.1 * u + self.c)

    def resolution(self, magnitude):
        return np.full(1, 0.5)

    def rounding(self, magnitude):
        return super().resolution(magnitude)


def test_a_share_of_a_step_is_of_its_motion_however_much_a_solver_may_leave():
    x, u = np.linspace(-1, 1, 40)[:, None], np.ones((40, 1))
    a, b = Loose(0.0), Loose(0.02)
    met = Meeting.of(a, b, (a.step(x, u).x, b.step(x, u).x), x)
    assert met.mean == pytest.approx(0.02 / 0.12)
    assert not met.resolved.any()
