"""What multipliers prove of the Lipschitz constant of a network; imports nothing that found them.

The network y = W_l σ(… σ(W_0 x + b_0) …) + b_l has elementwise activations with slopes in [0, 1]; one more on the output
changes nothing. With diagonal multipliers Λ_i ≻ 0 and ρ for which the matrix of LipSDP is positive definite,
‖y(x) − y(x′)‖₂ ≤ √ρ·√(Σ_k s_k² (x_k − x′_k)²) (Fazlyab et al. 2019): ρ = L², no multiplier in the last block.
So that floats hold the sizes of its layers well, it is balanced before, by powers of two alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy.linalg import LinAlgError, cholesky

from gapcert.plugin import Array, Bools, Ints, UsageError
from gapcert_networks.thresholds import THRESHOLDS

TINY = float(np.finfo(np.float64).tiny)
UNIT = 2.0**-53
SPARE = 2.0  # on every bound below: they are themselves computed, and a library may divide by multiplying with reciprocals


def gamma(k: float) -> float:
    """γ_k = k u/(1 − k u): bounds the relative error of sums of k products in any order, u = 2⁻⁵³ (Higham 2002, 3.1)."""
    if not k * UNIT < 0.5:
        raise ValueError(f"a sum of {k:.3g} terms has no relative error bound in double precision")
    return k * UNIT / (1 - k * UNIT)


def positive_definite(a: Array, error: float = 0.0) -> bool:
    """Is every symmetric matrix B with ‖B − A‖₂ ≤ error positive definite, whatever rounding did? False says nothing.

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


