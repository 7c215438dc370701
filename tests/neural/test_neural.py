"""Family neural: trained on the certified integral, proved, deterministic, resumable."""

from __future__ import annotations

import dataclasses
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import gapcert
import gapcert_functions
from gapcert.contracts.gaps.gap import GapFamily, GapProblem
from gapcert.contracts.plugins.events import Event
from gapcert_bounds.testing.contracts import GapFamilyContract
from gapcert_bounds.testing.fields import Waves, gap_problem
from gapcert_neural.banded import BandTraining, Pool
from gapcert_neural.family import Neural, _Units
from gapcert_neural.thresholds import THRESHOLDS
from gapcert_neural.training import Plan
from gapcert_verify.verify import verify_run

SPECS = Path(__file__).parents[2] / "specs"
OPTIONS = {"hidden": (16,), "steps": 60, "cells": (2, 2, 2), "boxes": 8_000}


def problem(**changes: object) -> GapProblem:
    return dataclasses.replace(gap_problem(Waves.smooth(), (6, 6, 6)), **changes)


class TestNeural(GapFamilyContract):
    def family(self) -> GapFamily:
        return Neural(**OPTIONS)


class TestDeepNeural(GapFamilyContract):
    def family(self) -> GapFamily:
        family = Neural(**{**OPTIONS, "hidden": (12, 8), "activation": "tanh", "predictor": "affine"})
        family.routes = ("dominate",)
        return family


class TestOneSideNeural(GapFamilyContract):
    def family(self) -> GapFamily:
        family = Neural(**OPTIONS, sides="one")
        family.routes = ("dominate",)
        return family


def test_one_network_for_the_bound_itself_holds_on_both_sides() -> None:
    field, asked = Waves.smooth(), problem()
    gap, z = Neural(**OPTIONS, sides="one").fit(asked), asked.domain.draw(5_000, np.random.default_rng(1))
    low, high = gap.sides
    assert np.array_equal(low(z), -high(z))
    lower, upper = gap.interval(z)
    assert (lower <= field(z)).all()
    assert (field(z) <= upper).all()
    assert gap.boxes.shape == (2, 2)


def test_route_theorem1_pays_for_its_own_constant() -> None:
    """Less than the constant bound, and more than without the margin that the cover asks for, which fails."""
    field = Waves.smooth()
    asked = gap_problem(field, (24, 24, 24), route="theorem1")
    z = asked.domain.draw(20_000, np.random.default_rng(1))
    gap = Neural(hidden=(48,), steps=500).fit(asked)
    constant = np.abs(asked.samples.r).max(axis=0) + asked.margin
    size = np.abs(field(z))
    assert (size <= gap.gamma(z)).all()
    assert (gap.gamma(z).mean(axis=0) < 0.9 * constant).all()
    short = (np.abs(asked.samples.r) - gap.q(asked.samples.z)).max(axis=0)
    assert (size > gap.q(z) + short).any()


@pytest.mark.exam
def test_the_published_recipe_keeps_to_its_constant() -> None:
    """Its log-determinant holds every network within the constant that it was given, and no band is below the truth."""
    field = Waves.smooth()
    asked = gap_problem(field, (16, 16, 16), route="theorem1")
    for constant in (0.05, 1.0):
        gap = Neural(hidden=(40,), steps=300, training="paper", lipschitz=constant, barrier=1e-4).fit(asked)
        assert (np.sqrt(gap.squares) <= constant * (1 + 1e-6)).all()
        z = asked.domain.draw(5_000, np.random.default_rng(1))
        assert (np.abs(field(z)) <= gap.gamma(z)).all()


def test_what_does_not_go_together_is_refused() -> None:
    asked = gap_problem(Waves.smooth(), (6, 6, 6))
    with pytest.raises(gapcert.UsageError, match="route theorem1"):
        Neural(**OPTIONS, training="paper").fit(asked)
    with pytest.raises(gapcert.UsageError, match=r"gap\.cells: found \[2, 2\]; expected 3 numbers"):
        Neural(**{**OPTIONS, "cells": (2, 2)}).fit(asked)
    covered = gap_problem(Waves.smooth(), (6, 6, 6), route="theorem1")
    with pytest.raises(
        gapcert.UsageError, match=r"gap\.lipschitz: found \[1\.0, 1\.0, 1\.0\]; expected one number, or one for each of 2"
    ):
        Neural(hidden=(8,), training="paper", lipschitz=(1.0, 1.0, 1.0)).fit(covered)
    with pytest.raises(gapcert.UsageError, match="one on route theorem1"):
        Neural(**{**OPTIONS, "hidden": (8, 8)}).fit(covered)


@pytest.mark.exam
def test_training_pays() -> None:
    """The band of a trained network is tighter than that of one that was only drawn, and than a constant."""
    asked = gap_problem(Waves.smooth(), (9, 9, 9))
    z = asked.domain.draw(5_000, np.random.default_rng(1))
    mean = {
        steps: Neural(hidden=(48,), steps=steps, cells=(4, 4, 4), boxes=60_000).fit(asked).gamma(z).mean(axis=0)
        for steps in (1, 600)
    }
    best = gapcert_functions.band(asked).gamma(z).mean(axis=0)
    top, _ = gapcert.plugin.supremum(gapcert_functions.band(asked), asked.domain)
    assert (mean[600] < 1.15 * best).all()
    assert (mean[600] < 0.8 * mean[1]).all()
    assert (mean[600] < top).all()


def test_another_seed_trains_another_network() -> None:
    first, second = (Neural(**OPTIONS).fit(problem(seed=s)).arrays() for s in (0, 1))
    assert not np.array_equal(first["upper.W0"], second["upper.W0"])


