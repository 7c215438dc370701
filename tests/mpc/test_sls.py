"""System level synthesis: optimal as the same program written out in CVXPY, and kept by every disturbance of the boxes."""

import dataclasses
import importlib.util
import itertools

import numpy as np
import pytest
import scipy.optimize

import gapcert as gc
from gapcert_mpc.variants import sls, sls_kernels
from gapcert_mpc.variants.sls import LtvProblem, SlsPlan, SlsRefusal, SlsSolver, verified

G, TAU = 9.81, 0.1
PENDULUM = np.array([[1, TAU], [TAU * G, 1]])


@pytest.fixture(autouse=True)
def plain(monkeypatch):
    """The kernels as they are without Numba: compiling takes longer than all these tests."""
    spec = importlib.util.spec_from_file_location("plain_kernels", sls_kernels.__file__)
    module = importlib.util.module_from_spec(spec)
    with monkeypatch.context() as patch:
        patch.setattr(importlib.util, "find_spec", lambda name: None)
        spec.loader.exec_module(module)
    assert not module.COMPILED
    monkeypatch.setattr(sls, "kernels", module)


def pendulum(N=10, x0=(0.3, 0.0), most=4.0, r=(0.004, 0.02), **changes):
    """About its upper end; the torque cannot hold it far from there."""
    limits = np.array([0.6, 1.5, most])
    rows = {"Cx": np.eye(3, 2), "Cu": np.eye(3)[:, 2:], "h": limits, "low": -limits}
    end = {"C_end": np.eye(2), "h_end": np.array([0.1, 0.3]), "low_end": -np.array([0.1, 0.3])}
    weights = {"Q": np.diag([10.0, 1.0]), "R": np.eye(1) * 0.1, "Q_end": np.diag([50.0, 5.0])}
    B = np.repeat([[[0.0], [TAU]]], N, axis=0)
    return LtvProblem(**{"A": PENDULUM, "B": B, "x0": np.array(x0), "r": np.array(r), **weights, **rows, **end, **changes})


def varying(seed, N, n, m):
    """Random and time-varying, with a drift, references, rates of the input, and limits on one side."""
    rng = np.random.default_rng(seed)
    A = np.eye(n) + 0.15 * rng.normal(size=(n, n)) + 0.02 * rng.normal(size=(N, n, n))
    B = 0.4 * rng.normal(size=(N, n, m))
    Cx, Cu, Cp = np.zeros((n + 2 * m, n)), np.zeros((n + 2 * m, m)), np.zeros((n + 2 * m, m))
    Cx[:n], Cu[n : n + m], Cu[n + m :], Cp[n + m :] = np.eye(n), np.eye(m), np.eye(m), -np.eye(m)
    h = np.tile(np.r_[np.full(n, 1.3), np.full(m, 0.8), np.full(m, 0.5)], (N, 1))
    low = -h
    low[:, 0] = -np.inf
    h[0, :n], low[0, :n] = np.inf, -np.inf
    return LtvProblem(
        A=A,
        B=B,
        Cx=Cx,
        Cu=Cu,
        Cp=Cp,
        h=h,
        low=low,
        C_end=np.eye(n),
        h_end=np.full(n, 0.8),
        Q=np.eye(n),
        R=0.2 * np.eye(m),
        Q_end=3 * np.eye(n),
        x0=rng.uniform(-1, 1, n),
        d=0.02 * rng.normal(size=(N, n)),
        r=rng.uniform(0, 0.04, size=(N, n)) * (rng.uniform(size=(N, n)) < 0.8),
        x_ref=0.3 * rng.normal(size=n),
        u_ref=0.1,
        u_before=np.full(m, 0.1),
        response_weight=0.05,
    )


def closed_loop(problem, plan, disturbances):
    """Trajectories under measured states, from which the plan's disturbances are recovered."""
    x, past, X, U = problem.x0, [], [problem.x0], []
    for k, w in enumerate(disturbances):
        u = plan.input(k, np.array(past))
        after = problem.A[k] @ x + problem.B[k] @ u + problem.d[k] + w
        past.append(problem.disturbance(k, x, u, after))
        x = after
        X.append(x)
        U.append(u)
    return np.array(X), np.array(U)


def excess(problem, X, U):
    """How far a trajectory lies beyond the rows."""
    N = len(U)
    before = np.concatenate([problem.u_before[None], U[:-1]])
    stage = np.einsum("kci,ki->kc", problem.Cx, X[:N]) + np.einsum("kci,ki->kc", problem.Cu, U)
    stage += np.einsum("kci,ki->kc", problem.Cp, before)
    end = problem.C_end @ X[N]
    beyond = [stage - problem.h, problem.low - stage, end - problem.h_end, problem.low_end - end]
    return max(np.max(v, initial=-np.inf) for v in beyond)