def proved(
    weights: Sequence[Array],
    multipliers: Sequence[Array],
    rho: float,
    units: Array | None = None,
    most: float = THRESHOLDS.last_slack,
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
    power = int(np.rint(np.log2(rho) / 2))
    if len(weights) == 2 and len(weights[1]) == 1 and _even(multipliers[0], power):
        check = _narrow(weights[0], weights[1][0], multipliers[0], units, power)
    else:
        held = _normal(weights, multipliers, power)
        weights, multipliers, power = (weights, multipliers, 0) if held is None else (*held, power)
        narrow = len(weights) == 2 and len(weights[1]) == 1
        check = _narrow(weights[0], weights[1][0], multipliers[0], units) if narrow else _whole(weights, multipliers, units)
    rho = float(np.ldexp(rho, -2 * power))
    slack = min(most, max(THRESHOLDS.first_slack, check.least(rho)))
    while slack <= most:
        tried = float(np.nextafter(rho * (1 + slack), np.inf))
        if check(tried):
            found = np.nextafter(np.sqrt(tried), np.inf)
            out = np.ldexp(found, power)
            return float(out if np.ldexp(out, -power) >= found else np.nextafter(out, np.inf))
        slack *= 4
    return None


def rescaled(a: Array, rows: Ints, columns: Ints) -> Array | None:
    """a_ij·2^(rows_i + columns_j), laid out along the longer side; None where floats do not hold it."""
    if not (rows.any() or columns.any()):
        return a
    a = np.asfortranarray(a) if len(a) > a.shape[1] else a
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        out = a * np.ldexp(1.0, rows)[:, None]
        out *= np.ldexp(1.0, columns)
        back = out * np.ldexp(1.0, -columns)
        back *= np.ldexp(1.0, -rows)[:, None]
        if (back == a).all():
            return np.asarray(out)
        out = np.ldexp(a, rows[:, None] + columns)  # both powers at once, where one alone leaves the floats
        return np.asarray(out) if (np.ldexp(out, -(rows[:, None] + columns)) == a).all() else None


def _even(multipliers: Array, power: int) -> bool:
    """Are they, and 2^power, so far from the ends of the floats that a root times 2^−power loses no digit?"""
    return bool(abs(power) < 400 and multipliers.min() > 1e-250 and multipliers.max() < 1e250)


def _normal(weights: Sequence[Array], multipliers: Sequence[Array], power: int) -> tuple[list[Array], list[Array]] | None:
    """(W′, Λ′): W′_i = C_{i+1} W_i C_i⁻¹, Λ′_i = C_i⁻² Λ_i, C_0 = 2^power, by powers of two that bring Λ′ and ρ′ near 1.

    Both matrices are congruent, and with an even diagonal the shift that covers rounding is smallest. None where floats do not
    hold W′.
    """
    if any((m == 0).any() for m in multipliers):
        return None
    c = [np.full(weights[0].shape[1], power), *((np.frexp(m)[1] + 1) // 2 for m in multipliers)]
    c.append(np.zeros(len(weights[-1]), dtype=np.int64))
    scaled = [rescaled(w, c[i + 1], -c[i]) for i, w in enumerate(weights)]
    held = [w for w in scaled if w is not None]
    if len(held) < len(weights):
        return None
    return held, [np.ldexp(m, -2 * own) for m, own in zip(multipliers, c[1:-1], strict=True)]


class _Check:
    """Is the matrix positive definite at ρ?"""

    def __init__(self, matrix: Array, error: float, inputs: Array) -> None:
        self.matrix, self.error, self.inputs = matrix, error, inputs

    def least(self, rho: float) -> float:
        """The part of ρ that makes up for the error of the entries, about."""
        return float(self.error / (rho * (self.inputs**2).min()))

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


def _narrow(first: Array, last: Array, t: Array, units: Array, power: int = 0) -> _Check:
    """Of one hidden layer and one output, with both of these eliminated: ρ·diag(s²) − ½W₀ᵀTW₀ − ggᵀ/(4q), g = W₀ᵀw.
    W₀ is that of `first` times 2^−power.

    q = 1 − ½Σ w²/t > 0. A neuron without a weight behind it needs no multiplier. With Z = (W₀ᵀ√T; wᵀ/√t) all three sums are in
    ZZᵀ, and by Cauchy–Schwarz |fl(ZZᵀ) − ZZᵀ|_jk ≤ γ·√((ZZᵀ)_jj (ZZᵀ)_kk).
    """
    used = last != 0
    if not used.all():
        first, last, t = first[used], last[used], t[used]
    n = first.shape[1]
    if not (t > 0).all():
        return _Check(np.full((n, n), np.nan), 0.0, units)
    root = np.sqrt(t)
    both, count = _products(np.vstack([first.T * np.ldexp(root, -power), last / root]))
    size = np.einsum("ii->i", both)
    # √t, its product or quotient twice: four factors more. What underflows is below TINY of the largest.
    terms, tiny = SPARE * gamma(count + 6), TINY * (1 + float(size.max(initial=0.0)))
    q = 1 - (float(both[n, n]) / 2 * (1 + terms) + tiny) - 4 * UNIT
    if not q > 0:
        return _Check(np.full((n, n), np.nan), 0.0, units)
    g = both[:n, n]
    error = terms * float(np.sqrt(size[:n].sum() * size[n])) + tiny * n
    outer = np.outer(g, g) / (4 * q)
    whole = (2 * float(np.linalg.norm(g)) * error + error**2) / (4 * q) + 4 * UNIT * float(np.linalg.norm(outer))
    return _Check(-(both[:n, :n] / 2 + outer), SPARE * (terms * float(size[:n].sum()) / 2 + whole + tiny * n), units)


def _products(z: Array) -> tuple[Array, int]:
    """(ZZᵀ, k): summed by blocks, so that no product passes through more than k sums, about thrice the root of the columns."""
    block = max(1, int(np.sqrt(z.shape[1])))
    whole = z.shape[1] // block
    parts = z[:, : whole * block].reshape(len(z), whole, block).transpose(1, 0, 2)
    rest = z[:, whole * block :]
    return (parts @ parts.transpose(0, 2, 1)).sum(axis=0) + rest @ rest.T, 2 * block + whole + 1


def proved_balanced(weights: Sequence[Array], multipliers: Sequence[Array], square: float, exponent: int = 0) -> float | None:
    """A constant L ≥ √square, rounded up, that the multipliers of the weights as they are prove once both are balanced; None
    where they prove none. 2^exponent bounds the product of the activations' slopes.
    """
    weights, kept = trimmed(weights)
    if any(not w.any() for w in weights):
        return 0.0
    scaled, own, power, exponents = balanced(weights, np.ones(weights[0].shape[1]))
    with np.errstate(over="ignore", under="ignore"):
        given = [np.ldexp(m[rows], -2 * c) for m, rows, c in zip(multipliers, kept, exponents, strict=True)]
        found = proved(scaled, given, float(np.ldexp(square, -2 * (power + exponent))), own)
    return None if found is None else shifted(found, power + exponent, up=True)


def trimmed(weights: Sequence[Array]) -> tuple[list[Array], list[Bools]]:
    """Without the neurons that change with no input or that change no output; and which ones of each hidden layer are kept."""
    kept = [np.ones(len(w), dtype=bool) for w in weights[:-1]]
    moved, used = np.ones(weights[0].shape[1], dtype=bool), np.ones(len(weights[-1]), dtype=bool)
    for rows, w in zip(kept, weights, strict=False):
        rows &= np.asfortranarray(w if moved.all() else w[:, moved]).any(axis=1)
        moved = rows
    for rows, w in zip(kept[::-1], weights[:0:-1], strict=True):
        rows &= (w if used.all() else w[used]).any(axis=0)
        used = rows
    if all(rows.all() for rows in kept):
        return list(weights), kept
    ends = [np.ones(weights[0].shape[1], dtype=bool), *kept, np.ones(len(weights[-1]), dtype=bool)]
    return [w[np.ix_(ends[i + 1], ends[i])] for i, w in enumerate(weights)], kept


def balanced(weights: Sequence[Array], units: Array) -> tuple[list[Array], Array, int, list[Ints]]:
    """(W′, s′, p, c): W′_i = C_{i+1} W_i C_i⁻¹, C_i = 2^c_i, so that what goes into each neuron is as large as what leaves it.
    The columns of W_0 are first divided by the powers of two above the units: s′ = s/2^k lies in [½, 1).

    The constant is 2^p times that of W′ and s′, and the multipliers are C_i² Λ′_i: the matrices of both are congruent.
    Every change is by powers of two, and checked to be exact.
    """
    inputs = np.frexp(units)[1].astype(np.int64)
    own = np.ldexp(units, -inputs)
    weights = [_exact(weights[0], np.zeros(len(weights[0]), dtype=np.int64), -inputs, "weights[0]"), *weights[1:]]
    sizes = [_exponents(w) for w in weights]
    c = [np.zeros(weights[0].shape[1]), *(np.zeros(len(w)) for w in weights)]
    for _ in range(THRESHOLDS.scaling_sweeps if len(weights) > 2 else 1):  # of one hidden layer the first is the last
        for i in range(1, len(weights)):
            c[i] = ((sizes[i] + c[i + 1][:, None]).max(axis=0) - _into(sizes[i - 1], c[i - 1])) / 2
    mean = float(np.mean([(_into(z, c[i]) + c[i + 1]).max() for i, z in enumerate(sizes)]))
    whole = [np.rint(each + (len(weights) - i) * mean).astype(np.int64) for i, each in enumerate(c)]
    scaled = [_exact(w, whole[i + 1], -whole[i], f"weights[{i}]") for i, w in enumerate(weights)]
    return scaled, own, int(whole[0][0]), whole[1:-1]


def _into(sizes: npt.NDArray[np.int32], before: Array) -> Array:
    """The largest of each row, in the units of what it multiplies."""
    return np.asarray((sizes - before if before.any() else sizes).max(axis=1))


def _exponents(a: Array) -> npt.NDArray[np.int32]:
    """k with 2^(k−1) ≤ |a| < 2^k, and far below everything where a is 0; by columns, along which most of it is read."""
    a = np.asfortranarray(a)
    out = np.frexp(a)[1]
    np.copyto(out, -1_000_000, where=a == 0)
    return out


def _exact(a: Array, rows: Ints, columns: Ints, where: str) -> Array:
    """a_ij·2^(rows_i + columns_j); UsageError where floats do not hold it."""
    out = rescaled(a, rows, columns)
    if out is None:
        size = np.abs(a[a != 0])
        raise UsageError(
            f"network {where}: found {size.max():.3g} beside {size.min():.3g}, too far apart for floats once scaled; "
            f"expected sizes within 1e150 of each other; set the smaller ones to 0"
        )
    return out


def shifted(value: float, power: int, *, up: bool) -> float:
    """value·2^power, rounded up where it is not exact and up is asked for."""
    try:
        out = math.ldexp(value, power)
        if up and math.ldexp(out, -power) < value:
            out = math.nextafter(out, math.inf)
    except OverflowError:
        raise UsageError(f"network: its constant is about {value:.3g}·2^{power}, beyond floats; rescale the weights") from None
    return out
