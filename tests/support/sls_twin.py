"""System level synthesis written out in CVXPY: the reference of `gapcert_mpc.variants.sls`.

Columns of a response are scaled by r, so that x_k = x̄_k + Σ_{j<k} Y_{k,j} δ_j with |δ| ≤ 1.
"""

from __future__ import annotations

import cvxpy as cp
import numpy as np


def root(M):
    values, vectors = np.linalg.eigh(M)
    return (vectors * np.sqrt(np.maximum(values, 0))).T


class Twin:
    """One program whose data are parameters; `solve` returns its optimal value, or None where it is infeasible."""

    def __init__(self, problem):
        N, n, m = problem.B.shape
        names = ("A", "B", "d", "r")
        self.data = {name: [cp.Parameter(v.shape) for v in getattr(problem, name)] for name in names}
        self.x0 = cp.Parameter(n)
        self.x, self.u = cp.Variable((N + 1, n)), cp.Variable((N, m))
        X = {(k, j): cp.Variable((n, n)) for j in range(N) for k in range(j + 1, N + 1)}
        U = {(k, j): cp.Variable((m, n)) for j in range(N) for k in range(j + 1, N)}
        A, B = self.data["A"], self.data["B"]
        rows = [self.x[0] == self.x0]
        for k in range(N):
            rows.append(self.x[k + 1] == A[k] @ self.x[k] + B[k] @ self.u[k] + self.data["d"][k])
            rows.append(X[k + 1, k] == cp.diag(self.data["r"][k]))
            rows += [X[k + 1, j] == A[k] @ X[k, j] + B[k] @ U[k, j] for j in range(k)]
        for k in range(N):
            before = self.u[k - 1] if k else problem.u_before
            nominal = problem.Cx[k] @ self.x[k] + problem.Cu[k] @ self.u[k] + problem.Cp[k] @ before
            moved = [problem.Cx[k] @ X[k, j] + problem.Cu[k] @ U[k, j] for j in range(k)]
            moved = [v + problem.Cp[k] @ U[k - 1, j] if j < k - 1 else v for j, v in enumerate(moved)]
            rows += self.kept(nominal, moved, problem.low[k], problem.h[k])
        moved = [problem.C_end @ X[N, j] for j in range(N)]
        rows += self.kept(problem.C_end @ self.x[N], moved, problem.low_end, problem.h_end)
        Q, R, end = [root(M) for M in problem.Q], [root(M) for M in problem.R], root(problem.Q_end)
        self.cost = 0.5 * cp.sum_squares(end @ (self.x[N] - problem.x_ref[N]))
        for k in range(N):
            self.cost += 0.5 * cp.sum_squares(Q[k] @ (self.x[k] - problem.x_ref[k]))
            self.cost += 0.5 * cp.sum_squares(R[k] @ (self.u[k] - problem.u_ref[k]))
        spread = [cp.sum_squares((Q[k] if k < N else end) @ v) for (k, _), v in X.items()]
        spread += [cp.sum_squares(R[k] @ v) for (k, _), v in U.items()]
        self.problem = cp.Problem(cp.Minimize(self.cost + 0.5 * problem.response_weight * sum(spread)), rows)
        self.update(problem)

    @staticmethod
    def kept(nominal, moved, low, high):
        """low ≤ nominal ± Σ |moved| ≤ high."""
        margin = sum(cp.sum(cp.abs(v), axis=1) for v in moved) if moved else np.zeros(len(high))
        up, down = np.flatnonzero(np.isfinite(high)), np.flatnonzero(np.isfinite(low))
        rows = [(nominal + margin)[up] <= high[up]] if len(up) else []
        return rows + ([(nominal - margin)[down] >= low[down]] if len(down) else [])

    def update(self, problem):
        for name, parameters in self.data.items():
            for parameter, value in zip(parameters, getattr(problem, name), strict=True):
                parameter.value = value
        self.x0.value = problem.x0

    def solve(self):
        value = self.problem.solve(solver=cp.CLARABEL)
        return value if np.isfinite(value) else None
