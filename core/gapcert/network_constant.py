"""What multipliers prove of the Lipschitz constant of a network; imports nothing that found them.

The network y = W_l σ(… σ(W_0 x + b_0) …) + b_l has elementwise activations with slopes in [0, 1]; one more on the output
changes nothing. With diagonal multipliers Λ_i ≻ 0 and ρ for which the matrix of LipSDP is positive definite,
‖y(x) − y(x′)‖₂ ≤ √ρ·√(Σ_k s_k² (x_k − x′_k)²) (Fazlyab et al. 2019): ρ = L², no multiplier in the last block.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from gapcert.definite import SPARE, UNIT, gamma, positive_definite

Array = npt.NDArray[np.float64]

SLACK, MOST = 1e-13, 1e-6  # of ρ: first and, by default, last of what is added until the proof succeeds
TINY = float(np.finfo(np.float64).tiny)


def proved(
    weights: Sequence[Array], multipliers: Sequence[Array], rho: float, units: Array | None = None, most: float = MOST
) -> float | None:
    """A constant L ≥ √ρ, rounded up, that these multipliers prove; None where they prove none up to ρ(1 + most).

    weights W_0 … W_l, exact as floats; multipliers (h_i,) of the hidden layers; units s (n,) of the inputs, 1 by default.
    """
    units = np.ones(weights[0].shape[1]) if units is None else units
    # A matrix of multipliers that couples neurons proves nothing: relu(x + 1) − relu(x − 1) is the counterexample.
    if [m.shape for m in multipliers] != [(len(w),) for w in weights[:-1]]:
        return None
    if any(not (np.isfinite(m).all() and (m >= 0).all()) for m in multipliers) or not (units > 0).all():
        return None
    if not (np.isfinite(rho) and rho > 0):
        return None
    weights, multipliers, power = _normal(weights, multipliers, rho)
    rho = float(np.ldexp(rho, -2 * power))
    narrow = len(weights) == 2 and len(weights[1]) == 1
    check = _narrow(weights[0], weights[1][0], multipliers[0], units) if narrow else _whole(weights, multipliers, units)
    slack = SLACK
    while slack <= most:
        tried = float(np.nextafter(rho * (1 + slack), np.inf))
        if check(tried):
            found = np.nextafter(np.sqrt(tried), np.inf)
            out = np.ldexp(found, power)
            return float(out if np.ldexp(out, -power) >= found else np.nextafter(out, np.inf))
        slack *= 4
    return None


def _normal(weights: Sequence[Array], multipliers: Sequence[Array], rho: float) -> tuple[list[Array], list[Array], int]:
    """(W′, Λ′, p): W′_i = C_{i+1} W_i C_i⁻¹, Λ′_i = C_i⁻² Λ_i, ρ′ = 4⁻ᵖρ, by powers of two that bring Λ′ and ρ′ near 1.

    Both matrices are congruent, and with an even diagonal the shift that covers rounding is smallest. Where floats do not hold
    W′, everything stays as it is.
    """
    if any((m == 0).any() for m in multipliers):
        return list(weights), list(multipliers), 0
    power = int(np.rint(np.log2(rho) / 2))
    c = [np.full(weights[0].shape[1], power), *(np.rint(np.log2(m) / 2 + 0.5).astype(np.int64) for m in multipliers)]
    c.append(np.zeros(len(weights[-1]), dtype=np.int64))
    with np.errstate(over="ignore", under="ignore"):
        scaled = [np.ldexp(w, c[i + 1][:, None] - c[i]) for i, w in enumerate(weights)]
        back = [np.ldexp(w, c[i] - c[i + 1][:, None]) for i, w in enumerate(scaled)]
    if not all((b == w).all() for b, w in zip(back, weights, strict=True)):
        return list(weights), list(multipliers), 0
    return scaled, [np.ldexp(m, -2 * own) for m, own in zip(multipliers, c[1:-1], strict=True)], power


class _Check:
    """Is the matrix positive definite at ρ?"""

    def __init__(self, matrix: Array, error: float, inputs: Array) -> None:
        self.matrix, self.error, self.inputs = matrix, error, inputs

    def __call__(self, rho: float) -> bool:
        a, at = self.matrix.copy(), np.arange(len(self.inputs))
        square = rho * self.inputs**2
        a[at, at] += square
        # s² and its product with ρ round twice, and the sum once more.
        error = self.error + SPARE * (3 * UNIT * float(np.abs(np.concatenate([square, a[at, at]])).max()) + TINY * (1 + rho))
        return positive_definite(a, error)


def _whole(weights: Sequence[Array], multipliers: Sequence[Array], units: Array) -> _Check:
    sizes = [weights[0].shape[1], *(len(w) for w in weights)]
    at = np.concatenate([[0], np.cumsum(sizes)]).tolist()
    a, squares = np.zeros((at[-1], at[-1])), 0.0
    for i, w in enumerate(weights):
        last = i == len(weights) - 1
        rows, columns = slice(at[i + 1], at[i + 2]), slice(at[i], at[i + 1])
        block = w if last else multipliers[i][:, None] * w
        a[rows, columns], a[columns, rows] = -block, -block.T
        a[rows, rows] = np.eye(len(w)) if last else np.diag(2 * multipliers[i])
        squares += 0.0 if last else 2 * float(np.sum(block**2))
    return _Check(a, SPARE * (UNIT * float(np.sqrt(squares)) + TINY * at[-1]), units)


def _narrow(first: Array, last: Array, t: Array, units: Array) -> _Check:
    """Of one hidden layer and one output, with both of these eliminated: ρ·diag(s²) − ½W₀ᵀTW₀ − ggᵀ/(4q), g = W₀ᵀw.

    q = 1 − ½Σ w²/t > 0. A neuron without a weight behind it needs no multiplier.
    """
    used = last != 0
    first, last, t = first[used], last[used], t[used]
    n, terms = first.shape[1], gamma(len(last) + 4)
    if not (t > 0).all():
        return _Check(np.full((n, n), np.nan), 0.0, units)
    # A square may lose digits to underflow before it is divided.
    share = float(np.sum((last**2 + TINY) / t)) / 2
    q = 1 - share * (1 + SPARE * terms) - 4 * UNIT
    if not q > 0:
        return _Check(np.full((n, n), np.nan), 0.0, units)
    scaled = np.sqrt(t)[:, None] * first
    inner, g = (scaled.T @ scaled) / 2, last @ first
    size = np.abs(last) @ np.abs(first)
    # |fl − exact| of both sums: of products in any order, the root of t and the quotient counted as further factors.
    wrong = terms * (np.einsum("ij,ij->", scaled, scaled) / 2)
    error = terms * float(np.linalg.norm(size))
    outer = np.outer(g, g) / (4 * q)
    whole = (2 * float(np.linalg.norm(g)) * error + error**2) / (4 * q) + 4 * UNIT * float(np.linalg.norm(outer))
    return _Check(-(inner + outer), SPARE * (wrong + whole + TINY * n), units)
