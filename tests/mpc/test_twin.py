"""The program of one step against its twin in cvxpy, which is written from the formulas and shares no row with it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from tube_designs import drawn, mecanum, with_pieces

from gapcert_mpc.planning.design import Design
from gapcert_mpc.planning.engine import Engine
from gapcert_mpc.program.program import Preferred, Program
from gapcert_mpc.program.solver import SOLVERS, solver
from gapcert_mpc.program.tuning import Least

Array = np.ndarray


def cost(design: Design, z: Array) -> float:
    program, w = design.program(), design.weights
    n = design.frame.nx
    x, u = design.reference[:n], design.reference[n:]
    fixed = program.N * (x @ w.Q @ x + u @ w.R @ u) + x @ w.P @ x + x @ w.T @ x
    upper = program.P
    return float(z @ upper @ z - 0.5 * z @ (upper.diagonal() * z) + program.q @ z + fixed)


def starts(design: Design, seed: int, count: int) -> Array:
    return np.random.default_rng(seed).uniform(-0.7, 0.7, (count, design.frame.nx))


def first(design: Design, z: Array) -> Array:
    program = design.program()
    return np.asarray(z[program.at["u"][0] :][: program.m])


def softened(design: Design, wide: float = 0.0) -> Design:
    """With ranges of the first state, ± wide, and of the last input that are preferred."""
    axis, one = np.array([0, len(design.frame.half) - 1]), np.ones(2)
    return replace(design, soft=Preferred(axis, np.array([-wide, 0.02]), np.array([wide, 0.1]), 0.02 * one, 0.5 * one))


@pytest.mark.exam
@pytest.mark.parametrize("variable", [False, True])
@pytest.mark.parametrize(("seed", "soft"), [(0, False), (1, False), (2, False), (3, False), (1, True), (2, True)])
def test_every_solver_gives_what_the_formulas_give(seed: int, variable: bool, soft: bool) -> None:
    from tube_program import twin

    design = softened(drawn(seed, variable)) if soft else drawn(seed, variable)
    program, reference = design.program(), twin(design)
    solvers = [solver(name, program.qp, 1e-7) for name in SOLVERS]
    found, excess = 0, 0.0
    for x in starts(design, seed, 4):
        u, best = reference.solve(x)
        program.begin(x)
        for s in solvers:
            s.update(program.qp)
            answer = s.solve()
            if answer.status == "unfinished":
                continue
            assert (answer.status == "solved") == np.isfinite(best), s.name
            if np.isfinite(best):
                found += 1
                excess = max(excess, answer.z[program.at["e"][1] :][:2].max() if soft else 0.0)
                assert np.abs(first(design, answer.z) - u).max() < 1e-4, s.name
                assert abs(cost(design, answer.z) - best) < 1e-4 * max(1.0, best), s.name
    assert found >= 4, "nothing was compared"
    assert excess > 1e-2 or not soft, "no preferred range was left"


@pytest.mark.exam
@pytest.mark.parametrize("variable", [False, True])
@pytest.mark.parametrize(("seed", "soft"), [(0, False), (1, False), (2, False), (3, False), (2, True)])
def test_pieces_give_what_the_formulas_give(seed: int, variable: bool, soft: bool) -> None:
    from tube_program import twin

    design = with_pieces(softened(drawn(seed, variable), 0.1) if soft else drawn(seed, variable))
    engine, reference, held = Engine(design, "piqp"), twin(design), 0
    for x in np.vstack([starts(design, seed, 4), 0.9 * design.reference[: design.frame.nx]]):
        if (known := engine.pieces(x)) is not None:
            u, best = reference.solve(x)
            assert np.abs(first(design, known[0]) - u).max() < 1e-4
            assert abs(cost(design, known[0]) - best) < 1e-4 * max(1.0, best)
            held += 1
    assert held, "no piece held anywhere"


@pytest.mark.parametrize(("made", "given"), [(mecanum, (True,)), (mecanum, (False,)), (drawn, (2, True)), (drawn, (1, False))])
def test_the_least_tube_keeps_what_any_tube_keeps(made: Callable[..., Design], given: tuple[Any, ...]) -> None:
    """Answers of an interior-point method leave room; the tube that is computed keeps all rows, and is no wider."""
    design = made(*given)
    program = design.program()
    least, solve = Least(program), solver("piqp", program.qp, 1e-8)
    _, more, _ = program.terminal
    for x in starts(design, 3, 6):
        program.begin(x)
        solve.update(program.qp)
        answer = solve.solve()
        if answer.status != "solved":
            continue
        z, after = answer.z, program.at["size"][0]
        tight = least(z)
        assert program.missed(tight, x) <= 1e-7
        assert np.array_equal(tight[:after], z[:after])
        grown = slice(after + program.p, None)
        assert (tight[grown] <= z[grown] + 1e-7).all()
        kappa = slice(after, after + program.p)
        if not program.variable:
            assert (more @ tight[kappa] <= more @ z[kappa] + 1e-7).all()
        # A narrower terminal set would not hold the last section, or not itself.
        for j in np.flatnonzero(tight[kappa] > 1e-4):
            less = tight.copy()
            less[after + j] -= 1e-4
            assert program.missed(less, x) > 1e-7


def test_what_equations_are_missed_by_stays_in_the_tube() -> None:
    """Errors e⁺ = (A + BK)e + w with |w| ≤ c + ε, from |e| ≤ ε, reach Σ |H(A + BK)ʲ|(c + ε) + |H(A + BK)ᵏ|ε in k steps."""

    def reached(program: Program, missed: float) -> Array:
        st, sec = program.stages, program.section
        row, size, found = sec.H, np.zeros(len(sec.H)), []
        for _ in range(program.N):
            size = size + np.abs(row) @ (st.c[0] + missed)
            row = row @ (st.A[0] + st.B[0] @ sec.K)
            found.append(size + np.abs(row).sum(axis=1) * program.tolerance)
        return np.array(found)

    ratios = []
    for seed in range(8):
        program = replace(drawn(seed, False), tolerance=1e-3).program()
        assert (reached(program, program.tolerance) <= program.constant[1:] * (1 + 1e-12)).all()
        ratios.append((reached(program, 2 * program.tolerance) / program.constant[1:]).max())
    assert max(ratios) > 1, "the tube is far too wide to tell"
