"""A spec from end to end, on equations against equations: every core room without an engine."""

import html
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import gapcert as gc
import gapcert_cells
from gapcert.certification import contradiction
from gapcert.cli.main import main
from gapcert.contracts.controllers.policies import POLICIES
from gapcert_figures.data import Figures

MODEL = {
    "kind": "equations",
    "states": {"x": "m", "v": "m/s"},
    "inputs": {"a": "m/s^2"},
    "parameters": {"c": "0 1/s"},
    "derivative": {"x": "v", "v": "a - c*v"},
    "integrator": "euler",
    "period": "0.1 s",
}
SPEC = {
    "version": 1,
    "name": "cart",
    "model": MODEL,
    "backend": {**MODEL, "parameters": {"c": "0.4 1/s"}, "integrator": "semi_implicit"},
    "domain": {"x": [-1, 1], "v": [-1, 1], "a": [-2, 2]},
    "sampling": {"kind": "adaptive", "budget": 120},
    "lipschitz": {"residual": {"kind": "interval"}},
    "gap": {"kind": "envelope", "predictor": "affine"},
    "certificate": {"claim": "deterministic", "violation": 1e-2, "confidence": 0.999, "attack": 5000},
    "controller": {
        "kind": "symbolic",
        "goal": {"invariance": {"x": [-1, 1], "v": [-1, 1]}},
        "cells": {"x": 40, "v": 40},
        "inputs": {"a": 9},
    },
    "closed_loop": {"steps": 100, "starts": 20},
    "report": {"html": False, "rerun": False},
    "expect": {"verdict": "holds", "certificate.states.*.tightness <=": 1.01, "closed_loop.with_gamma.violations": 0},
}

BOUND_ONLY = {k: v for k, v in SPEC.items() if k not in ("controller", "closed_loop", "expect")}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return gc.run(SPEC, out=tmp_path_factory.mktemp("runs"))


@pytest.fixture
def runs(run, tmp_path):
    """A copy of the folder that the run is in, to go on in."""
    return shutil.copytree(run.folder.parent, tmp_path / "runs")


def test_every_expectation_is_met(run):
    assert run.exit_code == 0
    assert [e["met"] for e in run.summary["expectations"]] == [True] * 3


def test_summary_is_the_contract(run):
    s = json.loads((run.folder / "summary.json").read_text())
    assert s == json.loads(json.dumps(run.summary))
    assert {
        "name",
        "run_dir",
        "verdict",
        "reason",
        "certificate",
        "controller",
        "closed_loop",
        "timings",
        "expectations",
    } <= set(s)
    assert set(s["controller"]) >= {"kind", "claim", "cells", "winning_cells", "winning_fraction"}
    counts = {"policy", "starts", "steps", "violations", "stranded", "left_goal", "broken_promises"}
    assert set(s["closed_loop"]["with_gamma"]) == counts | {"steps_held", "outside_gap"}
    assert set(s["closed_loop"]["without_gamma"]) == counts
    assert {p["policy"] for p in s["closed_loop"]["policies"]} == set(POLICIES)
    assert set(s["expectations"][0]) == {"text", "value", "met"}


def test_the_runs_are_an_audit_that_no_step_refutes(run):
    loop = run.summary["closed_loop"]
    claim = {k: loop["claim"][k] for k in ("kind", "beta", "runs", "violations")}
    assert claim == {"kind": "statistical", "beta": 0.001, "runs": 20, "violations": 0}
    least = 1 - (0.001 / 2) ** (1 / 20)  # the first audit of a question spends half of its β
    assert least <= loop["claim"]["epsilon"] < least + 2e-4
    for row in loop["policies"]:
        if row["controller"] == "with_gamma":
            assert (row["broken_promises"], row["outside_gap"], row["steps_held"]) == (0, 0, 2000)


