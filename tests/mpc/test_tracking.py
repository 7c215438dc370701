"""References that move: they are followed, the promise is kept under any of them, and a run alone determines its plans."""

from __future__ import annotations

import pickle
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.sparse as sp

from gapcert import UsageError, closed_loop
from gapcert_cells.testing import Band, Rod, rod_problem, rod_reach_avoid
from gapcert_closed_loop.closed_loop import compare_loops
from gapcert_figures.data import Figures, loop_figure
from gapcert_mpc.controller import MpcController
from gapcert_mpc.planning.design import Course
from gapcert_mpc.program.solver import Piqp, Qp
from gapcert_mpc.synthesizer import Mpc
from gapcert_report.pictures.control import wanted_pictures

Array = np.ndarray
GAP = Band((-1.5e-4, -6e-5), (1.5e-4, 6e-5))
HORIZON, PERIOD = 25, Rod().period
# In periods: long enough to arrive and to stay a while.
JUMPS = (0, 120, 300)
WANTED = (0.05, 0.15, 0.08)
STEPS = 420
SCHEDULE = {"theta": {"at": [[k * PERIOD, at] for k, at in zip(JUMPS, WANTED, strict=True)]}}


@cache
def _made() -> MpcController:
    found = Mpc(horizon=HORIZON, reference=SCHEDULE, weights={"omega": 0.01, "torque": 0.001}, majorant="constant").synthesize(
        rod_problem(gap=GAP)
    )
    assert isinstance(found, MpcController)
    return found


@pytest.fixture
def controller() -> MpcController:
    # Begins with no plan, and with no counts.
    return replace(_made(), counts={"solved": 0, "shifted": 0})


def played(controller: MpcController, low: Array, high: Array, steps: int = STEPS) -> tuple[Array, Array]:
    """x (steps + 1, nx) under disturbances between low and high (nx,), at random corners; did each step keep its tube?"""
    rng = np.random.default_rng(0)
    x = np.array([[0.05, 0.0]])
    memory, out, kept = controller.start(x), [x[0]], []
    for k in range(steps):
        u = controller.respond(x, memory, "first")
        # At the moments of the jumps all push one way, and then the other.
        corner = rng.random(2) < 0.5 if min(abs(k - j) for j in JUMPS) > 20 else np.full(2, k % 40 < 20)
        after = Rod().step(x, u).x + np.where(corner, low, high)
        kept.append(controller.kept(x, u, after, memory)[0])
        x, memory = after, controller.advance(after, memory)
        out.append(x[0])
    return np.array(out), np.array(kept)


def misses(x: Array) -> Array:
    """The largest |θ − reference| over the last 30 steps before plans see each jump, and before the end."""
    ends = (*(k - HORIZON for k in JUMPS[1:]), STEPS)
    return np.array([np.abs(x[end - 30 : end, 0] - at).max() for end, at in zip(ends, WANTED, strict=True)])


def test_a_schedule_is_followed(controller: MpcController) -> None:
    x, kept = played(controller, np.zeros(2), np.zeros(2))
    assert misses(x).max() < 1e-3
    assert kept.all()
    # Plans know what comes: a jump is begun before its time.
    assert x[JUMPS[1] - 1, 0] > WANTED[0]


def test_the_promise_is_kept_where_the_reference_jumps(controller: MpcController) -> None:
    x, kept = played(controller, np.array(GAP.low), np.array(GAP.high))
    assert kept.all()
    assert controller.goal.holds(x).all()
    assert controller.counts["shifted"] == 0, "a jump lost a plan"
    assert misses(x).max() < 0.5 * controller.evidence["tube"]["theta"]


def test_a_schedule_that_stands_still_misses(controller: MpcController, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Course, "ahead", lambda self, step, count: np.repeat(self.references[:1], count, axis=0))
    x, kept = played(controller, np.zeros(2), np.zeros(2))
    assert misses(x)[1] > 0.05
    assert kept.all(), "what is wanted is no part of the promise"


def test_a_plan_that_had_to_end_at_the_reference_would_be_lost(controller: MpcController) -> None:
    """The pair where a plan ends is its own: fixed to a reference that has jumped, no plan is left."""
    x = np.array([[0.05, 0.0]])
    memory = controller.aim({"theta": 0.17}, controller.start(x))
    memory = controller.advance(x, memory)
    assert controller.counts == {"solved": 1, "shifted": 0}
    program, held = controller.engine.program, controller.memory[memory[0]]
    assert held is not None
    assert held.aim is not None
    pair = np.arange(program.n) + program.at["xs"][0]
    fixed = sp.csc_matrix((np.ones(program.n), (np.arange(program.n), pair)), shape=(program.n, program.size))
    at = held.aim[: program.n]
    A, low, high = sp.vstack([program.A, fixed], format="csc"), np.append(program.low, at), np.append(program.high, at)
    assert Piqp(Qp(program.P, program.q, A, low, high), 1e-8).solve().status == "infeasible"


