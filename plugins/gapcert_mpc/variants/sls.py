"""System level synthesis: nominal inputs and causal feedback from disturbances, optimised jointly and robustly feasible.

Method: Anderson, Doyle, Low and Matni, "System level synthesis", Annual Reviews in Control 47 (2019); for robust predictive
control with time-varying systems Leeman et al., "Fast system level synthesis", arXiv 2401.13762. Here disturbances are from
boxes, so that tightenings are 1-norms, and the program is solved by an interior-point method over multipliers of rows.
"""

from __future__ import annotations

from typing import Any, NamedTuple, final

import numpy as np
import numpy.typing as npt

from gapcert.plugin import Array, Ints, UsageError
from gapcert_mpc.thresholds import THRESHOLDS

from . import sls_kernels as kernels
from .sls_problem import LtvProblem, SlsPlan, SlsRefusal

_DYNAMICS = {"A", "B", "Q", "R", "Q_end", "Cx", "Cu", "Cp", "C_end"}


class Condensed(NamedTuple):
    """Under u = K x + W v with the gains of the Riccati recursion, W Wᵀ = (R + BᵀPB)⁻¹, the cost is ½|v|² + linear + constant.

    `P` (N + 1, n, n) are its matrices; `states` (N + 1, n, z) and `inputs` (N, m, z) respond to z = v₀ … v_{N−1}, x₀,
    w₀ … w_{N−1}, and so do all rows (rows, z), those of stages first.
    """

    P: Array
    states: Array
    inputs: Array
    rows: Array

    @classmethod
    def of(cls, p: LtvProblem) -> Condensed:
        """Raises numpy.linalg.LinAlgError where R + BᵀPB is numerically singular."""
        A, B, (N, n, m) = p.A, p.B, p.B.shape
        K, W, P = np.zeros((N, m, n)), np.zeros((N, m, m)), np.zeros((N + 1, n, n))
        P[N] = p.Q_end
        for k in range(N - 1, -1, -1):
            PB = P[k + 1] @ B[k]
            root = np.linalg.inv(np.linalg.cholesky(p.R[k] + B[k].T @ PB))
            G = root @ (PB.T @ A[k])
            W[k], K[k] = root.T, -root.T @ G
            V = p.Q[k] + A[k].T @ P[k + 1] @ A[k] - G.T @ G
            P[k] = 0.5 * (V + V.T)
        X, U = np.zeros((N + 1, n, N * (m + n) + n)), np.zeros((N, m, N * (m + n) + n))
        closed, driven = A + B @ K, B @ W
        X[0, :, N * m : N * m + n] = np.eye(n)
        for k in range(N):
            np.matmul(closed[k], X[k], out=X[k + 1])
            X[k + 1, :, k * m : (k + 1) * m] = driven[k]
            X[k + 1, :, N * m + (k + 1) * n : N * m + (k + 2) * n] = np.eye(n)
        np.matmul(K, X[:N], out=U)
        for k in range(N):
            U[k, :, k * m : (k + 1) * m] = W[k]
        before = np.concatenate([np.zeros_like(U[:1]), U[:-1]])
        staged = p.Cx @ X[:N] + p.Cu @ U + p.Cp @ before
        return cls(P, X, U, np.concatenate([staged.reshape(-1, X.shape[2]), p.C_end @ X[N]]))

    def tracking(self, p: LtvProblem) -> tuple[Array, Array]:
        """(x, u) of least cost without rows."""
        N, _, m = p.B.shape
        z = np.concatenate([np.zeros(N * m), p.x0, p.d.ravel()])
        dx, du = self.states @ z - p.x_ref, self.inputs @ z - p.u_ref
        weighted = np.einsum("kij,kj->ki", p.Q, dx[:N]), np.einsum("kij,kj->ki", p.R, du), p.Q_end @ dx[N]
        z[: N * m] = -np.einsum("kiz,ki->z", self.states[:N, :, : N * m], weighted[0])
        z[: N * m] -= np.einsum("kiz,ki->z", self.inputs[:, :, : N * m], weighted[1])
        z[: N * m] -= self.states[N, :, : N * m].T @ weighted[2]
        return self.states @ z, self.inputs @ z