def test_the_runs_can_be_replayed_from_the_folder(run):
    controller = gapcert_cells.GridController.load(run.folder / "controller" / "with_gamma")
    with np.load(run.folder / "closed_loop.npz") as stored:
        x, u, broken = (stored[f"with_gamma_{part}"] for part in ("x", "u", "broken"))
    assert x.shape == (20, 101, 2)
    for k in range(100):
        assert np.array_equal(controller.kept(x[:, k], u[:, k], x[:, k + 1]), ~broken[:, k])
    assert not controller.kept(x[:, 0], u[:, 0], x[:, 50]).all()


def test_deterministic_carries_to_the_controller(run):
    assert run.summary["certificate"]["claim"] == {"kind": "deterministic"}
    assert run.summary["controller"]["claim"] == {"kind": "deterministic"}


def test_gamma_bounds_the_gap_from_python(run):
    rng = np.random.default_rng(0)
    x, u = rng.uniform(-1, 1, (500, 2)), rng.uniform(-2, 2, (500, 1))
    model = gc.load_spec(SPEC).build("model")
    backend = gc.load_spec(SPEC).build("backend", model=model)
    gap = np.abs(backend.step(x, u).x - model.step(x, u).x)
    assert (gap <= run.certificate.gamma(x, u)).all()
    assert run.certificate.gamma(x[0], u[0]).shape == (1, 2)


def test_the_controller_runs_without_its_maker(run):
    controller = gapcert_cells.GridController.load(run.folder / "controller" / "with_gamma")
    x = np.array([[0.0, 0.0]])
    np.testing.assert_array_equal(controller.act(x, "first"), run.controller.act(x, "first"))


@pytest.mark.run
def test_the_same_spec_again_is_the_same_run_and_the_same_audit(run, runs):
    again = gc.run(SPEC, out=runs)
    assert again.folder == runs / run.folder.name
    for key in ("certificate", "controller", "closed_loop"):
        assert again.summary[key] == run.summary[key]
    assert again.summary["certificate"]["audit"]["number"] == 1


def test_nothing_wins_is_a_failure_with_its_reason_and_no_picture(tmp_path, capsys):
    spec = {k: v for k, v in SPEC.items() if k != "expect"}
    spec |= {"controller": {**SPEC["controller"], "cells": {"x": 40, "v": 5}}, "report": {"html": True, "rerun": False}}
    (tmp_path / "cart.yaml").write_text(json.dumps(spec))
    assert main(["run", str(tmp_path / "cart.yaml"), "--out", str(tmp_path / "runs"), "--quiet", "--json"]) == 1
    summary = json.loads(capsys.readouterr().out)
    assert summary["verdict"] == "fails"
    assert summary["reason"] == f"no cell wins: {summary['controller']['reason']}"
    assert summary["controller"]["change"]["cells"]["v"] in (10, 20)
    assert "closed_loop" not in summary
    folder = Path(summary["run_dir"])
    assert Figures.load(folder).winning is None
    page = html.unescape((folder / "report.html").read_text())
    assert summary["reason"] in page
    assert "Where the controller may start" not in page


def test_another_seed_is_the_next_audit(run, runs):
    again = gc.run(SPEC, overrides=["seed=3"], out=runs)
    assert again.folder.name != run.folder.name
    assert again.summary["certificate"]["audit"]["number"] == 2


def test_an_unknown_executor_leaves_no_folder(tmp_path):
    with pytest.raises(gc.UsageError, match=r"no plugin provides executor 'thread'.*did you mean 'threads'"):
        gc.run(SPEC, out=tmp_path / "runs", executor="thread")
    assert not (tmp_path / "runs").exists()


PYTHON = """\
def step(x, u, c):
    return x + 0.1 * u


def slope(x, u, c):
    import numpy as np

    return np.tile([[1.0, 0.1]], (len(x), 1, 1))
"""


