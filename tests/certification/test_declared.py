"""A gap that a person declares: synthesised against, shown as an assumption, refuted where a simulator is there to do so."""

import json

import numpy as np
import pytest

import gapcert as gc
import gapcert_cells
from gapcert.certification import contradiction
from gapcert.numerics.errors import GapcertError
from gapcert_cells.testing import Band
from gapcert_verify.verify import verify_run

GAMMA = 0.02
MODEL = {
    "kind": "equations",
    "states": {"x": "1", "v": "1"},
    "inputs": {"u": "1"},
    "next": {"x": "x + 0.1*v", "v": "v + 0.1*u"},
    "period": "0.1 s",
}
BOX = {"x": [-1, 1], "v": [-1, 1]}
CONTROLLER = {"kind": "symbolic", "goal": {"invariance": BOX}, "cells": {"x": 40, "v": 40}, "inputs": {"u": 5}}
SPEC = {
    "version": 1,
    "name": "declared",
    "model": MODEL,
    "domain": BOX | {"u": [-1, 1]},
    "gap": {"kind": "declared", "gamma": {"x": 0.001, "v": GAMMA}},
    "controller": CONTROLLER,
    "report": {"rerun": False, "html": False},
}
DRAG = {**MODEL, "next": {"x": "x + 0.1*v", "v": "v + 0.1*u - 0.015*v"}}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return gc.run({**SPEC, "report": {"rerun": False, "html": True}}, out=tmp_path_factory.mktemp("runs"))


def test_the_controller_is_that_of_the_stated_numbers(made):
    spec = gc.load_spec(SPEC)
    model = spec.build("model")
    domain = gc.Domain.of(model, dict(spec.config.domain))
    for name, gap in (("with_gamma", Band([-0.001, -GAMMA], [0.001, GAMMA])), ("without_gamma", None)):
        own = spec.build("controller").synthesize(gc.SynthesisProblem(model, gap, domain, spec.goal(domain)))
        saved = gapcert_cells.GridController.load(made.folder / "controller" / name)
        assert np.array_equal(own.winning, saved.winning)
        assert np.array_equal(own.bits, saved.bits)


def test_it_is_an_assumption_wherever_it_is_told(made):
    certificate = made.summary["certificate"]
    assert made.summary["verdict"] == "holds"
    assert "assumed" in made.summary["reason"]
    assert certificate["claim"] == made.summary["controller"]["claim"] == {"kind": "assumed"}
    assert {n: s["gamma_max"] for n, s in certificate["states"].items()} == SPEC["gap"]["gamma"]
    assert "audit" not in certificate
    assert "samples" not in certificate
    assert any("declared by the user" in a for a in certificate["assumptions"])
    page = (made.folder / "report.html").read_text(encoding="utf-8")
    assert "is assumed everywhere on the domain" in page
    assert "no simulator was asked" in page
    assert "Holds if γ does" in page
    assert "✓ Holds" not in page
    assert made.certificate.gamma(np.zeros((2, 2)), np.zeros((2, 1))).tolist() == [[0.001, GAMMA]] * 2


def extremes(controller, model, steps=150):
    """How many of the runs leave the domain, under residuals at the ends of ±γ."""
    rng = np.random.default_rng(5)
    x = controller.draw(200, rng)
    for k in range(steps):
        u = controller.act(x, "random", 3, k)
        x = model.step(x, u).x + rng.choice([-1.0, 1.0], (len(x), 2)) * [0.001, GAMMA]
        x = x[controller.contains(x)]
    return 200 - len(x)


def test_no_residual_within_it_breaks_the_controller_and_one_without_the_margin_is_broken(made):
    model = gc.load_spec(SPEC).build("model")
    assert extremes(made.controller, model) == 0
    assert extremes(gapcert_cells.GridController.load(made.folder / "controller" / "without_gamma"), model) > 0


def test_it_is_verified_as_what_it_is_and_no_more(made, tmp_path):
    assert verify_run(made.folder)["verdict"] == "holds"
    data = json.loads((made.folder / "certificate.json").read_text())
    (tmp_path / "certificate.npz").write_bytes((made.folder / "certificate.npz").read_bytes())
    smaller = {**data["states"], "v": {"gamma_max": GAMMA / 2}}
    for forged in ({"claim": {"kind": "deterministic"}}, {"states": smaller}, {"arrays": "0" * 64}):
        (tmp_path / "certificate.json").write_text(json.dumps(data | forged))
        assert verify_run(tmp_path)["verdict"] == "fails", forged


def test_measurements_are_held_against_it(made):
    monitor = made.certificate.monitor()
    assert not monitor.step([0.0, 0.5], [0.0], [0.05, 0.5 + 0.9 * GAMMA]).violated
    assert monitor.step([0.0, 0.5], [0.0], [0.05, 0.5 + 1.1 * GAMMA]).violated


@pytest.mark.parametrize(("gamma", "verdict"), [(0.016, "holds"), (0.0149, "fails"), (0.007, "fails")])
def test_a_simulator_may_refute_it_and_does_not_make_it_more(tmp_path, gamma, verdict):
    spec = {**SPEC, "backend": DRAG, "gap": {"kind": "declared", "gamma": {"x": 0.0, "v": gamma}}}
    spec |= {"certificate": {"claim": "assumed", "violation": 1e-2}, "closed_loop": {"starts": 10, "steps": 30}}
    run = gc.run(spec, out=tmp_path)
    certificate = run.summary["certificate"]
    assert run.summary["verdict"] == verdict, run.summary["reason"]
    assert certificate["claim"] == run.summary["controller"]["claim"] == {"kind": "assumed"}
    assert (certificate["audit"]["violations"] > 0) == (verdict == "fails")
    assert verify_run(run.folder)["verdict"] == verdict
    assert run.summary["closed_loop"]["with_gamma"]["starts"] == 10
    assert not isinstance(run.certificate, gc.Declaration)