class _Rows(NamedTuple):
    """All rows along the trajectory without rows: their values, what columns add, limits, and the cost there."""

    alpha: Array
    beta: Array
    limits: Array
    cost: float
    stages: Ints
    u: Array


@final
class SlsSolver:
    """Solves one `LtvProblem` after another of the same shapes.

    Inputs are u = K x + κ + W v with the gains of the Riccati recursion, which makes the cost ½|v̄|² + ½ρ Σ |v_c|² + constant
    (v̄ nominal, v_c for the scalar disturbance c) and all rows of nominal and of responses parts of one matrix. The interior-
    point method sees only the rows that are needed: it begins with those of the last plan, and rows that its solution breaks
    join.
    """

    def __init__(self, problem: LtvProblem) -> None:
        self.problem = problem
        self._stale = True
        self.working: npt.NDArray[np.bool_] = np.zeros(
            (2, problem.Cx.shape[0] * problem.Cx.shape[1] + len(problem.C_end)), np.bool_
        )

    def update(self, **changes: Any) -> None:
        """Other data of the same shapes: x0, A, B, d, r, references, limits, …"""
        self.problem = self.problem.replaced(changes)
        self._stale |= not _DYNAMICS.isdisjoint(changes)

    def forget(self) -> None:
        """Begins the next solution without the rows of the last plan: it depends then on the problem alone."""
        self.working = np.zeros_like(self.working)

    def solve(self) -> SlsPlan | SlsRefusal:
        """The optimal plan, verified; or why there is none."""
        rows, p = self._prepared(), self.problem
        (N, _, m), radii = p.B.shape, p.r.ravel()
        columns = np.flatnonzero(radii)
        v, V, count = np.zeros(N * m), np.zeros((len(columns), N * m)), 0
        status, working, bound, multipliers = kernels.SOLVED, self.working, rows.cost, np.zeros(self.working.shape)
        for _ in range(THRESHOLDS.sls_rounds):
            if working.any():
                status, v, V, multipliers, steps, extra = self._restricted(rows, working)
                count, bound = count + steps, max(bound, rows.cost + extra)
                if status == kernels.INFEASIBLE:
                    break
            a, tau = rows.alpha + self._ahead @ v, np.abs(rows.beta + self._ahead @ V.T).sum(axis=1)
            slack = rows.limits - np.array([tau + a, tau - a])
            broken = ~working & (slack < 0.0)
            if not broken.any():
                break
            working = working | broken
        if status != kernels.SOLVED:
            self.forget()
            if status == kernels.INFEASIBLE:
                return SlsRefusal("infeasible", f"rows cannot all hold: every plan costs more than {bound:.3g}", float(bound))
            why = f"the interior-point method did not converge; plans cost at least {bound:.3g}"
            return SlsRefusal("unsolved", why, float(bound))
        self.working = working & (multipliers > 1e-6 * multipliers.max(initial=0.0))
        return self._plan(rows, v, V / radii[columns][:, None], columns, count)

    def _prepared(self) -> _Rows:
        """All that changes with x₀, disturbances, references and limits; what does not is made where it is stale."""
        p = self.problem
        N, n, m = p.B.shape
        if self._stale:
            try:
                self._condensed = Condensed.of(p)
            except np.linalg.LinAlgError:
                raise UsageError("SlsSolver: R + BᵀPB is numerically singular; choose a larger R or smaller Q") from None
            self._ahead = np.ascontiguousarray(self._condensed.rows[:, : N * m])
            # So many leading entries of v enter a row.
            now = p.Cu.any(axis=2) + np.arange(N)[:, None]
            self._reach = m * np.concatenate([now.ravel(), np.full(len(p.C_end), N)])
            self._stale = False
        x, u = self._condensed.tracking(p)
        before = np.concatenate([p.u_before[None], u[:-1]])
        staged = p.Cx @ x[:N, :, None] + p.Cu @ u[:, :, None] + p.Cp @ before[:, :, None]
        radii = p.r.ravel()
        columns, limits = np.flatnonzero(radii), limits_of(p)
        limits -= THRESHOLDS.sls_inside * (1.0 + np.where(np.isinf(limits), 0.0, np.abs(limits)))
        # A response without rows costs r² Pᵢᵢ.
        least = 0.5 * p.response_weight * float(radii**2 @ np.diagonal(self._condensed.P[1:], axis1=1, axis2=2).ravel())
        return _Rows(
            alpha=np.concatenate([staged.ravel(), p.C_end @ x[N]]),
            beta=self._condensed.rows[:, N * m + n + columns] * radii[columns],
            limits=limits,
            cost=self._cost(x, u) + least,
            stages=columns // n,
            u=u,
        )

    def _cost(self, x: Array, u: Array) -> float:
        p = self.problem
        dx, du, N = x - p.x_ref, u - p.u_ref, len(u)
        stages = np.einsum("ki,kij,kj->", dx[:N], p.Q, dx[:N]) + np.einsum("ki,kij,kj->", du, p.R, du)
        return 0.5 * float(stages + dx[N] @ p.Q_end @ dx[N])

    def _restricted(self, rows: _Rows, working: npt.NDArray[np.bool_]) -> tuple[int, Array, Array, Array, int, float]:
        """With the rows `working` (2, rows) alone: status, v̄, v_c, multipliers, iterations and a bound of the cost added."""
        (N, _, m), rho = self.problem.B.shape, self.problem.response_weight
        chosen = np.flatnonzero(working.any(axis=0))
        chosen = chosen[np.argsort(self._reach[chosen], kind="stable")]
        side, row = (np.ascontiguousarray(v) for v in np.nonzero(working[:, chosen]))  # one layout, compiled once
        own = self._ahead[chosen]
        blocks = own.reshape(-1, N, m).transpose(1, 0, 2)
        grams = np.zeros((N + 1, len(chosen), len(chosen)))
        grams[:N] = np.cumsum((blocks @ blocks.transpose(0, 2, 1))[::-1], axis=0)[::-1]
        beta = np.ascontiguousarray(rows.beta[chosen].T)
        first = np.searchsorted(self._reach[chosen], (rows.stages + 1) * m, side="right")
        fixed = np.where(np.arange(len(chosen)) < first[:, None], np.abs(beta), 0.0).sum(axis=0)
        moving = first < len(chosen)
        sign = np.where(side == 0, 1.0, -1.0)
        alpha, beta, first, stages = rows.alpha[chosen], beta[moving], first[moving], rows.stages[moving]
        limit = rows.limits[side, chosen[row]] - fixed[row]
        gram = grams[1:] / rho
        status, lam, y, steps, bound = kernels.solved(
            kernels.started(alpha, beta, grams[0], gram, first, row, sign, limit),
            alpha,
            grams[0],
            (beta, gram, first, stages),
            (row, sign, limit),
            (rows.cost, THRESHOLDS.sls_tolerance, THRESHOLDS.sls_hopeless * max(rows.cost, 1e-300)),
        )
        eta = np.bincount(row, weights=sign * lam, minlength=len(chosen))
        V = np.zeros((len(moving), N * m))
        V[moving] = -(y @ own) / rho
        V[np.arange(N * m) < ((rows.stages + 1) * m)[:, None]] = 0.0
        multipliers = np.zeros(working.shape)
        multipliers[side, chosen[row]] = lam
        return status, -(eta @ own), V, multipliers, steps, bound

    def _plan(self, rows: _Rows, v: Array, V: Array, columns: Ints, count: int) -> SlsPlan | SlsRefusal:
        """Its trajectories follow from its inputs, and it is one only where all rows hold on them."""
        p = self.problem
        N, n, m = p.B.shape
        ahead, c = self._condensed.inputs[:, :, : N * m], p.Cx.shape[1]
        inputs = np.empty((N, m, 1 + N * n))
        inputs[:, :, 0] = rows.u + ahead @ v
        inputs[:, :, 1:] = self._condensed.inputs[:, :, N * m + n :]
        inputs[:, :, 1 + columns] += ahead @ V.T
        Z, tau, slack = verified(p, inputs)
        if not slack >= 0.0:
            return SlsRefusal("unsolved", f"the plan found breaks a row by {-slack:.3g}, rounding counted outwards", -np.inf)
        x, u, radii = Z[:, :, 0].copy(), inputs[:, :, 0].copy(), p.r.ravel()
        response, answer = Z[:, :, 1:] * radii, inputs[:, :, 1:] * radii
        spread = (response[:N] * (p.Q @ response[:N])).sum() + (answer * (p.R @ answer)).sum()
        spread += (response[N] * (p.Q_end @ response[N])).sum()
        cost = self._cost(x, u)
        return SlsPlan(
            x=x,
            u=u,
            state_response=Z[:, :, 1:].reshape(N + 1, n, N, n).transpose(0, 2, 1, 3),
            input_response=inputs[:, :, 1:].reshape(N, m, N, n).transpose(0, 2, 1, 3),
            tightening=tau[: N * c].reshape(N, c),
            tightening_end=tau[N * c :],
            cost=cost,
            objective=cost + 0.5 * p.response_weight * float(spread),
            slack=slack,
            iterations=count,
        )


