"""Closed loops: what ends a run and how it is counted, and the promise itself on a simulator with damping."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gapcert import Backend, Box, Controller, Event, Goal, Region, StateSpec, UsageError
from gapcert.plugin import POLICIES, Step
from gapcert_cells.testing import Band, Rod, rod_problem, rod_reach_avoid
from gapcert_closed_loop.closed_loop import ClosedLoop, closed_loop, compare_loops, draw_starts
from gapcert_closed_loop.prediction import followed
from gapcert_figures.data import loop_figure
from gapcert_symbolic.synthesizer import Symbolic

AXIS = (StateSpec("x", "m"),)
ROD_GAP = Band((-1.5e-4, -6e-5), (1.5e-4, 6e-5))


class Line(Backend):
    """x⁺ = x + u, counting its calls in a hidden state; the seed, if any, is added."""

    def __init__(self, *, stochastic: bool = False) -> None:
        self.states, self.inputs, self.period = AXIS, (StateSpec("u", "m"),), 1.0
        self.hidden, self.hidden_default = (StateSpec("calls"),), (0.0,)
        self.capabilities = frozenset({"hidden", "seed"} if stochastic else {"hidden"})
        self.seen: list[int] = []

    def _step(self, x: np.ndarray, u: np.ndarray, **options: Any) -> Step:
        self.seen.append(len(x))
        noise = 0.0 if options.get("seed") is None else 1e-3 * (options["seed"] % 7)
        # Every third call moves twice as far, which only a handed-on hidden state can know.
        calls = options["hidden"] + 1
        return Step(x + u * np.where(calls % 3 == 0, 2.0, 1.0) + noise, calls)


class Steady(Controller):
    """u = 1 wherever 0 ≤ x ≤ limit."""

    kind = "steady"

    def __init__(self, goal: Goal, limit: float) -> None:
        self.goal, self.limit, self.evidence = goal, limit, {"reason": "it is a toy"} if limit < 0 else {}

    def contains(self, x: np.ndarray) -> np.ndarray:
        return np.asarray((x[:, 0] >= 0) & (x[:, 0] <= self.limit))

    def act(self, x: np.ndarray, policy: Any, seed: int = 0, k: int = 0) -> np.ndarray:
        if not self.contains(x).all():
            raise UsageError("outside")
        return np.ones((len(x), 1))

    def save(self, folder: Path) -> None:
        (folder / "limit").write_text(str(self.limit))


def line(low: float, high: float) -> Box:
    return Box(AXIS, (low,), (high,))


STAY = Goal("invariance", line(0, 10))


def test_runs_end_where_they_should() -> None:
    trace = closed_loop(Line(), Steady(STAY, 8.5), np.array([[0.0], [6.0], [9.5], [11.0]]), 5)
    # 1, 2, 4, 5, 6 | 7, 8, 10: outside the domain at once and inside `stay` | never in the domain | outside both.
    nan = np.nan
    expected = [[0, 1, 2, 4, 5, 6], [6, 7, 8, 10, nan, nan], [9.5] + [nan] * 5, [11.0] + [nan] * 5]
    assert np.array_equal(trace.x[:, :, 0], expected, equal_nan=True)
    assert trace.stranded.tolist() == [False, True, True, True]
    assert trace.left_goal.tolist() == [False, False, False, True]
    assert trace.violation.tolist() == [False, True, True, True]
    assert np.isfinite(trace.u[:, :, 0]).sum(axis=1).tolist() == [5, 3, 0, 0]


def test_leaving_the_set_counts_even_inside_the_domain() -> None:
    trace = closed_loop(Line(), Steady(STAY, 100.0), np.array([[8.5]]), 5)
    assert trace.left_goal.tolist() == trace.violation.tolist() == [True]
    assert trace.stranded.tolist() == [False]
    assert trace.x[0, :, 0].tolist()[:3] == [8.5, 9.5, 10.5]


def test_an_obstacle_is_a_violation_and_a_target_an_end() -> None:
    goal = Goal("reach_avoid", line(0, 20), Region((line(6.5, 7.5), line(11.5, 12.5))), Region((line(3.5, 4.5),)))
    trace = closed_loop(Line(), Steady(goal, 100.0), np.array([[5.0], [2.0], [9.0], [7.0]]), 9)
    # 5, 6, 7: reached | 2, 3, 4: obstacle | 9, 10, 11, 13, …, 19, 21: over the target and out | 7: there already.
    assert trace.left_goal.tolist() == [False, True, True, False]
    assert trace.reached.tolist() == [True, False, False, True]
    assert np.isfinite(trace.x[:, :, 0]).sum(axis=1).tolist() == [3, 3, 10, 1]


def test_only_alive_runs_are_stepped() -> None:
    system = Line()
    closed_loop(system, Steady(STAY, 8.5), np.array([[0.0], [6.0], [9.5], [11.0]]), 5)
    assert system.seen == [2, 2, 2, 1, 1]


def test_a_run_does_not_depend_on_the_others() -> None:
    controller = Symbolic({"theta": 40, "omega": 40}, {"torque": 9}).synthesize(rod_problem())
    x0 = controller.draw(20, np.random.default_rng(0))
    for policy in POLICIES:
        whole = closed_loop(Engine(), controller, x0, 150, policy, seed=4)
        part = closed_loop(Engine(), controller, x0[:5], 150, policy, seed=4)
        assert np.array_equal(whole.x[:5], part.x, equal_nan=True)
        assert np.array_equal(whole.u[:5], part.u, equal_nan=True)


def test_a_stochastic_system_is_pure_in_the_seed() -> None:
    runs = [closed_loop(Line(stochastic=True), Steady(STAY, 8.5), np.array([[0.0]]), 4, seed=s).x for s in (1, 1, 2)]
    assert np.array_equal(runs[0], runs[1])
    assert not np.array_equal(runs[0], runs[2])


def test_starts_lie_in_both_domains() -> None:
    one, two = Steady(STAY, 5.0), Steady(STAY, 0.5)
    x = draw_starts((one, two), 300, seed=0)
    assert x.shape == (300, 1)
    assert one.contains(x).all()
    assert two.contains(x).all()
    assert np.array_equal(x, draw_starts((one, two), 300, seed=0))
    with pytest.raises(UsageError, match=r"0 of 10 starts found where all controllers win \(it is a toy\)"):
        draw_starts((one, Steady(STAY, -1.0)), 10, seed=0)


def test_summary_is_the_contract() -> None:
    events: list[Event] = []
    result = compare_loops(
        Line(), Steady(STAY, 4.0), Steady(STAY, 8.5), starts=7, steps=3, policies=("last", "random"), emit=events.append
    )
    assert isinstance(result, ClosedLoop)
    summary = result.summary()
    keys = {"policy", "starts", "steps", "violations", "stranded", "left_goal", "broken_promises"}
    assert set(summary) == {"with_gamma", "without_gamma", "policies", "claim"}
    assert set(summary["with_gamma"]) == set(summary["without_gamma"]) == keys
    assert all(set(row) == keys | {"controller"} for row in summary["policies"])
    assert [(r["controller"], r["policy"]) for r in summary["policies"]] == [
        (c, p) for c in ("with_gamma", "without_gamma") for p in ("first", "last", "random")
    ]
    assert summary["with_gamma"]["violations"] == int(result.with_gamma.violation.sum()) > 0
    assert (summary["with_gamma"]["starts"], summary["with_gamma"]["steps"]) == (7, 3)
    assert {(e.name, e.stage, e.data["total"]) for e in events} == {("progress", "closed_loop", 6 * 3)}
    assert events[-1].data["done"] == 6 * 3
    assert events[-1].data["best"]["runs failed with γ"] == sum(r["violations"] for r in summary["policies"][:3])
    assert events[0].data["best"].get("over") is None  # one policy is begun
    assert events[-1].data["best"]["over"] == "3 policies"
    with pytest.raises(UsageError, match="no row for with_gamma under 'middle'"):
        result.count("with_gamma", "middle")


def test_starts_that_the_careful_controller_refuses_are_counted() -> None:
    """Drawn where the other wins: those that both take stand first, so that rows of both are the same runs."""
    careful, trusting = Steady(STAY, 4.0), Steady(STAY, 8.5)
    loop = compare_loops(Line(), careful, trusting, starts=50, steps=3, policies=("last",), starts_from="without_gamma")
    drawn = draw_starts((trusting,), 50, 0)
    refused = int((drawn[:, 0] > 4.0).sum())
    assert 0 < refused < 50
    for row in loop.summary()["policies"]:
        taken = row["controller"] == "with_gamma"
        assert (row["starts"], row.get("refused")) == ((50 - refused, refused) if taken else (50, None))
    assert loop.claim["runs"] == len(loop.with_gamma.x) == 50 - refused
    assert np.array_equal(loop.with_gamma.x[:, 0], loop.without_gamma.x[: 50 - refused, 0])
    assert np.array_equal(np.sort(loop.without_gamma.x[:, 0], axis=0), np.sort(drawn, axis=0))
    assert (loop.with_gamma.x[:, 0] <= 4.0).all()
    figure = loop_figure(loop, Line(), careful, trusting)
    assert [r.starts for r in figure.runs] == [50, 50 - refused]
    assert all(np.array_equal(a[0], b[0]) for a, b in zip(*(r.traces for r in figure.runs), strict=True))
    with pytest.raises(UsageError, match="starts from none of 50 states drawn where the one without γ wins"):
        compare_loops(Line(), Steady(STAY, -1.0), trusting, starts=50, steps=3, starts_from="without_gamma")


class Root(Backend):
    """x⁺ = √x + u − 1, which has no answer below 0."""

    def __init__(self) -> None:
        self.states, self.inputs, self.period = AXIS, (StateSpec("u", "m"),), 1.0

    def _step(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        return np.asarray(np.sqrt(np.where(x < 0, np.nan, x)) + u - 1)


def test_a_model_without_an_answer_costs_no_picture() -> None:
    """After a run's end there is no input; and what the model makes of those before may leave where it is defined."""
    goal = Goal("reach_avoid", line(0, 20), Region((line(6.5, 7.5),)))
    loop = compare_loops(Line(), Steady(goal, 100.0), Steady(goal, 100.0), starts=40, steps=9, policies=("last",))
    ends = np.isfinite(loop.with_gamma.x).all(axis=2).sum(axis=1)
    assert len(set(ends)) > 2
    drawn = loop_figure(loop, Root(), Steady(goal, 100.0), Steady(goal, 100.0)).runs[1]
    for x, predicted in zip(drawn.traces, drawn.predicted, strict=True):
        assert np.array_equal(np.isfinite(x), np.isfinite(predicted))
    x, u = np.tile(np.linspace(4, 0, 5)[None, :, None], (2, 1, 1)), np.array([[[1.0]] * 4, [[-2.0], [1], [1], [1]]])
    assert np.isfinite(followed(Root(), x, u)[:, :, 0]).sum(axis=1).tolist() == [5, 2]
    np.testing.assert_array_equal(followed(Line(), x, u), Line().rollout(x[:, 0], u).x)


