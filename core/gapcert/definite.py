"""Is a symmetric matrix positive definite, whatever rounding did? By a Cholesky factor in floating point (Rump 2006)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.linalg import LinAlgError, cholesky

Array = npt.NDArray[np.float64]

UNIT = 2.0**-53
SPARE = 2.0  # on every bound below: they are themselves computed, and a library may divide by multiplying with reciprocals


def gamma(k: float) -> float:
    """γ_k = k u/(1 − k u): bounds the relative error of sums of k products in any order, u = 2⁻⁵³ (Higham 2002, 3.1)."""
    if not k * UNIT < 0.5:
        raise ValueError(f"a sum of {k:.3g} terms has no relative error bound in double precision")
    return k * UNIT / (1 - k * UNIT)


def positive_definite(a: Array, error: float = 0.0) -> bool:
    """Is every symmetric matrix B with ‖B − A‖₂ ≤ error positive definite? False says nothing.

    With f = γ_{n+1}/(1 − γ_{n+1}): if the Cholesky factor R̃ of A − cI exists in floating point, R̃ᵀR̃ = A − cI + Δ with
    |Δ_ij| ≤ f·√(a_ii a_jj) plus underflow, so that A ≻ (c − f·tr A)·I (S. M. Rump, BIT 46, 2006, Theorem 2.3).
    """
    n = len(a)
    diagonal = np.einsum("ii->i", a)
    if a.shape != (n, n) or not np.isfinite(a).all() or not np.isfinite(error) or not (diagonal > 0).all():
        return False
    size = float(diagonal.sum())
    factor = gamma(n + 1) / (1 - gamma(n + 1))
    tiny = 4 * (n + 1) * (2 * n + float(diagonal.max())) * np.finfo(np.float64).tiny
    # Taking c away rounds each entry of the diagonal once more.
    shift = SPARE * (factor * size + tiny + error + UNIT * float(diagonal.max()))
    b = a.copy()
    b[np.arange(n), np.arange(n)] -= shift
    try:
        cholesky(b, lower=True, overwrite_a=True, check_finite=False)
    except LinAlgError:
        return False
    return True