def attacks(problem, plan, rng):
    """The worst vertex for each row by the plan's own responses, other vertices, and points inside."""
    N = len(problem.B)
    for k, c in itertools.product(range(N), range(problem.Cx.shape[1])):
        row = np.einsum("i,jil->jl", problem.Cx[k, c], plan.state_response[k])
        row += np.einsum("i,jil->jl", problem.Cu[k, c], plan.input_response[k])
        if k:
            row += np.einsum("i,jil->jl", problem.Cp[k, c], plan.input_response[k - 1])
        yield from (problem.r * np.sign(row), -problem.r * np.sign(row))
    for c in problem.C_end:
        worst = problem.r * np.sign(np.einsum("i,jil->jl", c, plan.state_response[N]))
        yield from (worst, -worst)
    for _ in range(20):
        yield problem.r * rng.choice([-1.0, 1.0], size=problem.r.shape)
        yield problem.r * rng.uniform(-1, 1, size=problem.r.shape)


def fixed_gain(problem):
    """Whether any nominal inputs are feasible when all responses are those of the gains of the Riccati recursion."""
    free = SlsSolver(problem.replaced({"h": np.inf, "low": -np.inf, "h_end": np.inf, "low_end": -np.inf})).solve()
    N, _, m = problem.B.shape
    _, tau, _ = verified(problem, np.concatenate([free.u[:, :, None], flat(free.input_response)], axis=2))
    unit = np.eye(N * m).reshape(N * m, N, m)
    zero = problem.replaced({"r": 0.0})
    values = []
    for u in (np.zeros((N, m)), *unit):
        X = [zero.x0]
        for k in range(N):
            X.append(zero.A[k] @ X[k] + zero.B[k] @ u[k] + zero.d[k])
        stage = [zero.Cx[k] @ X[k] + zero.Cu[k] @ u[k] for k in range(N)]
        values.append(np.concatenate([*stage, zero.C_end @ X[N]]))
    base, slopes = values[0], (np.array(values[1:]) - values[0]).T
    high, low = np.r_[problem.h.ravel(), problem.h_end], np.r_[problem.low.ravel(), problem.low_end]
    A, b = np.r_[slopes, -slopes], np.r_[high - tau - base, base - tau - low]
    finite = np.isfinite(b)
    return scipy.optimize.linprog(np.zeros(N * m), A[finite], b[finite], bounds=(None, None)).status == 0


def flat(response):
    """(k, j, m, n) as columns (k, m, j n)."""
    return response.transpose(0, 2, 1, 3).reshape(len(response), response.shape[2], -1)


CASES = [pendulum(), pendulum(most=3.2, x0=(0.25, -0.2)), varying(4, 7, 2, 1), varying(3, 6, 3, 2), varying(33, 6, 4, 1)]


@pytest.mark.exam
@pytest.mark.parametrize("problem", CASES, ids=["pendulum", "weak", "2-1", "3-2", "4-1"])
def test_the_plan_is_that_of_the_program_written_out(problem):
    from sls_twin import Twin

    plan, twin = SlsSolver(problem).solve(), Twin(problem)
    value = twin.solve()
    assert isinstance(plan, SlsPlan)
    assert plan.iterations > 0, "a case in which no row matters shows nothing"
    assert plan.objective == pytest.approx(value, rel=1e-5)
    assert plan.x == pytest.approx(twin.x.value, abs=2e-5)
    assert plan.u == pytest.approx(twin.u.value, abs=2e-5)
    assert plan.cost == pytest.approx(twin.cost.value, rel=1e-4)


@pytest.mark.parametrize("problem", CASES, ids=["pendulum", "weak", "2-1", "3-2", "4-1"])
def test_no_disturbance_of_the_boxes_breaks_a_row(problem):
    plan = SlsSolver(problem).solve()
    assert plan.slack >= 0
    worst = max(excess(problem, *closed_loop(problem, plan, w)) for w in attacks(problem, plan, np.random.default_rng(0)))
    # The worst vertex of an active row meets its limit: nothing is given away either.
    assert -1e-6 < worst <= 1e-12


def test_a_plan_without_tightening_is_broken():
    problem = CASES[0]
    plan = SlsSolver(problem.replaced({"r": 0.0})).solve()
    assert max(excess(problem, *closed_loop(problem, plan, w)) for w in attacks(problem, plan, np.random.default_rng(0))) > 1e-3


def test_half_the_radii_are_not_enough():
    problem = CASES[3]
    plan = SlsSolver(problem.replaced({"r": 0.5 * problem.r})).solve()
    assert max(excess(problem, *closed_loop(problem, plan, w)) for w in attacks(problem, plan, np.random.default_rng(0))) > 1e-4


def test_responses_obey_the_recursion_and_are_causal():
    problem = varying(4, 7, 2, 1)
    plan = SlsSolver(problem).solve()
    X, U, N = plan.state_response, plan.input_response, 7
    for j in range(N):
        assert not X[: j + 1, j].any()
        assert not U[: j + 1, j].any()
        assert np.array_equal(X[j + 1, j], np.eye(2))
        for k in range(j + 1, N):
            assert X[k + 1, j] == pytest.approx(problem.A[k] @ X[k, j] + problem.B[k] @ U[k, j], abs=1e-13)
    moved = np.abs(problem.Cx[4] @ flat(X)[4] + problem.Cu[4] @ flat(U)[4] + problem.Cp[4] @ flat(U)[3]) @ problem.r.ravel()
    assert plan.tightening[4] == pytest.approx(moved, abs=1e-13)