def test_only_reach_avoid_counts_what_reached() -> None:
    goal = Goal("reach_avoid", line(0, 20), Region((line(6.5, 7.5),)))
    result = compare_loops(Line(), Steady(goal, 100.0), Steady(goal, 100.0), starts=40, steps=3, policies=("last",))
    summary = result.summary()
    for row in (summary["with_gamma"], *summary["policies"]):
        assert row["reached"] == int(result.with_gamma.reached.sum())
        assert 0 < row["reached"] < row["starts"] - row["violations"]
    assert (
        "reached" not in compare_loops(Line(), Steady(STAY, 4.0), Steady(STAY, 8.5), starts=7, steps=3).summary()["with_gamma"]
    )


class Engine(Backend):
    """The rod as an engine steps it: semi-implicit Euler, and a damping of 0.04 on its speed."""

    def __init__(self) -> None:
        rod = Rod()
        self.states, self.inputs, self.period = rod.states, rod.inputs, rod.period

    def _step(self, x: np.ndarray, u: np.ndarray, **options: Any) -> np.ndarray:
        omega = x[:, 1] + self.period * (3 * u[:, 0] - 1.5 * 9.81 * np.sin(x[:, 0]) - 0.04 * x[:, 1])
        return np.stack([x[:, 0] + self.period * omega, omega], axis=1)


