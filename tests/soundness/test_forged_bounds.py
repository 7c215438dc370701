"""Stored numbers that would let a false bound through: each is put into a saved certificate, and verify has to refuse it."""

from __future__ import annotations

import hashlib
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rough_fields import Coarse

import gapcert as gc
from gapcert.certification.samples.executors import threads
from gapcert.contracts.gaps.gap import GapFamily
from gapcert_bounds.constants.declared_constants import Declared
from gapcert_bounds.constants.interval import IntervalJacobian
from gapcert_bounds.families.basis import Basis
from gapcert_bounds.families.constant import Constant
from gapcert_bounds.families.envelope import Envelope
from gapcert_bounds.families.multilinear import Multilinear
from gapcert_bounds.testing.fields import Nothing, Waves
from gapcert_functions.dominating import dominate
from gapcert_networks.network import Network
from gapcert_networks.theorem1_network import raised
from gapcert_verify.verify import verify_run

FIELD = Waves(np.array([[0.4, 0.3, 0.05], [0.2, 0.3, 0.1]]), np.full((2, 3), 2.0), np.array([[0.3, 1.0, 0.2]] * 2))
AXES = [a.name for a in FIELD.domain.axes]
VALUES = {n: dict(zip(AXES, row, strict=True)) for n, row in zip(AXES, FIELD.constants.tolist(), strict=False)}

MORE = {n: {a: 3 * v for a, v in row.items()} for n, row in VALUES.items()}
BENDS = {n: dict(zip(AXES, row, strict=True)) for n, row in zip(AXES, FIELD.curvature.tolist(), strict=False)}


def network(outputs: int) -> Network:
    rng = np.random.default_rng(outputs)
    return Network((rng.normal(size=(6, 3)), 0.3 * rng.normal(size=(outputs, 6))), (rng.normal(size=6), np.zeros(outputs)))


class Raised(GapFamily):
    name, routes = "raised", ("theorem1",)

    def fit(self, problem: gc.plugin.GapProblem) -> gc.GapFunction:
        return raised(problem, self.name, network(2))


class Lifted(GapFamily):
    name, routes = "lifted", ("dominate",)

    def fit(self, problem: gc.plugin.GapProblem) -> gc.GapFunction:
        return dominate(problem, self.name, network(2), network(2), (2, 1, 2), 0.05, 20_000)


GRID = {"route": "theorem1", "sampling": gc.GridSampling((8, 8, 6))}
MADE: dict[str, dict[str, Any]] = {
    "network": {"family": Raised(), **GRID},
    "basis": {"family": Basis(("1", "x0^2", "abs(x1)", "u0")), **GRID},
    "constant": {"family": Constant()},
    "coarse": {"family": Constant(), "backend": Coarse(FIELD, 0.02), **GRID},
    "lifted": {"family": Lifted()},
    "envelope": {"family": Envelope(), "backend": Coarse(FIELD, 0.02), "predictor": "affine", "lipschitz": Declared(MORE)},
    "multilinear": {
        "family": Multilinear(),
        "backend": Coarse(FIELD, 0.02),
        "sampling": gc.LatticeSampling(budget=200),
        "lipschitz": Declared(MORE, curvature=BENDS),
    },
    "cells": {"family": Lifted(), "lipschitz": IntervalJacobian(2048, 8)},
}


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("bounds")
    for name, options in MADE.items():
        folder = out / name
        options = {"sampling": gc.AdaptiveSampling(200), "lipschitz": Declared(VALUES), **options}
        request = gc.Request("deterministic", 1e-2, 1e-3)
        backend = options.pop("backend", FIELD)
        made = gc.certify(Nothing(FIELD), backend, FIELD.domain, folder=folder, executor=threads, request=request, **options)
        made.save(folder)
        assert made.claim.kind == "deterministic", name
    return out


def digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


