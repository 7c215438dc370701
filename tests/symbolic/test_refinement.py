"""Halved cells: the domain is that of the fine grid, and what is promised on them is kept at points that nobody sampled."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import touched
import yaml
from halving import nested
from hypothesis import given, settings
from hypothesis import strategies as st

import gapcert
from gapcert import Box, Goal, Interval, Region, UsageError
from gapcert.contracts.controllers.policies import POLICIES
from gapcert.plugin import Synthesizer
from gapcert_cells import GridController, Splits, Successors, SuccessorsByLevel
from gapcert_cells.testing import Band, Rod, SynthesizerContract, rod_problem, rod_reach_avoid
from gapcert_report.pages.page import controller as section
from gapcert_symbolic.cells.abstraction import Windows
from gapcert_symbolic.cells.grid import Grid
from gapcert_symbolic.games import games, refinement
from gapcert_symbolic.games.games import solve
from gapcert_symbolic.games.refinement import Refined, refined
from gapcert_symbolic.solvers.problem import Problem, Solution
from gapcert_symbolic.synthesizer import Symbolic

GOALS = ("invariance", "reach_avoid", "reach_and_stay", "recurrence")
KINDS = st.sampled_from(GOALS)
GAP = Band((-1e-4, -6e-5), (1e-4, 6e-5))


def goal_of(box: Box, kind: Any, rng: np.random.Generator) -> Goal:
    def part(width: float) -> Region:
        span = np.asarray(box.high)
        low = rng.random(len(span)) * span * (1 - width)
        return Region((Box(box.axes, tuple(low.tolist()), tuple((low + width * span).tolist())),))

    avoid = part(0.3) if rng.random() < 0.7 else None
    return Goal(kind, box, None if kind == "invariance" else part(0.45 if kind == "reach_avoid" else 0.7), avoid)


def masks(grid: Grid, goal: Goal) -> tuple[np.ndarray, np.ndarray]:
    return ~grid.touching(goal.avoid), grid.inside(goal.target)


def solved(windows: Windows, goal: Goal) -> Solution:
    safe, target = masks(windows.grid, goal)
    problem = Problem(lambda: windows, safe)
    if goal.kind in ("invariance", "reach_avoid"):
        return solve(problem if goal.target is None else replace(problem, target=target))
    return {"reach_and_stay": games.reach_and_stay, "recurrence": games.recurrence}[goal.kind](problem, target)


def on_levels(made: list[Windows], goal: Goal, allowed: np.ndarray | None = None) -> Refined:
    """allowed: inputs by number that the cells of further levels may use."""
    by_grid = {w.grid.counts: w for w in made}

    def finer(grid: Grid, cell: np.ndarray) -> Windows:
        return replace(by_grid[grid.counts], allowed=None if allowed is None else np.tile(allowed, (len(cell), 1)))

    return refined(goal, len(made) - 1, solved(made[0], goal), made[0], finer)


def painted(found: Refined, levels: int) -> np.ndarray:
    """Values on the grid of the last level, whether or not it was needed."""
    splits = found.splits
    return found.solution.values[replace(splits, levels=levels).painted()]


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.integers(1, 3), st.integers(1, 4), st.integers(1, 3), KINDS, st.integers(0, 2**32 - 1))
def test_wins_what_the_fine_grid_wins(n: int, m: int, levels: int, kind: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    made = nested(n, m, levels, rng)
    goal = goal_of(made[0].grid.box, kind, rng)
    found, fine = on_levels(made, goal), solved(made[-1], goal)
    assert np.array_equal(painted(found, levels) >= 0, fine.values >= 0)
    coarse = solved(made[0], goal).values
    own = found.solution.values[: len(coarse)]
    assert np.array_equal(own[coarse >= 0], coarse[coarse >= 0])
    assert found.levels[-1]["winning_fraction"] == pytest.approx((fine.values >= 0).mean(), abs=1e-12)


@pytest.mark.exam
@settings(max_examples=30, deadline=None, derandomize=True)
@given(st.integers(1, 3), st.integers(1, 4), st.integers(1, 3), KINDS, st.integers(0, 2**32 - 1))
def test_each_input_leads_into_the_domain_in_fewer_steps_and_none_is_left_out(
    n: int, m: int, levels: int, kind: str, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    made = nested(n, m, levels, rng)
    goal, allowed = goal_of(made[0].grid.box, kind, rng), rng.random(m) < 0.8
    found = on_levels(made, goal, allowed)
    splits, values = found.splits, found.solution.values
    bits = np.unpackbits(found.solution.bits, axis=1, count=m).astype(bool)
    shown = painted(found, levels).reshape(made[-1].grid.counts)
    for node in np.flatnonzero((splits.first == 0) & (splits.level(np.arange(len(values))) > 0)):
        level, value = int(splits.level(np.array([node]))[0]), values[node]
        windows, left = made[level], levels - level
        most = np.inf if kind == "recurrence" and value == 0 else (value if value in found.solution.lasting else value - 1)
        cell = np.ravel_multi_index(tuple(splits.index[node]), windows.grid.counts)
        best = np.iinfo(np.int32).max
        for j in np.flatnonzero(allowed):
            first, last = (e[0] for e in touched.ends(windows, np.array([cell]), np.array([j])))
            sides = zip(first << left, (last + 1) << left, shown.shape, windows.grid.wraps, strict=True)
            ranges = [np.arange(a, b) % c if w else np.arange(a, b) for a, b, c, w in sides]
            inside = all(r[0] >= 0 and r[-1] < c for r, c in zip(ranges, shown.shape, strict=True))
            after = shown[np.ix_(*ranges)] if inside else np.array([-1])
            leads = bool((after >= 0).all())
            best = min(best, int(after.max()) + 1) if leads else best
            if kind == "reach_avoid" and value == 0:
                assert bits[node, j]
            else:
                assert bits[node, j] == (leads and int(after.max()) <= most and value >= 0)
        if value not in (-1, *found.solution.lasting):
            assert value == best
        assert not bits[node, ~allowed].any()


@pytest.mark.parametrize("kind", ["reach_and_stay", "recurrence"])
def test_goals_that_never_end_win_what_the_fine_grid_wins_beside_what_was_won(kind: str) -> None:
    rng, more, lasting = np.random.default_rng(3), 0, 0
    for _ in range(200):
        levels = int(rng.integers(1, 4))
        made = nested(int(rng.integers(1, 3)), int(rng.integers(1, 4)), levels, rng)
        goal = goal_of(made[0].grid.box, kind, rng)
        found = on_levels(made, goal)
        assert np.array_equal(painted(found, levels) >= 0, solved(made[-1], goal).values >= 0)
        more += found.levels[-1]["winning_fraction"] > found.levels[0]["winning_fraction"] > 0
        lasting += len(found.solution.lasting) > 1
    assert more >= 4
    assert lasting or kind == "recurrence"


@pytest.mark.parametrize("kind", ["reach_and_stay", "recurrence"])
def test_less_hope_loses_cells(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Planted fault: what touches the target, but does not lie inside, is taken for nothing of it."""
    monkeypatch.setattr(Grid, "touching", Grid.inside)
    rng, fewer = np.random.default_rng(3), 0
    for _ in range(60):
        made = nested(1, 3, 2, rng)
        goal = replace(goal_of(made[0].grid.box, kind, rng), avoid=None)
        shown, fine = painted(on_levels(made, goal), 2) >= 0, solved(made[-1], goal).values >= 0
        assert not (shown & ~fine).any()
        fewer += bool((fine & ~shown).any())
    assert fewer


