"""LipSDP of one hidden layer by its dual over the spectraplex: as many unknowns as inputs, however wide the layer is.

For y = w·σ(W₀x + b), σ with slopes in [0, 1] elementwise, the optimum of LipSDP with diagonal multipliers is
L* = max over X ⪰ 0, tr X = 1 of F(X)/2, F(X) = Σ_j |w_j|·√(a_jᵀXa_j) + √(gᵀXg), with a_j the rows of W₀ and g = W₀ᵀw.
Any X bounds L* from below; its multipliers t_j = F·|w_j|/(2√(a_jᵀXa_j)) bound it from above.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize

Array = npt.NDArray[np.float64]

ROUNDS, CORRECTIONS = 300, 20
RESTARTS, ENOUGH = 3, 5e-9  # further searches, from where the last one stopped, until both sides are this close
MORE = (0.0, *(10.0**k for k in range(-13, -2)))  # relative, by which multipliers are enlarged
ROUNDING = 4e-16  # per neuron, what the proof takes from q
TINY = float(np.finfo(np.float64).tiny)
REGULAR = 1e-12  # of the largest, what every eigenvalue of the first X has at least


@final
@dataclass(frozen=True)
class OneLayer:
    """multipliers (h,) ≥ 0; lower ≤ L* ≤ upper, as computed: neither is rounded outwards."""

    multipliers: Array
    lower: float
    upper: float


def solved(first: Array, last: Array) -> OneLayer:
    """first W₀ (h, n), in units of the norm of the inputs; last w (h,)."""
    weight = np.abs(last)
    rows = np.concatenate([weight[:, None] * first, (last @ first)[None]])
    used = np.einsum("ij,ij->i", rows, rows) > 0
    if not used.any():
        return OneLayer(np.zeros(len(last)), 0.0, 0.0)
    rows = rows[used]
    value, vectors = np.linalg.eigh(rows.T @ rows)
    at = vectors * np.sqrt(np.maximum(value, REGULAR * value[-1]))
    for _ in range(RESTARTS):
        found = minimize(
            _negative,
            (at / np.linalg.norm(at)).ravel(),
            (rows,),
            jac=True,
            method="L-BFGS-B",
            options={"maxiter": ROUNDS, "ftol": 1e-16, "gtol": 1e-12, "maxcor": CORRECTIONS},
        )
        at = found.x.reshape(first.shape[1], -1)
        length = np.linalg.norm(rows @ (at / np.linalg.norm(at)), axis=1) + 1e-300
        total = float(length.sum())
        slope = 0.5 * (rows.T / length) @ rows
        upper = float(np.sqrt(0.5 * total * np.linalg.eigvalsh(slope)[-1]))
        if upper <= 0.5 * total * (1 + ENOUGH):
            break
    each = np.zeros(len(last) + 1)
    each[used] = length
    own = np.maximum(each[:-1], TINY)
    return OneLayer(np.where(each[:-1] > 0, 0.5 * total * weight**2 / own, 0.0), 0.5 * total, upper)


def enlarged(first: Array, last: Array, multipliers: Array) -> list[tuple[float, Array]]:
    """(ρ, t) with t the multipliers times 1 and a little more, the smallest ρ first; the optimum itself may prove nothing.

    ρ(t) = λmax(½W₀ᵀTW₀ + ggᵀ/(4q)), q = 1 − ½Σ w²/t > 0: where g vanishes, q does at the optimum.
    """
    inner, g = (first.T * multipliers) @ first / 2, last @ first
    share, spare = float(np.sum(last**2 / multipliers)) / 2, ROUNDING * (len(last) + 8)
    found = []
    for more in MORE:
        q = 1 - share / (1 + more) - spare
        matrix = (1 + more) * inner + np.outer(g, g) / (4 * max(q, TINY))
        if q > 0 and np.isfinite(matrix).all():
            found.append((float(np.linalg.eigvalsh(matrix)[-1]), (1 + more) * multipliers))
    return sorted(found, key=lambda f: f[0])


def _negative(root: Array, rows: Array) -> tuple[float, Array]:
    """−F and its slope at X = BBᵀ/|B|², which is in the spectraplex for every B."""
    b = root.reshape(rows.shape[1], -1)
    moved = rows @ b
    length = np.sqrt(np.einsum("ij,ij->i", moved, moved)) + 1e-300
    total, norm = float(length.sum()), float(np.linalg.norm(b))
    slope = rows.T @ (moved / length[:, None])
    return -total / norm, (total / norm**3 * b - slope / norm).ravel()
