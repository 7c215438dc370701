"""After a diagnosis: the extended model as a spec, and what it buys a certificate and a controller."""

import json
import re

import numpy as np
import pytest

import gapcert as gc
from gapcert.cli.main import main

MODEL = {
    "kind": "equations", "coordinates": {"q": "m"}, "inputs": {"F": "N"}, "parameters": {"mass": "2 kg"},
    "mass_matrix": [["mass"]], "forces": {"q": "F"}, "period": "20 ms", "integrator": "semi_implicit",
}  # fmt: skip
REAL = MODEL | {"parameters": {"mass": "2 kg", "c": "8 N*s/m"}, "forces": {"q": "F - c*q_dot"}}
ASKED = {
    "backend": REAL,
    "domain": {"q": [-1, 1], "q_dot": [-1, 1], "F": [-12, 12]},
    "sampling": {"kind": "adaptive", "budget": 60},
    "gap": {"kind": "constant"},
    "certificate": {"claim": "empirical", "violation": 0.01, "confidence": 0.99},
    "controller": {
        "kind": "symbolic", "goal": {"invariance": {"q": [-0.5, 0.5], "q_dot": [-1, 1]}},
        "cells": {"q": 40, "q_dot": 20}, "inputs": {"F": 9},
    },
}  # fmt: skip


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """12 s of a cart with viscous friction, against a cart without."""
    folder = tmp_path_factory.mktemp("extend")
    real = gc.load_spec({"version": 1, "name": "real", "model": REAL}).build("model")
    t = 0.02 * np.arange(600)
    force = 10.0 * np.sign(np.sin(2 * np.pi * 0.7 * t)) + 6.0 * np.sin(2 * np.pi * 1.9 * t)
    x = real.rollout(np.zeros((1, 2)), force[None, :, None]).x[0, :-1]
    q = x[:, 0] + 1e-4 * np.random.default_rng(5).standard_normal(len(t))
    np.savetxt(folder / "log.csv", np.column_stack([t, q, force]), delimiter=",", header="t,q,F", comments="", fmt="%.9f")
    recording = {"kind": "csv", "files": [str(folder / "log.csv")], "time": "t", "columns": {"q": "q", "F": "F"}}
    effects = ["viscous-friction", "coulomb-friction"]
    diagnose = {"effects": effects, "hold_out": {"last": "25 %"}, "horizons": ["0.5 s"]}
    spec = {"version": 1, "name": "cart", "model": MODEL, "recording": recording, "diagnose": diagnose} | ASKED
    return gc.run(spec, out=folder)


@pytest.mark.exam
def test_the_summary_says_it(run):
    assert run.summary["verdict"] == "causes"
    assert re.match(r"The simulation lacks viscous friction at q, (8\.0|7\.9)\d* ± 0\.\d+ N/\(m/s\); ", run.summary["sentence"])
    assert run.summary["sentence"] == run.diagnosis.sentence()
    assert run.summary["units"] == {"q": "m"}
    assert "q_dot" in run.summary["equations"]


def test_the_controller_wins_more_with_the_cause_in_the_model(run):
    again = run.summary["recertified"]
    before, after = (again[k]["states"]["q_dot"]["gamma_mean"] for k in ("before", "after"))
    assert after < before / 5
    cells = {k: again[k]["controller"] for k in ("before", "after")}
    assert cells["after"]["cells"] == cells["before"]["cells"] == 800
    assert cells["after"]["winning_cells"] > cells["before"]["winning_cells"]
    text = (run.folder / "report.html").read_text()
    said = ("How wrong it was, and is", "The controller wins from", "only with the causes", "Where the controller may start")
    assert [part for part in said if part not in text] == []


@pytest.mark.run
def test_extend_writes_the_model(run, tmp_path, capsys):
    assert main(["extend", str(run.folder)]) == 0
    text = capsys.readouterr().out
    assert text.startswith("# The simulation lacks viscous friction at q")
    assert "# (mass)*q_ddot = F - viscous_friction_q*q_dot" in text
    assert max(map(len, text.splitlines())) <= 120
    assert main(["extend", str(run.folder), "-o", str(tmp_path / "mine.yaml"), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["extended"] == str(tmp_path / "mine.yaml")
    assert told["spec"]["name"] == "cart-extended"
    model = gc.load_spec(tmp_path / "mine.yaml").build("model")
    x, u = np.array([[0.1, 0.5]]), np.array([[1.0]])
    assert np.array_equal(model.step(x, u).x, run.diagnosis.extended_model.step(x, u).x)


def test_the_extended_model_serves_as_predictor(run, tmp_path):
    main(["extend", str(run.folder), "-o", str(tmp_path / "mine.yaml")])
    gap = {"kind": "envelope", "predictor": {"model": str(tmp_path / "mine.yaml")}}
    spec = {k: v for k, v in ASKED.items() if k != "controller"} | {"version": 1, "name": "again", "model": MODEL, "gap": gap}
    again = gc.run(spec, out=tmp_path).summary["certificate"]["states"]["q_dot"]
    assert again["gamma_mean"] < 1.1 * run.summary["recertified"]["before"]["states"]["q_dot"]["gap_mean"]


@pytest.mark.parametrize("case", ["no run", "no cause", "no diagnosis", "no place"])
def test_what_cannot_be_extended_is_told_in_a_sentence(case, run, tmp_path, capsys):
    folder = tmp_path / "run"
    words = {"no run": "no summary.json", "no cause": "'nothing'", "no diagnosis": "it is no diagnosis"}
    if case in ("no cause", "no diagnosis"):
        folder.mkdir()
        made = {"verdict": "nothing", "causes": []} if case == "no cause" else {"verdict": "holds"}
        (folder / "summary.json").write_text(json.dumps(made))
    lost = [str(run.folder), "-o", str(tmp_path / "a" / "b.yaml")]
    command = ["extend", *(lost if case == "no place" else [str(folder)])]
    assert main(command) == 2
    said = capsys.readouterr().err
    assert words.get(case, "cannot be written") in said
    assert said.count("\n") == 1