def rod_goal(kind: Any) -> Goal | None:
    end = rod_reach_avoid()
    return None if kind == "invariance" else Goal(kind, end.stay, end.target, end.avoid)


@cache
def made(kind: str = "invariance", levels: int = 3) -> GridController:
    goal = rod_goal(kind)
    controller = Symbolic({"theta": 20, "omega": 50}, {"torque": 9}, refine=levels).synthesize(rod_problem(goal, GAP))
    assert isinstance(controller, GridController)
    return controller


@pytest.mark.parametrize("kind", GOALS)
def test_the_rod_on_halved_cells_wins_as_on_the_fine_grid(kind: str) -> None:
    goal = rod_goal(kind)
    fine = Symbolic({"theta": 160, "omega": 400}, {"torque": 9}).synthesize(rod_problem(goal, GAP))
    assert isinstance(fine, GridController)
    ours = made(kind)
    assert np.array_equal(ours.winning, fine.winning)
    levels = ours.evidence["levels"]
    assert [r["uniform_cells"] for r in levels] == [1000, 4000, 16000, 64000]
    assert ours.evidence["winning_fraction"] == pytest.approx(fine.evidence["winning_fraction"], abs=1e-12)
    assert [r["winning_fraction"] for r in levels] == sorted(r["winning_fraction"] for r in levels)
    assert ours.evidence["cells"] < (0.5 if kind == "invariance" else 0.9) * fine.evidence["cells"]


