"""Order statistics of scores: how many are needed, which one to take, and what may then be said of the next one.

Let N scores be independent draws of one distribution, ε and β given, and m fixed before any of them is looked at. If the
(N − m)-th smallest is exceeded by the next draw with probability v > ε, at most m of the N exceed the (1 − ε)-quantile, so

    P(v > ε) ≤ P(Bin(N, ε) ≤ m) = Σ_{j ≤ m} C(N, j) ε^j (1 − ε)^(N − j) ≤ β.

Exchangeable scores allow less: the next one exceeds the ⌈(N + 1)(1 − ε)⌉-th smallest with probability ≤ ε, over all draws
together. Sums are decimal and rounded in the direction that claims less. Sources: docs/theory.md.
"""

from __future__ import annotations

import decimal
import math
from collections.abc import Iterator
from decimal import Decimal
from fractions import Fraction
from typing import Any

import numpy as np
import numpy.typing as npt

from gapcert.numerics.arrays import Array, Ints
from gapcert.numerics.digest import json_digest
from gapcert.numerics.errors import UsageError
from gapcert.thresholds import THRESHOLDS

STREAM = 0xCA11B
NOISE, NOISE_OF = ", the noise drawn once at each point", ", all of {} draws of the noise at each point"
WINDOWS = "a further window that is exchangeable with those of the recording, on average over calibrations"
DRAWN_WINDOWS = "a further window, drawn as those of the recording and independently of them"
NO_CONSTANTS = "none"
_DIGITS = 60


def _context(rounding: str) -> decimal.Context:
    return decimal.Context(prec=_DIGITS, rounding=rounding, Emin=decimal.MIN_EMIN, Emax=decimal.MAX_EMAX, traps=[])


_UP, _DOWN = _context(decimal.ROUND_CEILING), _context(decimal.ROUND_FLOOR)


def _power(base: Decimal, n: int, context: decimal.Context) -> Decimal:
    """base ≥ 0 to the n, every product rounded by the context."""
    out = Decimal(1)
    for bit in bin(n)[2:]:
        out = context.multiply(out, out)
        out = context.multiply(out, base) if bit == "1" else out
    return out


def _sums(n: int, epsilon: float, context: decimal.Context, other: decimal.Context) -> Iterator[Decimal]:
    """P(Bin(n, ε) ≤ j) for j = 0, 1, …, n, each rounded by the context; `other` rounds against it."""
    share = Decimal(epsilon)  # exact
    odds = context.divide(share, other.subtract(Decimal(1), share))
    term = total = _power(context.subtract(Decimal(1), share), n, context)
    yield total
    for j in range(n):
        term = context.divide(context.multiply(context.multiply(term, Decimal(n - j)), odds), Decimal(j + 1))
        total = context.add(total, term)
        yield total


def missed(exceedances: int, n: int, epsilon: float) -> Decimal:
    """P(Bin(n, ε) ≤ exceedances), rounded up: the smallest β that n points with so many exceedances give."""
    _probability("ε", epsilon)
    if not 0 <= exceedances < n:
        return Decimal(1)
    return next(total for j, total in enumerate(_sums(n, epsilon, _UP, _DOWN)) if j == exceedances)


def points_needed(epsilon: float, beta: float, exceedances: int = 0) -> int:
    """The smallest N with P(Bin(N, ε) ≤ exceedances) ≤ β."""
    _probability("ε", epsilon)
    _probability("β", beta)
    if exceedances < 0:
        raise UsageError(f"calibration: {exceedances} exceedances; expected a whole number ≥ 0")
    low, high, goal = exceedances, exceedances + 1, Decimal(beta)  # low is too few
    while missed(exceedances, high, epsilon) > goal:
        low, high = high, 2 * high
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if missed(exceedances, middle, epsilon) <= goal else (middle, high)
    return high


def most_exceedances(n: int, epsilon: float, beta: float) -> int | None:
    """The largest m with P(Bin(n, ε) ≤ m) ≤ β; None where not even 0 will do."""
    _probability("ε", epsilon)
    _probability("β", beta)
    goal = Decimal(beta)
    first = next((j for j, total in enumerate(_sums(n, epsilon, _UP, _DOWN)) if total > goal), n)
    return first - 1 if first else None


