"""LipSDP of deep networks by a primal–dual interior point method that knows the structure of the linear matrix inequality.

With Λ_i ⪰ 0 diagonal, ρ = L² and blocks (input, layers 1 … l, output), the matrix has the diagonal ρI, 2Λ_1, …, 2Λ_l, I.
Symmetrically below it stand −Λ_iW_{i−1} for hidden layers and −W_l for the output, without a multiplier. Where it is positive
semidefinite, L is a Lipschitz constant. Its derivative by the multiplier of neuron j is e_j v_jᵀ + v_j e_jᵀ with
v_j = e_j − W_{i−1}ᵀ e_j: so the normal equations of the Newton step are four Hadamard products, and others go by blocks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve, cholesky, lapack, solve_triangular

from gapcert import Array
from gapcert_lipsdp.thresholds import THRESHOLDS


@final
@dataclass(frozen=True)
class Solved:
    """ρ and multipliers of each hidden layer, for which the matrix is positive definite in floating point; ρ of the dual."""

    rho: float
    multipliers: tuple[Array, ...]
    dual: float
    rounds: int


def first_multipliers(weights: Sequence[Array]) -> tuple[list[float], float]:
    """(λ_i, ρ): one multiplier per layer, from the last one backwards; above ρ the matrix is positive definite with them.

    With P_l = W_lᵀW_l, λ_i = λmax(P_i) and P_{i−1} = W_{i−1}ᵀ λ_i² (2λ_i − P_i)⁻¹ W_{i−1} (ECLipsE-Fast), ρ = λmax(P_0).
    """
    p, found = weights[-1].T @ weights[-1], list[float]()
    for w in weights[-2::-1]:
        size = max(float(np.linalg.eigvalsh(p)[-1]), np.finfo(np.float64).tiny)
        found.append(size)
        p = w.T @ np.linalg.solve(2 * np.eye(len(p)) / size - p / size**2, w)
    return found[::-1], float(np.linalg.eigvalsh(p)[-1])


def solved(weights: Sequence[Array], tolerance: float = THRESHOLDS.interior_gap) -> Solved:
    """weights W_0 … W_l, the first in units of the norm of the inputs; LinAlgError where floats allow no start."""
    multipliers, rho = first_multipliers(weights)
    # Of powers of two, so that the matrix of the scaled network is that of the given one to the bit.
    scale = [float(2.0 ** np.round(-0.5 * np.log2(s))) for s in (rho, *multipliers)]
    scaled = [w * scale[i] / (scale[i + 1] if i + 1 < len(scale) else 1.0) for i, w in enumerate(weights)]
    found = _Method(scaled).run(tolerance)
    own = tuple(m / s**2 for m, s in zip(found.multipliers, scale[1:], strict=True))
    return Solved(found.rho / scale[0] ** 2, own, found.dual / scale[0] ** 2, found.rounds)


@final
class _Method:
    """Mehrotra's predictor and corrector along the HKM direction; S is the matrix, X its dual, Z = S⁻¹."""

    def __init__(self, weights: Sequence[Array]) -> None:
        sizes = [weights[0].shape[1], *(len(w) for w in weights)]
        at = np.concatenate([[0], np.cumsum(sizes)]).tolist()
        self.n, self.count, self.size = sizes[0], sum(sizes[1:-1]), sum(sizes)
        self.hidden = slice(self.n, self.n + self.count)
        self.output, self.last, self.end = slice(at[-2], at[-1]), slice(at[-3], at[-2]), weights[-1]
        self.layers = [
            (slice(at[i], at[i + 1]), slice(at[i + 1], at[i + 2]), slice(at[i + 1] - self.n, at[i + 2] - self.n), w)
            for i, w in enumerate(weights[:-1])
        ]
        values, rho = first_multipliers(weights)
        self.lam = np.concatenate([np.full(k, v) for k, v in zip(sizes[1:-1], values, strict=True)])
        self.rho = THRESHOLDS.interior_start * rho
        self.low = _factor(self.matrix(self.rho, self.lam))
        if self.low is None:
            raise LinAlgError("the first multipliers are not inside: the weights are too far apart")
        self.inverse = _inverse(self.low)
        self.dual = self.inverse / np.trace(self.inverse[: self.n, : self.n])
        self.root = _factor(self.dual)
        self.random = np.random.default_rng(0)

    def matrix(self, rho: float, lam: Array, constant: bool = True) -> Array:
        out = np.zeros((self.size, self.size))
        inputs, neurons = np.arange(self.n), np.arange(self.n, self.n + self.count)
        out[inputs, inputs], out[neurons, neurons] = rho, 2 * lam
        for before, own, column, w in self.layers:
            out[own, before] = -lam[column][:, None] * w
            out[before, own] = out[own, before].T
        if constant:
            out[self.output, self.output] = np.eye(len(self.end))
            out[self.output, self.last], out[self.last, self.output] = -self.end, -self.end.T
        return out

    def traces(self, x: Array) -> tuple[float, Array]:
        """Products of a symmetric matrix with the derivatives by ρ and by every multiplier."""
        d = np.einsum("ii->i", x)[self.hidden].copy()
        for before, own, column, w in self.layers:
            d[column] -= np.einsum("jk,jk->j", w, x[own, before])
        return float(np.trace(x[: self.n, : self.n])), 2 * d

    def constant(self, x: Array) -> float:
        """Product with what depends on neither."""
        return float(np.trace(x[self.output, self.output]) - 2 * np.sum(self.end * x[self.output, self.last]))

    def moved(self, rho: float, lam: Array, z: Array) -> Array:
        """The derivative along (ρ, λ), times z."""
        out = np.zeros_like(z)
        out[: self.n], out[self.hidden] = rho * z[: self.n], 2 * lam[:, None] * z[self.hidden]
        for before, own, column, w in self.layers:
            out[own] -= lam[column][:, None] * (w @ z[before])
            out[before] -= w.T @ (lam[column][:, None] * z[own])
        return out

    def columns(self, x: Array) -> Array:
        """X V, V the columns v_j."""
        out = x[:, self.hidden].copy()
        for before, _, column, w in self.layers:
            out[:, column] -= x[:, before] @ w.T
        return out

    def rows(self, x: Array) -> Array:
        """Vᵀ X."""
        out = x[self.hidden].copy()
        for before, _, column, w in self.layers:
            out[column] -= w @ x[before]
        return out

    def normal(self) -> Any:
        """Factor of ⟨A_j, X A_k Z⟩ for ρ and all multipliers."""
        x, z, h = self.dual, self.inverse, self.hidden
        xv, zv = self.columns(x), self.columns(z)
        out = np.empty((self.count + 1, self.count + 1))
        cross = xv[h] * zv[h].T
        out[1:, 1:] = cross + cross.T + self.rows(xv) * z[h, h] + self.rows(zv) * x[h, h]
        both = z[:, : self.n] @ x[: self.n]
        out[0, 1:] = out[1:, 0] = self.traces((both + both.T) / 2)[1]
        out[0, 0] = np.sum(x[: self.n, : self.n] * z[: self.n, : self.n])
        return cho_factor(out, lower=True, overwrite_a=True, check_finite=False)

    def direction(self, normal: Any, goal: Array) -> tuple[float, Array, Array]:
        """(dρ, dλ, dX) with X + dX = goal − sym(X dS Z), feasible in the dual."""
        first, others = self.traces(goal)
        step = cho_solve(normal, np.concatenate([[first - 1], others]), check_finite=False)
        along = self.dual @ self.moved(float(step[0]), step[1:], self.inverse)
        return float(step[0]), step[1:], goal - (along + along.T) / 2 - self.dual

    def lengths(self, rho: float, lam: Array, dual: Array) -> tuple[float, float]:
        """How far (X, S) stay positive definite, at most 1."""
        assert self.root is not None
        assert self.low is not None
        ends = (self._reach(self.root, dual), self._reach(self.low, self.matrix(rho, lam, False)))
        return min(1.0, ends[0]), min(1.0, ends[1])

    def _reach(self, low: Array, step: Array) -> float:
        """The largest a, or a little less, with LLᵀ + a·step ⪰ 0: by Lanczos steps with L⁻¹ step L⁻ᵀ."""
        q = self.random.standard_normal(len(low))
        basis, a, b = np.empty((THRESHOLDS.krylov_steps, len(low))), list[float](), list[float]()
        q /= np.linalg.norm(q)
        least = -np.inf
        for k in range(min(THRESHOLDS.krylov_steps, len(low))):
            basis[k] = q
            v = step @ solve_triangular(low, q, lower=True, trans=1, check_finite=False)
            v = solve_triangular(low, v, lower=True, check_finite=False)
            a.append(float(q @ v))
            for _ in range(2):
                v -= (basis[: k + 1] @ v) @ basis[: k + 1]
            size = float(np.linalg.norm(v))
            values, vectors = np.linalg.eigh(np.diag(a) + np.diag(b, 1) + np.diag(b, -1))
            error = size * abs(float(vectors[-1, 0]))
            least = float(values[0]) - error
            if error < THRESHOLDS.eigenvalue_error * abs(float(values[0])) or least > -THRESHOLDS.free_eigenvalue or size == 0:
                break
            b.append(size)
            q = v / size
        return np.inf if least >= 0 else -1 / least

    def run(self, tolerance: float) -> Solved:
        done = 0
        while done < THRESHOLDS.interior_rounds:
            one, others = self.traces(self.dual)
            constant = self.constant(self.dual)
            product = self.rho * one + float(self.lam @ others) + constant
            if product < tolerance * self.rho and max(abs(1 - one), float(np.abs(others).max())) < tolerance:
                break
            if not self._round(product / self.size):
                break
            done += 1
        parts = tuple(self.lam[column] for _, _, column, _ in self.layers)
        return Solved(self.rho, parts, -self.constant(self.dual), done)

    def _round(self, mean: float) -> bool:
        """One step of predictor and corrector; False where floats allow none."""
        try:
            normal = self.normal()
        except LinAlgError:
            return False
        rho, lam, dual = self.direction(normal, np.zeros_like(self.dual))
        p, d = self.lengths(rho, lam, dual)
        one, others = self.traces(self.dual + p * dual)
        there = (self.rho + d * rho) * one + (self.lam + d * lam) @ others + self.constant(self.dual + p * dual)
        centre = max(min(1.0, max(float(there) / self.size / mean, 0.0) ** 2), 1e-8)
        curve = dual @ self.moved(rho, lam, self.inverse)
        rho, lam, dual = self.direction(normal, centre * mean * self.inverse - (curve + curve.T) / 2)
        share = THRESHOLDS.boundary_step if mean > THRESHOLDS.late_product else THRESHOLDS.late_boundary_step
        p, d = (min(1.0, share * a) if a < 1 else 1.0 for a in self.lengths(rho, lam, dual))
        low, root = None, None
        while low is None and d > 1e-8:
            low = _factor(self.matrix(self.rho + d * rho, self.lam + d * lam))
            d = d if low is not None else THRESHOLDS.step_back * d
        while root is None and p > 1e-8:
            root = _factor(self.dual + p * dual)
            p = p if root is not None else THRESHOLDS.step_back * p
        if low is None or root is None:
            return False
        self.rho, self.lam, self.dual = self.rho + d * rho, self.lam + d * lam, self.dual + p * dual
        self.low, self.root, self.inverse = low, root, _inverse(low)
        return True


def _factor(a: Array) -> Array | None:
    try:
        return np.asarray(cholesky(a, lower=True, check_finite=False))
    except LinAlgError:
        return None


def _inverse(low: Array) -> Array:
    """(LLᵀ)⁻¹."""
    half = np.tril(lapack.dpotri(low, lower=1)[0])
    return np.asarray(half + np.tril(half, -1).T)