def broken(controller: GridController, policy: Any, n: int = 4000) -> int:
    """Steps from states all over the domain, with the gap at its corners and between, that do not keep the promise."""
    rng = np.random.default_rng(7)
    x = controller.draw(n, rng)
    x = x[~controller.goal.reached(x)]
    u = controller.act(x, policy)
    share = np.where(np.arange(len(x))[:, None] % 2 == 0, rng.random(x.shape), np.round(rng.random(x.shape)))
    after = Rod().step(x, u).x + GAP.low + (GAP.high - GAP.low) * share
    return int((~controller.kept(x, u, after)).sum())


@pytest.mark.parametrize("kind", GOALS)
def test_every_policy_keeps_the_promise_between_the_cells(kind: str) -> None:
    controller = made(kind)
    assert set(controller.policies) == set(POLICIES)
    assert not any(broken(controller, policy) for policy in POLICIES)


@pytest.mark.parametrize("kind", GOALS)
def test_planted_faults_of_halved_cells_break_the_promise(kind: str) -> None:
    """Inputs that were not kept, and cells that lost: each of them shows."""
    controller = made(kind)
    splits = controller.splits
    assert splits is not None
    every = np.where((controller.values >= 0)[:, None], np.packbits(np.ones(9, dtype=bool)), np.uint8(0))
    assert sum(broken(replace(controller, bits=every), policy) for policy in ("first", "last")) > 100
    lost = controller.values.copy()
    lost[(splits.first == 0) & (lost < 0)] = 0
    assert (
        broken(replace(controller, values=lost, bits=np.where((lost >= 0)[:, None], every.max(), controller.bits)), "last") > 10
    )


def test_a_step_is_held_against_the_cells_of_its_own_level() -> None:
    controller = made()
    splits, rng = controller.splits, np.random.default_rng(3)
    assert splits is not None
    assert controller.successors is not None
    x = controller.draw(3000, rng)
    level, cell = splits.level(controller.cells(x)), controller.cells(x)
    assert len(set(level.tolist())) > 2
    u = controller.act(x, "middle")
    after = Rod().step(x, u).x
    assert controller.promising(cell, u, after).all()
    # Four cells of the own level farther than any window of the rod goes.
    width = np.asarray(controller.widths) * 2.0 ** (splits.levels - level)[:, None]
    far = after + np.array([0.0, 1.0]) * (4 * width + 0.02)
    inside = controller.places(far) >= 0
    assert inside.sum() > 500
    assert not controller.promising(cell, u, far)[inside].any()
    assert not controller.promising(cell, u, after + 9.0).any()


def test_starts_are_uniform_over_the_volume() -> None:
    controller = made()
    assert controller.splits is not None
    level = controller.splits.level(controller.cells(controller.draw(40_000, np.random.default_rng(1))))
    won = np.array([r["winning_cells"] * 0.25**k for k, r in enumerate(controller.evidence["levels"])])
    assert np.bincount(level, minlength=4) / 40_000 == pytest.approx(won / won.sum(), abs=0.01)


def test_a_spec_of_a_goal_that_never_ends_runs_on_halved_cells(tmp_path: Path) -> None:
    raw = yaml.safe_load((Path(__file__).parents[2] / "specs" / "benchmarks" / "pendulum_refined.yaml").read_text())
    goal = {"target": {"theta": [0.04, 0.12], "omega": [-0.15, 0.15]}, "stay": raw["controller"]["goal"]["invariance"]}
    raw["controller"] |= {"goal": {"reach_and_stay": goal}, "inputs": {"torque": 5}}
    raw["controller"]["refine"] = 1
    raw |= {"closed_loop": {"steps": 120, "starts": 5, "policies": ["first", "adversarial"]}, "expect": {"verdict": "holds"}}
    raw |= {"gap": {"kind": "constant"}, "report": {"html": False, "rerun": False}}
    path = tmp_path / "spec.yaml"
    path.write_text(yaml.safe_dump(raw))
    run = gapcert.run(path, out=tmp_path / "run")
    first, last = (level["winning_fraction"] for level in run.summary["controller"]["levels"])
    assert first < last
    for row in run.summary["closed_loop"]["policies"]:
        assert row["violations"] == row["broken_promises"] == 0
        assert row["settled"] == 5
    assert GridController.load(run.folder / "controller" / "with_gamma").digest() == run.controller.digest()