class Forgery:
    """A copy of a run, its data and arrays open to change; `failed` writes them with the right digests and verifies."""

    def __init__(self, source: Path, folder: Path) -> None:
        shutil.copytree(source, folder)
        self.folder = folder
        self.data = json.loads((folder / "certificate.json").read_text())
        with np.load(folder / "certificate.npz") as stored:
            self.arrays = dict(stored)

    def residuals(self, name: str, change: Any) -> None:
        """Change the first shard of a round in place; it stays what its manifest says."""
        folder = self.folder / "samples" / name
        r = np.load(folder / "chunk-000000.npy")
        change(r)
        np.save(folder / "chunk-000000.npy", r)
        header, *lines = [json.loads(line) for line in (folder / "manifest.jsonl").read_text().splitlines()]
        for line in lines:
            if line["chunk"] == 0:
                line["sha256"] = digest((folder / "chunk-000000.npy").read_bytes())
        (folder / "manifest.jsonl").write_text("".join(json.dumps(line) + "\n" for line in [header, *lines]))
        entries = [[line[k] for k in ("sha256", "residuals") if k in line] for line in sorted(lines, key=lambda a: a["chunk"])]
        total = entries if "extremes" in header else [e for (e,) in entries]
        self.data["digests"][name] = digest(json.dumps([header, total]).encode())

    def refused(self, why: str) -> None:
        failed = self.failed()
        assert any(why in text for text in failed), failed

    def failed(self) -> list[str]:
        np.savez(self.folder / "certificate.npz", **self.arrays)
        self.data["arrays"] = digest((self.folder / "certificate.npz").read_bytes())
        (self.folder / "certificate.json").write_text(json.dumps(self.data))
        checks = [c for c in verify_run(self.folder)["checks"] if not c["passed"]]
        assert not any("digest" in c["check"] for c in checks), checks
        # Figures of the audit are easily forged as well; nothing rests on them here.
        return [c["detail"] for c in checks if "figures" not in c["check"]]


@pytest.mark.parametrize("name", MADE)
def test_honest_certificates_verify(runs: Path, tmp_path: Path, name: str) -> None:
    assert Forgery(runs / name, tmp_path / "run").failed() == []


def test_a_margin_without_the_resolution_is_refused(runs: Path, tmp_path: Path) -> None:
    forgery = Forgery(runs / "coarse", tmp_path / "run")
    assert (forgery.arrays["resolution"] >= 0.01).all()
    forgery.arrays["gap.gamma"] -= 1.9 * forgery.arrays["resolution"]
    forgery.refused("γ clears the samples by")


def test_audited_residuals_that_are_no_numbers_hide_nothing(runs: Path, tmp_path: Path) -> None:
    """NaN lies neither above nor below a bound."""
    run = Forgery(runs / "lifted", tmp_path / "run")
    run.residuals(f"audit-{run.data['audit']['number']}", lambda r: r.__setitem__(slice(0, 100), np.nan))
    run.refused("finite")


def test_one_output_does_not_serve_two_states(runs: Path, tmp_path: Path) -> None:
    """Of an output that is not there the constant would be 0."""
    run = Forgery(runs / "network", tmp_path / "run")
    run.arrays["gap.q.W1"], run.arrays["gap.q.b1"] = run.arrays["gap.q.W1"][:1], run.arrays["gap.q.b1"][:1]
    run.refused("outputs")


def test_axes_counted_from_the_end_are_no_axes(runs: Path, tmp_path: Path) -> None:
    """A function of axis −3 would be given the slope 0 along axis 0, though −cos dips between the samples."""
    run = Forgery(runs / "basis", tmp_path / "run")
    run.data["form"]["functions"].append([[-3, "cos", 8 * np.pi]])
    run.data["form"]["text"].append("-cos")
    run.arrays["gap.weights"] = np.hstack([run.arrays["gap.weights"], np.full((2, 1), -1e-2)])
    run.arrays["gap.margin"] = run.arrays["gap.margin"] - 7e-3
    run.refused("is no factor")


def test_as_many_states_as_residuals(runs: Path, tmp_path: Path) -> None:
    """−1 states would leave all constants but the last out of the margin."""
    run = Forgery(runs / "basis", tmp_path / "run")
    run.data["domain"]["states"] = -1
    run.refused("states")


@pytest.mark.parametrize("kind", ["lifted", "constant"])
def test_the_remainder_errs_by_the_residuals_resolution_at_least(runs: Path, tmp_path: Path, kind: str) -> None:
    run = Forgery(runs / kind, tmp_path / "run")
    for name in ("resolution", "rounding"):
        run.arrays[name] = np.full(2, 0.05)
    run.refused("smaller resolution")


@pytest.mark.parametrize("kind", ["network", "basis"])
def test_extremes_of_coarse_cells_bound_constants_alone(runs: Path, tmp_path: Path, kind: str) -> None:
    """|r| of a sample that was dropped lies below the largest, and may still lie above γ where it was."""
    folder = tmp_path / "constant"
    options = {
        **GRID,
        "sampling": gc.GridSampling((16, 16, 12), cells=(4, 4, 3)),
        "lipschitz": Declared(VALUES),
        "family": Constant(),
    }
    gc.certify(Nothing(FIELD), FIELD, FIELD.domain, folder=folder, executor=threads, **options).save(folder)
    run = Forgery(folder, tmp_path / "run")
    assert run.failed() == []
    other = Forgery(runs / kind, tmp_path / "other")
    run.data["form"], run.arrays = other.data["form"], {**run.arrays, **other.arrays}
    run.refused("extremes")


