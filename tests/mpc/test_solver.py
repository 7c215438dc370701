"""Solvers of quadratic programs behind one face: they agree with cvxpy, are updated in place, and are pure."""

from __future__ import annotations

import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.sparse as sp
from tube_designs import drawn, mecanum, with_pieces

from gapcert import UsageError, closed_loop
from gapcert_cells.testing import Band, Rod, rod_problem
from gapcert_mpc.controller import MpcController
from gapcert_mpc.planning.engine import Engine
from gapcert_mpc.program.solver import SOLVERS, Osqp, Qp, QpSolver, solver
from gapcert_mpc.program.tuning import Pieces, tuned
from gapcert_mpc.synthesizer import Mpc

Array = np.ndarray


class Random:
    """A convex program with equations, rows bounded on one side, and rows bounded on both; feasible, at `inside`."""

    def __init__(self, seed: int, n: int = 12) -> None:
        rng = np.random.default_rng(seed)
        root = rng.normal(size=(n, n)) / np.sqrt(n)
        self.whole = root @ root.T + 0.1 * np.eye(n)
        self.P, self.q = sp.csc_matrix(np.triu(self.whole)), rng.normal(size=n)
        self.A = sp.csc_matrix(rng.normal(size=(2 * n, n)) * (rng.random((2 * n, n)) < 0.5) + np.eye(2 * n, n))
        self.inside = rng.normal(size=n)
        value = self.A @ self.inside
        self.low, self.high = value - rng.uniform(0.05, 0.5, 2 * n), value + rng.uniform(0.05, 0.5, 2 * n)
        self.low[:4] = self.high[:4] = value[:4]
        self.low[4:8], self.high[8:12] = -np.inf, np.inf

    @property
    def qp(self) -> Qp:
        return Qp(self.P, self.q, self.A, self.low, self.high)

    def made(self, name: Any, tolerance: float = 1e-7) -> QpSolver:
        found = solver(name, self.qp, tolerance)
        if isinstance(found, Osqp):
            found.osqp.update_settings(max_iter=20_000)
        return found

    def best(self) -> tuple[Array, float]:
        import cvxpy as cp

        z = cp.Variable(len(self.q))
        some, most = np.isfinite(self.low), np.isfinite(self.high)
        rows = [(self.A @ z)[some] >= self.low[some], (self.A @ z)[most] <= self.high[most]]
        problem = cp.Problem(cp.Minimize(cp.quad_form(z, cp.psd_wrap(self.whole)) / 2 + self.q @ z), rows)
        problem.solve(solver=cp.CLARABEL)
        return np.asarray(z.value), float(problem.value)

    def cost(self, z: Array) -> float:
        return float(z @ self.whole @ z / 2 + self.q @ z)


@pytest.mark.exam
@pytest.mark.parametrize("name", SOLVERS)
@pytest.mark.parametrize("seed", range(5))
def test_agrees_with_cvxpy(name: str, seed: int) -> None:
    program = Random(seed)
    answer, (z, cost) = program.made(name).solve(), program.best()
    assert answer.status == "solved"
    assert np.abs(answer.z - z).max() < 1e-4
    assert abs(program.cost(answer.z) - cost) < 1e-5
    # Multipliers: the cost's slope is held by the rows, and each pushes back from the bound that is reached.
    assert np.abs(program.whole @ answer.z + program.q + program.A.T @ answer.y).max() < 1e-4
    value = program.A @ answer.z
    assert (answer.y[value < program.high - 1e-3] < 1e-4).all()
    assert (answer.y[value > program.low + 1e-3] > -1e-4).all()


@pytest.mark.parametrize("name", SOLVERS)
def test_updates_in_place_are_a_fresh_set_up(name: str) -> None:
    program = Random(0)
    kept = program.made(name)
    kept.solve()
    rng = np.random.default_rng(1)
    program.q = rng.normal(size=len(program.q))
    program.A = program.A.copy()
    program.A.data *= rng.uniform(0.8, 1.2, program.A.nnz)
    moved = program.A @ program.inside - (program.low + program.high) / 2
    moved[~np.isfinite(moved)] = 0.1
    program.low, program.high = program.low + moved, program.high + moved
    kept.update(program.qp, varied=True)
    fresh, z = program.made(name).solve(), program.best()[0]
    answer = kept.solve(np.zeros(len(z)), np.zeros(len(program.low)))
    assert answer.status == fresh.status == "solved"
    assert np.abs(answer.z - fresh.z).max() < 1e-5
    assert np.abs(answer.z - z).max() < 1e-4