def test_saved_halved_cells_answer_as_before(tmp_path: Path) -> None:
    controller = made("reach_avoid")
    controller.save(tmp_path)
    loaded = GridController.load(tmp_path)
    x = np.random.default_rng(2).uniform((-0.01, -0.26), (0.21, 0.26), (20_000, 2))
    assert np.array_equal(loaded.value(x), controller.value(x))
    x = x[controller.contains(x) & ~controller.goal.reached(x)]
    for policy in POLICIES:
        assert np.array_equal(loaded.act(x, policy, k=1), controller.act(x, policy, k=1))
    assert loaded.digest() == controller.digest() != replace(controller, splits=None, promised=None).digest()
    with pytest.raises(UsageError, match="is outside its domain"):
        loaded.act(np.array([[0.1, 0.26]]), "first")


def test_cells_that_cannot_win_are_left_whole() -> None:
    """Those inside an obstacle."""
    axes = Rod().states
    avoid = Region((Box(axes, (0.05, -0.25), (0.12, 0.25)),))
    problem = rod_problem(Goal("invariance", Box(axes, (0.0, -0.25), (0.2, 0.25)), None, avoid), GAP)
    found = Symbolic({"theta": 20, "omega": 20}, {"torque": 9}, refine=2).synthesize(problem)
    assert isinstance(found, GridController)
    assert found.splits is not None
    whole = found.splits.first[: found.splits.starts[1]].reshape(20, 20) == 0
    assert whole[6:11].all()
    assert not whole[:5].all()
    assert not whole[12:].all()
    assert not found.contains(np.array([[0.08, 0.0]]))[0]


def test_what_cannot_be_refined_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = rod_problem()
    with pytest.raises(UsageError, match=r"controller.refine: align: scots is solved on one grid"):
        Symbolic(align="scots", eta={"theta": 0.01, "omega": 0.01, "torque": 0.1}, refine=1).synthesize(problem)
    monkeypatch.setattr(refinement, "THRESHOLDS", replace(refinement.THRESHOLDS, memory=1e5))
    with pytest.raises(UsageError, match=r"on level \d need .* GB \(limit 0\); use a smaller number"):
        Symbolic({"theta": 20, "omega": 20}, {"torque": 9}, refine=5).synthesize(problem)


def test_the_report_holds_the_domain_against_the_cell_size() -> None:
    class Album:
        loop = ()

    shown = str(section({"controller": made().evidence}, Album()))  # type: ignore[arg-type]
    levels = made().evidence["levels"]
    assert "Domain against cell size" in shown
    assert f"{levels[0]['winning_fraction']:.2%}" in shown
    assert f"{levels[-1]['uniform_cells']:,}" in shown


def test_nodes_of_a_tree_are_told_apart() -> None:
    splits = Splits((2,), 2, np.array([0, 2, 4, 0, 0, 0]))
    assert splits.starts == (0, 2, 4, 6)
    assert splits.nodes(np.array([-1, 0, 3, 4, 5, 6, 7])).tolist() == [-1, 0, 0, 4, 5, 3, 3]
    assert splits.shares().tolist() == [0.5, 0.5, 0.25, 0.25, 0.125, 0.125]
    assert [e.ravel().tolist() for e in splits.ends(np.array([0, 3, 5]))] == [[0, 6, 5], [4, 8, 6]]


class TestRefined(SynthesizerContract):
    def synthesizer(self) -> Synthesizer:
        return Symbolic({"theta": 15, "omega": 15}, {"torque": 9}, refine=2)


class Bowl(Band):
    """γ grows with θ and ω: no two cells have the same."""

    def interval_over(self, boxes: Interval) -> Interval:
        most = 1 + boxes.mag[:, 0] + boxes.mag[:, 1]
        return Interval(self.low * most[:, None], self.high * most[:, None])

    def lipschitz(self, boxes: Interval) -> np.ndarray:
        return np.tile(np.array([1.0, 1.0, 0.0]), (len(boxes), 2, 1))


def test_a_gap_that_differs_everywhere_is_tabulated_where_it_is_asked_for() -> None:
    problem = rod_problem(gap=Bowl((-1e-4, -6e-5), (1e-4, 6e-5)))
    fine = Symbolic({"theta": 80, "omega": 200}, {"torque": 9}).synthesize(problem)
    ours = Symbolic({"theta": 20, "omega": 50}, {"torque": 9}, refine=2).synthesize(problem)
    assert isinstance(ours, GridController)
    assert isinstance(fine, GridController)
    assert np.array_equal(ours.winning, fine.winning)
    assert not any(broken(ours, policy) for policy in POLICIES)
    promised, whole = ours.successors, fine.successors
    assert isinstance(promised, SuccessorsByLevel)
    assert isinstance(whole, Successors)
    assert len(promised.levels[2].axes[0].first) == ours.evidence["levels"][2]["cells"] < 0.6 * len(whole.axes[0].first)