def test_cells_in_another_order_than_their_cuts(runs: Path, tmp_path: Path) -> None:
    """A point that is sent back to an earlier cut would be looked up in a cell that does not hold it."""
    run = Forgery(runs / "cells", tmp_path / "run")
    child, m = run.arrays["cells.child"], len(run.arrays["cells.axis"])
    assert m > 2
    order = np.array([0, *range(m - 1, 0, -1)])
    run.arrays["cells.child"] = np.where(child >= 0, order[np.maximum(child, 0).astype(int)], child)[order]
    for name in ("cells.axis", "cells.cut"):
        run.arrays[name] = run.arrays[name][order]
    run.refused("no tree")


@pytest.mark.parametrize("kind", ["envelope", "multilinear"])
def test_remainders_within_the_resolution_are_not_free_to_choose(runs: Path, tmp_path: Path, kind: str) -> None:
    """2 e is spent on the sample and on the point that is asked: nothing is left for another remainder."""
    run = Forgery(runs / kind, tmp_path / "run")
    run.arrays["gap.g"] = run.arrays["gap.g"] - 0.5 * run.arrays["resolution"]
    run.refused("not r − p")


def test_figures_of_an_infinite_bound(runs: Path, tmp_path: Path) -> None:
    """Any number is as near to infinity as another."""
    run = Forgery(runs / "envelope", tmp_path / "run")
    run.arrays["predictor.slope"][:] = np.inf
    for state in run.data["states"].values():
        state["gamma_mean"] = state["gamma_max"] = 1e-3
    run.failed()
    assert any("infinite" in c["detail"] for c in verify_run(run.folder)["checks"])


def test_a_constant_over_a_model_is_told_to_be_trusted(tmp_path: Path) -> None:
    """Its supremum needs the model's ranges, and no model is run again."""
    options = {"lipschitz": Declared(VALUES), "family": Constant(), "predictor": Nothing(FIELD), "executor": threads}
    gc.certify(Nothing(FIELD), FIELD, FIELD.domain, folder=tmp_path, sampling=gc.AdaptiveSampling(100), **options).save(
        tmp_path
    )
    assert any("lies above the envelope between the samples as stated" in text for text in verify_run(tmp_path)["trusted"])


EDGES = {
    "short": lambda a: a * 0.9,
    "backwards": lambda a: a[::-1],
    "a gap": lambda a: np.array([a[0], np.nan, a[-1]]),
    "twice": lambda a: np.array([a[0], a[-1], a[-1]]),
}


@pytest.mark.parametrize("name", EDGES)
def test_tables_that_leave_something_out(runs: Path, tmp_path: Path, name: str) -> None:
    run = Forgery(runs / "lifted", tmp_path / "run")
    run.arrays["gap.edges0"] = EDGES[name](run.arrays["gap.edges0"])
    run.refused("do not tile")


def test_shifts_of_the_next_cell(runs: Path, tmp_path: Path) -> None:
    run = Forgery(runs / "lifted", tmp_path / "run")
    run.arrays["gap.shifts"] = np.roll(run.arrays["gap.shifts"], 1, axis=2)
    run.refused("was not proved")


@pytest.mark.parametrize("change", ["squares", "multipliers0.0", "q.W0"])
def test_a_constant_that_the_multipliers_do_not_prove(runs: Path, tmp_path: Path, change: str) -> None:
    """A hundredth less in L₁ is two in ρ; steeper weights ask for as much more."""
    run = Forgery(runs / "network", tmp_path / "run")
    by = {"squares": 0.98, "multipliers0.0": 1.5, "q.W0": 1.01}[change]
    run.arrays[f"gap.{change}"] = run.arrays[f"gap.{change}"] * by
    run.refused("no margin is enough")


def test_a_function_without_bounded_slopes(runs: Path, tmp_path: Path) -> None:
    """Of √(x0 + 1) the slope is unbounded at −1, where the domain begins: an infinite margin is not one of 0."""
    run = Forgery(runs / "basis", tmp_path / "run")
    run.data["form"]["functions"][1] = ["sqrt", ["+", ["axis", 0], 1.0]]
    run.refused("no margin is enough")


def test_a_network_form_that_holds_no_network_is_damage(runs: Path, tmp_path: Path) -> None:
    run = Forgery(runs / "network", tmp_path / "run")
    run.data["form"]["q"] = {"kind": "sum", "functions": [[]], "text": ["1"]}
    run.arrays["gap.q.weights"] = np.ones((2, 1))
    run.refused("network")