def limits_of(p: LtvProblem) -> Array:
    """(2, rows): sign a + τ ≤ limit for the signs + and −."""
    return np.array([np.concatenate([p.h.ravel(), p.h_end]), np.concatenate([-p.low.ravel(), -p.low_end])])


def verified(p: LtvProblem, inputs: Array) -> tuple[Array, Array, float]:
    """States under `inputs` (N, m, 1 + N n) by the recursion itself, tightenings of all rows, and the least slack of a row.

    Columns are the nominal one, then responses to each w_j: Z_{k+1} = A_k Z_k + B_k inputs_k + what enters at k. A bound of all
    rounding errors is taken off the slack: with δ = (n + m + 4) ε, |error_{k+1}| ≤ |A_k| (|error_k| + δ |Z_k|) + δ (|B_k|
    |inputs_k| + |d_k|), and likewise for rows and their sums.
    """
    N, n, m = p.B.shape
    eps = float(np.finfo(float).eps)
    Z, error = np.zeros((N + 1, n, 1 + N * n)), np.zeros((N + 1, n, 1 + N * n))
    Z[0, :, 0] = p.x0
    driven = p.B @ inputs
    driven[:, :, 0] += p.d
    size = np.abs(p.B) @ np.abs(inputs)
    size[:, :, 0] += np.abs(p.d)
    for k in range(N):
        np.matmul(p.A[k], Z[k], out=Z[k + 1])
        Z[k + 1] += driven[k]
        Z[k + 1, :, 1 + k * n : 1 + (k + 1) * n] += np.eye(n)
        A = np.abs(p.A[k])
        error[k + 1] = A @ (error[k] + (n + m + 4) * eps * np.abs(Z[k])) + (n + m + 4) * eps * size[k]
    before = np.concatenate([np.zeros_like(inputs[:1]), inputs[:-1]])
    before[0, :, 0] = p.u_before
    rows = (p.Cx @ Z[:N] + p.Cu @ inputs + p.Cp @ before).reshape(-1, 1 + N * n)
    rows = np.concatenate([rows, p.C_end @ Z[N]])
    weights, rounding = np.concatenate([[1.0], p.r.ravel()]), (N * n + n + 2 * m + 8) * eps
    doubt = error + rounding * np.abs(Z)
    lost = np.abs(p.Cx) @ (doubt[:N] @ weights)[:, :, None]
    lost += rounding * (np.abs(p.Cu) @ np.abs(inputs) + np.abs(p.Cp) @ np.abs(before)) @ weights[:, None]
    outward = np.concatenate([lost.ravel(), np.abs(p.C_end) @ (doubt[N] @ weights)])
    a, tau = rows[:, 0], np.abs(rows[:, 1:]) @ weights[1:]
    outward += rounding * (np.abs(a) + tau)
    limits = limits_of(p)
    slack = limits - np.array([a, -a]) - tau - outward
    return Z, tau, float(slack[np.isfinite(limits)].min(initial=np.inf))
