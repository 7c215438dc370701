"""Run folders of every kind, forged at random with all digests mended: each is caught, or its subject is trusted by name."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from forgeries import Forger, Forgery

import gapcert as gc
from gapcert_verify import verify_run

MODEL = {
    "kind": "equations",
    "states": {"x": "m", "v": "m/s"},
    "inputs": {"F": "N"},
    "parameters": {"m": "2 kg", "b": "0.3 N*s/m"},
    "derivative": {"x": "v", "v": "(F - b*v)/m"},
    "integrator": "euler",
    "period": "50 ms",
}
BACKEND = {
    **MODEL,
    "parameters": {"m": "2 kg", "b": "0.34 N*s/m", "c": "0.05 N*s^2/m^2"},
    "derivative": {"x": "v", "v": "(F - b*v - c*v*abs(v))/m"},
    "integrator": "rk4",
}
PLAIN: dict[str, Any] = {
    "version": 1,
    "model": MODEL,
    "backend": BACKEND,
    "domain": {"x": [-1, 1], "v": [-1.5, 1.5], "F": [-2, 2]},
    "sampling": {"kind": "adaptive", "budget": 120, "executor": "threads"},
    "certificate": {"claim": "statistical", "violation": 0.05, "confidence": 0.95, "attack": 500},
    "report": {"rerun": False, "html": False},
    "expect": {"verdict": "holds"},
}
PROVED = {"residual": {"kind": "interval", "boxes": 256}}
STATED = {"x": {"x": 0, "v": 0.01, "F": 0.01}, "v": {"x": 0, "v": 0.06, "F": 0.02}}
DETERMINISTIC = {"claim": "deterministic", "violation": 0.05, "confidence": 0.95}
STAY = {"invariance": {"x": [-0.8, 0.8], "v": [-1, 1]}}
CELLS = {"kind": "symbolic", "goal": STAY, "cells": {"x": 16, "v": 16}, "inputs": {"F": 5}}
KINDS: dict[str, dict[str, Any]] = {
    "statistical": {"gap": {"kind": "envelope", "predictor": "affine"}},
    "controller": {
        "lipschitz": PROVED,
        "certificate": DETERMINISTIC,
        "controller": CELLS,
        "closed_loop": {"steps": 10, "starts": 4},
        "report": {"rerun": False, "html": True},
    },
    "constant": {"lipschitz": PROVED, "certificate": DETERMINISTIC, "gap": {"kind": "constant"}},
    "theorem1": {
        "lipschitz": {"residual": {"kind": "declared", "values": STATED}},
        "sampling": {"kind": "grid", "counts": {"x": 3, "v": 10, "F": 10}, "executor": "threads"},
        "gap": {"kind": "basis", "functions": ["1", "abs(v)", "v^2"]},
        "certificate": {**DETERMINISTIC, "route": "theorem1"},
        "symmetries": {"translation": ["x"]},
    },
    "multilinear": {
        "lipschitz": {
            "residual": {"kind": "declared", "values": STATED, "curvature": {k: dict.fromkeys("xvF", 1.0) for k in "xv"}}
        },
        "sampling": {"kind": "lattice", "budget": 120, "executor": "threads"},
        "gap": {"kind": "multilinear"},
        "certificate": DETERMINISTIC,
    },
    "calibrated": {
        "backend": {"kind": "stochastic", "of": BACKEND, "sensor_noise": {"x": "1 mm", "v": "2 mm/s"}},
        "sampling": None,
        "certificate": {"claim": "statistical", "route": "calibrate", "violation": 0.1, "confidence": 0.9, "exceedances": 1},
    },
    "declared": {
        "backend": None,
        "sampling": None,
        "certificate": None,
        "gap": {"kind": "declared", "gamma": {"x": 0.001, "v": 0.005}},
        "controller": CELLS,
    },
    "empirical": {
        "certificate": {"claim": "empirical", "violation": 0.05, "confidence": 0.95},
        "lipschitz": {"residual": {"kind": "piecewise", "budget": 4000}},
    },
    "mpc": {
        "lipschitz": PROVED,
        "certificate": DETERMINISTIC,
        "controller": {"kind": "mpc", "goal": STAY, "horizon": 5},
        "closed_loop": {"steps": 5, "starts": 2},
    },
}


def made(kind: str, out: Path) -> Path:
    """An honest run of a kind."""
    spec = {k: v for k, v in {**PLAIN, **KINDS[kind], "name": kind}.items() if v is not None}
    return gc.run(spec, out=out).folder


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return {}


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("forged")


def run_of(runs: dict[str, Path], kind: str, out: Path) -> Path:
    if kind not in runs:
        runs[kind] = made(kind, out)
        answer = verify_run(runs[kind])
        assert answer["verdict"] == "holds", (kind, [c for c in answer["checks"] if not c["passed"]])
    return runs[kind]


def forged(source: Path, place: Path, seed: int, count: int) -> list[str]:
    """What was accepted of so many forgeries, and is not trusted by name."""
    forger, found, target = Forger(np.random.default_rng(seed)), [], place / source.name
    shutil.copytree(source, target)
    forger.mend(target, Forgery("nothing"))
    # Whoever makes all digests anew has changed nothing that counts; else a forgery would be caught for its digests alone.
    assert [c for c in verify_run(target)["checks"] if not c["passed"]] == []
    for _ in range(count):
        found.append(forger.forge(source, target).answered(target))
    return [text for text in found if text]


@pytest.mark.contract
@pytest.mark.parametrize("kind", ["statistical", "declared"])
def test_a_few_forgeries_are_caught(runs, out, tmp_path, kind):
    assert forged(run_of(runs, kind, out), tmp_path, 3, 6) == []


@pytest.mark.exam
@pytest.mark.parametrize("kind", KINDS)
def test_forgeries_are_caught(runs, out, tmp_path, kind):
    assert forged(run_of(runs, kind, out), tmp_path, 11, 12) == []


def edited(run: Path, name: str, change: Any) -> None:
    data = json.loads((run / name).read_text())
    change(data)
    (run / name).write_text(json.dumps(data))
    Forger(np.random.default_rng(0)).mend(run, Forgery(f"{name}:"))


def another_model(data: dict[str, Any]) -> None:
    data["model"]["parameters"]["b"] = "0.31 N*s/m"


def renamed(data: dict[str, Any]) -> None:
    axes, states = data["domain"]["axes"], data["states"]
    axes[:2] = axes[1::-1]
    data["states"] = {"x": states["v"], "v": states["x"]}


FORGERIES: dict[str, tuple[str, str, Any, str]] = {
    "another model": ("statistical", "spec.json", another_model, "the residual at"),
    "a wider domain": ("statistical", "spec.json", lambda d: d["domain"].update(x=[-9, 9]), "low is stated"),
    "states renamed and swapped": ("statistical", "certificate.json", renamed, "the spec gives"),
    "no assumptions": ("statistical", "certificate.json", lambda d: d.update(assumptions=[]), "is left out"),
    "another ε and β, of all": (
        "statistical",
        "certificate.json",
        lambda d: [d[part].update(beta=0.9) for part in ("claim", "audit")],
        "the spec asks for",
    ),
    "a safety factor": (
        "statistical",
        "certificate.json",
        lambda d: (d["lipschitz"].update(safety=5.0), [s.update(safety_factor=5.0) for s in d["states"].values()]),
        "safety is stated as 5.0",
    ),
    "a proof in place of an estimate": (
        "statistical",
        "certificate.json",
        lambda d: (d["lipschitz"].update(provenance="interval", method="interval"), d.update(claim={"kind": "deterministic"})),
        "the spec asks for",
    ),
    "a larger attack": ("statistical", "certificate.json", lambda d: d["attack"].update(points=10**9), "attack is stated"),
    "a verdict": ("statistical", "summary.json", lambda d: d.update(verdict="fails", reason="no"), "the answer is stated"),
    "expectations": ("statistical", "summary.json", lambda d: d["expectations"][0].update(value="x"), "expectations are"),
    "a constant bound": (
        "statistical",
        "certificate.json",
        lambda d: [s.update(constant_bound=1e9) for s in d["states"].values()],
        "bounds the envelope",
    ),
    "nothing, and digests made anew": ("statistical", "certificate.json", lambda d: d["lipschitz"].update(safety=1.2), ""),
}


@pytest.mark.contract
@pytest.mark.parametrize("name", FORGERIES)
def test_a_forgery_is_told(runs, out, tmp_path, name):
    kind, file, change, why = FORGERIES[name]
    run = tmp_path / "run"
    shutil.copytree(run_of(runs, kind, out), run)
    edited(run, file, change)
    failed = [c["detail"] for c in verify_run(run)["checks"] if not c["passed"]]
    assert any(why in text for text in failed) if why else failed == [], failed


@pytest.mark.contract
def test_what_is_trusted_is_short(runs, out):
    trusted = verify_run(run_of(runs, "statistical", out))["trusted"]
    assert [text.partition(" ")[0] for text in trusted] == ["Versions,", "How", "The", "The"]


@pytest.mark.contract
def test_stored_transitions_are_stepped_again(runs, out, tmp_path):
    answer = verify_run(run_of(runs, "statistical", out), again=7)
    assert any(c["check"] == "7 stored transitions, stepped again, are the same bit for bit" for c in answer["checks"])


@pytest.mark.contract
def test_a_forged_run_is_not_loaded(runs, out, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(run_of(runs, "statistical", out), run)
    assert gc.Certified.load(run).model.nx == 2
    edited(run, "spec.json", another_model)
    with pytest.raises(gc.UsageError, match="is not what it claims"):
        gc.Certified.load(run)
