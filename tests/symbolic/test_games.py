"""Goals beyond invariance and reach-avoid against textbook fixpoints on explicit transitions, and controllers for them."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from gapcert import Box, Domain, Ellipsoid, Goal, Interval, Model, Polytope, Region, SynthesisProblem, closed_loop
from gapcert.plugin import Relation
from gapcert.testing.toys import Drift
from gapcert_cells import GridController
from gapcert_cells.testing import Band, Rod, rod_problem
from gapcert_symbolic.cells.bounds import Enclosed
from gapcert_symbolic.cells.grid import Grid
from gapcert_symbolic.synthesizer import Symbolic

Cell = tuple[int, ...]


class Explicit:
    """All transitions of a uniform grid in pure Python, and fixpoints over sets of cells."""

    def __init__(self, problem: SynthesisProblem, counts: tuple[int, ...], inputs: tuple[int, ...]) -> None:
        stay, u = problem.goal.stay, problem.domain.inputs
        self.goal = problem.goal
        self.edges = [np.linspace(a, b, n + 1).tolist() for a, b, n in zip(stay.low, stay.high, counts, strict=True)]
        points = list(itertools.product(*(np.linspace(*r) for r in zip(u.low, u.high, inputs, strict=True))))
        self.cells: list[Cell] = list(itertools.product(*(range(n) for n in counts)))
        self.post: dict[Cell, list[frozenset[Cell] | None]] = {}
        for cell in self.cells:
            low, high = (np.repeat([end], len(points), axis=0) for end in self.ends(cell))
            box = Enclosed(problem.model).over(low, high, np.array(points))
            if problem.gap is not None:
                v = np.array(points)
                box = box + problem.gap.interval_over(Interval(np.hstack([low, v]), np.hstack([high, v])))
            self.post[cell] = [self.touched(a, b) for a, b in zip(box.lo.tolist(), box.hi.tolist(), strict=True)]

    def ends(self, cell: Cell) -> tuple[list[float], list[float]]:
        return [e[i] for e, i in zip(self.edges, cell, strict=True)], [e[i + 1] for e, i in zip(self.edges, cell, strict=True)]

    def touched(self, low: list[float], high: list[float]) -> frozenset[Cell] | None:
        touched = []
        for edges, a, b in zip(self.edges, low, high, strict=True):
            pad = 1e-10 * (edges[1] - edges[0])
            if a - pad < edges[0] or b + pad > edges[-1]:
                return None
            touched.append([i for i in range(len(edges) - 1) if a - pad <= edges[i + 1] and b + pad >= edges[i]])
        return frozenset(itertools.product(*touched))

    def marked(self, region: Region | None, whole: bool) -> set[Cell]:
        found = set()
        for cell, box in itertools.product(self.cells, region.boxes if region else ()):
            low, high = self.ends(cell)
            sides = zip(low, high, box.low, box.high, strict=True)
            if all((a >= c and b <= d) if whole else (a <= d and b >= c) for a, b, c, d in sides):
                found.add(cell)
        return found

    def valid(self, cell: Cell, good: set[Cell]) -> list[int]:
        return [j for j, after in enumerate(self.post[cell]) if after is not None and after <= good]

    def reach(self, safe: set[Cell], values: dict[Cell, int]) -> tuple[dict[Cell, int], dict[Cell, list[int]]]:
        values, valid = dict(values), {}
        for level in itertools.count(1):
            found = {c: v for c in safe - set(values) if (v := self.valid(c, set(values)))}
            if not found:
                return values, valid
            values.update(dict.fromkeys(found, level))
            valid.update(found)
        raise AssertionError

    def stay(self, safe: set[Cell], target: set[Cell]) -> tuple[dict[Cell, int], dict[Cell, list[int]]]:
        values, valid = dict[Cell, int](), dict[Cell, list[int]]()
        while True:
            fresh, won = target - set(values), set(values)
            while (fewer := {c for c in fresh if self.valid(c, fresh | won)}) != fresh:
                fresh = fewer
            if not fresh:
                return values, valid
            level = max(values.values(), default=-1) + 1
            way, more = self.reach(safe, dict.fromkeys(fresh | won, 0))
            valid |= {c: self.valid(c, fresh | won) for c in fresh} | more
            values |= dict.fromkeys(fresh, level) | {c: level + v for c, v in way.items() if v}

    def solve(self) -> tuple[dict[Cell, int], dict[Cell, list[int]]]:
        safe = set(self.cells) - self.marked(self.goal.avoid, whole=False)
        target = self.marked(self.goal.target, whole=True) & safe
        if self.goal.kind == "reach_and_stay":
            return self.stay(safe, target)
        z = set(self.cells)
        while True:
            values, valid = self.reach(safe, dict.fromkeys((c for c in target if self.valid(c, z)), 0))
            if set(values) == z:
                return values, valid | {c: self.valid(c, z) for c in values if values[c] == 0}
            z = set(values)


def agrees(problem: SynthesisProblem, cells: dict[str, int], inputs: dict[str, int]) -> GridController:
    controller = Symbolic(cells, inputs).synthesize(problem)
    values, valid = Explicit(problem, tuple(cells.values()), tuple(inputs.values())).solve()
    allowed = controller.allowed(np.arange(len(controller.values)))
    for flat, cell in enumerate(np.ndindex(*controller.counts)):
        assert controller.values[flat] == values.get(cell, -1)
        assert np.flatnonzero(allowed[flat]).tolist() == valid.get(cell, [])
    return controller


def box(model: Model, low: tuple[float, ...], high: tuple[float, ...]) -> Box:
    return Box(model.states, low, high)


def rod_goal(kind: Any) -> Goal:
    rod = Rod()
    target = Region((box(rod, (0.0, -0.12), (0.12, 0.12)), box(rod, (-0.2, -0.25), (-0.15, 0.25))))
    return Goal(kind, box(rod, (-0.2, -0.25), (0.2, 0.25)), target, Region((box(rod, (-0.12, 0.2), (-0.05, 0.25)),)))


@pytest.mark.exam
@pytest.mark.parametrize("gap", [None, Band((-5e-4, -2e-3), (2e-4, 2e-3))])
@pytest.mark.parametrize("kind", ["reach_and_stay", "recurrence"])
def test_rod_equals_the_fixpoints(kind: str, gap: Any) -> None:
    problem = replace(rod_problem(rod_goal(kind), gap), model=Rod(0.03))
    controller = agrees(problem, {"theta": 32, "omega": 24}, {"torque": 7})
    assert 0 < controller.evidence["winning_cells"] < 32 * 24
    # Some cells of the target can neither be kept nor left for another visit.
    target = Grid(problem.goal.stay, (32, 24)).inside(problem.goal.target)
    assert (controller.values[target] != 0).any()


@pytest.mark.exam
@pytest.mark.parametrize("kind", ["reach_and_stay", "recurrence"])
@pytest.mark.parametrize(("n", "cells"), [(1, 20), (2, 11), (3, 9)])
def test_every_dimension_equals_the_fixpoints(kind: Any, n: int, cells: int) -> None:
    model = Drift(n)
    names = [f"x{i}" for i in range(n)]
    domain = Domain.of(model, dict.fromkeys(names, (0.0, 1.0)) | {f"u{i}": (-1.0, 1.0) for i in range(n)})
    target = Region((box(model, (0.55,) * n, (0.97,) * n),))
    avoid = Region((box(model, (0.1,) * n, (0.12,) * n),))
    problem = SynthesisProblem(model, Band((-0.01,) * n, (0.02,) * n), domain, Goal(kind, domain.states, target, avoid))
    controller = agrees(problem, dict.fromkeys(names, cells), {f"u{i}": 3 if n < 3 else 2 for i in range(n)})
    assert controller.evidence["winning_cells"] > 0


def walled() -> SynthesisProblem:
    """Only at full speed to the right, with what is beyond x = 1 out of bounds: a target there is met once and never again."""
    model = Drift(1)
    domain = Domain.of(model, {"x0": (0.0, 1.0), "u0": (0.2, 1.0)})
    target = Region((box(model, (0.8,), (1.0,)),))
    return SynthesisProblem(model, None, domain, Goal("recurrence", domain.states, target))


@pytest.mark.parametrize("kind", ["reach_and_stay", "recurrence"])
def test_what_is_met_only_once_does_not_win(kind: Any) -> None:
    problem = walled()
    counts = {"x0": 40}, {"u0": 3}
    once = Symbolic(*counts).synthesize(replace(problem, goal=replace(problem.goal, kind="reach_avoid")))
    often = Symbolic(*counts).synthesize(replace(problem, goal=replace(problem.goal, kind=kind)))
    assert once.evidence["winning_cells"] > 10
    assert often.evidence["winning_cells"] == 0
    assert "the inputs are too weak" in often.evidence["reason"], "whoever has come cannot stay"


def test_runs_come_to_stay_and_visit_again() -> None:
    model = Rod(0.03)
    for kind in ("reach_and_stay", "recurrence"):
        problem = replace(rod_problem(rod_goal(kind)), model=model)
        controller = Symbolic({"theta": 40, "omega": 40}, {"torque": 7}).synthesize(problem)
        x = controller.draw(50, np.random.default_rng(0))
        for policy in ("first", "last", "random"):
            trace = closed_loop(model, controller, x, 150, policy)
            assert not trace.violation.any()
            assert not trace.reached.any()
            assert (trace.counted > 3).all()
            if kind == "reach_and_stay":
                last = trace.x[np.arange(50), -1]
                assert problem.goal.visited(last).all()


def test_leaving_what_was_to_be_kept_is_a_violation() -> None:
    model = Drift(1)
    domain = Domain.of(model, {"x0": (0.0, 1.0), "u0": (-1.0, 1.0)})
    goal = Goal("reach_and_stay", domain.states, Region((box(model, (0.5,), (1.0,)),)))
    controller = Symbolic({"x0": 20}, {"u0": 5}).synthesize(SynthesisProblem(model, None, domain, goal))
    # The same controller with every input allowed in the target: some lead out of it, though not out of its domain.
    freed = replace(controller, bits=np.where(controller.values[:, None] == 0, np.uint8(0xF8), controller.bits))
    x = np.array([[0.1], [0.55], [0.9]])
    assert not closed_loop(model, controller, x, 40, "first").violation.any()
    assert closed_loop(model, freed, x, 40, "first").stranded.all()


def sampled(low: np.ndarray, high: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Corners and points of cells (n, 60, nx)."""
    share = rng.random((len(low), 60, low.shape[1]))
    share[:, :30] = np.round(share[:, :30])
    return low[:, None] + (high - low)[:, None] * share


