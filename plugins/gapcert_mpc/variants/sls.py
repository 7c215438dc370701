"""System level synthesis: nominal inputs and causal feedback from disturbances, optimised jointly and robustly feasible.

Method: Anderson, Doyle, Low and Matni, "System level synthesis", Annual Reviews in Control 47 (2019); for robust predictive
control with time-varying systems Leeman et al., "Fast system level synthesis", arXiv 2401.13762. Here disturbances are from
boxes, so that tightenings are 1-norms, and the program is solved by an interior-point method over multipliers of rows.
"""

from __future__ import annotations

from typing import Any, NamedTuple, final

import numpy as np
import numpy.typing as npt

from gapcert import Array, UsageError
from gapcert.plugin import Ints
from gapcert_mpc.thresholds import THRESHOLDS

from . import sls_kernels as kernels
from .sls_problem import LtvProblem, SlsPlan, SlsRefusal
from .sls_trajectories import Condensed, limits_of, verified

_DYNAMICS = {"A", "B", "Q", "R", "Q_end", "Cx", "Cu", "Cp", "C_end"}


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
            return self._refusal(status, bound)
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

    def _refusal(self, status: int, bound: float) -> SlsRefusal:
        bound = float(bound)
        if status == kernels.INFEASIBLE:
            return SlsRefusal("infeasible", f"rows cannot all hold: every plan costs more than {bound:.3g}", bound)
        return SlsRefusal("unsolved", f"the interior-point method did not converge; plans cost at least {bound:.3g}", bound)

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
