"""Interval arithmetic of `verify` alone: what is proved once more shares no rounding with what was proved first.

A `Range` holds real numbers between two ends. + − × ÷ √ are correctly rounded by IEEE 754, so that one step outwards suffices;
elementary functions are taken to err by `ULPS` units in the last place at most. An end that is no number bounds nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from gapcert.plugin import Array

ULPS = 4
"""What NumPy and its vectorised kernels are held to."""
_HALF = 2.0**-53 * (1 + 2.0**-51)
_LEAST = 2.0**-1022
_WILD = 2.0**30  # beyond it an argument of sin says nothing


class Range(NamedTuple):
    """[lo, hi], elementwise; the same array twice where it is a point."""

    lo: Any
    hi: Any

    @property
    def mag(self) -> Array:
        """max |v|; NaN where nothing is known."""
        return np.asarray(np.maximum(np.abs(self.lo), np.abs(self.hi)))


def down(v: Any) -> Any:
    """A float below every real number that rounds to v: v − (½ ulp of |v|, rounded up), Rump et al. 2009, eq. 2.9."""
    return v - (_HALF * np.abs(v) + _LEAST)


def up(v: Any) -> Any:
    """A float above every real number that rounds to v."""
    return v + (_HALF * np.abs(v) + _LEAST)


def point(v: Any) -> Range:
    """[v, v]."""
    v = np.asarray(v, dtype=np.float64)
    return Range(v, v)


def outward(lo: Any, hi: Any) -> Range:
    """One rounding outwards."""
    return Range(down(lo), up(hi))


def known(x: Range) -> Range:
    """With infinite ends where they are no numbers."""
    return Range(np.where(np.isnan(x.lo), -np.inf, x.lo), np.where(np.isnan(x.hi), np.inf, x.hi))


def hull(a: Range, b: Range) -> Range:
    """The smallest that holds both."""
    return Range(np.minimum(a.lo, b.lo), np.maximum(a.hi, b.hi))


def common(a: Range, b: Range) -> Range:
    """What both bound, of which one may bound nothing."""
    return Range(np.fmax(a.lo, b.lo), np.fmin(a.hi, b.hi))


def zero(a: Range) -> Any:
    """Where it is 0, exactly."""
    return (a.lo == 0) & (a.hi == 0)


def add(a: Range, b: Range) -> Range:
    """What adds nothing rounds nothing: a state that an input leaves alone stays where it is."""
    out = outward(a.lo + b.lo, a.hi + b.hi)
    for one, other in ((a, b), (b, a)):
        if np.any(none := zero(other)):
            out = Range(*(np.where(none, end, o) for end, o in zip(one, out, strict=True)))
    return out


def subtract(a: Range, b: Range) -> Range:
    return outward(a.lo - b.hi, a.hi - b.lo)


def negative(a: Range) -> Range:
    return Range(-a.hi, -a.lo)


def multiply(a: Range, b: Range) -> Range:
    out = _product(a, b)
    if np.any(none := (zero(a) & np.isfinite(b.lo + b.hi)) | (zero(b) & np.isfinite(a.lo + a.hi))):
        return Range(*(np.where(none, 0.0, o) for o in out))
    return out


def _product(a: Range, b: Range) -> Range:
    if a.lo is a.hi and np.ndim(a.lo) == 0:
        a, b = b, a
    if b.lo is b.hi and np.ndim(b.lo) == 0:
        low, high = (a.lo, a.hi) if b.lo >= 0 else (a.hi, a.lo)
        return outward(low * b.lo, high * b.lo)
    parts = a.lo * b.lo, a.lo * b.hi, a.hi * b.lo, a.hi * b.hi
    low, high = (f(f(parts[0], parts[1]), f(parts[2], parts[3])) for f in (np.minimum, np.maximum))
    return outward(low, high)


def divide(a: Range, b: Range) -> Range:
    parts = a.lo / b.lo, a.lo / b.hi, a.hi / b.lo, a.hi / b.hi
    low, high = (f(f(parts[0], parts[1]), f(parts[2], parts[3])) for f in (np.minimum, np.maximum))
    zero = (b.lo <= 0) & (b.hi >= 0)
    return outward(np.where(zero, np.nan, low), np.where(zero, np.nan, high))


def whole_power(a: Range, n: int) -> Range:
    """aⁿ for a whole n ≥ 0, which grows with |a|, or with a."""
    if n == 0:
        return point(1.0)
    if n % 2 == 0:
        a = absolute(a)
    (low, _), (_, high) = _raised(a.lo, n), _raised(a.hi, n)
    return Range(low, high)


def _raised(x: Any, n: int) -> tuple[Any, Any]:
    """Floats around xⁿ."""
    low = high = np.abs(x)
    for _ in range(n - 1):
        low, high = np.maximum(down(low * np.abs(x)), 0.0), up(high * np.abs(x))
    return np.where(x < 0, -high, low), np.where(x < 0, -low, high)


def root(a: Range) -> Range:
    """√a; nothing is known where a may be negative."""
    inside = np.where(a.lo < 0, np.nan, a.lo), np.where(a.lo < 0, np.nan, a.hi)
    out = outward(*map(np.sqrt, inside))
    return Range(np.maximum(out.lo, 0.0), out.hi)


def _library(lo: Any, hi: Any) -> Range:
    pad = (ULPS + 2) * 2.0**-52
    return Range(lo - (pad * np.abs(lo) + _LEAST), hi + (pad * np.abs(hi) + _LEAST))


def exp(a: Range) -> Range:
    out = _library(np.exp(a.lo), np.exp(a.hi))
    return Range(np.maximum(out.lo, 0.0), out.hi)


def log(a: Range) -> Range:
    """Nothing is known where a may be negative."""
    bad = a.lo < 0
    with np.errstate(divide="ignore"):
        low, high = np.log(np.where(bad, np.nan, a.lo)), np.log(np.where(bad, np.nan, a.hi))
    out = _library(low, high)
    return Range(np.where(low == -np.inf, -np.inf, out.lo), np.where(high == -np.inf, -np.inf, out.hi))


def tanh(a: Range) -> Range:
    out = _library(np.tanh(a.lo), np.tanh(a.hi))
    return Range(np.maximum(out.lo, -1.0), np.minimum(out.hi, 1.0))


def arctan(a: Range) -> Range:
    return _library(np.arctan(a.lo), np.arctan(a.hi))


def arcsin(a: Range) -> Range:
    bad = (a.lo < -1) | (a.hi > 1)
    return _library(np.arcsin(np.where(bad, np.nan, a.lo)), np.arcsin(np.where(bad, np.nan, a.hi)))


def arccos(a: Range) -> Range:
    bad = (a.lo < -1) | (a.hi > 1)
    return _library(np.arccos(np.where(bad, np.nan, a.hi)), np.arccos(np.where(bad, np.nan, a.lo)))


def sin(a: Range) -> Range:
    return _wave(a, np.sin, 0.25)


def cos(a: Range) -> Range:
    return _wave(a, np.cos, 0.0)


def tan(a: Range) -> Range:
    pole = ~(a.mag < _WILD) | _meets(a, math.pi, 0.5)
    return _library(np.tan(np.where(pole, np.nan, a.lo)), np.tan(np.where(pole, np.nan, a.hi)))


def _wave(a: Range, wave: Callable[[Any], Any], top: float) -> Range:
    """Between values at the ends, but where a crest at (top + k)·2π, or a trough half a turn on, may lie between them."""
    wild = ~(a.mag < _WILD)
    first, last = wave(np.where(wild, 0.0, a.lo)), wave(np.where(wild, 0.0, a.hi))
    out = _library(np.minimum(first, last), np.maximum(first, last))
    crest, trough = (wild | _meets(a, 2 * math.pi, at) for at in (top, top + 0.5))
    return Range(np.where(trough, -1.0, np.maximum(out.lo, -1.0)), np.where(crest, 1.0, np.minimum(out.hi, 1.0)))


def _meets(a: Range, period: float, shift: float) -> Any:
    """May a / period − shift hold a whole number? The period is a float next to the true one, by 2⁻⁵³ of itself at most: with
    the quotient's and the difference's rounding that is less than 2⁻⁵⁰ (|quotient| + 1).
    """
    first, last = a.lo / period - shift, a.hi / period - shift
    first, last = first - 2.0**-50 * (np.abs(first) + 1), last + 2.0**-50 * (np.abs(last) + 1)
    return np.floor(last) >= np.ceil(first)


def absolute(a: Range) -> Range:
    return Range(np.maximum(np.maximum(a.lo, -a.hi), 0.0), a.mag)


def sign(a: Range) -> Range:
    return Range(np.sign(a.lo), np.sign(a.hi))


def rounded(a: Range) -> Range:
    return Range(np.round(a.lo), np.round(a.hi))


def least(a: Range, b: Range) -> Range:
    return Range(np.minimum(a.lo, b.lo), np.minimum(a.hi, b.hi))


def greatest(a: Range, b: Range) -> Range:
    return Range(np.maximum(a.lo, b.lo), np.maximum(a.hi, b.hi))


def soft(v: Range, k: Range) -> Range:
    """sign(v) max(|v| − k, 0) for k ≥ 0: it grows with v, and is the nearer to zero the larger k is."""
    low = np.where(v.lo >= 0, np.maximum(down(v.lo - k.hi), 0.0), np.minimum(down(v.lo + k.lo), 0.0))
    high = np.where(v.hi >= 0, np.maximum(up(v.hi - k.lo), 0.0), np.minimum(up(v.hi + k.hi), 0.0))
    return Range(low + 0 * v.lo, high + 0 * v.hi)  # what is no number stays so
