"""MPC with feedback from disturbances: plans and runs keep their promise, from more states than with one gain."""

from __future__ import annotations

import pickle
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from gapcert import UsageError, load_controller
from gapcert.testing import SynthesizerContract
from gapcert_cells.testing import Band, rod_problem, rod_reach_avoid
from gapcert_mpc.controller import MpcController
from gapcert_mpc.synthesizer import Mpc
from gapcert_mpc.variants.disturbance import DisturbanceMpcController, Run

Array = np.ndarray
WIDE = Band((-4.5e-4, -1.8e-4), (4.5e-4, 1.8e-4))
HORIZON = 8


def synthesizer(horizon: int = HORIZON, **options: object) -> Mpc:
    made = Mpc(**{"horizon": horizon, "feedback": "disturbance", **options})
    made.starts = 10
    return made


@cache
def made(gap: Band | None = WIDE) -> DisturbanceMpcController:
    controller = synthesizer().synthesize(rod_problem(gap=gap))
    assert isinstance(controller, DisturbanceMpcController)
    return controller


@pytest.mark.exam
class TestContract(SynthesizerContract):
    states = 12
    gap = Band((-6e-4, -3e-4), (6e-4, 3e-4))

    def synthesizer(self) -> Mpc:
        return synthesizer(6)

    def test_reach_avoid_is_sound(self) -> None:
        with pytest.raises(UsageError, match=r"controller\.feedback: disturbance keeps invariance"):
            self.controller(rod_reach_avoid())

    def test_domain_keeps_to_the_goal(self) -> None:
        controller = self.controller()
        points = np.random.default_rng(1).uniform([-0.1, -0.4], [0.3, 0.4], (200, 2))
        inside = controller.contains(points)
        assert inside.any()
        assert controller.goal.holds(points[inside]).all()


@cache
def edge(controller: DisturbanceMpcController, count: int = 9) -> Array:
    """States of the domain that lie at its edge, by bisection from its middle outwards."""
    turn = 2 * np.pi * np.arange(count) / count
    inside = np.tile(controller.design.frame.out(controller.design.reference)[:2], (count, 1))
    outside = np.array([0.1, 0.0]) + np.stack([0.2 * np.cos(turn), 0.5 * np.sin(turn)], axis=1)
    for _ in range(12):
        middle = (inside + outside) / 2
        held = controller.contains(middle)[:, None]
        inside, outside = np.where(held, middle, inside), np.where(held, outside, middle)
    return inside


def pushed(controller: DisturbanceMpcController, gap: Band, x: Array, steps: int, anew: bool) -> tuple[Array, Array]:
    """Runs under corners of the gap, most for ever at one: (violations of the goal, broken promises), per run."""
    rng, model = np.random.default_rng(3), rod_problem().model
    corner, memory = rng.random(x.shape) < 0.5, controller.start(x)
    out, broken = np.zeros((2, len(x)), dtype=bool)
    for _ in range(steps):
        corner[::3] = rng.random(corner[::3].shape) < 0.5
        u = controller.respond(x, memory, "first")
        out |= (np.abs(u) > 1.0 + 1e-9).any(axis=1)
        after = model.step(x, u).x + np.where(corner, gap.low, gap.high)
        broken |= ~controller.kept(x, u, after, memory)
        memory, x = controller.advance(after, memory), after
        broken |= ~controller.keeps(x, memory)
        out |= ~controller.goal.holds(x)
    assert anew == (controller.counts["solved"] > 0)
    return out, broken


def without_solver(controller: DisturbanceMpcController, x: Array) -> DisturbanceMpcController:
    """The same, with plans from x and from nowhere else."""
    again = DisturbanceMpcController(controller.fixed)
    numbers = again.start(x)
    again.start = lambda x: numbers  # type: ignore[method-assign]
    again.responses.solve = lambda x, rows: None  # type: ignore[method-assign]
    return again


def test_corners_of_the_gap_break_nothing_at_the_edge_of_the_domain() -> None:
    controller = DisturbanceMpcController(made().fixed)
    out, broken = pushed(controller, WIDE, edge(made()), 25, anew=True)
    assert not out.any()
    assert not broken.any()
    assert controller.counts["shifted"] == 0, "what is left of a plan was feasible, and no plan was found"


def test_plans_that_trust_the_model_break_it() -> None:
    careless = made(None)
    out, broken = pushed(careless, WIDE, edge(careless), 25, anew=True)
    assert out.any()
    assert broken.any()


