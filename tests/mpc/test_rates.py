"""Inputs that may not change faster than they can: kept by plans, by what is left of them, and by the terminal feedback."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
import scipy.sparse as sp
from scipy.optimize import linprog

from gapcert import UsageError
from gapcert_cells.testing import Band, rod_problem, rod_reach_avoid
from gapcert_mpc.controller import MpcController
from gapcert_mpc.program.program import Program, Table
from gapcert_mpc.synthesizer import Mpc

Array = np.ndarray
GAP = Band((-1.5e-4, -6e-5), (1.5e-4, 6e-5))
RATE = 0.06
Majorant = Literal["auto", "affine", "constant"]


@cache
def _made(majorant: Majorant, rate: float | str | None, horizon: int) -> MpcController:
    rates = None if rate is None else {"torque": rate}
    found = Mpc(horizon=horizon, reference={"theta": 0.19}, solver="osqp", majorant=majorant, rates=rates).synthesize(
        rod_problem(gap=GAP)
    )
    assert isinstance(found, MpcController)
    return found


def made(majorant: Majorant = "constant", rate: float | str | None = RATE, horizon: int = 12) -> MpcController:
    # Begins with no plan, and with no counts.
    return replace(_made(majorant, rate, horizon), counts={"solved": 0, "shifted": 0})


def changes(controller: MpcController, steps: int, corners: str, solve: int = 1, seed: int = 0) -> Array:
    """|u_k − u_{k−1}| (steps − 1, runs) of runs under corners of the gap, with a new plan at every `solve`-th step only."""
    rng, model = np.random.default_rng(seed), rod_problem().model
    x = controller.draw(400, rng)[:6]
    memory, inputs, solvers = controller.start(x), [], list(controller.engine.solvers)
    fixed = np.where(rng.random(x.shape) < 0.5, GAP.low, GAP.high)
    for k in range(steps):
        inputs.append(controller.respond(x, memory, "first")[:, 0])
        each = np.where(rng.random(x.shape) < 0.5, GAP.low, GAP.high)
        x = model.step(x, inputs[-1][:, None]).x + (fixed if corners == "fixed" else each)
        assert controller.goal.holds(x).all()
        controller.engine.solvers[:] = solvers if (k + 1) % solve == 0 else []
        memory = controller.advance(x, memory)
    controller.engine.solvers[:] = solvers
    return np.abs(np.diff(inputs, axis=0))


@pytest.mark.exam
@pytest.mark.parametrize(("majorant", "horizon"), [("constant", 12), ("affine", 8), ("affine", 1)])
def test_no_input_changes_faster_and_no_plan_is_lost(majorant: Majorant, horizon: int) -> None:
    controller = made(majorant, horizon=horizon)
    assert controller.wins, controller.evidence
    found = np.vstack([changes(controller, 60, corners) for corners in ("fixed", "each")])
    assert found.max() <= RATE
    if horizon > 1:
        assert found.max() > 0.95 * RATE, "the limit held nothing back"
    assert controller.counts["shifted"] == 0, "a plan that could be shifted was not found again"


@pytest.mark.exam
def test_plans_that_go_on_and_the_terminal_feedback_keep_it() -> None:
    controller = made()
    # A new plan now and then: after some steps of the old one, and after all of them.
    for solve in (3, 17, 1000):
        assert changes(controller, 70, "each", solve).max() <= RATE
    assert controller.counts["shifted"] > 600
    before = controller.counts["shifted"]
    changes(controller, 60, "fixed", 20)
    assert controller.counts["shifted"] - before == 6 * 57, "from the terminal set no plan was found"


def test_without_the_tube_s_part_it_is_exceeded(monkeypatch: pytest.MonkeyPatch) -> None:
    def careless(program: Program, table: Table, rates: Array) -> Array:
        """Of the plan alone, as if the feedback changed nothing."""
        feedback, section = program.section.K, program.section
        object.__setattr__(section, "K", 0 * feedback)
        try:
            return limit(program, table, rates)
        finally:
            object.__setattr__(section, "K", feedback)

    limit = Program._rates
    monkeypatch.setattr(Program, "_rates", careless)
    wrong = _made.__wrapped__("constant", RATE, 12)  # is nobody else's
    assert max(changes(wrong, 60, "each", solve).max() for solve in (1, 17)) > RATE


def test_the_terminal_set_asks_for_a_rate_of_its_own() -> None:
    """With one step to plan, nothing but the feedback of the terminal set needs it."""
    controller = made("constant", RATE, 1)
    assert controller.design is not None
    section, st, eps = controller.design.section, controller.design.stages, controller.design.tolerance
    size = controller.design.program().terminal[0]
    needed = section.turning(section.closed) @ size + np.abs(section.K) @ (st.c[-1] + eps) + eps
    x = controller.draw(400, np.random.default_rng(0))[:20]
    for share, some in ((1.2, True), (0.9, False)):
        limited = replace(controller, design=replace(controller.design, rates=share * needed))
        assert limited.contains(x).any() == some


def test_what_the_solver_may_miss_is_taken_off() -> None:
    """An answer that misses every row by ε keeps the rates on the whole tube, where equations are missed by ε, too."""
    design = made().design
    assert design is not None
    assert design.rates is not None
    program = replace(design, tolerance=1e-3).program()
    at, st, sec, eps = program.at, program.stages, program.section, program.tolerance
    cost = np.zeros(program.size)
    cost[at["u"][:2]] = 1.0, -1.0

    def fastest(missed: float) -> float:
        sides = np.concatenate([program.high, -program.low])
        rows = np.flatnonzero(np.isfinite(sides))
        found = linprog(cost, sp.vstack([program.A, -program.A]).tocsr()[rows], sides[rows] + missed, bounds=(None, None))
        assert found.status == 0
        tube = sec.turning(st.A[0] + st.B[0] @ sec.K) @ program.constant[0] + np.abs(sec.K) @ (st.c[0] + eps)
        return float(tube[0] - found.fun)

    assert fastest(eps) <= design.rates[0] + 1e-9
    assert fastest(3 * eps) > design.rates[0]


def test_fewer_states_can_be_kept() -> None:
    some = made()
    assert some.design is not None
    # Of the same gain; with another one there may be more of them.
    few, all_ = (replace(some, design=replace(some.design, rates=r)) for r in (np.array([0.02]), None))
    x = np.random.default_rng(2).uniform([0.0, -0.25], [0.2, 0.25], (150, 2))
    a, b, c = (controller.contains(x) for controller in (few, some, all_))
    assert not (a & ~b).any()
    assert not (b & ~c).any()
    assert 0 < a.sum() < b.sum() < c.sum()


@pytest.mark.exam
def test_a_run_remembers_its_input_and_a_file_its_rates(tmp_path: Path) -> None:
    controller = made(rate="0.06 N*m")
    controller.save(tmp_path)
    loaded = MpcController.load(tmp_path)
    assert loaded.digest() == controller.digest() == made().digest() != made(rate=None).digest()
    x = controller.draw(400, np.random.default_rng(0))[0]
    u, info = loaded.step(x)
    again, _ = loaded.step(x, info.memory)
    assert u is not None
    assert again is not None
    assert abs(again - u).max() <= RATE


def test_the_audit_refutes_an_input_that_jumps() -> None:
    """The promise of a step has its input in it: one that is further from the last is found out though its tube is kept."""
    controller, model = made(), rod_problem().model
    x = controller.draw(400, np.random.default_rng(0))[:1]
    memory = controller.start(x)
    for _ in range(2):
        u = controller.respond(x, memory, "first")
        before, x = x, model.step(x, u).x
        assert controller.kept(before, u, x, memory).all()
        held, memory = memory, controller.advance(x, memory)
    assert not controller.kept(before, u + 2.01 * RATE, x, held).any()


def test_no_rates_no_rows() -> None:
    free = made(rate=None)
    assert free.design is not None
    assert not [name for name in free.design.program()._assembled().blocks if name.startswith("rate")]
    assert "rates" not in free.design.arrays()


@pytest.mark.parametrize(
    ("rates", "told"),
    [
        ({"theta": 1.0}, "'theta' is no input; expected some of torque"),
        ({"torque": 0.0}, "found 0.0; expected a positive change"),
        ({"torque": "1 m"}, "rates.torque"),
    ],
)
def test_what_is_no_rate_is_refused(rates: dict[str, float | str], told: str) -> None:
    with pytest.raises(UsageError, match=told):
        Mpc(rates=rates).synthesize(rod_problem(gap=GAP))


@pytest.mark.parametrize(
    "other",
    [
        {"adapt": {"m": "10 %"}},
        {"terminal": {"cells": {"theta": 9, "omega": 9}, "inputs": {"torque": 3}}},
        {"linearisation": "successive"},
        {"feedback": "disturbance"},
    ],
)
def test_what_has_no_limits_of_rates_says_so(other: dict[str, Any]) -> None:
    problem = rod_problem(gap=GAP)
    with pytest.raises(UsageError, match=r"controller\.rates: inputs are limited"):
        Mpc(rates={"torque": 0.1}, **other).check(problem.model, problem.domain, problem.goal)


def test_what_reaches_has_no_limits_of_rates_and_no_gain_keeps_those_that_are_too_small() -> None:
    with pytest.raises(UsageError, match=r"controller\.rates: inputs are limited"):
        Mpc(rates={"torque": 0.1}).synthesize(rod_problem(rod_reach_avoid(), GAP))
    assert "the feedback alone takes" in made(rate=1e-3).evidence["reason"]
