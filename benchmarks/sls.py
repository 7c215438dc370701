"""One plan of system level synthesis, ours and cvxpy with Clarabel: CPU time for a new state, and for new dynamics too.

The pendulum about its upper end (τ = 0.05 s, N = 20, the torque at its limit), then random time-varying systems with 4 states
and 1 input and with 6 states and 2 inputs. cvxpy's program is written once, with parameters for all data that change
(`tests/support/sls_twin.py`), and its canonicalisation is warm. Ours starts without rows of an earlier plan (cold), or with
those of the plan before it (warm); states go round five, x₀ to 0.96 x₀.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator
from functools import partial
from itertools import cycle
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = "1"
sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))

import numpy as np
from harness import Row, alternate, main, row
from sls_twin import Twin

from gapcert_mpc.variants.sls import LtvProblem, SlsPlan, SlsSolver

N, TAU = 20, 0.05
PEER = "cvxpy, Clarabel"


def pendulum() -> LtvProblem:
    limits = np.array([0.8, 2.0, 8.0])
    A = np.array([[1.0, TAU], [TAU * 9.81, 1.0 - 0.1 * TAU]])
    return LtvProblem(
        A=A,
        B=np.repeat([[[0.0], [TAU]]], N, axis=0),
        x0=np.array([0.6, 0.0]),
        r=np.array([0.002, 0.02]),
        Q=np.diag([10.0, 1.0]),
        R=0.1 * np.eye(1),
        Q_end=np.diag([50.0, 5.0]),
        Cx=np.eye(3, 2),
        Cu=np.eye(3)[:, 2:],
        h=limits,
        low=-limits,
        C_end=np.eye(2),
        h_end=np.array([0.2, 0.4]),
        low_end=-np.array([0.2, 0.4]),
    )


def varying(n: int, m: int, rng: np.random.Generator) -> LtvProblem:
    A, B = np.eye(n) + 0.15 * rng.normal(size=(n, n)), 0.3 * rng.normal(size=(n, m))
    limits = np.tile(np.r_[np.full(n, 1.2), np.full(m, 1.0)], (N, 1))
    limits[0, :n] = np.inf
    return LtvProblem(
        A=A + 0.02 * rng.normal(size=(N, n, n)),
        B=B + 0.02 * rng.normal(size=(N, n, m)),
        x0=rng.uniform(-1, 1, n),
        r=rng.uniform(0.005, 0.02, size=(N, n)),
        d=0.01 * rng.normal(size=(N, n)),
        Q=np.eye(n),
        R=0.1 * np.eye(m),
        Q_end=5 * np.eye(n),
        Cx=np.eye(n + m, n),
        Cu=np.eye(n + m)[:, n:],
        h=limits,
        low=-limits,
        C_end=np.eye(n),
        h_end=np.full(n, 0.8),
        low_end=-np.full(n, 0.8),
    )


def problems() -> Iterator[tuple[str, LtvProblem]]:
    yield "pendulum, 2 states, 1 input", pendulum()
    for n, m in ((4, 1), (6, 2)):
        rng = np.random.default_rng(0)
        while True:  # the first that is feasible and not decided without rows
            problem = varying(n, m, rng)
            plan = SlsSolver(problem).solve()
            if isinstance(plan, SlsPlan) and plan.iterations > 15:
                break
        yield f"time-varying, {n} states, {m} input{'s' * (m > 1)}", problem


def ours(solver: SlsSolver, states: Iterator[np.ndarray], changes: tuple[str, ...], warm: bool) -> None:
    if not warm:
        solver.forget()
    solver.update(x0=next(states), **{name: getattr(solver.problem, name) for name in changes})
    assert isinstance(solver.solve(), SlsPlan)


def theirs(twin: Twin, problem: LtvProblem, states: Iterator[np.ndarray]) -> None:
    twin.update(problem.replaced({"x0": next(states)}))
    assert twin.solve() is not None


def measure(options: argparse.Namespace) -> list[Row]:
    rows, repeats = list[Row](), 3 if options.quick else 9
    for case, problem in problems():
        solver, twin = SlsSolver(problem), Twin(problem)
        plan = solver.solve()
        states = [problem.x0 * (1 - 0.01 * i) for i in range(5)]
        assert isinstance(plan, SlsPlan)

        for what, changes in (("new state", ()), ("new dynamics", ("A", "B", "d", "r"))):
            for warm in (False, True):
                spent, other = alternate(
                    partial(ours, solver, cycle(states), changes, warm),
                    partial(theirs, twin, problem, cycle(states)),
                    repeats=repeats,
                    warm=0.1,
                )
                name = f"time, {what}, {'warm' if warm else 'cold'}"
                rows.append(row(case, name, "ms of CPU", 1e3 * spent, 1e3 * other, PEER))
        twin.update(problem)
        value = twin.solve()
        assert value is not None
        first, start = abs(plan.u[0] - twin.u.value[0]).max(), max(1.0, abs(plan.u[0]).max())
        rows.append(Row(case, "first input, relative difference", "1", float(first / start), None, PEER, None))
        rows.append(
            Row(case, "states of the plan, largest difference", "1", float(abs(plan.x - twin.x.value).max()), None, PEER, None)
        )
        rows.append(Row(case, "objective, relative difference", "1", abs(plan.objective / value - 1), None, PEER, None))
        rows.append(Row(case, "iterations, cold", "1", float(plan.iterations), None, "", None))
        rows.append(Row(case, "slack of the verified rows", "1", plan.slack, None, "", None))
    return rows


if __name__ == "__main__":
    main(measure, argparse.ArgumentParser(description=__doc__))
