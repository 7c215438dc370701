"""The synthesizer `symbolic` against a slow textbook twin, its answers to bad input, and its reasons when nothing wins."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from gapcert import (
    Box,
    Domain,
    Event,
    GapFunction,
    Goal,
    Interval,
    Model,
    Region,
    StateSpec,
    SynthesisProblem,
    UsageError,
    load_spec,
    registry,
)
from gapcert.testing.toys import Drift
from gapcert_cells import GridController
from gapcert_cells.testing import Band, Rod, rod_problem, rod_reach_avoid
from gapcert_symbolic.cells.bounds import Enclosed
from gapcert_symbolic.cells.grid import Grid, share
from gapcert_symbolic.config import SymbolicConfig
from gapcert_symbolic.synthesizer import Symbolic

TURN = 2 * np.pi
TURNED = {
    "version": 1,
    "name": "turned",
    "model": {
        "kind": "equations",
        "states": {"omega": "rad/s", "phase": 1, "theta": {"unit": "rad", "kind": "angle"}},
        "inputs": {"torque": "N*m"},
        "parameters": {"tau": "0.2 s", "w": "1 rad/s", "j": "1 kg*m^2"},
        "next": {
            "omega": "0.8*omega + tau*(torque/j - 2*w*sin(theta)/tau*0.1)",
            "phase": "0.5*phase + 0.2*sin(theta) + 0.05*omega/w",
            "theta": "theta + tau*omega + 0.1*phase",
        },
        "period": "0.2 s",
    },
}


class Twin:
    """The textbook fixpoints: sets of cells in pure Python, one enclosure per cell and input, cells by comparison of edges."""

    def __init__(self, problem: SynthesisProblem, counts: tuple[int, ...], inputs: tuple[int, ...]) -> None:
        self.problem, self.stay = problem, problem.goal.stay
        self.edges = [np.linspace(a, b, n + 1) for a, b, n in zip(self.stay.low, self.stay.high, counts, strict=True)]
        u = problem.domain.inputs
        self.inputs = list(itertools.product(*(np.linspace(*r) for r in zip(u.low, u.high, inputs, strict=True))))
        self.cells = list(itertools.product(*(range(n) for n in counts)))
        pairs = list(itertools.product(self.cells, range(len(self.inputs))))
        low = np.array([[e[i] for e, i in zip(self.edges, c, strict=True)] for c, _ in pairs])
        high = np.array([[e[i + 1] for e, i in zip(self.edges, c, strict=True)] for c, _ in pairs])
        values = np.array([self.inputs[j] for _, j in pairs])
        box = Enclosed(problem.model).over(low, high, values)
        if problem.gap is not None:
            box = box + problem.gap.interval_over(Interval(np.hstack([low, values]), np.hstack([high, values])))
        self.post = {p: self.touched(a, b) for p, a, b in zip(pairs, box.lo.tolist(), box.hi.tolist(), strict=True)}

    def touched(self, low: list[float], high: list[float]) -> set[tuple[int, ...]] | None:
        """Cells that the closed successor box touches; None where it may leave the grid."""
        touched = []
        for axis, edges, a, b in zip(self.stay.axes, self.edges, low, high, strict=True):
            ends, pad = edges.tolist(), 1e-10 * (edges[1] - edges[0])
            a, b, wraps = a - pad, b + pad, axis.kind == "angle" and ends[-1] - ends[0] >= TURN
            if not wraps and (a < ends[0] or b > ends[-1]):
                return None
            turns = (-TURN, 0.0, TURN) if wraps else (0.0,)
            cells = range(len(ends) - 1)
            touched.append([i for i in cells if any(a + t <= ends[i + 1] and b + t >= ends[i] for t in turns)])
        return set(itertools.product(*touched))

    def marked(self, region: Region | None, inside: bool) -> set[tuple[int, ...]]:
        found = set()
        for cell, box in itertools.product(self.cells, region.boxes if region else ()):
            ends = [(e[i], e[i + 1]) for e, i in zip(self.edges, cell, strict=True)]
            if inside:
                ok = all(a >= low and b <= high for (a, b), low, high in zip(ends, box.low, box.high, strict=True))
            else:
                ok = all(a <= high and b >= low for (a, b), low, high in zip(ends, box.low, box.high, strict=True))
            if ok:
                found.add(cell)
        return found

    def valid(self, cell: tuple[int, ...], good: set[tuple[int, ...]]) -> list[int]:
        return [j for j in range(len(self.inputs)) if (p := self.post[cell, j]) is not None and p <= good]

    def solve(self) -> tuple[dict[tuple[int, ...], int], dict[tuple[int, ...], list[int]]]:
        """Values and all valid inputs of the winning cells."""
        safe = set(self.cells) - self.marked(self.problem.goal.avoid, inside=False)
        if self.problem.goal.kind == "invariance":
            while (fewer := {c for c in safe if self.valid(c, safe)}) != safe:
                safe = fewer
            return dict.fromkeys(safe, 0), {c: self.valid(c, safe) for c in safe}
        target = self.marked(self.problem.goal.target, inside=True) & safe
        values, valid = dict.fromkeys(target, 0), {c: list(range(len(self.inputs))) for c in target}
        for level in itertools.count(1):
            found = {c: v for c in safe - set(values) if (v := self.valid(c, set(values)))}
            if not found:
                return values, valid
            values.update(dict.fromkeys(found, level))
            valid.update(found)
        raise AssertionError


def agrees(problem: SynthesisProblem, cells: dict[str, int], inputs: dict[str, int]) -> GridController:
    controller = Symbolic(cells, inputs).synthesize(problem)
    values, valid = Twin(problem, tuple(cells.values()), tuple(inputs.values())).solve()
    allowed = controller.allowed(np.arange(len(controller.values)))
    for flat, cell in enumerate(np.ndindex(*controller.counts)):
        assert controller.values[flat] == values.get(cell, -1)
        assert np.flatnonzero(allowed[flat]).tolist() == valid.get(cell, [])
    return controller


def drift_problem(n: int, goal: Any = None, gap: GapFunction | None = None) -> SynthesisProblem:
    model = Drift(n)
    domain = Domain.of(model, {f"x{i}": (0.0, 1.0) for i in range(n)} | {f"u{i}": (-1.0, 1.0) for i in range(n)})
    return SynthesisProblem(model, gap, domain, goal(model) if goal else Goal("invariance", domain.states))


def box(model: Model, low: float, high: float) -> Box:
    return Box(model.states, (low,) * len(model.states), (high,) * len(model.states))


def reach_corner(model: Model) -> Goal:
    target, avoid = box(model, 0.55, 0.95), box(model, 0.3, 0.42)
    return Goal("reach_avoid", box(model, 0.0, 1.0), Region((target,)), Region((avoid,)) if len(model.states) > 1 else None)


@pytest.mark.parametrize("gap", [None, Band((-3e-3, -5e-3), (1e-3, 5e-3))])
@pytest.mark.parametrize("goal", [None, rod_reach_avoid()])
def test_rod_equals_the_twin(goal: Goal | None, gap: GapFunction | None) -> None:
    problem = rod_problem(goal, gap)
    problem = replace(problem, model=Rod(0.03))
    controller = agrees(problem, {"theta": 20, "omega": 14}, {"torque": 7})
    assert 0 < controller.evidence["winning_cells"] < 280


@pytest.mark.exam
@pytest.mark.parametrize("goal", [None, reach_corner])
@pytest.mark.parametrize(("n", "cells", "inputs"), [(1, 30, 11), (2, 13, 3), (3, 8, 2), (4, 5, 2)])
def test_every_dimension_equals_the_twin(n: int, cells: int, inputs: int, goal: Any) -> None:
    gap = Band((-0.01,) * n, (0.02,) * n)
    problem = drift_problem(n, goal, gap)
    names = [f"x{i}" for i in range(n)]
    controller = agrees(problem, dict.fromkeys(names, cells), {f"u{i}": inputs for i in range(n)})
    assert controller.evidence["winning_cells"] > 0


@pytest.mark.parametrize("reach", [False, True])
def test_full_turn_equals_the_twin(reach: bool) -> None:
    model = Rod(0.2)
    domain = Domain.of(model, {"theta": (-np.pi, np.pi), "omega": (-4.0, 4.0), "torque": (-6.0, 6.0)})
    target = Region((Box(model.states, (-0.6, -1.0), (0.6, 1.0)),))
    avoid = Region((Box(model.states, (1.0, 2.5), (1.3, 3.0)),))
    goal = Goal("reach_avoid", domain.states, target, avoid) if reach else Goal("invariance", domain.states, avoid=avoid)
    controller = agrees(SynthesisProblem(model, None, domain, goal), {"theta": 16, "omega": 15}, {"torque": 7})
    x = np.array([[3.0, 1.0], [3.0 - TURN, 1.0], [3.0 + 2 * TURN, 1.0]])
    assert len(set(controller.cells(x))) == 1
    assert controller.winning[[0, -1]].any() or reach


@pytest.mark.parametrize("inputs", [1, 3])
def test_full_turn_along_the_last_axis_equals_the_twin(inputs: int) -> None:
    """Windows depend on each other and go over the end of the axis whose runs are counted."""
    model = load_spec(TURNED).build("model")
    domain = Domain.of(model, {"omega": (-4.0, 4.0), "phase": (-1.0, 1.0), "theta": (-np.pi, np.pi), "torque": (-6.0, 6.0)})
    wall = Region((Box(model.states, (-1.0, -1.0, -3.1), (4.0, 0.2, -2.5)),))
    goal = Goal("invariance", domain.states, avoid=wall)
    problem = SynthesisProblem(model, Band((-0.02,) * 3, (0.03,) * 3), domain, goal)
    controller = agrees(problem, {"omega": 15, "phase": 5, "theta": 16}, {"torque": 2 * inputs + 1})
    assert 0 < controller.evidence["winning_cells"] < 15 * 5 * 16


def test_narrow_angle_is_a_real_number() -> None:
    model = Rod(0.2)
    domain = Domain.of(model, {"theta": (-3.0, 3.0), "omega": (-4.0, 4.0), "torque": (-6.0, 6.0)})
    goal = Goal("invariance", domain.states)
    controller = agrees(SynthesisProblem(model, None, domain, goal), {"theta": 16, "omega": 15}, {"torque": 7})
    assert not Grid(domain.states, (16, 15)).wraps[0]
    # At the upper edge only a falling speed keeps the angle inside.
    assert not controller.winning[-1, 8:].any()


def test_more_than_a_turn_is_refused() -> None:
    with pytest.raises(UsageError, match=r"theta .* more than a full turn"):
        Grid(Box(Rod().states, (-4.0, -1.0), (4.0, 1.0)), (10, 10))


def test_targets_shrink_and_obstacles_grow() -> None:
    model = Drift(1)
    grid = Grid(box(model, 0.0, 1.0), (10,))
    part = box(model, 0.25, 0.55)
    assert np.flatnonzero(grid.inside(Region((part,)))).tolist() == [3, 4]
    assert np.flatnonzero(grid.touching(Region((part,)))).tolist() == [2, 3, 4, 5]
    edge = Box(model.states, (float(grid.edges[0][3]),), (float(grid.edges[0][5]),))
    assert np.flatnonzero(grid.inside(Region((edge,)))).tolist() == [3, 4]
    assert np.flatnonzero(grid.touching(Region((edge,)))).tolist() == [2, 3, 4, 5]


def test_grid_tiles_the_set_exactly() -> None:
    controller = Symbolic({"theta": 7, "omega": 11}, {"torque": 5}).synthesize(rod_problem())
    assert [(e[0], e[-1], len(e)) for e in controller.edges] == [(0.0, 0.2, 8), (-0.25, 0.25, 12)]
    assert controller.points[[0, -1], 0].tolist() == [-1.0, 1.0]


def test_gap_may_only_shrink_the_domain_and_its_inputs() -> None:
    sizes = [0.0, 2e-5, 1e-4, 3e-4]
    made = [
        Symbolic({"theta": 50, "omega": 50}, {"torque": 11}).synthesize(rod_problem(gap=Band((-s, -s), (s, s)))) for s in sizes
    ]
    for wide, narrow in itertools.pairwise(made):
        assert not (~wide.bits & narrow.bits).any()
        assert narrow.evidence["winning_cells"] < wide.evidence["winning_cells"]


def test_progress_is_told() -> None:
    events: list[Event] = []
    problem = replace(rod_problem(gap=Band((-1e-4, -1e-4), (1e-4, 1e-4))), emit=events.append)
    Symbolic({"theta": 9, "omega": 9}, {"torque": 5}).synthesize(problem)
    assert {e.data["part"] for e in events} == {"gap over cells", "successors of cells", "fixpoint"}
    assert all((e.name, e.stage) == ("progress", "controller") for e in events)
    last = {e.data["part"]: e.data for e in events}
    assert all(d["done"] == d["total"] for d in last.values())
    assert last["fixpoint"]["best"]["winning cells"] >= 0


REASONS = [
    (
        Band((-2e-3, -1e-5), (2e-3, 1e-5)),
        40,
        None,
        "theta: the gap is up to 0.002 rad per step, but one step moves theta by at most 0.00125",
    ),
    (
        Band((-1e-5, -0.02), (1e-5, 0.02)),
        40,
        None,
        "omega: the gap is up to 0.02 rad/s per step, but the inputs move omega by at most 0.015",
    ),
    (None, 12, None, "omega: cells are 0.0417 rad/s wide"),
    (None, 1, None, "each cell may leave"),
    (None, 2, rod_reach_avoid(), "theta: the target is 0.1 rad wide and a cell 0.2"),
    (Band((-1e-5, -0.0148), (1e-5, 0.0148)), 100, None, "omega: cells are 0.005 rad/s wide and the gap is up to 0.0148"),
]


@pytest.mark.parametrize(("gap", "cells", "goal", "reason"), REASONS)
def test_nothing_wins_for_a_named_reason(gap: Any, cells: int, goal: Goal | None, reason: str) -> None:
    problem = rod_problem(goal, gap)
    controller = Symbolic({"theta": cells, "omega": cells}, {"torque": 21}).synthesize(problem)
    assert controller.evidence["winning_cells"] == 0
    assert reason in controller.evidence["reason"]


def winning(gap: Any, cells: int, goal: Goal | None = None) -> int:
    made = Symbolic({"theta": cells, "omega": cells}, {"torque": 21}).synthesize(rod_problem(goal, gap))
    return int(made.evidence["winning_cells"])


@pytest.mark.parametrize(("low", "high"), [((-2e-3, -1e-5), (2e-3, 1e-5)), ((-1e-5, -0.02), (1e-5, 0.03))])
def test_the_largest_share_of_the_gap_that_wins_is_named(low: Any, high: Any) -> None:
    evidence = Symbolic({"theta": 40, "omega": 40}, {"torque": 21}).synthesize(rod_problem(gap=Band(low, high))).evidence
    scale = evidence["change"]["gap_scale"]
    assert f"with γ scaled by {scale:.3g}" in evidence["reason"]
    for factor, wins in ((scale, True), (scale + 1 / 256, False)):
        assert (winning(Band(np.multiply(low, factor), np.multiply(high, factor)), 40) > 0) == wins
    assert 0 < evidence["change"]["gap_below"]["theta" if low[0] < -1e-3 else "omega"] < 0.0151


def test_the_number_of_cells_that_wins_is_named() -> None:
    evidence = Symbolic({"theta": 12, "omega": 12}, {"torque": 21}).synthesize(rod_problem()).evidence
    assert evidence["change"] == {"cells_above": {"omega": 33}, "cells": {"theta": 48, "omega": 48}}
    assert "above 33; with cells {theta: 48, omega: 48}, some cell wins" in evidence["reason"]
    assert winning(None, 24) == 0 < winning(None, 48)
    assert 0.5 / 33 >= 0.015 > 0.5 / 34


def test_a_smaller_gap_and_more_cells_are_named_where_only_both_help() -> None:
    """γ₁ ≥ τ x₂max, and cells that one step does not cross; with neither alone does anything win."""
    low, high = (-1.4e-3, -1e-4), (1.4e-3, 1e-4)
    evidence = Symbolic({"theta": 20, "omega": 20}, {"torque": 21}).synthesize(rod_problem(gap=Band(low, high))).evidence
    assert set(evidence["change"]) == {"gap_below", "both"}
    scale, cells = evidence["change"]["both"]["gap_scale"], evidence["change"]["both"]["cells"]
    assert f"with γ scaled by {scale:.3g} and cells {{theta: {cells['theta']}, omega: {cells['omega']}}}" in evidence["reason"]
    assert 0 < scale < 0.9
    for factor, wins in ((scale, True), (scale + 1 / 256, False)):
        assert (winning(Band(np.multiply(low, factor), np.multiply(high, factor)), cells["theta"]) > 0) == wins
    assert winning(None, 20) == winning(Band(low, high), cells["theta"]) == 0


def cart(pull: float) -> Model:
    """Pulled back by `pull` per metre."""
    return load_spec(CART | {"model": {**CART["model"], "parameters": {"tau": "0.25 s", "pull": f"{pull} Hz^2"}}}).build(
        "model"
    )


def weak(pull: float, low: float, high: float, goal: Goal | None = None, gap: Any = None, cells: int = 24) -> dict[str, Any]:
    """What is told of a cart that can push by low to high, in m/s^2, from 0.4 to 2.4 m."""
    model = cart(pull)
    domain = Domain.of(model, {"x": (0.4, 2.4), "v": (-1.0, 1.0), "a": (low, high)})
    problem = SynthesisProblem(model, gap, domain, goal or Goal("invariance", domain.states))
    return dict(Symbolic({"x": cells, "v": cells}, {"a": 21}).synthesize(problem).evidence)


CART: dict[str, Any] = {
    "version": 1,
    "name": "cart",
    "model": {
        "kind": "equations",
        "states": {"x": "m", "v": "m/s"},
        "inputs": {"a": "m/s^2"},
        "next": {"x": "x + tau*v", "v": "v + tau*(a - pull*x)"},
        "period": "0.25 s",
    },
}


def test_inputs_that_are_too_weak_come_first_with_what_is_needed_and_what_suffices() -> None:
    """pull · 0.4 m is the least that holds the cart anywhere; the range that is named wins, and one below that does not."""
    small, large = Band((-1e-4, -1e-3), (1e-4, 1e-3)), Band((-1e-4, -0.3), (1e-4, 0.3))
    for gap in (None, small, large):
        told = weak(2.5, -0.4, 0.4, gap=gap)
        assert told["winning_cells"] == 0
        assert told["reason"].startswith("v: the inputs are too weak: with a in [-0.4, 0.4] m/s^2 each step moves v by -")
        assert "for γ = 0 too" in told["reason"]
        low, high = told["change"]["inputs"]["a"]
        assert low == -0.4
        needed = "about a in [-0.4, 1] m/s^2 is needed at the least"
        assert f"{needed}; for γ = 0, a in [-0.4, {high:.3g}] m/s^2 suffices" in told["reason"]
        assert weak(2.5, -0.4, high)["winning_cells"] > 0
        assert weak(2.5, -0.4, 0.99)["winning_cells"] == 0
    assert "reason" not in weak(2.5, -0.4, 5.0)


def test_a_goal_that_no_input_keeps_is_to_blame_itself() -> None:
    axes = cart(1.0).states
    moving = Goal("invariance", Box(axes, (0.4, 0.3), (2.4, 0.9)))
    told = weak(1.0, -5.0, 5.0, moving, Band((-1e-4, -1e-3), (1e-4, 1e-3)))
    assert told["reason"].startswith(
        "x: each step moves x by 0.075 to 0.225 m wherever the goal has it stay, for γ = 0 too, even"
    )
    assert told["reason"].endswith("so the goal cannot be kept; choose another goal")
    assert told["change"] == {}


def test_a_target_behind_a_wall_is_told_after_all_else_was_tried() -> None:
    axes = cart(1.0).states
    stay = Box(axes, (0.4, -1.0), (2.4, 1.0))
    far, wall = (Region((Box(axes, low, high),)) for low, high in (((2.1, -1.0), (2.4, 1.0)), ((1.4, -1.0), (2.1, 1.0))))
    told = weak(1.0, -0.3, 0.3, Goal("reach_avoid", stay, far, wall), Band((-1e-4, -1e-3), (1e-4, 1e-3)), cells=20)
    assert told["reason"].startswith("nothing beyond the target: ")
    assert "for γ = 0 nothing wins either, with these cells and inputs" in told["reason"]
    assert told["reason"].endswith("; neither do more cells help, nor inputs 33 times as wide")
    assert "inputs" not in told["change"]


def test_nothing_beyond_the_target_is_no_answer() -> None:
    """A target that is won where it stands, and that no step leads into."""
    whole = rod_reach_avoid().stay
    goal = Goal("reach_avoid", whole, Region((Box(whole.axes, (0.049, -0.1), (0.101, 0.1)),)))
    gap = Band((-0.03, -1e-5), (0.03, 1e-5))
    made = Symbolic({"theta": 16, "omega": 16}, {"torque": 21}).synthesize(rod_problem(goal, gap))
    assert made.evidence["winning_cells"] == (made.values == 0).sum() > 0
    assert made.evidence["reason"].startswith("nothing beyond the target: theta: the target is 0.052 rad wide, less")
    assert made.evidence["change"]["gap_below"] == {"theta": pytest.approx(0.0135)}
    easy = Symbolic({"theta": 80, "omega": 80}, {"torque": 21}).synthesize(rod_problem(rod_reach_avoid()))
    assert "reason" not in easy.evidence


def test_obstacle_over_the_target_is_named() -> None:
    goal = rod_reach_avoid()
    problem = rod_problem(replace(goal, avoid=goal.target))
    controller = Symbolic({"theta": 40, "omega": 40}, {"torque": 5}).synthesize(problem)
    assert "touches an obstacle" in controller.evidence["reason"]


def test_obstacles_everywhere_are_named() -> None:
    problem = rod_problem()
    problem = replace(problem, goal=replace(problem.goal, avoid=Region((problem.goal.stay,))))
    controller = Symbolic({"theta": 5, "omega": 5}, {"torque": 5}).synthesize(problem)
    assert "every cell touches an obstacle" in controller.evidence["reason"]


@pytest.mark.parametrize(
    ("cells", "inputs", "message"),
    [
        ({"theta": 5}, {"torque": 5}, "controller.cells: nothing for 'omega'"),
        ({"theta": 5, "omega": 5, "phi": 5}, {"torque": 5}, "controller.cells: 'phi' is unknown; expected theta, omega"),
        ({"theta": 5, "omega": 0}, {"torque": 5}, "controller.cells: omega is 0; give at least 1"),
        ({"theta": 5, "omega": 5}, {"torque": 1}, "controller.inputs: torque is 1; give at least 2"),
        ({"theta": 5, "omega": 5}, {}, "controller.inputs: nothing for 'torque'"),
        ({"theta": 30_000, "omega": 30_000}, {"torque": 5}, "GB"),
    ],
)
def test_bad_counts_are_one_sentence(cells: dict[str, int], inputs: dict[str, int], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        Symbolic(cells, inputs).synthesize(rod_problem())


def test_what_no_gap_could_change_is_refused_without_one() -> None:
    problem = rod_problem()
    parts = problem.model, problem.domain, problem.goal
    Symbolic({"theta": 9, "omega": 9}, {"torque": 3}).check(*parts)
    with pytest.raises(UsageError, match="nothing for 'omega'"):
        Symbolic({"theta": 9}, {"torque": 3}).check(*parts)
    with pytest.raises(UsageError, match="'speed' is unknown"):
        Symbolic({"theta": 9, "omega": 9}, {"speed": 3}).check(*parts)
    with pytest.raises(UsageError, match=r"1,000,000,000 cells × 3 inputs need 9.0 GB \(limit 8\); use fewer of either"):
        Symbolic({"theta": 100_000, "omega": 10_000}, {"torque": 3}).check(*parts)


def test_goal_outside_the_domain_is_refused() -> None:
    problem = rod_problem()
    wide = Goal("invariance", Box(problem.model.states, (-0.3, -0.25), (0.2, 0.25)))
    with pytest.raises(UsageError, match=r"goal: stay asks for theta in \[-0.3, 0.2\] rad, but the domain is \[-0.2, 0.2\]"):
        Symbolic({"theta": 5, "omega": 5}, {"torque": 5}).synthesize(replace(problem, goal=wide))


def test_declared_and_built_from_a_config() -> None:
    config = registry().config("synthesizer", "symbolic")
    assert config is SymbolicConfig
    made = registry().build("synthesizer", "symbolic", SymbolicConfig(cells={"x": 3}, inputs={"u": 3}, policy="last"))
    assert (made.cells, made.inputs, made.policy, made.name) == ({"x": 3}, {"u": 3}, "last", "symbolic")


@pytest.mark.parametrize("bad", [{"cells": {"x": 0}}, {"inputs": {"u": 1}}, {"policy": "best"}, {"sells": {"x": 3}}])
def test_config_refuses(bad: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        SymbolicConfig(**({"cells": {"x": 3}, "inputs": {"u": 3}} | bad))


def test_shares_stay_within_the_budget() -> None:
    for counts in [(200, 200, 201), (5, 1000, 2), (3,), (10, 10, 10, 10, 7, 7)]:
        blocks = share(counts, 60_000)
        assert np.prod(blocks) <= 60_000
        assert all(1 <= b <= n for b, n in zip(blocks, counts, strict=True))
    assert share((200, 200, 201), 60_000) == (39, 39, 39)
    assert share((20, 20, 20), 60_000) == (20, 20, 20)


def test_a_real_state_never_wraps() -> None:
    assert Grid(Box((StateSpec("x"),), (0.0,), (100.0,)), (3,)).wraps == (False,)