def test_interrupted_training_resumes_to_the_same_bits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gapcert_neural.training.THRESHOLDS", replace(THRESHOLDS, checkpoint_seconds=0.0))
    monkeypatch.setattr("gapcert.contracts.plugins.events.BEAT", 0.0)
    whole = Neural(**OPTIONS).fit(problem()).arrays()

    def stopping(event: Event) -> None:
        if event.stage == "training" and event.data["done"] >= 30:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Neural(**OPTIONS).fit(problem(emit=stopping, folder=tmp_path))
    with np.load(tmp_path / "training.npz") as stored:
        assert 30 <= int(stored["numbers"][0]) < 60
    resumed: list[int] = []

    def watching(event: Event) -> None:
        if event.stage == "training":
            resumed.append(event.data["done"])

    again = Neural(**OPTIONS).fit(problem(emit=watching, folder=tmp_path)).arrays()
    assert min(resumed) > 30
    assert all(np.array_equal(whole[k], again[k]) for k in whole)


def test_a_checkpoint_of_another_problem_is_not_used(tmp_path: Path) -> None:
    Neural(**OPTIONS).fit(problem(folder=tmp_path))
    other = problem(seed=1)
    assert np.array_equal(
        Neural(**OPTIONS).fit(dataclasses.replace(other, folder=tmp_path)).arrays()["upper.W0"],
        Neural(**OPTIONS).fit(other).arrays()["upper.W0"],
    )


def test_a_checkpoint_of_another_device_is_not_used() -> None:
    """A GPU rounds otherwise: what one began, the other would not end with the bits of either."""
    one, other = (BandTraining(Plan((4,), "relu", 5, 0, "auto"), Pool(*_few()), None, lambda *_: None) for _ in range(2))
    assert one._digest() == other._digest()
    other.__dict__["device"] = "another"
    assert one._digest() != other._digest()


def _few() -> tuple[np.ndarray, ...]:
    return np.zeros((3, 2)), np.zeros((3, 1)), np.ones(1), np.array([0, 3])


def test_on_the_cpu_nobody_asks_for_a_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    import torch

    def asked() -> bool:
        raise AssertionError("device: cpu looks for a GPU")

    monkeypatch.setattr(torch.cuda, "is_available", asked)
    assert np.isfinite(Neural(**OPTIONS, device="cpu").fit(problem()).arrays()["upper.W0"]).all()


def test_a_gpu_that_is_not_there_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    import torch

    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(gapcert.UsageError, match=r"gap\.device: found cuda, and PyTorch sees no GPU.*set device: auto or cpu"):
        Neural(**OPTIONS, device="cuda").fit(problem())


def test_training_ends_early_where_nothing_improves() -> None:
    steps: list[int] = []
    flat = gap_problem(Waves(np.zeros((2, 3)), np.ones((2, 3)), np.zeros((2, 3)), offset=0.5), (3, 3, 3))

    def watching(event: Event) -> None:
        if event.stage == "training":
            steps.append(event.data["done"])

    Neural(**{**OPTIONS, "steps": 4000}).fit(dataclasses.replace(flat, emit=watching))
    assert max(steps) < 4000


def test_batches_stay_in_their_cells() -> None:
    rng = np.random.default_rng(0)
    z, cell = rng.random((500, 2)), rng.integers(0, 7, 500)
    pool = Pool.sorted(z, z, np.ones(2), cell)
    rows = pool.batch(np.random.default_rng(1))
    owner = np.searchsorted(pool.starts, rows, side="right")
    assert (owner == owner[:, :1]).all()
    assert len(np.unique(owner[:, 0])) == len(rows) == 7


@pytest.mark.contract
@pytest.mark.parametrize("route", ["dominate", "theorem1"])
def test_a_spec_names_it(tmp_path: Path, route: str) -> None:
    """From a spec file to a certificate that `verify` proves again, shifts included."""
    overrides = [
        "controller=null",
        "closed_loop=null",
        "expect=null",
        "report.html=false",
        "report.rerun=false",
        "report.beside=[]",
    ]
    if route == "dominate":
        overrides += ["gap={kind: neural, hidden: [16], steps: 50, boxes: 4000, cells: [2, 2, 2], predictor: affine}"]
    else:
        overrides += ["gap={kind: neural, hidden: [16], steps: 50}", "certificate.route=theorem1"]
        overrides += ["sampling={kind: grid, counts: {theta: 12, omega: 12, torque: 12}}"]
    run = gapcert.run(SPECS / "pendulum.yaml", overrides=[*overrides, "certificate.attack=2000"], out=tmp_path)
    summary = run.summary["certificate"]
    assert summary["family"] == "neural"
    assert summary["route"] == route
    assert summary["attack"]["violations"] == 0
    found = verify_run(run.folder)
    assert found["verdict"] == "holds", [c for c in found["checks"] if not c["passed"]]


def test_a_network_in_units_of_its_training_is_the_same_in_those_of_the_problem():
    rng = np.random.default_rng(4)
    low, high, targets = np.array([1.0, -3.0]), np.array([2.0, 5.0]), rng.normal(3, 2, (50, 1))
    units, w, v = _Units.of(low, high, targets, 1), rng.normal(size=(4, 2)), rng.normal(size=(1, 4))
    (first, b), (last, c) = units.restored([(w, np.ones(4)), (v, np.zeros(1))])
    z = rng.uniform(low, high, (20, 2))
    trained = np.maximum(units.inputs(z) @ w.T + 1.0, 0.0) @ v.T
    assert units.outputs(np.maximum(z @ first.T + b, 0.0) @ last.T + c) == pytest.approx(trained, rel=1e-9, abs=1e-9)
