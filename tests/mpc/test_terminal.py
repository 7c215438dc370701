"""Plans that end in the winning set of a controller on cells: what they win, and what keeps the promise where they end."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gapcert import Box, Goal, UsageError, load_controller, registry
from gapcert.testing import SynthesizerContract
from gapcert_cells.testing import Band, rod_problem, rod_reach_avoid
from gapcert_mpc.config import MpcConfig, Terminal
from gapcert_mpc.controller import MpcController
from gapcert_mpc.planning.design import Ends
from gapcert_mpc.planning.engine import Landing
from gapcert_mpc.synthesizer import Mpc
from gapcert_mpc.variants import terminal
from gapcert_mpc.variants.terminal import HandedController, Sums, inscribed, lost

Array = np.ndarray
GAP = Band((-1.5e-4, -6e-5), (1.5e-4, 6e-5))
CELLS = {"kind": "symbolic", "cells": {"theta": 100, "omega": 60}, "inputs": {"torque": 9}}
LOW, HIGH = np.array([0.0, -0.25]), np.array([0.2, 0.25])


def mpc(**options: Any) -> Mpc:
    made = Mpc(**{"horizon": 5, "terminal": CELLS, **options})
    made.starts = 40
    return made


@cache
def made() -> HandedController:
    found = mpc().synthesize(rod_problem(gap=GAP))
    assert isinstance(found, HandedController)
    return found


def fresh(controller: HandedController, boxes: Array | None = None) -> HandedController:
    """With its own solvers and memory; with other boxes in which plans end."""
    design = controller.design
    assert design.ends is not None
    design = replace(design, ends=Ends(design.ends.boxes if boxes is None else boxes, design.ends.F))
    return replace(controller, plans=MpcController(controller.goal, design, {}, controller.plans.solver))


def on_the_edge(controller: HandedController, count: int) -> Array:
    """States from which a plan leads into the winning set, which they are not in."""
    x = np.random.default_rng(7).uniform(LOW, HIGH, (400, 2))
    x = x[~controller.then.contains(x)]
    return np.asarray(x[controller.plans.contains(x)][:count])


def pushed(controller: HandedController, x: Array, steps: int, online: bool = True) -> int:
    """Steps that leave the goal or break the promise, under corners of the gap; offline no plan is made but the first."""
    model, rng, memory = rod_problem().model, np.random.default_rng(3), controller.start(x)
    corner, bad = np.where(rng.random(x.shape) < 0.5, GAP.low, GAP.high), 0
    assert (memory > 0).all()
    if not online:
        controller.plans.engine.solvers.clear()
    for k in range(steps):
        u = controller.respond(x, memory, "first")
        now = corner if k % 8 < 6 else np.where(rng.random(x.shape) < 0.5, GAP.low, GAP.high)
        after = model.step(x, u).x + now
        bad += int((~controller.kept(x, u, after, memory)).sum())
        memory, x = controller.advance(after, memory), after
        keeps = controller.keeps(x, memory)
        bad += int((~keeps | ~controller.goal.holds(x)).sum())
        if not keeps.all():
            return bad
    return bad


class TestContract(SynthesizerContract):
    states = 6

    def synthesizer(self) -> Mpc:
        return mpc()

    def test_reach_avoid_is_sound(self) -> None:
        with pytest.raises(UsageError, match="terminal: plans end in a winning set for invariance"):
            self.controller(rod_reach_avoid())

    def test_domain_keeps_to_the_goal(self) -> None:
        points = np.random.default_rng(1).uniform(LOW - 0.1, HIGH + 0.1, (60, 2))
        assert not (made().contains(points) & ~made().goal.holds(points)).any()

    def test_gap_shrinks_the_domain(self) -> None:
        trusting, x = mpc().synthesize(rod_problem()), np.random.default_rng(2).uniform(LOW, HIGH, (150, 2))
        with_gap, without = made().contains(x), trusting.contains(x)
        assert not (with_gap & ~without).any()
        assert (without & ~with_gap).any(), "the gap costs nothing: is it used?"


def test_it_starts_where_a_steady_pair_is_too_far() -> None:
    steady = Mpc(horizon=5)
    steady.starts = 1
    x = np.random.default_rng(5).uniform(LOW, HIGH, (150, 2))
    around, into = steady.synthesize(rod_problem(gap=GAP)).contains(x), made().plans.contains(x)
    assert into.mean() > around.mean() + 0.1
    assert (into & ~made().then.contains(x)).any(), "plans reach no further than the cells do"


def test_corners_of_the_gap_break_nothing() -> None:
    controller = fresh(made())
    x = np.vstack([on_the_edge(controller, 6), controller.draw(64, np.random.default_rng(0))[:4]])
    assert pushed(controller, x, 120) == 0
    assert controller.counts["solved"] > 0


def test_where_no_plan_is_found_the_cells_take_over() -> None:
    controller = fresh(made())
    x = np.vstack([on_the_edge(controller, 8), controller.draw(64, np.random.default_rng(0))[:4]])
    assert pushed(controller, x, 300, online=False) == 0
    assert controller.counts["solved"] == 0


def test_a_tube_that_follows_the_plan_ends_in_winning_cells_too() -> None:
    controller = mpc(majorant="affine").synthesize(rod_problem(gap=GAP))
    assert isinstance(controller, HandedController)
    assert controller.plans.engine.program.variable
    assert pushed(controller, on_the_edge(controller, 4), 40, online=False) == 0


def test_a_spec_asks_for_it() -> None:
    config = MpcConfig.model_validate({"kind": "mpc", "terminal": CELLS | {"boxes": 3}})
    asked = registry().build("synthesizer", "mpc", config)
    assert asked.options.terminal == Terminal(boxes=3, **CELLS)
    assert registry().build("synthesizer", "mpc", MpcConfig()).options.terminal is None


def test_a_new_plan_takes_over_from_the_cells() -> None:
    controller, model = fresh(made()), rod_problem().model
    x, rng = on_the_edge(controller, 3), np.random.default_rng(0)
    memory, solvers = controller.start(x), list(controller.plans.engine.solvers)
    controller.plans.engine.solvers.clear()
    for k in range(60):
        x = model.step(x, controller.respond(x, memory, "first")).x + rng.uniform(GAP.low, GAP.high, x.shape)
        memory = controller.advance(x, memory)
        assert controller.keeps(x, memory).all()
        if k == 10:
            assert (controller.fallbacks(memory) == 11).all()
            assert controller.predicted(x[0], memory[:1]) is None
            tube = controller.tube(x[0], controller.respond(x[:1], memory[:1], "first")[0], memory[:1])
            assert tube is not None
            assert tube.shape == (1, 2, 2)
            controller.plans.engine.solvers.extend(solvers)
    assert (controller.fallbacks(memory) < 60).all()
    found = controller.predicted(x[0], memory[:1])
    assert found is not None
    assert len(found[0]) == 6


def test_a_box_with_a_losing_cell_is_refused_and_breaks_the_promise(monkeypatch: pytest.MonkeyPatch) -> None:
    controller = made()
    middle, half = controller.design.frame.x
    then = controller.then
    # The corner of fast motion to the right, where no input brakes in time.
    losing = np.array([[0.19, 0.2], [0.2, 0.25]])
    assert lost(then, losing) > 0
    box = np.array([[0.1, 0.0], [0.102, 0.002]])
    assert lost(then, box) == 0
    assert lost(then, box + 0.2) > 0, "outside the grid"
    planted = ((losing - middle) / half)[None]
    with pytest.raises(UsageError, match="losing cells"):
        fresh(controller, planted)
    monkeypatch.setattr(terminal, "lost", lambda then, box: 0)
    careless = fresh(controller, planted)
    x = np.random.default_rng(1).uniform([0.17, 0.2], HIGH, (200, 2))
    x = x[careless.plans.contains(x)][:6]
    assert len(x)
    assert pushed(careless, x, 40, online=False) > 0


def test_without_the_tube_at_the_end_the_promise_breaks() -> None:
    """Plans whose centre alone ends in a box come out of the winning set under the corners of the gap."""
    controller = fresh(made())
    wide = controller.plans.engine.program.constant[-1] @ controller.design.section.support[:2].T
    landing = controller.plans.planner
    assert isinstance(landing, Landing)
    landing.boxes = landing.boxes + np.array([[-1.0], [1.0]]) * wide
    x = on_the_edge(controller, 40)
    assert pushed(controller, x, 8, online=False) > 0
    careful = fresh(made())
    x = x[careful.plans.contains(x)]
    assert len(x)
    assert pushed(careful, x, 8, online=False) == 0


def test_saved_and_loaded(tmp_path: Path) -> None:
    controller = made()
    controller.save(tmp_path)
    loaded = load_controller(tmp_path)
    assert isinstance(loaded, HandedController)
    assert loaded.digest() == controller.digest()
    assert dict(loaded.evidence) == dict(controller.evidence)
    x = on_the_edge(controller, 3)
    assert np.array_equal(loaded.act(x), controller.act(x))
    with pytest.raises(UsageError, match="load it with load_controller"):
        MpcController.load(tmp_path)
    file = tmp_path / "controller.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"terminal": "last"}))
    with pytest.raises(UsageError, match="do not belong together"):
        load_controller(tmp_path)
    (tmp_path / "terminal" / "controller.json").unlink()
    with pytest.raises(UsageError, match="no saved controller"):
        load_controller(tmp_path)


def test_first_cause_is_named() -> None:
    def reason(goal: Goal | None = None, gap: Band = GAP, **options: Any) -> str:
        return str(mpc(**options).synthesize(rod_problem(goal, gap)).evidence["reason"])

    coarse = CELLS | {"cells": {"theta": 20, "omega": 20}}
    assert "the winning set in which plans would end is empty: omega: cells are" in reason(terminal=coarse)
    narrow = Goal("invariance", Box(rod_problem().model.states, (0.06, -0.25), (0.085, 0.25)))
    few = CELLS | {"cells": {"theta": 60, "omega": 120}}
    wide = Band(3 * GAP.low, 3 * GAP.high)
    assert "after 60 steps the tube needs ± 0.01158 of theta" in reason(narrow, wide, horizon=60, terminal=few)


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ({"kind": "nowhere"}, "no plugin provides synthesizer 'nowhere'"),
        ({"kind": "mpc"}, "makes no controller on cells; use symbolic"),
        ({"kind": "symbolic"}, "cells and inputs are needed"),
        (CELLS | {"cell": {}}, "controller.terminal: cell"),
        (CELLS | {"growth": {"model": "growth.yaml"}}, "leave growth out"),
        (CELLS | {"cells": {"theta": 9}}, "nothing for 'omega'"),
    ],
)
def test_what_cannot_be_used_is_refused(asked: dict[str, Any], said: str) -> None:
    problem = rod_problem(gap=GAP)
    with pytest.raises(UsageError, match=said):
        mpc(terminal=asked).check(problem.model, problem.domain, problem.goal)


def test_only_invariance_along_one_line() -> None:
    problem = rod_problem(gap=GAP)
    with pytest.raises(UsageError, match="invariance"):
        mpc(linearisation="successive").check(problem.model, problem.domain, problem.goal)
    target = rod_reach_avoid()
    with pytest.raises(UsageError, match="invariance"):
        mpc().check(problem.model, problem.domain, Goal("reach_avoid", target.stay, target.target))


@pytest.mark.parametrize("shape", [(40,), (14, 11), (7, 6, 5), (4, 5, 4, 3)])
@pytest.mark.parametrize("seed", range(3))
def test_boxes_hold_winning_cells_alone_and_cannot_grow(shape: tuple[int, ...], seed: int) -> None:
    rng = np.random.default_rng(seed)
    winning = rng.random(shape) < 0.97
    room = np.ones(len(shape), dtype=np.int64)
    boxes = inscribed(winning, room, 5)
    assert boxes
    for box in boxes:
        assert winning[box.slices].all()
        assert (box.after - box.first > room).all()
        for j, up in product(range(len(shape)), (False, True)):
            first, after = box.first.copy(), box.after.copy()
            first[j], after[j] = first[j] - (not up), after[j] + up
            wider = tuple(slice(a, b) for a, b in zip(first.tolist(), after.tolist(), strict=True))
            assert first[j] < 0 or after[j] > shape[j] or not winning[wider].all()
    best = 0
    sums = Sums(winning)
    ends = [[(a, b) for a in range(n) for b in range(a + 2, n + 1)] for n in shape]
    for cut in product(*ends) if len(shape) == 2 else ():
        box = type(boxes[0])(np.array([a for a, _ in cut]), np.array([b for _, b in cut]))
        best = max(best, int(np.prod(box.after - box.first)) if sums.whole(box) else 0)
    assert max(int(np.prod(b.after - b.first)) for b in boxes) >= 0.7 * best


def test_one_losing_cell_is_never_covered() -> None:
    for at in product(range(6), range(5)):
        winning = np.ones((6, 5), dtype=bool)
        winning[at] = False
        boxes = inscribed(winning, np.zeros(2, dtype=np.int64), 20)
        covered = np.zeros_like(winning)
        for box in boxes:
            covered[box.slices] = True
        assert (covered == winning).all()
    assert inscribed(np.zeros((3, 3), dtype=bool), np.zeros(2, dtype=np.int64), 3) == []
