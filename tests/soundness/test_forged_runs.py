"""Run folders of every kind, forged at random with all digests mended: each is caught, or its subject is trusted by name."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from forgeries import Forger, Forgery
from run_kinds import KINDS, made

import gapcert as gc
from gapcert_verify import verify_run


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
    forger, target = Forger(np.random.default_rng(seed)), place / source.name
    shutil.copytree(source, target)
    forger.mend(target, Forgery("nothing"))
    # Whoever makes all digests anew has changed nothing that counts; else a forgery would be caught for its digests alone.
    assert [c for c in verify_run(target)["checks"] if not c["passed"]] == []
    found = [forger.forge(source, target).answered(target) for _ in range(count)]
    return [text for text in found if text]


@pytest.mark.contract
@pytest.mark.parametrize("kind", ["statistical", "declared"])
def test_a_few_forgeries_are_caught(runs, out, tmp_path, kind):
    assert forged(run_of(runs, kind, out), tmp_path, 3, 6) == []


@pytest.mark.exam
@pytest.mark.parametrize("kind", KINDS)
def test_forgeries_are_caught(runs, out, tmp_path, kind):
    assert forged(run_of(runs, kind, out), tmp_path, 11, 12) == []


@pytest.mark.exam
@pytest.mark.parametrize("kind", ["recording", "declared"])
def test_each_field_and_array_is_held(runs, out, tmp_path, kind):
    source = run_of(runs, kind, out)
    target = tmp_path / source.name
    each = list(Forger(np.random.default_rng(12)).every(source, target))[::6]
    assert len(each) > 50
    assert [text for make in each if (text := make().answered(target))] == []


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
    "another confidence": ("recording", "spec.json", lambda d: d["certificate"].update(confidence=0.45), "beta is stated as"),
    "no confidence": ("recording", "spec.json", lambda d: d["certificate"].pop("confidence"), "and the spec asks for None"),
    "more above γ": (
        "calibrated",
        "certificate.json",
        lambda d: d["audit"].update(gamma_violations=d["audit"]["gamma_violations"] + 1, violations=d["audit"]["violations"]),
        "|r| > γ at",
    ),
    "no predictor": ("statistical", "spec.json", lambda d: d["gap"].update(predictor="none"), "and the spec asks for none"),
    "a predictor": ("related", "spec.json", lambda d: d["gap"].pop("predictor"), "and the spec asks for affine"),
    "terms of no text": (
        "engine",
        "certificate.json",
        lambda d: d["arithmetic"][0].update(terms=["m*g"]),
        "or has terms, but f̂ has no equations",
    ),
    "jitter below 0": (
        "engine",
        "certificate.json",
        lambda d: d["arithmetic"][0].update(jitter=[-j for j in d["arithmetic"][0]["jitter"]]),
        "expected 2 sizes",
    ),
    "e of one state": ("engine", "certificate.json", lambda d: d["arithmetic"][0]["e"].pop(), "expected 2 sizes"),
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
    "more pairs": (
        "statistical",
        "certificate.json",
        lambda d: d["lipschitz"].update(method=d["lipschitz"]["method"].replace("pairs", "000 pairs").replace(" 000", "000")),
        "the spec asks for",
    ),
    "a field": ("statistical", "certificate.json", lambda d: d.update(reviewed="by everyone"), "unknown field 'reviewed'"),
    "a field of a state": (
        "statistical",
        "certificate.json",
        lambda d: d["states"]["x"].update(seen=1),
        "unknown field 'seen' of x",
    ),
    "a field of the answer": ("statistical", "summary.json", lambda d: d.update(approved=True), "unknown field 'approved'"),
    "a field of a picture": (
        "statistical",
        "figures.json",
        lambda d: d["gap"].update(note="exact"),
        "unknown field 'note' in 'gap'",
    ),
    "a domain without relations": (
        "statistical",
        "certificate.json",
        lambda d: d["domain"].pop("relations"),
        "the domain lacks relations",
    ),
    "nothing, and digests made anew": ("statistical", "certificate.json", lambda d: d["lipschitz"].update(safety=1.2), ""),
}


@pytest.mark.exam
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
