"""Trajectories as functions of what is free: the Riccati recursion and responses under its feedback."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gapcert import Array

from .sls_problem import LtvProblem


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