def test_a_plan_is_a_certificate_by_itself() -> None:
    """To its end and beyond, with no plan but the first; each state is where that plan foresaw it."""
    x = edge(made())
    controller = without_solver(made(), x)
    tubes = [controller.predicted(row, np.array([n])) for row, n in zip(x, controller.start(x), strict=True)]
    out, broken = pushed(controller, WIDE, x, 5 * HORIZON, anew=False)
    assert not out.any()
    assert not broken.any()
    assert controller.counts["shifted"] == 5 * HORIZON * len(x)
    rng, model, memory = np.random.default_rng(4), rod_problem().model, controller.start(x)
    for k in range(1, HORIZON + 1):
        x = model.step(x, controller.respond(x, memory, "first")).x + np.where(rng.random(x.shape) < 0.5, WIDE.low, WIDE.high)
        memory = controller.advance(x, memory)
        for row, tube in zip(x, tubes, strict=True):
            assert tube is not None
            assert (tube[1][k] <= row).all()
            assert (row <= tube[2][k]).all()


@pytest.mark.parametrize("flaw", ["deaf", "late"])
def test_a_plan_that_does_not_answer_breaks_it(flaw: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Inputs as if no disturbance had been, or each had come one step later, are not those that the plan is proved for."""
    x = edge(made())
    controller = without_solver(made(), x)
    input_of = DisturbanceMpcController._input

    def flawed(self: DisturbanceMpcController, x: Array, run: Run) -> Array:
        past = 0.0 * run.past if flaw == "deaf" else np.vstack([0.0 * run.past[:1], run.past[:-1]])
        return input_of(self, x, run._replace(past=past))

    monkeypatch.setattr(DisturbanceMpcController, "_input", flawed)
    assert pushed(controller, WIDE, x, 5 * HORIZON, anew=False)[0].any()


def test_the_terminal_set_is_invariant_and_no_smaller_one_is() -> None:
    made_of, rng = made().responses, np.random.default_rng(0)
    sec, size = made_of.section, len(made_of.base)
    moved, grows = sec.moved_by(made_of.A, made_of.B), np.abs(sec.H) @ made_of.radius
    for kappa in (np.zeros(size), *rng.random((20, size))):
        x, u, sigma = made_of.target(np.concatenate([rng.uniform(-0.1, 0.1, made_of.turn.shape[1]), kappa]))
        np.testing.assert_allclose(made_of.A @ x + made_of.B @ u + made_of.d, x, rtol=0, atol=1e-12)
        assert (moved @ sigma + grows <= sigma).all()
    assert not (moved @ (0.95 * made_of.base) + grows <= 0.95 * made_of.base).all()


def test_it_begins_wherever_one_gain_does_and_at_more_states() -> None:
    controller = made()
    x = np.random.default_rng(5).uniform([0, -0.25], [0.2, 0.25], (100, 2))
    fixed, answering = controller.fixed.contains(x), controller.contains(x)
    assert fixed.any()
    assert (answering >= fixed).all()
    assert answering.sum() > fixed.sum()


def test_a_disturbance_beyond_the_bounds_ends_the_promise() -> None:
    controller = DisturbanceMpcController(made().fixed)
    x = np.array([[0.1, 0.0]])
    memory = controller.start(x)
    u = controller.respond(x, memory, "first")
    after = rod_problem().model.step(x, u).x + 1.5 * WIDE.high
    assert not controller.kept(x, u, after, memory)[0]
    then = controller.advance(after, memory)
    assert controller.keeps(after, then)[0], "a new plan promises anew"
    controller.responses.solve = lambda x, rows: None  # type: ignore[method-assign]
    assert not controller.keeps(after, controller.advance(after, memory))[0]
    assert controller.fallbacks(controller.advance(after, memory))[0] == 1


def test_saved_and_loaded(tmp_path: Path) -> None:
    controller = made()
    controller.save(tmp_path)
    loaded, copied = load_controller(tmp_path), pickle.loads(pickle.dumps(controller))
    assert isinstance(loaded, DisturbanceMpcController)
    x = controller.draw(40, np.random.default_rng(0))[:5]
    for other in (loaded, copied):
        assert other.digest() == controller.digest()
        assert np.array_equal(other.act(x, "first"), controller.act(x))
    assert controller.digest() != controller.fixed.digest()
    file = tmp_path / "controller.json"
    file.write_text(file.read_text().replace('"feedback": "disturbance"', '"feedback": "fixed"'))
    with pytest.raises(UsageError, match="do not belong together"):
        MpcController.load(tmp_path)


def test_what_it_does_not_know_is_said() -> None:
    problem = rod_problem(gap=WIDE)
    for options in ({"linearisation": "successive"}, {"adapt": {"m": None}}):
        with pytest.raises(UsageError, match=r"controller\.feedback: disturbance keeps invariance"):
            synthesizer(**options).synthesize(problem)
    hopeless = synthesizer().synthesize(rod_problem(gap=Band((-1.0, -1.0), (1.0, 1.0))))
    assert not hopeless.wins
    assert "needs ±" in hopeless.evidence["reason"]
