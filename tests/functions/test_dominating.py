"""FitRoute dominate: any function, lifted above the envelope of samples and constants, and proved to stay there."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from certified import certified_waves
from forging import edit_arrays, failed

import gapcert
import gapcert_functions
from gapcert.contracts.gaps.gap import FitRoute, GapFamily, GapFunction, GapProblem
from gapcert.contracts.gaps.lipschitz import LipschitzBound
from gapcert.contracts.plugins.events import Event
from gapcert.numerics.constraint_zone import Relation, Zone
from gapcert.numerics.intervals import Interval
from gapcert_bounds.testing.contracts import GapFamilyContract
from gapcert_bounds.testing.fields import Waves, gap_problem
from gapcert_functions.dominating import dominate
from gapcert_functions.lifting import Cones, Side, Table, lift
from gapcert_networks.network import Network
from gapcert_verify.verify import verify_run

Array = np.ndarray


def network(nz: int, nx: int, hidden: tuple[int, ...] = (16, 16), seed: int = 0, activation: str = "relu") -> Network:
    """Random weights: a proof does not ask how a function was found."""
    rng = np.random.default_rng(seed)
    sizes = (nz, *hidden, nx)
    weights = tuple(rng.standard_normal((b, a)) / np.sqrt(a) for a, b in itertools.pairwise(sizes))
    return Network(weights, tuple(0.3 * rng.standard_normal(len(w)) for w in weights), activation)


class Drawn(GapFamily):
    """A family that takes any two networks."""

    name = "drawn"
    routes: tuple[FitRoute, ...] = ("dominate",)

    def __init__(self, counts: int = 2, predictor: str = "none", budget: int = 20_000) -> None:
        self.counts, self.predictor, self.budget = counts, predictor, budget

    def fit(self, problem: GapProblem) -> GapFunction:
        nz, nx = len(problem.domain.low), problem.domain.nx
        sides = network(nz, nx, seed=1, activation="tanh"), network(nz, nx, seed=2)
        return dominate(problem, self.name, *sides, counts=(self.counts,) * nz, budget=self.budget)


class TestDrawn(GapFamilyContract):
    def family(self) -> GapFamily:
        return Drawn()


class TestDrawnOverAnAffinePart(GapFamilyContract):
    def family(self) -> GapFamily:
        return Drawn(predictor="affine")


def banded(problem: GapProblem, z: Array) -> tuple[Array, Array]:
    return gapcert_functions.band(problem).interval(z)


def scattered(problem: GapProblem) -> GapProblem:
    """The same samples as no lattice: the band is then the envelope."""
    return dataclasses.replace(problem, samples=dataclasses.replace(problem.samples, lattice=None))


@pytest.mark.exam
@pytest.mark.parametrize("kind", ["envelope", "multilinear"])
@pytest.mark.parametrize("seed", range(4))
def test_contains_the_band_everywhere(seed: int, kind: str) -> None:
    problem = gap_problem(Waves.smooth(), (7, 7, 7), affine=bool(seed % 2))
    problem = problem if kind == "multilinear" else scattered(problem)
    assert gapcert_functions.band(problem).family == kind
    sides = network(3, 2, seed=seed), network(3, 2, (40,), seed=seed + 9, activation="softplus")
    gap = dominate(problem, "drawn", *sides, counts=(3, 1, 2))
    z = problem.domain.draw(40_000, np.random.default_rng(seed))
    (low, high), (lower, upper) = gap.interval(z), banded(problem, z)
    assert (low <= lower).all()
    assert (upper <= high).all()


def test_shifts_are_nearly_the_smallest() -> None:
    problem = gap_problem(Waves.smooth(), (7, 7, 7))
    gap = dominate(problem, "drawn", network(3, 2, seed=3), network(3, 2, seed=4), counts=(2, 2, 2), tolerance=0.01)
    z, boxes = problem.domain.draw(100_000, np.random.default_rng(0)), gap.table.boxes
    # Many differences are largest on the border of a cell.
    sides = np.random.default_rng(1).integers(0, 2, (len(z), 3))
    cell, free = gap.table.locate(z), np.random.default_rng(2).random(z.shape) < 0.4
    z = np.where(free, z, np.where(sides == 1, boxes.hi[cell], np.nextafter(boxes.lo[cell], np.inf)))
    slack = np.abs(problem.samples.r).mean(axis=0)
    (low, high), (lower, upper) = gap.interval(z), banded(problem, z)
    for c in range(len(gap.table)):
        assert ((high - upper)[cell == c].min(axis=0) < 0.1 * slack).all()
        assert ((lower - low)[cell == c].min(axis=0) < 0.1 * slack).all()


def test_without_the_cones_part_it_fails() -> None:
    """What the samples alone say is not enough: with constants of 0 the truth escapes between them."""
    field = Waves.smooth()
    problem = scattered(gap_problem(field, (7, 7, 7)))
    bare = LipschitzBound(0 * problem.lipschitz.value, 0 * problem.lipschitz.lower, "declared", "declared")
    z = problem.domain.draw(20_000, np.random.default_rng(0))
    for bound, holds in ((problem.lipschitz, True), (bare, False)):
        gap = Drawn().fit(dataclasses.replace(problem, lipschitz=bound))
        low, high = gap.interval(z)
        inside = (low <= field(z)) & (field(z) <= high)
        assert inside.all() == holds


def test_a_small_budget_loosens_and_still_proves() -> None:
    problem = gap_problem(Waves.smooth(), (7, 7, 7))
    z = problem.domain.draw(20_000, np.random.default_rng(0))
    gaps = [Drawn(budget=n).fit(problem).interval(z) for n in (8, 400, 20_000)]
    width = [float((high - low).mean()) for low, high in gaps]
    assert width[0] > width[1] > width[2]
    lower, upper = banded(problem, z)
    for low, high in gaps:
        assert ((low <= lower) & (upper <= high)).all()


def test_a_budget_that_ends_is_told() -> None:
    told: list[str] = []

    def hear(event: Event) -> None:
        if event.name == "warning":
            told.append(event.data["message"])

    asked = dataclasses.replace(gap_problem(Waves.smooth(), (7, 7, 7)), emit=hear)
    Drawn(budget=40).fit(asked)
    assert len(told) == 1
    assert "ended at 40 boxes" in told[0]
    Drawn(budget=100_000).fit(asked)
    assert len(told) == 1


def test_known_shifts_are_proved_or_not() -> None:
    problem = gap_problem(Waves.smooth(), (6, 6, 6))
    side = Side(
        [Cones(problem.domain.interval, problem.samples.z, problem.remainder[:, 0], problem.lipschitz.value[0], 1e-9)],
        network(3, 2),
        0,
        1,
    )
    table = Table.uniform((-1, -1, -1), (1, 1, 1), (2, 2, 2))
    found = lift(side, table, problem.domain.zone, 1e-3, 50_000).shift
    again = lift(side, table, problem.domain.zone, 0.0, 400_000, found + 1e-12)
    assert (again.shift <= found + 1e-12).all()
    lower = found - np.array([0.05, 0, 0, 0, 0, 0, 0, 0])
    refused = lift(side, table, problem.domain.zone, 0.0, 20_000, lower)
    assert refused.shift[0] > lower[0]


def test_cells_that_a_relation_cuts_off_cost_nothing() -> None:
    zone = Zone((-1.0, -1.0), (1.0, 1.0), (Relation("a + b <= -0.5", (1.0, 1.0), -0.5),))
    z = zone.draw(40, np.random.default_rng(0))
    side = Side(
        [Cones(Interval(np.full((1, 2), -1.0), np.ones((1, 2))), z, z.sum(axis=1), np.ones(2), 0.0)], network(2, 1), 0, 1
    )
    table = Table.uniform(zone.low, zone.high, (4, 4))
    free, cut = lift(side, table, Zone(zone.low, zone.high), 1e-2, 4000), lift(side, table, zone, 1e-2, 4000)
    assert cut.boxes < free.boxes
    fresh = zone.draw(5000, np.random.default_rng(1))
    t = (side.parts[0].g + np.abs(fresh[:, None] - z).sum(axis=2)).min(axis=1)
    assert (network(2, 1)(fresh)[:, 0] + cut.shift[table.locate(fresh)] >= t).all()
    assert np.isfinite(cut.shift).all()


def test_a_saved_one_is_proved_again(tmp_path: Path) -> None:
    assert certified_waves(tmp_path, Drawn(), gapcert.AdaptiveSampling(400)).holds
    found = verify_run(tmp_path)
    assert found["verdict"] == "holds", [c for c in found["checks"] if not c["passed"]]


@pytest.mark.exam
@pytest.mark.parametrize(
    "change",
    [
        {"gap.shifts": lambda a: a - 0.05},
        {"gap.upper.b2": lambda a: a - 0.05},
        {"gap.lower.W0": lambda a: 1.2 * a},
        {"gap.edges0": lambda a: a * 0.9},
        {"gap.shifts": lambda a: a[:, :, :-1]},
    ],
    ids=["shifts", "bias", "weights", "edges", "shape"],
)
def test_forged_functions_are_found(tmp_path: Path, change: Mapping[str, Any]) -> None:
    certified_waves(tmp_path, Drawn(), gapcert.AdaptiveSampling(400))
    edit_arrays(tmp_path, **change)
    assert "the stored function is the one that samples and constants give" in failed(tmp_path)


def test_boxes_hold_where_sides_cross() -> None:
    """Constants that samples refute make the sides cross; what is said of a box still contains what is said of its points."""
    problem = scattered(gap_problem(Waves.smooth(), (7, 7, 7)))
    tiny = LipschitzBound(1e-3 * problem.lipschitz.value, 0 * problem.lipschitz.lower, "declared", "declared")
    gap = Drawn().fit(dataclasses.replace(problem, lipschitz=tiny))
    low = problem.domain.draw(200, np.random.default_rng(0))
    boxes = Interval(low, np.minimum(low + 0.05, 1.0))
    crossed = 0
    for share in (0.0, 0.3, 1.0):
        z = np.clip(boxes.lo + share * (boxes.hi - boxes.lo), boxes.lo, boxes.hi)
        ends, (lower, upper), over = gap.ends(z), gap.interval(z), gap.interval_over(boxes)
        crossed += int((ends[0] > ends[1]).sum())
        assert ((over.lo <= lower) & (upper <= over.hi)).all()
    assert crossed