@pytest.mark.exam
def test_the_promise_holds_with_gamma_and_breaks_without() -> None:
    """The published demonstration: 200 × 200 cells, 201 inputs, 100 starts, 600 steps."""
    problem, synthesizer = rod_problem(), Symbolic({"theta": 200, "omega": 200}, {"torque": 201})
    z = problem.domain.draw(20_000, np.random.default_rng(0))
    x, u = problem.domain.split(z)
    r = Engine().step(x, u).x - problem.model.step(x, u).x
    assert (np.abs(r) <= ROD_GAP.high).all()
    careful, trusting = synthesizer.synthesize(rod_problem(gap=ROD_GAP)), synthesizer.synthesize(problem)
    assert trusting.evidence["winning_cells"] > careful.evidence["winning_cells"] > 0.9 * 40_000
    result = compare_loops(Engine(), careful, trusting, starts=100, steps=600)
    assert all(result.count("with_gamma", p).violations == 0 for p in POLICIES)
    assert result.count("without_gamma", "first").violations > 0
    # On the model that it trusts, even the trusting controller keeps its promise: what breaks it is the gap.
    assert not closed_loop(problem.model, trusting, result.without_gamma.x[:, 0], 600, "first").violation.any()


@pytest.mark.exam
def test_the_promise_holds_on_a_coarse_grid() -> None:
    problem, synthesizer = rod_problem(), Symbolic({"theta": 120, "omega": 120}, {"torque": 21})
    careful, trusting = synthesizer.synthesize(rod_problem(gap=ROD_GAP)), synthesizer.synthesize(problem)
    result = compare_loops(Engine(), careful, trusting, starts=30, steps=500)
    assert all(result.count("with_gamma", p).violations == 0 for p in POLICIES)
    assert result.count("without_gamma", "first").violations > 0


def test_reach_avoid_arrives() -> None:
    synthesizer = Symbolic({"theta": 80, "omega": 80}, {"torque": 11})
    controller = synthesizer.synthesize(rod_problem(rod_reach_avoid(), ROD_GAP))
    x0 = draw_starts((controller,), 50, seed=0)
    for policy in POLICIES:
        trace = closed_loop(Engine(), controller, x0, int(controller.values.max()), policy)
        assert trace.reached.all()
        assert not trace.violation.any()