@pytest.mark.exam
@pytest.mark.parametrize("name", SOLVERS)
def test_infeasible_is_told(name: str) -> None:
    program = Random(2)
    kept = program.made(name)
    row = 20
    low, high = program.low.copy(), program.high.copy()
    low[row], high[row] = 60.0, 61.0
    # The row twice, with bounds that exclude each other.
    program.A = sp.csc_matrix(sp.vstack([program.A, program.A[[row]]]))
    program.low, program.high = np.append(low, -61.0), np.append(high, -60.0)
    assert program.made(name).solve().status == "infeasible"
    assert kept.solve().status == "solved"


@pytest.mark.parametrize("name", SOLVERS)
@pytest.mark.parametrize("set_up", [True, False])
@pytest.mark.parametrize("part", ["bounds", "cost", "rows"])
def test_what_no_library_takes_has_no_answer(name: Any, set_up: bool, part: str) -> None:
    program = Random(6)
    good, kept = program.qp, program.made(name)
    low, q, A = program.low.copy(), program.q.copy(), program.A.copy()
    low[20], q[3], A.data[5] = program.high[20] + 0.3, np.nan, np.inf
    bad = good._replace(**{"bounds": {"low": low}, "cost": {"q": q}, "rows": {"A": A}}[part])
    if set_up:
        kept = solver(name, bad, 1e-7)
    else:
        kept.update(bad, varied=True)
    answer = kept.solve(np.zeros(len(q)), np.zeros(len(low)))
    assert answer.status == "infeasible"
    assert np.isnan(answer.z).all()
    if not set_up:  # and what is asked next has not seen it
        kept.update(good)
        assert kept.solve().status == "solved"


@pytest.mark.parametrize("name", SOLVERS)
def test_an_answer_is_a_function_of_data_and_guess(name: str) -> None:
    program = Random(3)
    one, two = program.made(name), program.made(name)
    guess = np.full(len(program.q), 0.1), np.full(len(program.low), 0.01)
    alone = one.solve(*guess)
    for seed in (4, 5):
        other = Random(seed)
        room = np.where(program.low == program.high, 0.0, 0.1)
        two.update(program.qp._replace(q=other.q, low=program.low - room, high=program.high + room))
        two.solve(other.q, np.ones(len(program.low)))
    two.update(program.qp)
    again = two.solve(*guess)
    assert np.array_equal(alone.z, again.z)
    assert np.array_equal(alone.y, again.y)


def test_an_unknown_solver_is_refused() -> None:
    with pytest.raises(UsageError, match=r"controller\.solver: 'qpoases' is unknown; use one of osqp, piqp, clarabel"):
        Random(0).made("qpoases")


DESIGNS = {
    "mecanum": lambda: with_pieces(mecanum()),
    "mecanum-constant": lambda: mecanum(False),
    "drawn": lambda: with_pieces(drawn(1, False)),
}


@pytest.mark.exam
@pytest.mark.parametrize("drawing", DESIGNS)
@pytest.mark.parametrize("name", ["osqp", "piqp"])
def test_a_plan_is_a_function_of_the_state_and_its_guess(drawing: str, name: Any) -> None:
    design = DESIGNS[drawing]()
    one, two = Engine(design, name), Engine(design, name)
    x = np.random.default_rng(0).uniform(-0.6, 0.6, (12, design.frame.nx))
    guesses = [one.solve(row, None) for row in x]
    plans = [one.solve(0.97 * row, guess) for row, guess in zip(x, guesses, strict=True)]
    for i in reversed(range(len(x))):
        again = two.solve(0.97 * x[i], guesses[i])
        held = plans[i]
        assert (again is None) == (held is None)
        if again is not None and held is not None:
            assert np.array_equal(again.z, held.z)
            assert np.array_equal(again.y, held.y)
    assert sum(p is not None for p in plans) >= 4


def test_pieces_are_found_again_and_worth_their_keep() -> None:
    design = mecanum(False)
    found = tuned(design.program(), design.reference[:2], "auto")
    again = tuned(design.program(), design.reference[:2], "auto")
    assert found[0] == again[0]
    assert np.array_equal(found[1].pieces, again[1].pieces)
    assert (found[1].rho, found[1].alpha) == (again[1].rho, again[1].alpha)
    engine = Engine(replace(design, tuning=found[1]), "piqp")
    x = np.random.default_rng(0).uniform(0.2, 0.7, (50, 2))
    assert np.mean([engine.pieces(row) is not None for row in x]) > 0.8


