"""The robust MPC keeps invariance whatever γ allows, plan by plan and step by step."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from gapcert import GapFunction, Interval, UsageError
from gapcert.testing import SynthesizerContract
from gapcert_cells.testing import Band, rod_problem
from gapcert_mpc.controller import MpcController
from gapcert_mpc.program.linearise import Frame, Nominal
from gapcert_mpc.program.tube import Section, regulator
from gapcert_mpc.synthesizer import Mpc
from gapcert_mpc.variants.regulation import margin

Array = np.ndarray
GAP = Band((-1.5e-4, -6e-5), (1.5e-4, 6e-5))


class TestContract(SynthesizerContract):
    states = 16

    def synthesizer(self) -> Mpc:
        return Mpc(horizon=20, majorant="constant")

    @pytest.mark.exam
    def test_reach_avoid_is_sound(self) -> None:
        super().test_reach_avoid_is_sound()

    @pytest.mark.exam
    def test_domain_keeps_to_the_goal(self) -> None:
        super().test_domain_keeps_to_the_goal()


def made(gap: GapFunction | None = GAP, **options: object) -> MpcController:
    return Mpc(**{"horizon": 20, "majorant": "constant", "reference": {"theta": 0.199}, **options}).synthesize(
        rod_problem(gap=gap)
    )  # type: ignore[arg-type]


def pushed(controller: MpcController, gap: Band, starts: int, steps: int) -> tuple[Array, Array]:
    """Runs under a disturbance that stays at one corner of the gap: (violations of the goal, broken promises), per run."""
    rng = np.random.default_rng(3)
    x = controller.draw(400, rng)[:starts]
    corner = np.where(rng.random((len(x), 2)) < 0.5, gap.low, gap.high)
    memory, model = controller.start(x), rod_problem().model
    out, broken = np.zeros((2, len(x)), dtype=bool)
    for _ in range(steps):
        u = controller.respond(x, memory, "first")
        after = model.step(x, u).x + corner
        broken |= ~controller.kept(x, u, after, memory)
        memory, x = controller.advance(after, memory), after
        out |= ~controller.goal.holds(x)
    return out, broken


@pytest.mark.exam
@pytest.mark.parametrize("majorant", ["constant", "affine"])
def test_corners_of_the_gap_break_nothing(majorant: str) -> None:
    controller = made(majorant=majorant)
    out, broken = pushed(controller, GAP, 8, 100)
    assert not out.any()
    assert not broken.any()
    assert controller.counts["shifted"] == 0, "a plan that could be shifted was not found again"


@pytest.mark.exam
def test_without_the_tube_they_break_it() -> None:
    careless = made(None)
    out, broken = pushed(careless, GAP, 12, 100)
    assert out.any()
    assert broken.any()


def test_a_plan_is_a_certificate_by_itself() -> None:
    """Without any solver after the start the runs go on with their plans, and beyond them with the terminal feedback."""
    controller = made()
    x = controller.draw(400, np.random.default_rng(0))[:12]
    memory = controller.start(x)
    controller.engine.solvers.clear()
    controller.engine.pieces.parts.clear()
    rng, model = np.random.default_rng(1), rod_problem().model
    for _ in range(200):
        u = controller.respond(x, memory, "first")
        x = model.step(x, u).x + np.where(rng.random(x.shape) < 0.5, GAP.low, GAP.high)
        memory = controller.advance(x, memory)
        assert controller.keeps(x, memory).all()
        assert controller.goal.holds(x).all()
    assert controller.counts["solved"] == 0
    assert controller.counts["shifted"] == 200 * 12


def test_the_straight_line_bounds_what_it_leaves_out() -> None:
    problem = rod_problem(gap=GAP)
    low, high = np.array([0, -0.25, -1.0]), np.array([0.2, 0.25, 1.0])
    frame = Frame.of(low, high, 2)
    stage = Nominal(problem.model, GAP).straight(low, high, 1, frame)
    z = np.random.default_rng(5).uniform(low, high, (20_000, 3))
    zeta = frame.into(z)
    after = (problem.model.step(z[:, :2], z[:, 2:]).x - frame.x[0]) / frame.x[1]
    line = zeta[:, :2] @ stage.A[0].T + zeta[:, 2:] @ stage.B[0].T + stage.d[0]
    bound = stage.c[0] + np.abs(zeta - stage.centre[0]) @ stage.G[0].T
    worst = np.abs(after - line) + np.array([1.5e-4, 6e-5]) / frame.x[1]
    assert (worst <= bound).all()
    # Without the remainder, the gap alone is too little.
    assert not (worst <= np.array([1.5e-4, 6e-5]) / frame.x[1]).all()


def test_terminal_set_is_invariant_by_intervals() -> None:
    controller = made()
    design = controller.design
    assert design is not None
    nominal = Nominal(rod_problem().model, GAP)
    base, _, per = design.program().terminal
    away = np.abs(design.reference - design.stages.centre[-1])
    size = base + per @ away[design.program().on]
    ends = design.reference[:2], design.reference[2:]
    assert margin(nominal, design.frame, design.section, *ends, size) > 0
    assert margin(nominal, design.frame, design.section, *ends, 0.95 * size) < 0, "a smaller set is kept too: is γ counted?"


def test_first_cause_is_named() -> None:
    wide = made(Band((-1.0, -1.0), (1.0, 1.0)))
    assert not wide.wins
    assert "theta" in wide.evidence["reason"] or "omega" in wide.evidence["reason"]

    class Endless(Band):  # type: ignore[misc]
        def interval_over(self, boxes: Interval) -> Interval:
            return Interval(*(np.full((len(boxes), 2), v) for v in (-np.inf, np.inf)))

    endless = made(Endless((0.0, 0.0), (1.0, 1.0)))
    assert "unbounded" in endless.evidence["reason"]
    with pytest.raises(UsageError, match="unknown"):
        made(reference={"thete": 0.1})


def test_a_state_that_is_no_number_is_refused() -> None:
    controller = made()
    nan = np.full((1, 2), np.nan)
    assert not controller.contains(nan)[0]
    with pytest.raises(UsageError, match="no plan begins"):
        controller.act(nan)


def test_saved_and_loaded(tmp_path: Path) -> None:
    controller = made()
    controller.save(tmp_path)
    loaded = MpcController.load(tmp_path)
    x = controller.draw(400, np.random.default_rng(0))[:5]
    assert loaded.digest() == controller.digest()
    assert dict(loaded.evidence) == dict(controller.evidence)
    np.testing.assert_allclose(loaded.act(x), controller.act(x), rtol=0, atol=2e-4)
    (tmp_path / "controller.json").write_text(
        (tmp_path / "controller.json").read_text().replace('"solver": "', '"solver": "clarabel')
    )
    with pytest.raises(UsageError, match="do not belong together"):
        MpcController.load(tmp_path)


def test_a_problem_without_a_stabilising_gain_says_so() -> None:
    problem = rod_problem(gap=GAP)

    class Deaf(type(problem.model)):  # type: ignore[misc]
        def jacobian_enclosure(self, z: Interval) -> Interval:
            J = super().jacobian_enclosure(z)
            lo, hi = J.lo.copy(), J.hi.copy()
            lo[..., 2:], hi[..., 2:] = 0.0, 0.0
            lo[..., 0, 0], hi[..., 0, 0] = 1.5, 1.5
            return Interval(lo, hi)

    reason = Mpc().synthesize(dataclasses.replace(problem, model=Deaf())).evidence["reason"]
    assert "no gain stabilises theta: it grows by 1.499 per step" in reason


def test_where_one_begins_is_planned_once() -> None:
    controller = made()
    x = controller.draw(40, np.random.default_rng(6))
    first = controller.start(x)
    controller.engine.pieces = None
    controller.engine.solvers.clear()
    assert controller.contains(x).all()
    assert (controller.start(x) == first).all()
    assert not controller.contains(x + 1e-12).any()


def test_a_steady_section_is_what_a_step_makes_of_it() -> None:
    A, B = np.array([[1.0, 0.1], [0.2, 1.0]]), np.array([[0.0], [1.0]])
    section = Section.of(A, B, regulator(A, B, np.ones(1), np.ones(2)))
    c, G, away = np.array([0.01, 0.02]), np.array([[1e-3, 0.0, 2e-3], [0.0, 3e-3, 1e-3]]), 0.5
    size = section.steady(c, G, away)
    after = np.abs(section.moved) @ size + np.abs(section.H) @ (c + G @ (away + section.support @ size))
    assert size == pytest.approx(after, rel=1e-9)
    assert (size > section.steady(c, G, 0.0)).all()


@pytest.mark.parametrize(
    ("option", "says"),
    [
        ({"horizon": 0}, "controller.horizon: found 0; expected greater than or equal to 1"),
        ({"solver": "nope"}, "controller.solver: found 'nope'; expected 'auto', 'osqp', 'piqp' or 'clarabel'"),
        ({"horizons": 5}, "controller.horizons: unknown key 'horizons'"),
    ],
)
def test_an_option_that_is_none_is_refused_where_it_is_given(option, says):
    with pytest.raises(UsageError) as error:
        Mpc(**option)
    assert str(error.value) == says