SHAPES = [
    Region(ellipsoids=(Ellipsoid(box(Drift(2), (0.1, 0.1), (0.9, 0.9)), (0, 1), (0.5, 0.45), ((12.0, -7.0), (-7.0, 9.0))),)),
    Region(ellipsoids=(Ellipsoid.of(box(Drift(2), (0.0, 0.0), (1.0, 1.0)), {"x1": 0.51}, {"x1": 0.2}),)),
    Region(
        polytopes=(
            Polytope(box(Drift(2), (0.1, 0.1), (0.9, 0.8)), (Relation("", (1.0, 2.0), 1.47), Relation("", (-1.0, 1.0), 0.19))),
        )
    ),
]


@pytest.mark.parametrize("region", SHAPES)
def test_shapes_shrink_as_targets_and_grow_as_obstacles(region: Region) -> None:
    grid = Grid(box(Drift(2), (0.0, 0.0), (1.0, 1.0)), (40, 40))
    low, high = grid.cells(0, grid.size)
    x = sampled(low, high, np.random.default_rng(0))
    within = region.contains(x.reshape(-1, 2)).reshape(len(low), -1)
    whole, some = grid.inside(region), grid.touching(region)
    assert within[whole].all()
    assert not within[~some].any()
    # Exact up to the cells whose border is met between the samples.
    assert (within.all(axis=1) & ~whole).sum() <= 3
    assert (some & ~within.any(axis=1)).sum() <= 12
    assert 20 < whole.sum() < some.sum() < 1500