def kicked():
    """A kick at the ends of the input: no point that is drawn lies there, and inputs of the controller do."""
    kick = {**MODEL, "next": {"x": "x + 0.1*v", "v": "v + 0.1*u + 500000*max(abs(u) - 0.999999, 0)"}}
    spec = {**SPEC, "backend": kick, "sampling": {"kind": "grid", "counts": {"x": 4, "v": 4, "u": 4}}}
    return spec | {"certificate": {"claim": "assumed", "violation": 1e-2}, "closed_loop": {"starts": 10, "steps": 30}}


def test_the_text_of_a_backend_is_searched_for_what_exceeds_a_declared_gap(tmp_path):
    said = r"gap: γ: \|f̂ − f\| of v is 0.0\d+ at \(x, u\) = .*, and the declaration allows 0.02;"
    with pytest.raises(gc.UsageError, match=said):
        gc.run(kicked(), out=tmp_path)


def test_what_only_the_closed_loop_meets_fails_the_run(tmp_path, monkeypatch):
    """As where the backend is an engine, and has no text."""
    monkeypatch.setattr(contradiction, "hunt", lambda *asked: False)
    run = gc.run(kicked(), out=tmp_path)
    assert run.summary["certificate"]["audit"]["violations"] == 0
    assert (run.summary["verdict"], run.exit_code) == ("fails", 1)
    assert run.summary["reason"].startswith("closed loop with γ: ")


def test_samples_alone_refute_it(tmp_path):
    spec = {**SPEC, "backend": DRAG, "gap": {"kind": "declared", "gamma": {"x": 0.0, "v": 0.007}}}
    spec |= {"controller": None, "certificate": {"claim": "assumed", "violation": 0.5, "confidence": 0.5}}
    summary = gc.run({k: v for k, v in spec.items() if v is not None}, out=tmp_path).summary
    assert summary["verdict"] == "fails"
    assert any(a.startswith("REFUTED: at ") for a in summary["certificate"]["assumptions"])


WRONG = [
    ({"gap": {"kind": "declared", "gamma": {"x": 0.1, "w": 0.1}}}, "'w'"),
    ({"gap": {"kind": "declared", "gamma": {"x": 0.1}}}, "nothing for 'v'"),
    ({"gap": {"kind": "declared", "gamma": {"x": -0.1, "v": 0.1}}}, "gap.gamma.x"),
    ({"gap": {"kind": "declared", "gamma": {"x": ".inf", "v": 0.1}}}, "gap.gamma.x"),
    ({"certificate": {"claim": "deterministic"}}, "assumed at most"),
    ({"certificate": {"claim": "assumed", "attack": 5}}, "'attack' needs a simulator"),
    ({"closed_loop": {"starts": 3}}, "'closed_loop' needs a simulator"),
    ({"sampling": {"kind": "adaptive", "budget": 100}}, "'sampling' needs a simulator"),
    ({"lipschitz": {"residual": {"kind": "none"}}}, "rests on no constants"),
    ({"report": {"beside": ["other.yaml"]}}, "'beside' needs a simulator"),
    ({"domain": None}, "'gap' needs 'domain'"),
    ({"gap": {"kind": "constant"}}, "'controller' needs 'certificate'"),
    ({"gap": {"kind": "constant"}, "backend": DRAG, "certificate": {"claim": "assumed"}}, "only a declared γ is assumed"),
    ({"backend": DRAG, "certificate": {"claim": "assumed", "route": "theorem1"}}, "certifies by declared"),
    ({"backend": DRAG, "certificate": {"claim": "statistical", "route": "calibrate"}}, "assumed at most"),
]


@pytest.mark.parametrize(("change", "said"), WRONG, ids=[said for _, said in WRONG])
def test_what_does_not_fit_is_told_in_a_sentence(tmp_path, change, said):
    spec = {k: v for k, v in (SPEC | change).items() if v is not None}
    with pytest.raises(GapcertError) as error:
        gc.run(spec, out=tmp_path)
    assert said in str(error.value)


def test_a_declared_gap_is_not_calibrated(tmp_path):
    spec = gc.load_spec(SPEC)
    model, backend = spec.build("model"), gc.load_spec({**SPEC, "model": DRAG}).build("model")
    domain = gc.Domain.of(model, dict(spec.config.domain))
    with pytest.raises(gc.UsageError, match="taken as it is stated"):
        gc.certify(model, backend, domain, family=spec.build("gap"), route="calibrate", folder=tmp_path)
    with pytest.raises(gc.UsageError, match="no check makes that more than assumed"):
        gc.certify(model, backend, domain, family=spec.build("gap"), request=gc.Request("empirical"), folder=tmp_path)


@pytest.mark.exam
def test_the_published_pendulum_is_a_spec(tmp_path):
    assert gc.run("specs/benchmarks/pendulum_gap.yaml", out=tmp_path).exit_code == 0
