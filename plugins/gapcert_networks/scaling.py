"""Networks whose layers have sizes that floats hold well, by powers of two alone; imports nothing that fits."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from gapcert.plugin import Array, UsageError
from gapcert_networks.thresholds import THRESHOLDS

from .network_constant import proved, rescaled

Integers = npt.NDArray[np.int64]


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


def trimmed(weights: Sequence[Array]) -> tuple[list[Array], list[npt.NDArray[np.bool_]]]:
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


def balanced(weights: Sequence[Array], units: Array) -> tuple[list[Array], Array, int, list[Integers]]:
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


def _exact(a: Array, rows: Integers, columns: Integers, where: str) -> Array:
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
