"""The interior-point method of `sls`: the same source compiled where Numba is installed, and by NumPy where it is not.

Bounds q hold for rows p = `row[q]`: sign[q] a_p + τ_p ≤ limit[q], where a = α − G η is the nominal part, τ_p = Σ_c |b_cp| the
tightening, and b_c = β_c − Γ_c y_c the response to column c. λ_q ≥ 0 are the multipliers, η_p = Σ sign λ, π_p = Σ λ, and
|y_cp| ≤ π_p. G and Γ are Gram matrices of the rows, so that neither inputs nor states appear.
"""

from __future__ import annotations

import importlib.util
from typing import Any

import numpy as np

from gapcert.plugin import Array, Ints, compiler

COMPILED = importlib.util.find_spec("numba") is not None
SOLVED, INFEASIBLE, STALLED = 0, 1, 2
_MOST = 40
_TINY = 1e-14  # pivots below this part of their diagonal count as it: the step is then inexact, and the next one corrects it

compiled = compiler(nogil=True, error_model="numpy")


def _inverted(M: Array) -> None:
    """`factorised` and `substituted` by NumPy: the inverse takes the place of the factor."""
    M[:] = np.linalg.inv(M)


def _multiplied(L: Array, X: Array) -> None:
    X[:] = L @ X


def _factorised(M: Array) -> None:
    """M becomes its lower Cholesky factor, with the diagonal inverted."""
    n = len(M)
    for i in range(n):
        top = M[i, i]
        for j in range(i):
            v = M[i, j]
            for k in range(j):
                v -= M[i, k] * M[j, k]
            M[i, j] = v * M[j, j]
        v = top
        for k in range(i):
            v -= M[i, k] * M[i, k]
        M[i, i] = 1.0 / np.sqrt(max(v, _TINY * top, 1e-300))