def test_a_cell_that_ends_at_the_border_is_not_trusted_to_be_inside_when_that_depends_on_rounding() -> None:
    square = box(Drift(2), (0.0, 0.0), (1.0, 1.0))
    grid = Grid(square, (8, 8))
    half = Region(polytopes=(Polytope(square, (Relation("", (0.1, 0.0), 0.05),)),))
    assert grid.inside(half).reshape(8, 8)[:, 0].tolist() == [True] * 3 + [False] * 5
    assert grid.touching(half).reshape(8, 8)[:, 0].tolist() == [True] * 5 + [False] * 3
    more = Region(polytopes=(Polytope(square, (Relation("", (0.1, 0.0), 0.05 + 1e-15),)),))
    assert grid.inside(more).reshape(8, 8)[:, 0].tolist() == [True] * 4 + [False] * 4


def test_shapes_over_an_angle_count_modulo_a_turn() -> None:
    rod = Rod()
    grid = Grid(box(rod, (-np.pi, -1.0), (np.pi, 1.0)), (32, 8))
    frame = box(rod, (-np.pi, -1.0), (np.pi, 1.0))
    ball = Region(ellipsoids=(Ellipsoid.of(frame, {"theta": np.pi, "omega": 0.0}, {"theta": 0.8, "omega": 0.7}),))
    low, high = grid.cells(0, grid.size)
    x = sampled(low, high, np.random.default_rng(1))
    within = ball.contains(x.reshape(-1, 2)).reshape(len(low), -1)
    whole, some = grid.inside(ball), grid.touching(ball)
    assert within[whole].all()
    assert not within[~some].any()
    rows = whole.reshape(32, 8).any(axis=1)
    assert rows[0]
    assert rows[-1]
    assert not rows[16]


def test_recurrence_with_an_ellipsoid_for_a_target_and_a_polytope_to_avoid() -> None:
    model = Drift(2)
    domain = Domain.of(model, {"x0": (0.0, 1.0), "x1": (0.0, 1.0), "u0": (-1.0, 1.0), "u1": (-1.0, 1.0)})
    target = Region(ellipsoids=(Ellipsoid.of(domain.states, {"x0": 0.7, "x1": 0.7}, {"x0": 0.2, "x1": 0.2}),))
    avoid = Region(polytopes=(Polytope(domain.states, (Relation("", (1.0, 1.0), 0.5),)),))
    problem = SynthesisProblem(model, None, domain, Goal("recurrence", domain.states, target, avoid))
    controller = Symbolic({"x0": 25, "x1": 25}, {"u0": 5, "u1": 5}).synthesize(problem)
    x = controller.draw(40, np.random.default_rng(3))
    assert (x.sum(axis=1) > 0.5).all()
    trace = closed_loop(model, controller, x, 60, "random")
    assert not trace.violation.any()
    assert (trace.counted > 10).all()
