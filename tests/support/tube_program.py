"""The tube's quadratic program as its formulas read, in cvxpy: a twin of `program.py` that is built of none of its rows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cvxpy as cp
import numpy as np

from gapcert_mpc.planning.design import Design

Array = np.ndarray


@dataclass(frozen=True)
class Twin:
    """A compiled problem with the parameter x₀ (n,), the start in the frame; `first` is the first input (m,)."""

    problem: Any
    start: Any
    first: Any

    def solve(self, x: Array, **options: Any) -> tuple[Array, float]:
        """The first input and the cost, from x."""
        self.start.value = x
        cost = self.problem.solve(solver=cp.CLARABEL, canon_backend=cp.SCIPY_CANON_BACKEND, **options)
        return np.asarray(self.first.value), float(cost)


def twin(design: Design) -> Twin:
    """One set of constraints per formula, all stages at once: a row of x (N+1, n), u (N, m), s (N+1, p), a (N+1, n+m) each.

    Stages must be alike. H, P, K, Λ and the reference are taken as they are; everything that rests on them is made again.
    """
    st, sec, eps, w = design.stages, design.section, design.tolerance, design.weights
    for part in (st.A, st.B, st.d, st.c, st.G, st.centre, st.low, st.high):
        assert (part == part[0]).all(), "the twin knows stages that are alike"
    A, B, d, c, G, centre, H, K = st.A[0], st.B[0], st.d[0], st.c[0], st.G[0], st.centre[0], sec.H, sec.K
    N, (n, m), p = st.horizon, B.shape, len(H)
    feedback = np.vstack([sec.P, K @ sec.P])
    E, moved = np.abs(feedback), np.abs(sec.moved + H @ (A + B @ K - sec.closed) @ sec.P)
    rows = np.vstack([np.eye(n + m), design.rows.C])
    low, high = np.concatenate([st.low[0], design.rows.low]), np.concatenate([st.high[0], design.rows.high])
    tight, variable = np.abs(rows @ feedback), bool(G.any())

    x, u, xs, us = cp.Variable((N + 1, n)), cp.Variable((N, m)), cp.Variable(n), cp.Variable(m)
    s, a = cp.Variable((N + 1, p)), cp.Variable((N + 1, n + m))
    kappa, start = cp.Variable(p, nonneg=True), cp.Parameter(n)
    z, steady = cp.hstack([x[:-1], u]), cp.hstack([xs, us])

    kept = [x[0] == start, s[0] == np.abs(H).sum(axis=1) * eps, x[1:] == x[:-1] @ A.T + u @ B.T + d]
    kept += [a[:-1] >= cp.abs(z - centre) + eps, a[-1] >= cp.abs(steady - centre) + eps]
    # A tube that is numbers is computed; one of variables may be missed by ε as every row may.
    extra = eps if variable else 0.0
    kept += [s[1:] >= s[:-1] @ moved.T + (c + eps + (a[:-1] + s[:-1] @ E.T) @ G.T) @ np.abs(H).T + extra]

    def within(z: Any, half: Any, take: Any) -> list[Any]:
        away = z @ rows[take].T
        wide, some = half @ tight[take].T + eps, [np.isfinite(bound[take]) for bound in (low, high)]
        least, most = (away - wide)[..., some[0]], (away + wide)[..., some[1]]
        return [least >= low[take][some[0]], most <= high[take][some[1]]]

    # What is asked of x̄₀ alone is asked of the start, not of the plan.
    kept += within(z[:1], s[:1], np.flatnonzero(rows[:, n:].any(axis=1))) + within(z[1:], s[1:-1], np.arange(len(rows)))
    inverse = np.linalg.inv(np.eye(p) - moved - np.abs(H) @ G @ E)
    sigma = inverse @ np.abs(H) @ (c + eps + G @ a[-1]) + (inverse / inverse.max(axis=0)) @ kappa
    kept += [
        xs == A @ xs + B @ us + d,
        cp.abs(H @ (x[-1] - xs)) + s[-1] + eps <= sigma,
        *within(steady, sigma, np.arange(len(rows))),
    ]

    def far(of: Any, aim: Array, weight: Array) -> Any:
        return cp.sum_squares((of - aim) @ np.linalg.cholesky(weight))

    xr, ur = design.reference[:n], design.reference[n:]
    cost = far(x[:-1], xr, w.Q) + far(u, ur, w.R) + far(x[-1], xr, w.P) + far(xs, xr, w.T)
    if (soft := design.soft) is not None:

        def excess(of: Any) -> Any:
            """Where there is an input; its rows as those of z."""
            return cp.maximum(of - np.broadcast_to(soft.high, of.shape), np.broadcast_to(soft.low, of.shape) - of, 0)

        states = soft.axis < n
        kept_at, last = excess(z[:, soft.axis]), excess(cp.reshape(steady[soft.axis], (1, len(soft.axis)), order="C"))
        end = cp.multiply(states.astype(float), excess(cp.hstack([x[-1], us])[soft.axis][None, :]))
        whole = cp.vstack([kept_at, cp.maximum(last, end)])
        cost += cp.sum(whole @ soft.linear) + cp.sum(cp.square(whole) @ soft.quadratic)
    return Twin(cp.Problem(cp.Minimize(cost), kept), start, u[0])