def test_a_model_without_ranges_is_refused_before_a_sample_is_drawn(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own.py").write_text(PYTHON)
    model = {
        "kind": "python",
        "function": "own:step",
        "jacobian": "own:slope",
        "states": {"x": "m"},
        "inputs": {"u": "m/s"},
        "parameters": {"c": "0 1/s"},
        "period": "0.1 s",
    }
    controller = {"kind": "symbolic", "goal": {"invariance": {"x": [-1, 1]}}, "cells": {"x": 9}, "inputs": {"u": 3}}
    spec = {
        "version": 1,
        "name": "own",
        "model": model,
        "backend": model,
        "domain": {"x": [-1, 1], "u": [-1, 1]},
        "lipschitz": {"residual": {"kind": "wood-zhang"}},
        "certificate": {"claim": "empirical"},
        "controller": controller,
    }
    events = []
    with pytest.raises(gc.UsageError, match=r"model\.\w+: a Python function says nothing about its range"):
        gc.run(spec, allow_code=True, observers=[events.append])
    assert [e.stage for e in events] == ["run"]
    assert not list(tmp_path.rglob("chunk-*"))


def test_a_refuted_claim_fails_with_a_witness(tmp_path, monkeypatch):
    monkeypatch.setattr(contradiction, "hunt", lambda *asked: False)  # as of an engine, whose equations nobody has
    low = {"x": dict.fromkeys("xva", 1e-9), "v": dict.fromkeys("xva", 1e-9)}
    run = gc.run(
        BOUND_ONLY
        | {
            "lipschitz": {"residual": {"kind": "declared", "values": low}},
            "gap": {"kind": "envelope", "predictor": "none"},
        },
        out=tmp_path,
    )
    assert run.summary["verdict"] == "fails"
    assert run.exit_code == 1
    assert "the residual of" in run.summary["reason"]
    assert run.summary["certificate"]["audit"]["witness"]["state"] in (0, 1)


def test_nothing_wins_is_a_failure_with_its_reason(tmp_path):
    hopeless = SPEC["controller"] | {"cells": {"x": 2, "v": 2}}
    run = gc.run(SPEC | {"controller": hopeless, "expect": {}}, out=tmp_path)
    assert run.summary["verdict"] == "fails"
    assert run.summary["reason"].startswith("no cell wins: ")
    assert len(run.summary["reason"]) > 20
    assert "closed_loop" not in run.summary


def test_no_start_beyond_the_target_is_a_failure_that_keeps_the_certificate(tmp_path):
    # Cells of 0.5 m, and at most 0.1 m per period: whoever is outside the target may never arrive.
    coarse = {"kind": "symbolic", "goal": {"reach": {"x": [0, 0.5]}}, "cells": {"x": 4, "v": 4}, "inputs": {"a": 3}}
    run = gc.run(SPEC | {"controller": coarse, "expect": {}}, out=tmp_path)
    assert run.summary["verdict"] == "fails"
    assert run.summary["controller"]["winning_cells"] > 0
    assert run.summary["reason"].startswith("no cell wins: nothing beyond the target: x: the target is 0.5 m wide, less than")
    assert "closed_loop" not in run.summary
    assert (run.folder / "summary.json").exists()


@pytest.mark.fault("a solver gives up", shows="verdict unknown, with its reason, exit 5")
def test_a_solver_that_gives_up_leaves_the_verdict_open(tmp_path, monkeypatch):
    cp = pytest.importorskip("cvxpy")

    def give_up(*_: object, **__: object) -> None:
        raise cp.SolverError("Solver 'CLARABEL' failed")

    monkeypatch.setattr(cp.Problem, "solve", give_up)
    grid = {"kind": "grid", "counts": {"x": 6, "v": 6, "a": 6}}
    spec = BOUND_ONLY | {"sampling": grid, "gap": {"kind": "basis", "functions": ["1", "abs(v)"]}, "report": {"rerun": False}}
    run = gc.run(spec, out=tmp_path)
    assert (run.summary["verdict"], run.exit_code) == ("unknown", 5)
    assert "the scenario program was not solved" in run.summary["reason"]
    assert "CLARABEL" in (run.folder / "report.html").read_text()


@pytest.mark.fault("a run is started within a run of the same spec", shows="the second is told so")
def test_two_runs_do_not_share_a_folder(tmp_path):
    def again(event: gc.Event) -> None:
        if event.name == "stage-finished":
            with pytest.raises(gc.UsageError, match="another process runs this spec"):
                gc.run(BOUND_ONLY, out=tmp_path)
            refused.append(event.stage)

    refused: list[str] = []
    gc.run(BOUND_ONLY, out=tmp_path, observers=[again])
    assert refused == ["certificate"]
    gc.run(BOUND_ONLY, out=tmp_path)


def test_unmet_expectations_exit_with_one(tmp_path):
    spec = BOUND_ONLY | {"expect": {"certificate.states.x.tightness <=": 0.5, "verdict": "holds"}}
    run = gc.run(spec, out=tmp_path)
    assert run.summary["verdict"] == "holds"
    assert [e["met"] for e in run.summary["expectations"]] == [False, True]
    assert run.exit_code == 1


def test_a_matrix_has_a_run_for_each_value(tmp_path):
    spec = BOUND_ONLY | {"matrix": {"gap.kind": ["envelope", "constant"]}}
    run = gc.run(spec, out=tmp_path)
    assert [r["certificate"]["family"] for r in run.summary["runs"]] == ["envelope", "constant"]
    tight = [r["certificate"]["states"]["x"]["tightness"] for r in run.summary["runs"]]
    assert tight[0] < tight[1]


@pytest.mark.fault("a run folder of another spec", shows="it is refused and left as it is")
def test_a_folder_of_another_spec_is_refused(run, runs):
    mark = runs / run.folder.name / "run.json"
    mark.write_text(json.dumps({"spec": "0" * 64}))
    before = {p: p.read_bytes() for p in runs.rglob("*") if p.is_file()}
    with pytest.raises(gc.UsageError, match="belongs to another spec"):
        gc.run(SPEC, out=runs)
    assert {p: p.read_bytes() for p in before} == before


@pytest.mark.fault("an observer raises an error", shows="it is dropped with a warning; the run goes on")
def test_observers_hear_every_stage_and_cannot_kill_a_run(tmp_path):
    heard = []

    def broken(event):
        raise ConnectionError("no viewer")

    with pytest.warns(RuntimeWarning, match="an observer was dropped after ConnectionError: no viewer"):
        run = gc.run(BOUND_ONLY, out=tmp_path, observers=[broken, lambda e: heard.append((e.name, e.stage))])
    assert run.exit_code == 0
    assert heard[0] == ("run-started", "run")
    assert ("stage-finished", "certificate") in heard
    assert heard[-1] == ("run-finished", "run")


def test_certificates_of_other_specs_stand_beside(tmp_path):
    # The other has more to do, which is left out.
    more = {k: SPEC[k] for k in ("controller", "closed_loop")}
    (tmp_path / "other.yaml").write_text(json.dumps(BOUND_ONLY | more | {"name": "other", "gap": {"kind": "constant"}}))
    spec = BOUND_ONLY | {"report": {"html": True, "rerun": False, "beside": [str(tmp_path / "other.yaml")]}}
    run = gc.run(spec, out=tmp_path / "runs")
    rows = run.summary["beside"]
    assert [(r["name"], r["family"]) for r in rows] == [("cart", "envelope"), ("other", "constant")]
    assert rows[0]["states"]["x"]["tightness"] < rows[1]["states"]["x"]["tightness"]
    assert "The same question by another route" in (run.folder / "report.html").read_text()


def test_a_certificate_names_the_packages_behind_its_components(tmp_path):
    """Those of the backend, of what a wrapper wraps, and of nothing that the spec does not use."""
    import importlib.metadata
    from pathlib import Path

    from gapcert.run.build import Build

    spec = Path(__file__).parents[2] / "specs" / "pendulum.yaml"
    wrapped = f"backend={{kind: stochastic, jitter: 1 ms, of: {gc.load_spec(spec).data['backend']}}}"
    for overrides in ((), (wrapped,)):
        found = Build(gc.load_spec(spec, overrides), None, tmp_path, False).versions()
        assert found == {"pybullet": importlib.metadata.version("pybullet")}
