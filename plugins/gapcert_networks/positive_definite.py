"""Is a symmetric matrix positive definite, whatever rounding did? By a Cholesky factor in floating point (Rump 2006)."""

from __future__ import annotations

import numpy as np
from scipy.linalg import LinAlgError, cholesky

from gapcert.plugin import Array

UNIT = 2.0**-53
SPARE = 2.0  # on every bound below: they are themselves computed, and a library may divide by multiplying with reciprocals


def gamma(k: float) -> float:
    """γ_k = k u/(1 − k u): bounds the relative error of sums of k products in any order, u = 2⁻⁵³ (Higham 2002, 3.1)."""
    if not k * UNIT < 0.5:
        raise ValueError(f"a sum of {k:.3g} terms has no relative error bound in double precision")
    return k * UNIT / (1 - k * UNIT)


def positive_definite(a: Array, error: float = 0.0) -> bool:
    """Is every symmetric matrix B with ‖B − A‖₂ ≤ error positive definite? False says nothing.

    If the Cholesky factor R̃ of A − cI exists in floating point, R̃ᵀR̃ = A − cI + Δ with |Δ_ij| ≤ f·√(a_ii a_jj) plus underflow,
    f = γ_{p+1}/(1 − γ_{p+1}), p the most terms of an inner product (S. M. Rump, BIT 46, 2006, Theorem 2.3). Left of a row's
    first entry that is not 0 the factor is 0 too, in whatever order it is computed, so that p is the length of the longest row
    from there to the diagonal, and Δ is 0 outside. By Schur's test with the weights √a_ii, ‖Δ‖₂ ≤ f·max_i Σ a_jj over the
    j with Δ_ij ≠ 0 (the trace, of a full matrix), so that A ≻ (c − ‖Δ‖₂)·I.
    """
    n = len(a)
    diagonal = np.einsum("ii->i", a)
    if a.shape != (n, n) or not np.isfinite(a).all() or not np.isfinite(error) or not (diagonal > 0).all():
        return False
    at = np.arange(n)
    begin = (a != 0).argmax(axis=1)
    inside = ((at >= begin[:, None]) & (at <= at[:, None])).astype(np.float64)
    size = float((inside @ diagonal + diagonal @ inside - diagonal).max())
    longest = int((at - begin).max()) + 1
    factor = gamma(longest + 1) / (1 - gamma(longest + 1))
    tiny = 4 * (n + 1) * (2 * n + float(diagonal.max())) * np.finfo(np.float64).tiny
    # Taking c away rounds each entry of the diagonal once more.
    shift = SPARE * (factor * size + tiny + error + UNIT * float(diagonal.max()))
    b = a.copy()
    b[at, at] -= shift
    try:
        cholesky(b, lower=True, overwrite_a=True, check_finite=False)
    except LinAlgError:
        return False
    return True
