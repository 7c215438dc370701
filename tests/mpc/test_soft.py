"""Ranges that are preferred: kept wherever a plan can, left at a cost where none can, and no part of what is promised."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tube_designs import drawn

from gapcert import UsageError
from gapcert_cells.testing import Band, Rod, rod_problem, rod_reach_avoid
from gapcert_mpc.controller import MpcController
from gapcert_mpc.program.program import Preferred
from gapcert_mpc.program.solver import Piqp
from gapcert_mpc.synthesizer import Mpc

Array = np.ndarray
GAP = Band((-1.5e-4, -6e-5), (1.5e-4, 6e-5))
LIMIT = 0.1
SOFT = {"omega": {"range": [-LIMIT, f"{LIMIT} rad/s"], "linear": 300.0}}
SOFT_ROWS = ("soft-above", "soft-below", "soft-positive")
WEIGHTS = {"omega": 0.01, "torque": 0.001}


@cache
def _made(majorant: str = "constant", linear: float | None = 300.0) -> MpcController:
    soft = None if linear is None else {"omega": {**SOFT["omega"], "linear": linear, "quadratic": 0.0}}
    problem = rod_problem(gap=GAP)
    found = Mpc(horizon=12, reference={"theta": 0.17}, weights=WEIGHTS, solver="piqp", majorant=majorant, soft=soft).synthesize(
        problem
    )
    assert isinstance(found, MpcController)
    return found


def made(majorant: str = "constant", linear: float | None = 300.0) -> MpcController:
    # Begins with no plan, and with no counts.
    return replace(_made(majorant, linear), counts={"solved": 0, "shifted": 0})


def played(controller: MpcController, x: Array, steps: int) -> Array:
    """x (steps + 1, nx) under disturbances at random corners."""
    rng, out = np.random.default_rng(0), [x[0]]
    memory = controller.start(x)
    for _ in range(steps):
        u = controller.respond(x, memory, "first")
        after = Rod().step(x, u).x + np.where(rng.random(2) < 0.5, GAP.low, GAP.high)
        assert controller.kept(x, u, after, memory)[0]
        assert controller.goal.holds(after)[0]
        x, memory = after, controller.advance(after, memory)
        out.append(x[0])
    assert controller.counts["shifted"] == 0
    return np.array(out)


def slack(controller: MpcController, x: Array) -> Array:
    """e (N + 1,) of the best plan from x (frame), in half-ranges."""
    program = controller.engine.program
    program.begin(x)
    found = Piqp(program.qp, 1e-9).solve()
    assert found.status == "solved"
    return np.asarray(found.z[program.at["e"]])


def without_excess(controller: MpcController, x: Array) -> bool:
    """Is there a plan from x (frame) whose slacks are 0?"""
    program = controller.engine.program
    program.begin(x)
    high = program.high.copy()
    first = program._assembled().blocks["soft-positive"][0]
    high[first] = 1e-7
    return Piqp(program.qp._replace(high=high), 1e-9).solve().status == "solved"


@pytest.mark.exam
@pytest.mark.parametrize(("majorant", "linear"), [("constant", 300.0), ("affine", 300.0), ("affine", 10.0)])
def test_the_domain_is_the_same(majorant: str, linear: float) -> None:
    x = np.random.default_rng(2).uniform([0.0, -0.25], [0.2, 0.25], (120, 2))
    inside = made(majorant, linear).contains(x)
    assert np.array_equal(inside, made(majorant, None).contains(x))
    assert 0 < inside.sum() < len(x)
    assert (np.abs(x[inside, 1]) > LIMIT).any()


def test_a_large_enough_cost_keeps_the_range_wherever_a_plan_can() -> None:
    controller = made()
    x = controller.draw(60, np.random.default_rng(1))
    x = controller.framed(x[np.abs(x[:, 1]) < 1.3 * LIMIT])
    can = np.array([without_excess(controller, row) for row in x])
    assert 0 < can.sum() < len(x)
    assert max(slack(controller, row).max() for row in x[can]) < 1e-5
    assert min(slack(controller, row).max() for row in x[~can]) > 1e-4
    # A small one buys speed with it.
    assert max(slack(made(linear=1e-3), row).max() for row in x[can]) > 0.1


def test_a_run_prefers_the_range_and_comes_back_to_it() -> None:
    x, room = np.array([[0.03, 0.0]]), GAP.high[1]
    free, kept = (np.abs(played(made(linear=linear), x, 120)[:, 1]) for linear in (None, 300.0))
    assert free.max() > 1.5 * LIMIT
    assert 0.9 * LIMIT < kept.max() <= LIMIT + 2 * room
    x = np.array([[0.03, 2 * LIMIT]])
    back = np.abs(played(made(), x, 120)[:, 1])
    assert back[0] == 2 * LIMIT
    assert back[30:].max() <= LIMIT + 2 * room


@pytest.mark.parametrize("seed", range(6))
def test_slacks_hold_the_excess_of_every_stage_and_of_the_pair_and_no_less(seed: int) -> None:
    design = drawn(seed % 3, bool(seed % 2))
    n, rng = design.frame.nx, np.random.default_rng(seed)
    axis, low, high = np.array([n - 1, n]), np.array([-0.3, 0.1]), np.array([-0.1, 0.2])
    program = replace(design, soft=Preferred(axis, low, high, np.ones(2), np.ones(2))).program()
    z, at = rng.uniform(-1, 1, program.size), program.at

    def excess(z: Array, j: int) -> Array:
        return np.asarray(np.maximum(0.0, np.maximum(z - high[j], low[j] - z)))

    x, u = excess(z[at["x"] + n - 1], 0), excess(z[at["u"]], 1)
    xs, us = excess(z[at["xs"] + n - 1], 0), excess(z[at["us"]], 1)
    e = np.stack([np.append(x[:-1], max(x[-1], xs[0])), np.append(u, us)], axis=1)
    columns = at["e"][:, None] + np.arange(2)
    blocks = program._assembled().blocks
    rows = np.concatenate([(blocks[k][0][:, None] + np.arange(2)).ravel() for k in SOFT_ROWS])

    def missed(e: Array) -> float:
        z[columns] = e
        return float((program.low - program.A @ z)[rows].max())

    assert missed(e) < 1e-12
    for k, j in np.ndindex(e.shape):
        less = e.copy()
        less[k, j] -= 1e-6
        assert missed(less) > 5e-7


def test_slacks_are_guessed_from_those_of_the_step_before() -> None:
    program = made().engine.program
    z, *_ = program.shifted()
    assert np.array_equal(z[program.at["e"]], np.append(program.at["e"][1:], program.at["e"][-1]))


def test_a_file_has_it(tmp_path: Path) -> None:
    controller = made()
    controller.save(tmp_path)
    x = controller.draw(20, np.random.default_rng(0))[:4]
    loaded = MpcController.load(tmp_path)
    assert loaded.digest() == controller.digest() != made(linear=None).digest()
    assert np.array_equal(loaded.act(x), controller.act(x))


@pytest.mark.parametrize(
    ("soft", "told"),
    [
        ({"speed": {"range": [0, 1]}}, "'speed' is unknown; expected some of theta, omega, torque"),
        ({"omega": {"range": [1, 0]}}, r"expected \[low, high\]"),
        ({"omega": {"range": ["0 m", 1]}}, r"controller\.soft\.omega"),
    ],
)
def test_what_is_no_range_is_refused(soft: dict[str, Any], told: str) -> None:
    problem = rod_problem(gap=GAP)
    with pytest.raises(UsageError, match=told):
        Mpc(soft=soft).check(problem.model, problem.domain, problem.goal)


@pytest.mark.parametrize("other", [{"adapt": {"m": "10 %"}}, {"linearisation": "successive"}, {"feedback": "disturbance"}])
def test_what_prefers_nothing_says_so(other: dict[str, Any]) -> None:
    problem = rod_problem(gap=GAP)
    with pytest.raises(UsageError, match=r"controller\.soft: ranges are preferred"):
        Mpc(soft=SOFT, **other).check(problem.model, problem.domain, problem.goal)
    with pytest.raises(UsageError, match=r"controller\.soft: ranges are preferred"):
        Mpc(soft=SOFT).synthesize(rod_problem(rod_reach_avoid(), GAP))
