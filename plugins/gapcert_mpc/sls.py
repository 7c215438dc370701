"""System level synthesis: nominal inputs and causal feedback from disturbances, optimised jointly and robustly feasible.

Method: Anderson, Doyle, Low and Matni, "System level synthesis", Annual Reviews in Control 47 (2019); for robust predictive
control with time-varying systems Leeman et al., "Fast system level synthesis", arXiv 2401.13762. Here disturbances are from
boxes, so that tightenings are 1-norms, and the program is solved by an interior-point method over multipliers of rows.
"""

from __future__ import annotations

from typing import Any, NamedTuple, final

import numpy as np
import numpy.typing as npt

from gapcert import UsageError
from gapcert_mpc import sls_kernels as kernels
from gapcert_mpc.sls_problem import LtvProblem, SlsPlan, SlsRefusal

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

_TOLERANCE = 1e-9
_INSIDE = 1e-8  # rows are solved for limits that lie this part further inside, since they then hold exactly
_HOPELESS = 1e8  # times the cost without rows: a plan that costs more counts as none
_ROUNDS = 40
_DYNAMICS = {"A", "B", "Q", "R", "Q_end", "Cx", "Cu", "Cp", "C_end"}


class _Rows(NamedTuple):
    """All rows along the trajectory without rows: their values, what columns add, limits, and the cost there."""

    alpha: Array
    beta: Array
    limits: Array
    cost: float
    stages: Ints
    x: Array
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
        self._working = np.zeros((2, problem.Cx.shape[0] * problem.Cx.shape[1] + len(problem.C_end)), bool)

    def update(self, **changes: Any) -> None:
        """Other data of the same shapes: x0, A, B, d, r, references, limits, …"""
        self.problem = self.problem.replaced(changes)
        self._stale |= not _DYNAMICS.isdisjoint(changes)

    def solve(self) -> SlsPlan | SlsRefusal:
        """The optimal plan, verified; or why there is none."""
        if self._stale:
            self._condense()
        rows, p = self._prepared(), self.problem
        (N, _, m), radii = p.B.shape, p.r.ravel()
        columns = np.flatnonzero(radii)
        v, V, count = np.zeros(N * m), np.zeros((len(columns), N * m)), 0
        status, working, bound, multipliers = kernels.SOLVED, self._working, rows.cost, np.zeros(self._working.shape)
        for _ in range(_ROUNDS):
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
            self._working = np.zeros_like(working)
            return self._refusal(status, bound)
        self._working = working & (multipliers > 1e-6 * multipliers.max(initial=0.0))
        return self._plan(rows, v, V / radii[columns][:, None], columns, count)

    def _condense(self) -> None:
        """What depends on dynamics, weights and rows, and neither on x₀ nor on limits."""
        p = self.problem
        (N, n, m) = p.B.shape
        try:
            self._K, self._W, self._P, X, U = kernels.condensed(p.A, p.B, p.Q, p.R, p.Q_end)
        except np.linalg.LinAlgError:
            raise UsageError("SlsSolver: R + BᵀPB is numerically singular; choose a larger R or smaller Q") from None
        before = np.concatenate([np.zeros_like(U[:1]), U[:-1]])
        staged = p.Cx @ X[:N] + p.Cu @ U + p.Cp @ before
        self._rows = np.concatenate([staged.reshape(-1, N * (m + n)), p.C_end @ X[N]])
        self._ahead, self._X, self._U = np.ascontiguousarray(self._rows[:, : N * m]), X, U
        # So many leading entries of v enter a row.
        now = p.Cu.any(axis=2) + np.arange(N)[:, None]
        self._reach = m * np.concatenate([now.ravel(), np.full(len(p.C_end), N)])
        self._stale = False

    def _prepared(self) -> _Rows:
        p = self.problem
        N, n, m = p.B.shape
        qx, ru = np.einsum("kij,kj->ki", p.Q, p.x_ref[:N]), np.einsum("kij,kj->ki", p.R, p.u_ref)
        kappa = kernels.tracking(p.A, p.B, p.d, qx, ru, p.Q_end @ p.x_ref[N], self._K, self._W, self._P)
        x, u = kernels.rolled(p.A, p.B, p.d, self._K, kappa, p.x0)
        before = np.concatenate([p.u_before[None], u[:-1]])
        staged = np.einsum("kci,ki->kc", p.Cx, x[:N]) + np.einsum("kci,ki->kc", p.Cu, u) + np.einsum("kci,ki->kc", p.Cp, before)
        radii = p.r.ravel()
        columns = np.flatnonzero(radii)
        limits = np.array([[*p.h.ravel(), *p.h_end], [*-p.low.ravel(), *-p.low_end]])
        limits -= _INSIDE * (1.0 + np.where(np.isinf(limits), 0.0, np.abs(limits)))
        # A response without rows costs r² Pᵢᵢ.
        least = 0.5 * p.response_weight * float(radii**2 @ np.diagonal(self._P[1:], axis1=1, axis2=2).ravel())
        return _Rows(
            alpha=np.concatenate([staged.ravel(), p.C_end @ x[N]]),
            beta=self._rows[:, N * m + columns] * radii[columns],
            limits=limits,
            cost=self._cost(x, u) + least,
            stages=columns // n,
            x=x,
            u=u,
        )

    def _cost(self, x: Array, u: Array) -> float:
        p = self.problem
        dx, du, N = x - p.x_ref, u - p.u_ref, len(u)
        stages = np.einsum("ki,kij,kj->", dx[:N], p.Q, dx[:N]) + np.einsum("ki,kij,kj->", du, p.R, du)
        return 0.5 * float(stages + dx[N] @ p.Q_end @ dx[N])

    def _restricted(self, rows: _Rows, working: Array) -> tuple[int, Array, Array, Array, int, float]:
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
        status, lam, y, steps, bound = kernels.solved(
            rows.alpha[chosen],
            beta[moving],
            grams[0],
            grams[1:] / rho,
            first[moving],
            rows.stages[moving],
            row,
            sign,
            rows.limits[side, chosen[row]] - fixed[row],
            rows.cost,
            _TOLERANCE,
            _HOPELESS * max(rows.cost, 1e-300),
        )
        eta = np.bincount(row, weights=sign * lam, minlength=len(chosen))
        V = np.zeros((len(beta), N * m))
        V[moving] = -(y @ own) / rho
        V[np.arange(N * m) < ((rows.stages + 1) * m)[:, None]] = 0.0
        multipliers = np.zeros(working.shape)
        multipliers[side, chosen[row]] = lam
        return status, -(eta @ own), V, multipliers, steps, bound

    def _refusal(self, status: int, bound: float) -> SlsRefusal:
        if status == kernels.INFEASIBLE:
            return SlsRefusal("infeasible", f"rows cannot all hold: every plan costs more than {bound:.3g}", bound)
        return SlsRefusal("unsolved", f"the interior-point method did not converge; plans cost at least {bound:.3g}", bound)

    def _plan(self, rows: _Rows, v: Array, V: Array, columns: Ints, count: int) -> SlsPlan | SlsRefusal:
        """Trajectories and responses by the recursion itself, and all rows on them, with bounds of all rounding errors."""
        p = self.problem
        N, n, m = p.B.shape
        eps = float(np.finfo(float).eps)
        rounding = (N * n + n + m + 8) * eps
        inputs = np.empty((N, m, 1 + N * n))
        inputs[:, :, 0] = rows.u + self._U[:, :, : N * m] @ v
        inputs[:, :, 1:] = self._U[:, :, N * m :]
        inputs[:, :, 1 + columns] += self._U[:, :, : N * m] @ V.T
        pushed, start = np.zeros((N, n, 1 + N * n)), np.zeros((n, 1 + N * n))
        pushed[:, :, 0], start[:, 0] = p.d, p.x0
        pushed[:, :, 1:].reshape(N, n, N, n)[np.arange(N), :, np.arange(N)] = np.eye(n)
        Z, error = kernels.verified(p.A, p.B, start, pushed, inputs, (n + m + 4) * eps)
        before = np.concatenate([np.zeros_like(inputs[:1]), inputs[:-1]])
        before[0, :, 0] = p.u_before
        c = p.Cx.shape[1]
        values = np.concatenate([(p.Cx @ Z[:N] + p.Cu @ inputs + p.Cp @ before).reshape(N * c, -1), p.C_end @ Z[N]])
        lost = np.abs(p.Cx) @ (error[:N] + rounding * np.abs(Z[:N]))
        lost += rounding * (np.abs(p.Cu) @ np.abs(inputs) + np.abs(p.Cp) @ np.abs(before))
        lost = np.concatenate([lost.reshape(N * c, -1), np.abs(p.C_end) @ (error[N] + rounding * np.abs(Z[N]))])
        weights = np.array([1.0, *p.r.ravel()])
        a, tau = values[:, 0], np.abs(values[:, 1:]) @ weights[1:]
        outward = lost @ weights + rounding * (np.abs(a) + tau)
        limits = np.array([[*p.h.ravel(), *p.h_end], [*-p.low.ravel(), *-p.low_end]])
        slack = (limits - np.array([a, -a]) - tau - outward)[np.isfinite(limits)].min(initial=np.inf)
        if not slack >= 0.0:
            return SlsRefusal("unsolved", f"the plan found breaks a row by {-slack:.3g}, rounding counted outwards", -np.inf)
        x, u = Z[:, :, 0].copy(), inputs[:, :, 0].copy()
        response, answer = Z[:, :, 1:] * weights[1:], inputs[:, :, 1:] * weights[1:]
        spread = np.einsum("kic,kij,kjc->", response[:N], p.Q, response[:N], optimize=True)
        spread += np.einsum("kic,kij,kjc->", answer, p.R, answer, optimize=True)
        spread += np.einsum("ic,ij,jc->", response[N], p.Q_end, response[N], optimize=True)
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
            slack=float(slack),
            iterations=count,
        )