def surprising(n: int, epsilon: float, level: float = THRESHOLDS.surprise) -> int:
    """The smallest v with P(Bin(n, ε) ≥ v) ≤ level, rounded up: so many violations refute ε."""
    _probability("ε", epsilon)
    goal = _UP.subtract(Decimal(1), Decimal(level))
    # The last sum, rounded down, may lie below 1 − level only where level is far below the rounding.
    return next((j + 1 for j, total in enumerate(_sums(n, epsilon, _DOWN, _UP)) if total >= goal), n + 1)


def conformal_rank(n: int, epsilon: float) -> int:
    """⌈(n + 1)(1 − ε)⌉; UsageError where n units are too few."""
    _probability("ε", epsilon)
    rank = math.ceil((n + 1) * (1 - Fraction(epsilon)))
    if rank > n:
        raise UsageError(
            f"calibration: {n} units, and ε = {epsilon:g} needs {conformal_points(epsilon)}; with these the smallest ε is "
            f"{smallest(n):g}; give more units, or ask for less"
        )
    return rank


def conformal_points(epsilon: float) -> int:
    """The fewest exchangeable units that a marginal claim of ε can be made with: ⌈1/ε⌉ − 1."""
    _probability("ε", epsilon)
    return math.ceil(1 / Fraction(epsilon)) - 1


def smallest(n: int, beta: float | None = None) -> float:
    """The smallest ε that n exchangeable units allow, 1 / (n + 1), or n independent ones at β, rounded up to a millionth."""
    return math.ceil(1e6 * (1 / (n + 1) if beta is None else -math.expm1(math.log(beta) / n))) / 1e6


def units_needed(epsilon: float, beta: float | None) -> int:
    """The fewest units with which ε can be claimed: on average over calibrations, or, of independent ones, at β."""
    return conformal_points(epsilon) if beta is None else points_needed(epsilon, beta)


def unit_rank(n: int, epsilon: float, beta: float | None) -> int:
    """Which of n units' scores, counted from the smallest, is to be kept; UsageError where they are too few."""
    if beta is None:
        return conformal_rank(n, epsilon)
    if (m := most_exceedances(n, epsilon, beta)) is None:
        raise UsageError(f"calibration: {n} units, and ε = {epsilon:g}, β = {beta:g} need {points_needed(epsilon, beta)}")
    return n - m


def drawing(seed: int, k: int, stream: str, question: str = "", audited: str = "") -> np.random.Generator:
    """What audit k of a question draws from: a hash, also of what is audited, so that no fit can know its points.

    Without a question by the rule of books before format 2: (seed, k), or (seed, k, STREAM) for a calibration.
    """
    if question:
        return np.random.default_rng(int(json_digest(seed, question, k, audited, stream), 16))
    return np.random.default_rng([seed, *{"calibration": (k, STREAM), "attack": (0xA77AC,)}.get(stream, (k,))])


def split(n: int, seed: int) -> Ints:
    """The order in which n units are dealt: first to the fit, then to the calibration."""
    return np.random.default_rng([seed, STREAM]).permutation(n)


def worst(values: Array, unit: npt.NDArray[Any]) -> Array:
    """The largest value of each unit, in the order of their numbers."""
    _, place = np.unique(unit, return_inverse=True)
    out = np.full(place.max() + 1, -np.inf)
    np.maximum.at(out, place, values)
    return out


def scores(r: Array, low: Array, high: Array, scale: Array) -> Array:
    """(n,) max_i max(l_i − r_i, r_i − u_i) / s_i, rounded up: by how many scales r (n, nx) leaves [l, u]; negative inside."""
    outside = np.nextafter(np.maximum(low - r, r - high), np.inf)
    return np.asarray(np.nextafter(outside / scale, np.inf).max(axis=1))


def widening(score: float, scale: Array) -> Array:
    """(nx,) score · s_i, rounded up."""
    return np.asarray(np.nextafter(score * scale, np.inf))


def ranked(values: Array, rank: int) -> float:
    """The rank-th smallest, counted from 1."""
    return float(np.partition(values, rank - 1)[rank - 1])


def _probability(name: str, value: float) -> None:
    if not 0 < value < 1:
        raise UsageError(f"calibration: {name} = {value}; expected a number between 0 and 1")