@pytest.fixture(scope="module")
def rod() -> MpcController:
    """Near the edge of where it may be: the rows of the terminal set hold its plans back."""
    made = Mpc(horizon=15, reference={"theta": 0.19})
    controller = made.synthesize(rod_problem(gap=Band((-1.5e-4, -6e-5), (1.5e-4, 6e-5))))
    assert controller.design is not None
    assert len(controller.design.tuning.pieces) > 1
    return controller


def test_a_piece_holds_only_where_its_multipliers_do() -> None:
    """A plan that begins at full speed for no reason keeps all rows and is affine, and is not the best: it is not taken."""
    design = mecanum(False)
    program = design.program()
    (row,) = np.flatnonzero(
        (program.A[:, [program.at["u"][0]]].toarray()[:, 0] != 0) & (np.diff(program.A.tocsr().indptr) == 1)
    )
    full, free = np.zeros((2, len(program.low)), dtype=np.int8)
    full[row] = 1
    pieces, x = Pieces(program, np.array([full, free]), design.reference[:2]), np.array([0.3, 0.4])
    found = [pieces.least((constant + slope @ x)[: program.size]) for constant, slope, *_ in pieces.parts]
    assert max(program.missed(z, x) for z in found) < program.tolerance / 2
    value = [0.5 * z @ (program.P + sp.triu(program.P, 1).T) @ z + program.q @ z for z in found]
    assert value[0] > value[1] + 1e-3
    known = pieces(x, 0)
    assert known is not None
    assert known[2] == 1
    assert Pieces(program, full[None], design.reference[:2])(x) is None


def test_a_piece_holds_only_where_the_rows_do() -> None:
    """The best plan without limits, from far away, breaks them: no piece gives it, and the solvers give another."""
    design = with_pieces(mecanum(False))
    engine, x = Engine(design, "piqp"), np.array([-0.9, -0.9])
    free = next(k for k, active in enumerate(design.tuning.pieces) if not active.any())
    constant, slope, *_ = engine.pieces.parts[free]
    z = engine.pieces.least((constant + slope @ x)[: engine.program.size])
    assert engine.program.missed(z, x) > 0.01
    made = engine.solve(x, None)
    assert made is not None
    assert engine.program.missed(made.z, x) <= design.tolerance


def test_pieces_know_the_reference_that_they_are_for() -> None:
    design = with_pieces(mecanum(False))
    engine, x, n = Engine(design, "piqp"), np.array([0.3, 0.4]), 2
    assert engine.pieces is not None
    assert engine.pieces(x) is not None
    engine.program.aim(np.array([-0.4, 0.1]), np.zeros(2))
    made = engine.solve(x, None)
    assert made is not None
    fresh = Engine(replace(design, reference=np.array([-0.4, 0.1, 0.0, 0.0])), "piqp").solve(x, None)
    assert fresh is not None
    assert np.abs(made.x - fresh.x).max() < 1e-4
    assert made.x[-1, :n] @ np.array([-0.4, 0.1]) > 0


def test_saved_and_sent_it_gives_the_same(rod: MpcController, tmp_path: Path) -> None:
    rod.save(tmp_path)
    x = rod.draw(20, np.random.default_rng(0))
    for other in (MpcController.load(tmp_path), pickle.loads(pickle.dumps(rod))):
        assert other.digest() == rod.digest()
        assert np.array_equal(other.act(x), rod.act(x))


def test_steps_are_those_of_the_closed_loop(rod: MpcController) -> None:
    x = rod.draw(1, np.random.default_rng(3))
    trace, memory = closed_loop(Rod(), rod, x, 30), None
    for k in range(30):
        u, told = rod.step(trace.x[0, k], memory)
        assert told.feasible
        assert np.array_equal(u, trace.u[0, k])
        memory = told.memory


@pytest.mark.exam
def test_workers_change_no_bit(rod: MpcController) -> None:
    x = rod.draw(9, np.random.default_rng(1))
    alone, apart = (closed_loop(Rod(), rod, x, 25, workers=workers) for workers in (1, 2))
    for part in ("x", "u", "stranded", "left_goal", "reached", "counted", "broken"):
        assert np.array_equal(getattr(alone, part), getattr(apart, part), equal_nan=part in "xu"), part
    assert (alone.visited, alone.strange) == (apart.visited, apart.strange)