def _substituted(L: Array, X: Array) -> None:
    """X (n, m) becomes M⁻¹X."""
    n, m = X.shape
    for i in range(n):
        for k in range(i):
            for j in range(m):
                X[i, j] -= L[i, k] * X[k, j]
        for j in range(m):
            X[i, j] *= L[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            for j in range(m):
                X[i, j] -= L[k, i] * X[k, j]
        for j in range(m):
            X[i, j] *= L[i, i]


factorised = compiled(_factorised) if COMPILED else _inverted
substituted = compiled(_substituted) if COMPILED else _multiplied


@compiled
def _reach(value: Array, change: Array, most: float) -> float:
    """The longest step ≤ `most` that keeps all values positive."""
    for v, c in zip(value.ravel(), change.ravel()):  # noqa: B905 (Numba knows no `strict`)
        if v + most * c < 0.0:
            most = -v / c
    return most


@compiled
def _summed(values: Array, row: Ints, P: int) -> Array:
    """Of bounds to their rows."""
    out = np.zeros(P)
    for q in range(len(row)):
        out[row[q]] += values[q]
    return out


@compiled
def _columns(L: Array, gram: Array, first: Ints, stage: Ints, right: Array) -> tuple[Array, Array]:
    """Δy_c = M_c⁻¹ right_c and Δb_c = −Γ_c Δy_c for all columns."""
    dy, db = np.zeros_like(right), np.zeros_like(right)
    P = right.shape[1]
    for c in range(len(right)):
        f = first[c]
        x = right[c, f:].copy().reshape((P - f, 1))
        substituted(L[c, f:, f:], x)
        dy[c, f:] = x[:, 0]
        db[c, f:] = -(gram[stage[c]] @ dy[c])[f:]
    return dy, db


@compiled
def _direction(
    kq: Array, kp: Array, km: Array, residual: Array, state: Any, factors: Any, structure: Any
) -> tuple[Array, Array, Array, Array]:
    """Δλ, Δy, Δb, Δt of the Newton step whose products λs, μ⁺f⁺ and μ⁻f⁻ change by −kq, −kp and −km."""
    lam, fp, fm = state
    L, S, E, iw, Dinv = factors
    gram, first, stage, row, mask = structure
    g, g2 = kp / fp + km / fm, kp / fp - km / fm
    e = mask * (E * g - g2)
    _, db = _columns(L, gram, first, stage, Dinv * e)
    theta = (g * iw - E * db).sum(axis=0)
    dlam = (-kq / lam - residual - theta[row]).reshape((len(lam), 1))
    substituted(S, dlam)
    dpi = _summed(dlam[:, 0].copy(), row, E.shape[1])
    dy, db = _columns(L, gram, first, stage, Dinv * (E * dpi + e))
    return dlam[:, 0].copy(), dy, db, E * db - (dpi + g) * iw


@compiled
def _factors(lam: Array, s: Array, fp: Array, fm: Array, mp: Array, mm: Array, G: Array, sign: Array, structure: Any) -> Any:
    """Factors of the columns' matrices M_c = D⁻¹ + Γ_c, and of the multipliers' matrix S."""
    gram, first, stage, row, mask = structure
    C, P = fp.shape
    up, um = fp / mp, fm / mm
    both = up + um
    Dinv, E, iw = 0.25 * both, mask * (um - up) / both, mask * up * um / both
    L, T = np.zeros((C, P, P)), np.diag(iw.sum(axis=0))
    for c in range(C):
        f = first[c]
        own = gram[stage[c], f:, f:]
        L[c, f:, f:] = own + np.diag(Dinv[c, f:])
        factorised(L[c, f:, f:])
        V = own.copy()
        substituted(L[c, f:, f:], V)
        T[f:, f:] += (E[c, f:] * Dinv[c, f:]).reshape((P - f, 1)) * V * E[c, f:]
    S = np.diag(s / lam)
    for q in range(len(row)):
        for o in range(len(row)):
            S[q, o] += sign[q] * sign[o] * G[row[q], row[o]] + T[row[q], row[o]]
    factorised(S)
    return L, S, E, iw, Dinv


def started(alpha: Array, beta: Array, G: Array, gram: Array, first: Ints, row: Ints, sign: Array, limit: Array) -> Any:
    """λ, s, f⁺, f⁻ to begin with: rows as far inside as they are outside, and products of rows of equal size."""
    P = beta.shape[1]
    mask = np.arange(P) >= first[:, None]
    tau, size = (mask * np.abs(beta)).sum(axis=0), np.diag(G) + np.diag(gram[0]) * mask.sum(axis=0)
    size = np.sqrt(np.maximum(size, 1e-12 * size.max() + 1e-300))[row]
    excess = np.abs(sign * alpha[row] + tau[row] - limit)
    most = max((excess / size).max(), 1e-12)
    s = np.maximum(excess, 0.1 * size * most + 1e-12)
    lam = 10.0 * most**2 / s
    spare = most**2 / np.bincount(row, weights=lam, minlength=P)
    return lam, s, spare + np.abs(beta) - beta, spare + np.abs(beta) + beta


@compiled
def solved(
    start: Any, alpha: Array, G: Array, columns: Any, bounds: Any, ends: tuple[float, float, float]
) -> tuple[int, Array, Array, int, float]:
    """Mehrotra's method on the dual-feasible side: status, λ, y, iterations, and a lower bound of the cost.

    `columns` are β, the matrices Γ of stages, and per column the first row that it meets and its stage; `bounds` are row, sign
    and limit; `ends` are scale, tolerance and most. It ends where rows hold to the tolerance and the gap is below
    tolerance (scale + cost), or where the multipliers prove that every plan costs more than most.
    """
    (beta, gram, first, stage), (row, sign, limit), (scale, tolerance, most) = columns, bounds, ends
    C, P = beta.shape
    mask = np.zeros((C, P))
    for c in range(C):
        mask[c, first[c] :] = 1.0
    beta = beta * mask
    structure = (gram, first, stage, row, mask)
    lam, s, fp, fm = start
    y, b, count, bound = np.zeros((C, P)), beta.copy(), len(lam) + 2.0 * mask.sum(), 0.0
    for iteration in range(_MOST):
        eta, pi = _summed(sign * lam, row, P), _summed(lam, row, P)
        mp, mm = 0.5 * (pi + y), 0.5 * (pi - y)
        moved = G @ eta
        tau = 0.5 * (mask * (fp + fm)).sum(axis=0)
        residual = limit - sign * (alpha - moved)[row] - tau[row] - s
        gap = lam @ s + (mask * (mp * fp + mm * fm)).sum()
        linear = lam @ (sign * alpha[row] - limit) + (y * beta).sum()
        square = eta @ moved + (y * (beta - b)).sum()
        bound = linear - 0.5 * square
        inside = (np.abs(residual) <= tolerance * (1.0 + np.abs(limit))).all()
        if inside and gap <= tolerance * (scale + abs(bound)):
            return SOLVED, lam, y, iteration, bound
        if not inside and linear > 0.0 and linear * linear > 2.0 * square * most:
            return INFEASIBLE, lam, y, iteration, bound
        factors = _factors(lam, s, fp, fm, mp, mm, G, sign, structure)
        kq, kp, km = lam * s, mask * mp * fp, mask * mm * fm
        mu, step = gap / count, 1.0
        for correction in range(2):
            dlam, dy, db, dt = _direction(kq, kp, km, residual, (lam, fp, fm), factors, structure)
            dpi = _summed(dlam, row, P)
            ds = residual + sign * (G @ _summed(sign * dlam, row, P))[row] - (mask * dt).sum(axis=0)[row]
            dp, dm = mask * (dt - db), mask * (dt + db)
            dmp, dmm = 0.5 * mask * (dpi + dy), 0.5 * mask * (dpi - dy)
            step = _reach(s, ds, _reach(lam, dlam, 1.0 / 0.99))
            step = _reach(fm, dm, _reach(fp, dp, step))
            step = min(1.0, 0.99 * _reach(mm, dmm, _reach(mp, dmp, step)))
            if correction == 0:
                after = (lam + step * dlam) @ (s + step * ds) + (
                    mask * ((mp + step * dmp) * (fp + step * dp) + (mm + step * dmm) * (fm + step * dm))
                ).sum()
                centre = (after / gap) ** 3 * mu
                kq += dlam * ds - centre
                kp += mask * (dmp * dp - centre)
                km += mask * (dmm * dm - centre)
        lam, s, y, b = lam + step * dlam, s + step * ds, y + step * mask * dy, b + step * mask * db
        fp, fm = fp + step * dp, fm + step * dm
    return STALLED, lam, y, _MOST, bound
