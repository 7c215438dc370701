"""Runs held against what was promised: which part of the promise a step refutes, and what all of them earn."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.stats import beta

from gapcert import Backend, Box, Goal, Interval
from gapcert.plugin import POLICIES
from gapcert_cells import GridController
from gapcert_cells.grid_controller import depths
from gapcert_cells.testing import Band, Rod, rod_problem, rod_reach_avoid
from gapcert_closed_loop.closed_loop import closed_loop, compare_loops
from gapcert_closed_loop.loop_audit import Oracle, audited, largest, loop_failures
from gapcert_report.words.summary import in_words
from gapcert_report.words.words import runs_sentence
from gapcert_symbolic.synthesizer import Symbolic

GAP = Band((-1e-4, -1e-4), (1e-4, 1e-4))


class Pushed(Backend):
    """The rod with a push on its speed."""

    def __init__(self, push: float) -> None:
        self.rod, self.push = Rod(), push
        self.states, self.inputs, self.period = self.rod.states, self.rod.inputs, self.rod.period

    def _step(self, x: np.ndarray, u: np.ndarray, **options: Any) -> np.ndarray:
        return np.asarray(self.rod.step(x, u).x + np.array([0.0, self.push]))


class Wrong(Rod):  # type: ignore[misc]
    """A rod whose enclosure is wrong: it has a push that the rod has not."""

    def enclosure(self, z: Interval) -> Interval:
        return super().enclosure(z) + Interval.exact(np.array([0.0, 0.012]))


def made(gap: Band = GAP, model: Rod | None = None) -> GridController:
    problem = rod_problem(gap=gap)
    if model is not None:
        problem = type(problem)(model, gap, problem.domain, problem.goal)
    return Symbolic({"theta": 80, "omega": 80}, {"torque": 11}).synthesize(problem)


def rows(controller: GridController, real: Backend, model: Rod | None = None) -> dict[str, Any]:
    done = compare_loops(
        real, controller, controller, starts=20, steps=40, oracle=Oracle(model or Rod(), GAP), policies=("first", "random")
    )
    return {r["policy"]: r for r in done.summary()["policies"] if r["controller"] == "with_gamma"}


def test_a_simulator_within_the_gap_breaks_no_promise() -> None:
    for row in rows(made(), Pushed(9e-5)).values():
        assert (row["broken_promises"], row["outside_gap"], row["violations"]) == (0, 0, 0)
        assert row["steps_held"] == 800
        assert "refuted" not in row


def test_a_small_excess_is_seen_although_no_promise_breaks() -> None:
    """Cells leave room, so that runs alone do not show that γ is too small."""
    row = rows(made(), Pushed(1.1e-4))["first"]
    assert row["violations"] == 0
    assert row["outside_gap"] == row["steps_held"] == 800


def test_a_large_excess_breaks_promises_and_refutes_gamma() -> None:
    row = rows(made(), Pushed(0.03))["random"]
    assert row["broken_promises"] > 0
    assert row["refuted"] == {"gap": row["broken_promises"], "bound": 0}


def test_a_wrong_bound_of_the_model_is_told_from_a_wrong_gap() -> None:
    model = Wrong()
    row = rows(made(model=model), Pushed(0.0), model)["first"]
    assert row["broken_promises"] > 0
    assert row["refuted"] == {"gap": 0, "bound": row["broken_promises"]}
    assert row["outside_gap"] == 0


def test_values_fall_on_the_way_to_a_target() -> None:
    problem = rod_problem(rod_reach_avoid(), GAP)
    controller = Symbolic({"theta": 80, "omega": 80}, {"torque": 11}).synthesize(problem)
    x0 = controller.draw(30, np.random.default_rng(0))
    for policy in POLICIES:
        trace = closed_loop(Pushed(-9e-5), controller, x0, 30, policy)
        assert not trace.broken.any()
        value = np.stack([np.where(np.isnan(x).any(axis=1), -1, controller.value(x)) for x in trace.x.swapaxes(0, 1)])
        on = (value[1:] >= 0) & (value[:-1] > 0)
        assert on.sum() > 30
        assert (value[1:] < value[:-1])[on].all()


@pytest.mark.parametrize("kind", ["reach_and_stay", "recurrence"])
def test_goals_that_never_end_break_no_promise(kind: Any) -> None:
    end = rod_reach_avoid()
    problem = rod_problem(Goal(kind, end.stay, end.target, end.avoid), GAP)
    controller = Symbolic({"theta": 80, "omega": 80}, {"torque": 11}).synthesize(problem)
    x0 = controller.draw(30, np.random.default_rng(0))
    away = 0
    for policy in POLICIES:
        trace = closed_loop(Pushed(-9e-5), controller, x0, 60, policy)
        assert not trace.violation.any()
        assert not trace.broken.any()
        x, u = trace.x[:, 0], trace.u[:, 0]
        value, aside = controller.value(x), controller.draw(30, np.random.default_rng(1))
        up = controller.value(aside) > np.where(value > 0, value - 1, 0 if kind == "reach_and_stay" else 10**6)
        assert not controller.kept(x, u, aside)[up].any()
        away += int(up.sum())
    assert away > 10


def test_an_adversarial_step_leads_nearest_to_the_edge() -> None:
    controller = made()
    x = controller.draw(2000, np.random.default_rng(0))
    deep = depths(controller.winning, controller.wraps)
    after = {p: deep[controller.cells(Rod().step(x, controller.act(x, p)).x)].mean() for p in POLICIES}
    assert after.pop("adversarial") < 0.95 * min(after.values())


def test_the_bound_of_an_audit_is_that_of_clopper_and_pearson() -> None:
    for v, n in ((0, 100), (3, 100), (40, 60), (0, 1), (7, 5000)):
        exact = beta.ppf(1 - 1e-3, v + 1, n - v)
        assert exact <= largest(v, n, 1e-3) <= exact + 1.001e-4
    assert largest(5, 5, 1e-3) == 1.0


def test_an_audit_counts_starts_that_fail_under_any_policy() -> None:
    done = compare_loops(Pushed(0.03), made(), made(), starts=30, steps=60, policies=POLICIES, beta=1e-2)
    summary = done.summary()
    counts = [r["violations"] for r in summary["policies"] if r["controller"] == "with_gamma"]
    claim = summary["claim"]
    assert max(counts) <= claim["violations"] <= min(30, sum(counts))
    assert claim["epsilon"] == largest(claim["violations"], 30, 1e-2)
    assert claim["distribution"].endswith("policies first, middle, last, random, least-effort, adversarial, 60 steps")
    assert "breaks the specification under at least one of these policies with probability" in runs_sentence(summary)
    assert any(
        "closed loop audit: with confidence 1 − 0.01" in line and "fail under any of 6 policies" in line
        for line in in_words({"verdict": "holds", "reason": "", "closed_loop": summary})
    )
    alone = summary | {"policies": [r for r in summary["policies"] if r["policy"] == "first"]}
    assert "breaks the specification under policy first with probability" in runs_sentence(alone)
    told = in_words({"verdict": "holds", "reason": "", "closed_loop": alone})
    assert any(line.endswith("of runs with γ fail under policy first") for line in told)


def test_more_runs_earn_more() -> None:
    few, many = (audited(np.zeros(n, dtype=bool), 1e-3, 10, ("first",)) for n in (50, 5000))
    assert few["epsilon"] > 50 * many["epsilon"]
    assert many["epsilon"] == pytest.approx(0.0014, abs=1e-9)


def test_a_policy_that_a_controller_does_not_know_is_left_out_and_told() -> None:
    whole = made()
    plain = GridController(whole.goal, whole.edges, whole.points, whole.bits, whole.values, whole.evidence)
    asked = compare_loops(Pushed(0.0), plain, whole, starts=5, steps=5, policies=("last", "adversarial"))
    assert asked.summary()["skipped"] == ["adversarial with gamma"]
    neither = compare_loops(Pushed(0.0), plain, plain, starts=5, steps=5, policies=("last", "adversarial"))
    assert neither.summary()["skipped"] == ["adversarial"]
    # Who asks for none asks for those that are known.
    summary = compare_loops(Pushed(0.0), plain, whole, starts=5, steps=5).summary()
    assert "skipped" not in summary
    told = [r["policy"] for r in summary["policies"] if r["controller"] == "without_gamma"]
    assert told == list(POLICIES)


def test_a_broken_promise_refutes_a_claim_about_all_of_the_domain_only() -> None:
    row = {"policy": "first", "controller": "with_gamma", "violations": 0, "starts": 9, "broken_promises": 4}
    summary = {"policies": [row | {"refuted": {"gap": 3, "bound": 1}}, row | {"controller": "without_gamma"}]}
    assert loop_failures(summary, "deterministic") == loop_failures(summary, "assumed")
    assert loop_failures(summary, "deterministic") == [
        "closed loop with γ: 4 steps under policy 'first' break the controller's promise: 3 refute γ, the residual being "
        "outside [l, u] and 1 refute the bound of the model's successors"
    ]
    assert loop_failures(summary, "empirical") == []


def test_only_cells_that_were_promised_count() -> None:
    """A successor in a winning cell that was not promised is a broken promise, too."""
    controller = made()
    x = controller.draw(200, np.random.default_rng(3))
    u = controller.act(x, "middle")
    after = Rod().step(x, u).x
    assert controller.kept(x, u, after).all()
    box: Box = controller.goal.stay
    aside = after + np.array([0.1 * (box.high[0] - box.low[0]), 0.0])
    assert controller.contains(aside).sum() > 50
    assert not controller.kept(x, u, aside).any()