def test_a_run_takes_another_reference_and_others_do_not(controller: MpcController) -> None:
    """What is solved for one run leaves the plans of another as they are, to the last bit."""
    x = np.array([[0.05, 0.0], [0.05, 0.0]])
    alone, both = (controller.start(row) for row in (x[:1], x))
    both[1:] = controller.aim({"theta": "0.1 rad"}, both[1:])
    for _ in range(90):
        u, then = controller.respond(x[:1], alone, "first"), controller.respond(x, both, "first")
        assert np.array_equal(u[0], then[0])
        x = Rod().step(x, then).x
        alone, both = controller.advance(x[:1], alone), controller.advance(x, both)
    assert abs(x[1, 0] - 0.1) < 2e-3
    assert abs(x[0, 0] - 0.05) < 2e-3


def test_pieces_of_another_reference_are_not_used(controller: MpcController, monkeypatch: pytest.MonkeyPatch) -> None:
    engine, x = controller.engine, np.array([[0.05, 0.0]])
    assert engine.pieces is not None
    assert len(engine.pieces), "nothing is tested"

    def ends() -> float:
        memory = controller.aim({"theta": 0.12}, controller.start(x))
        held = controller.memory[controller.advance(x, memory)[0]]
        assert held is not None
        return float(controller.goal.stay.low[0] + 0.1 * (1 + held.plan.xs[0]))

    assert ends() > 0.06
    # As if they were for any: their plan stays where the first reference is.
    monkeypatch.setattr(engine.pieces, "aimed", _Any())
    assert ends() < 0.055


class _Any(bytes):
    def __eq__(self, other: object) -> bool:
        return True

    def __ne__(self, other: object) -> bool:
        return False

    __hash__ = bytes.__hash__


def test_saved_sent_and_shared_out_it_goes_the_same_way(controller: MpcController, tmp_path: Path) -> None:
    controller.save(tmp_path)
    x = np.array([[0.05, 0.0], [0.1, 0.05]])
    first = closed_loop(Rod(), controller, x, JUMPS[1] + 20).x
    for other in (MpcController.load(tmp_path), pickle.loads(pickle.dumps(controller))):
        assert other.digest() == controller.digest()
        assert np.array_equal(closed_loop(Rod(), other, x, JUMPS[1] + 20).x, first)
    memory: Any = None
    for k in range(40):
        u, info = controller.step(first[0, k], memory)
        assert u is not None
        assert np.array_equal(Rod().step(first[:1, k], u[None]).x[0], first[0, k + 1])
        memory = info.memory


@pytest.mark.exam
def test_the_report_shows_what_is_wanted(controller: MpcController, tmp_path: Path) -> None:
    still = Mpc(horizon=5, majorant="constant", solver="piqp").synthesize(rod_problem(gap=GAP))
    loops = [compare_loops(Rod(), c, c, starts=2, steps=140, policies=()) for c in (controller, still)]
    figure, none = (loop_figure(loop, Rod(), c, c) for loop, c in zip(loops, (controller, still), strict=True))
    assert np.allclose(figure.wanted[[0, JUMPS[1] - 1, JUMPS[1]], 0], [WANTED[0], WANTED[0], WANTED[1]], atol=1e-3)
    Figures(loop=figure).save(tmp_path)
    loaded = Figures.load(tmp_path).loop
    assert loaded is not None
    (picture,) = wanted_pictures(loaded)
    assert picture.title == "theta and what is wanted of it"
    assert wanted_pictures(none) == []


@pytest.mark.parametrize(
    ("reference", "told"),
    [
        ({"theta": {"at": [[0.5, 0.1]]}}, r"reference\.theta: times begin at 0 s"),
        ({"theta": {"at": []}}, r"reference\.theta: times begin at 0 s"),
        ({"theta": {"at": [[0, 0.1], [0.001, 0.2], [0.002, 0.1]]}}, "grow by a period"),
        ({"theta": {"at": [["0 s", "0.1 m"]]}}, r"reference\.theta"),
        ({"theta": "0.1 m"}, r"reference\.theta"),
    ],
)
def test_what_is_no_reference_is_refused(reference: dict[str, Any], told: str) -> None:
    problem = rod_problem(gap=GAP)
    with pytest.raises(UsageError, match=told):
        Mpc(reference=reference).check(problem.model, problem.domain, problem.goal)


@pytest.mark.parametrize("other", [{"adapt": {"m": "10 %"}}, {"linearisation": "successive"}, {"feedback": "disturbance"}])
def test_what_follows_no_reference_that_moves_says_so(other: dict[str, Any]) -> None:
    problem = rod_problem(gap=GAP)
    with pytest.raises(UsageError, match=r"controller\.reference: what is wanted moves"):
        Mpc(reference=SCHEDULE, **other).check(problem.model, problem.domain, problem.goal)


def test_what_reaches_has_no_schedule_and_no_other_aim(controller: MpcController) -> None:
    with pytest.raises(UsageError, match=r"controller\.reference: what is wanted moves"):
        Mpc(reference=SCHEDULE).synthesize(rod_problem(rod_reach_avoid(), GAP))
    memory = controller.start(np.array([[0.05, 0.0]]))
    with pytest.raises(UsageError, match="'torque' is no state"):
        controller.aim({"torque": 1.0}, memory)
    with pytest.raises(UsageError, match="aim: "):
        controller.aim({"theta": "1 m"}, memory)
    assert controller.design is not None
    lasting = replace(controller, design=replace(controller.design, successive=True))
    with pytest.raises(UsageError, match="aim: only invariance"):
        lasting.aim({"theta": 0.1}, memory)
