"""LipSDP of one hidden layer by its dual over the spectraplex: as many unknowns as inputs, however wide the layer is.

For y = w·σ(W₀x + b), σ with slopes in [0, 1] elementwise, the optimum of LipSDP with diagonal multipliers is
L* = max over X ⪰ 0, tr X = 1 of F(X)/2, F(X) = Σ_j |w_j|·√(a_jᵀXa_j) + √(gᵀXg), with a_j the rows of W₀ and g = W₀ᵀw.
Any X bounds L* from below; its multipliers t_j = F·|w_j|/(2√(a_jᵀXa_j)) bound it from above.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import final

import numpy as np
from scipy.linalg import lapack
from scipy.optimize import minimize

from gapcert.plugin import Array, Bools, Ints
from gapcert_lipsdp.thresholds import THRESHOLDS

BLOCK = 4096  # neurons that are taken at once
MORE = np.array([0.0, *(10.0**k for k in range(-13, -2))])[:, None, None]  # relative, by which multipliers are enlarged
ROUNDING = 2e-15  # per term of a sum, what the proof takes from q
TINY = float(np.finfo(np.float64).tiny)


@final
@dataclass(frozen=True)
class OneLayer:
    """multipliers (h,) ≥ 0; lower ≤ L* ≤ upper, as computed: neither is rounded outwards."""

    multipliers: Array
    lower: float
    upper: float


def solved(first: Array, last: Array) -> OneLayer:
    """first W₀ (h, n), in units of the norm of the inputs; last w (h,)."""
    weight, n = np.abs(last), first.shape[1]
    columns = np.hstack([first.T * weight, (last @ first)[:, None]])
    used = np.asarray(columns.any(axis=0))
    if not used.any():
        return OneLayer(np.zeros(len(last)), 0.0, 0.0)
    columns = columns if used.all() else np.ascontiguousarray(columns[:, used])
    square = columns @ columns.T
    x = square / np.trace(square)
    if n * (n + 1) // 2 <= THRESHOLDS.newton_unknowns:
        x, length = _newton(columns, x)
        total, upper = _sides(columns, length)
        if upper <= 0.5 * total * (1 + THRESHOLDS.search_gap):
            return _multipliers(weight, used, length, upper)
    rows = np.ascontiguousarray(columns.T)
    value, vectors = np.linalg.eigh(x)
    at = vectors * np.sqrt(np.maximum(value, THRESHOLDS.least_eigenvalue * value[-1]))
    for _ in range(THRESHOLDS.search_restarts):
        found = minimize(
            _negative,
            (at / np.linalg.norm(at)).ravel(),
            (rows,),
            jac=True,
            method="L-BFGS-B",
            options={"maxiter": THRESHOLDS.search_rounds, "ftol": 1e-16, "gtol": 1e-12, "maxcor": THRESHOLDS.corrections},
        )
        at = found.x.reshape(n, -1)
        length = np.linalg.norm(rows @ (at / np.linalg.norm(at)), axis=1) + 1e-300
        total, upper = _sides(columns, length)
        if upper <= 0.5 * total * (1 + THRESHOLDS.search_gap):
            break
    return _multipliers(weight, used, length, upper)


def _sides(columns: Array, length: Array) -> tuple[float, float]:
    """(F, √(½F·λmax(∇F))), ∇F = ½Σ a aᵀ/√(aᵀXa)."""
    total = float(length.sum())
    slope = 0.5 * (columns / length) @ columns.T
    return total, float(np.sqrt(0.5 * total * _largest(slope)))


def _multipliers(weight: Array, used: Bools, length: Array, upper: float) -> OneLayer:
    each = np.zeros(len(weight) + 1)
    each[used] = length
    half, own = 0.5 * float(length.sum()), np.maximum(each[:-1], TINY)
    return OneLayer(np.where(each[:-1] > 0, half * weight**2 / own, 0.0), half, upper)


def _newton(columns: Array, x: Array) -> tuple[Array, Array]:
    """(X, √(aᵀXa)) of Newton's method on tr X = 1 from a definite X; it ends where a step leaves the definite matrices, too.

    F = Σ√(φᵀx) is homogeneous of degree ½ in x = svec X, so that ∇²F x = −½∇F: the step is 2x − 2y/tr Y with
    y = −(∇²F)⁻¹ svec I.
    """
    length = _lengths(columns, x)
    for _ in range(THRESHOLDS.newton_steps):
        total, inverse = float(length.sum()), 1 / length
        if 2 * _largest(0.5 * (columns * inverse) @ columns.T) <= total * (1 + THRESHOLDS.newton_gap) ** 2:
            break
        step = _step(columns, inverse, x)
        if step is None:
            break
        for _ in range(THRESHOLDS.newton_halvings):
            tried = (x + step) / np.trace(x + step)
            if lapack.dpotrf(tried)[1] == 0 and (there := _lengths(columns, tried)).sum() >= total * (1 - THRESHOLDS.rounding):
                break
            step = step / 2
        else:
            break
        x, length = tried, there
    return x, length


def _lengths(columns: Array, x: Array) -> Array:
    moved = x @ columns
    moved *= columns
    return np.asarray(np.sqrt(moved.sum(axis=0)))


def _step(columns: Array, inverse: Array, x: Array) -> Array | None:
    """2X − 2Y/tr Y; by blocks of columns that stay in the cache."""
    n = len(x)
    i, j, twice = _pairs(n)
    curve = np.zeros((len(i), len(i)))
    for k in range(0, len(inverse), BLOCK):
        part, own = columns[:, k : k + BLOCK], inverse[k : k + BLOCK]
        phi = part[i]
        phi *= part[j]
        phi *= own * np.sqrt(own)
        curve += phi @ phi.T
    curve *= twice[:, None] * twice / 4
    _, y, failed = lapack.dposv(curve, (i == j).astype(np.float64))
    if failed:
        return None
    out = np.empty((n, n))
    out[i, j] = out[j, i] = y
    return np.asarray(2 * x - 2 * out / np.trace(out))


@cache
def _pairs(n: int) -> tuple[Ints, Ints, Array]:
    """Of the upper triangle by rows: both indices, and how often an entry stands in the matrix."""
    i, j = np.triu_indices(n)
    return i, j, np.where(i == j, 1.0, 2.0)


def _largest(a: Array) -> float:
    return float(lapack.dsyev(a, compute_v=0)[0][-1])


def enlarged(first: Array, last: Array, multipliers: Array) -> list[tuple[float, Array]]:
    """(ρ, t) with t the multipliers times 1 and a little more, the smallest ρ first; the optimum itself may prove nothing.

    ρ(t) = λmax(½W₀ᵀTW₀ + ggᵀ/(4q)), q = 1 − ½Σ w²/t > 0: where g vanishes, q does at the optimum.
    """
    inner, g = (first.T * multipliers) @ first / 2, last @ first
    q = 1 - float(np.sum(last**2 / multipliers)) / 2 / (1 + MORE) - ROUNDING * (np.sqrt(len(last)) + 8)
    matrix = (1 + MORE) * inner + np.outer(g, g) / (4 * np.maximum(q, TINY))
    held = (q.ravel() > 0) & np.isfinite(matrix).all(axis=(1, 2))
    square = np.linalg.eigvalsh(matrix[held])[:, -1]
    order = np.argsort(square, kind="stable")
    return [(float(square[k]), (1 + m) * multipliers) for k, m in zip(order, MORE.ravel()[held][order], strict=True)]


def _negative(root: Array, rows: Array) -> tuple[float, Array]:
    """−F and its slope at X = BBᵀ/|B|², which is in the spectraplex for every B."""
    b = root.reshape(rows.shape[1], -1)
    moved = rows @ b
    length = np.sqrt(np.einsum("ij,ij->i", moved, moved)) + 1e-300
    total, norm = float(length.sum()), float(np.linalg.norm(b))
    slope = rows.T @ (moved / length[:, None])
    return -total / norm, (total / norm**3 * b - slope / norm).ravel()
