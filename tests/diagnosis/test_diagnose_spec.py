"""A diagnosis spec as a user writes it first: no period, no integrator, no velocity."""

import json

import numpy as np
import pytest

import gapcert as gc
from gapcert.cli.main import main
from gapcert_report.words.summary import in_words

SPEC = {
    "version": 1,
    "name": "slide",
    "model": {
        "kind": "equations",
        "coordinates": {"q": "m"},
        "inputs": {"F": "N"},
        "parameters": {"mass": {"value": "2 kg", "tolerance": "2 %"}},
        "mass_matrix": [["mass"]],
        "forces": {"q": "F"},
    },
    "diagnose": {"effects": "all", "hold_out": {"last": "33 %"}, "horizons": ["0.5 s"]},
    "report": {"html": False, "rerun": False},
}


@pytest.fixture
def spec(tmp_path):
    t = np.arange(1500) * 0.004
    force = 3.0 * np.sign(np.sin(2 * np.pi * 0.7 * t)) + 2.0 * np.sin(2 * np.pi * 1.9 * t)
    q, v = np.empty_like(t), 0.0
    q[0] = 0.0
    for k in range(1, len(t)):
        # Exact solution of 2 v̇ = F − 0.8 v over one period with F held.
        rest = force[k - 1] / 0.8
        decay = np.exp(-0.4 * 0.004)
        q[k] = q[k - 1] + rest * 0.004 + (v - rest) * (1 - decay) / 0.4
        v = rest + (v - rest) * decay
    q += 1e-4 * np.random.default_rng(5).standard_normal(len(t))
    np.savetxt(tmp_path / "log.csv", np.column_stack([t, q, force]), delimiter=",", header="t,q,F", comments="", fmt="%.9f")
    recording = {"kind": "csv", "files": [str(tmp_path / "log.csv")], "time": "t", "columns": {"q": "q", "F": "F"}}
    return SPEC | {"recording": recording}


@pytest.mark.run
def test_period_and_integrator_follow_from_the_recording(spec, tmp_path):
    run = gc.run(spec, out=tmp_path / "runs")
    assert [(c["effect"], c["site"]) for c in run.summary["causes"]] == [("viscous-friction", "q")]
    value = run.summary["causes"][0]["parameters"]["coefficient"]["value"]
    assert value == pytest.approx(0.8, rel=0.05)
    assert run.diagnosis.extended_model.period == 0.004
    assert gc.load_spec(run.summary["extended_model"]).build("model").period == 0.004


@pytest.mark.run
def test_the_command_names_the_cause(spec, tmp_path, capsys):
    path = tmp_path / "slide.yaml"
    path.write_text(json.dumps(spec))
    assert main(["diagnose", str(path), "--json", "--quiet", "--out", str(tmp_path / "runs")]) == 0
    out, err = capsys.readouterr()
    found = json.loads(out)
    assert [(c["effect"], c["site"]) for c in found["causes"]] == [("viscous-friction", "q")]
    assert "viscous friction at q" in err


@pytest.mark.exam
def test_what_a_tolerance_let_the_data_move_is_told(spec, tmp_path):
    parameters = {"mass": {"value": "2.06 kg", "tolerance": "5 %"}, "b": "0.8 N*s/m"}
    model = spec["model"] | {"parameters": parameters, "forces": {"q": "F - b*q_dot"}}
    run = gc.run(spec | {"model": model}, out=tmp_path / "runs")
    assert run.summary["verdict"] == "nothing"
    ((name, mass),) = run.summary["refitted"].items()
    assert (name, mass["stated"], mass["unit"]) == ("mass", 2.06, "kg")
    assert mass["low"] < 2.0 < mass["high"] < 2.06
    assert any(line.startswith("  refitted: mass is 2.00") for line in in_words(run.summary))
    freed = spec["model"] | {"parameters": parameters | {"mass": {"value": "2.4 kg", "tolerance": "2 %"}}}
    run = gc.run(spec | {"model": freed | {"forces": {"q": "F - b*q_dot"}}}, out=tmp_path / "runs")
    assert [(c["effect"], c["site"]) for c in run.summary["causes"]] == [("parameter", "mass")]
    assert "refitted" not in run.summary


def test_a_certificate_needs_a_period(tmp_path):
    certify = {k: v for k, v in SPEC.items() if k not in ("diagnose",)}
    certify |= {
        "backend": SPEC["model"],
        "domain": {"q": [-1, 1], "q_dot": [-1, 1], "F": [-1, 1]},
        "certificate": {"claim": "empirical"},
    }
    with pytest.raises(gc.SpecError, match="missing required key 'period'"):
        gc.load_spec(certify)


AGAIN = {
    "backend": SPEC["model"] | {"period": "4 ms", "integrator": "rk4"},
    "domain": {"q": [-1, 1], "q_dot": [-1, 1], "F": [-1, 1]},
    "certificate": {"claim": "empirical", "violation": 0.01, "confidence": 0.99},
}


@pytest.mark.run
def test_a_model_that_cannot_be_certified_keeps_its_diagnosis(spec, tmp_path):
    run = gc.run(spec | AGAIN | {"backend": AGAIN["backend"] | {"period": "8 ms"}}, out=tmp_path / "runs")
    assert run.summary["verdict"] == "causes"
    assert "its period is 0.008 s" in run.summary["recertified"]["before"]["refused"]


def test_a_backend_that_does_not_fit_is_refused_before_the_diagnosis(spec, tmp_path):
    heard = []
    robot = {"kind": "pybullet", "robot": __file__, "states": {"q": "a.position", "q_dot": "a.velocity"}, "inputs": {"F": "a"}}
    with pytest.raises(gc.UsageError, match="robot"):
        gc.run(spec | AGAIN | {"backend": robot}, out=tmp_path / "runs", observers=[lambda e: heard.append(e.stage)])
    assert "diagnosis" not in heard