def test_rounding_is_counted_outwards():
    # One row, u_0 ≤ h, which no disturbance moves: at its very value it holds, and is refused by what rounding may add.
    problem = pendulum()
    plan = SlsSolver(problem).solve()
    inputs = np.concatenate([plan.u[:, :, None], flat(plan.input_response)], axis=2)
    h = np.full((10, 3), np.inf)
    h[0, 2] = plan.u[0, 0]
    alone = {"h": h, "low": -np.inf, "h_end": np.inf, "low_end": -np.inf}
    assert -1e-12 < verified(problem.replaced(alone), inputs)[2] < 0
    assert verified(problem.replaced({**alone, "h": h + 1e-12}), inputs)[2] >= 0


def test_feedback_from_disturbances_wins_where_a_fixed_gain_does_not():
    # The same program with its responses held to the Riccati gains is a part of this one, so that the converse cannot happen.
    wider = [pendulum(x0=(0.1, 0.0), r=(0.004 * s, 0.02 * s)) for s in (1.0, 2.0, 2.5, 3.0)]
    fixed = [fixed_gain(p) for p in wider]
    free = [isinstance(SlsSolver(p).solve(), SlsPlan) for p in wider]
    assert all(b for a, b in zip(fixed, free, strict=True) if a)
    assert any(fixed)
    assert sum(free) > sum(fixed)


@pytest.mark.exam
@pytest.mark.parametrize(
    "changes", [{"x0": (0.59, 1.4)}, {"r": (0.05, 0.3)}, {"x0": (0.61, 0.0)}], ids=["far", "wide", "outside"]
)
def test_what_cannot_hold_is_refused(changes):
    from sls_twin import Twin

    problem = pendulum(**changes)
    found = SlsSolver(problem).solve()
    assert isinstance(found, SlsRefusal)
    assert found.kind == "infeasible"
    assert Twin(problem).solve() is None


def test_updates_are_as_a_new_solver():
    solver, other = SlsSolver(CASES[0]), pendulum(x0=(0.28, 0.1), r=(0.003, 0.02))
    solver.solve()
    solver.update(x0=other.x0, r=other.r)
    assert solver.solve().u == pytest.approx(SlsSolver(other).solve().u, abs=1e-6)
    turned = dataclasses.replace(other, A=PENDULUM * 0.99)
    solver.update(A=turned.A)
    assert solver.solve().u == pytest.approx(SlsSolver(turned).solve().u, abs=1e-6)
    refused = pendulum(r=(0.05, 0.3))
    solver.update(r=refused.r)
    assert isinstance(solver.solve(), SlsRefusal)
    solver.update(A=other.A, r=other.r)
    assert solver.solve().u == pytest.approx(SlsSolver(other).solve().u, abs=1e-6)


def test_without_rows_it_is_the_regulator():
    problem = pendulum(h=np.inf, low=-np.inf, h_end=np.inf, low_end=-np.inf)
    plan = SlsSolver(problem).solve()
    assert plan.iterations == 0
    assert plan.slack == np.inf
    # It answers a disturbance as it does the state that this leads to.
    shorter = pendulum(N=9, x0=(0.0, 1.0), h=np.inf, low=-np.inf, h_end=np.inf, low_end=-np.inf)
    assert plan.input_response[1, 0, 0, 1] == pytest.approx(SlsSolver(shorter).solve().u[0, 0])
    assert plan.tightening.shape == (10, 3)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"r": (-0.1, 0.1)}, "r has negative values"),
        ({"x0": (0.1, 0.2, 0.3)}, r"x0 has shape \(3,\); it needs \(2,\)"),
        ({"R": np.zeros((1, 1))}, "R is not symmetric and positive definite"),
        ({"Q": -np.eye(2)}, "Q is not symmetric and positive semidefinite"),
        ({"d": np.nan}, "d has values that are not finite"),
        ({"response_weight": 0.0}, "response_weight is 0.0"),
        ({"B": np.ones((2, 1))}, "B has shape"),
    ],
)
def test_bad_problems_are_told(changes, says):
    with pytest.raises(gc.UsageError, match=says):
        pendulum(**changes)


def test_bad_questions_are_told():
    solver = SlsSolver(CASES[0])
    with pytest.raises(gc.UsageError, match="no array 'speed'"):
        solver.update(speed=1.0)
    with pytest.raises(gc.UsageError, match="stage 3 of 10 with 2 disturbances"):
        solver.solve().input(3, np.zeros((2, 2)))


@pytest.mark.exam
def test_compiled_and_plain_kernels_agree(monkeypatch):
    pytest.importorskip("numba")
    plain = [SlsSolver(problem).solve() for problem in CASES]
    monkeypatch.setattr(sls, "kernels", sls_kernels)
    assert sls_kernels.COMPILED
    for problem, expected in zip(CASES, plain, strict=True):
        found = SlsSolver(problem).solve()
        assert found.u == pytest.approx(expected.u, abs=1e-6)
        assert found.objective == pytest.approx(expected.objective, rel=1e-9)
