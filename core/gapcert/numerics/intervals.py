"""Outward-rounded interval arithmetic on float64 arrays, vectorised over any shape."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from gapcert.numerics.arrays import Array, Bools, Ints

_EPS = float(np.finfo(np.float64).eps)
_TINY = float(np.finfo(np.float64).tiny)
_PHI = _EPS / 2 * (1 + _EPS)
_MAX = float(np.finfo(np.float64).max)
_LIBRARY_ULPS = 4
_HUGE = 2.0**40


def _down(value: Any) -> Array:
    """A float64 below every real number that rounds to `value`.

    v − fl(φ|v| + η) with φ = u (1 + 2u) is at most the predecessor of v (Rump, Zimmermann, Boldo, Melquiond 2009); η is the
    smallest normal number, so that results flushed to zero are covered too. NaN where v = +∞.
    """
    return np.asarray(value - (_PHI * np.abs(value) + _TINY))


def _up(value: Any) -> Array:
    return np.asarray(value + (_PHI * np.abs(value) + _TINY))


def _pad(value: Array) -> Array:
    # ulp(v) <= eps |v|, and adding the pad loses at most another half ulp.
    return np.asarray((_LIBRARY_ULPS + 1) * _EPS * np.abs(value) + _TINY)


@final
@dataclass(frozen=True, eq=False)
class Interval:
    """Closed intervals [lo, hi], elementwise; every operation returns a superset of the exact range.

    + − * / and sqrt are correctly rounded by IEEE 754, so one step outwards is enough; other library
    functions are taken to err by at most 4 ulp (the bound that NumPy and its SIMD kernels are held to). Plain numbers and
    arrays on either side are exact constants. Division by an interval that contains zero gives [−∞, ∞]; sqrt, log, arcsin
    and arccos are taken over the part of the interval inside their domain.
    """

    lo: Array
    hi: Array

    # NumPy arrays on the left then leave the operation to the reflected methods below.
    __array_ufunc__ = None

    def __post_init__(self) -> None:
        lo, hi = np.asarray(self.lo, dtype=np.float64), np.asarray(self.hi, dtype=np.float64)
        if lo.shape != hi.shape:
            lo, hi = np.broadcast_arrays(lo, hi)
        if not (lo <= hi).all():
            raise ValueError(f"Interval: lower end above upper end, or not a number: [{lo}, {hi}]; give lo <= hi")
        object.__setattr__(self, "lo", lo)
        object.__setattr__(self, "hi", hi)

    @staticmethod
    def _of(lo: Any, hi: Any) -> Interval:
        new = object.__new__(Interval)
        object.__setattr__(new, "lo", np.asarray(lo))
        object.__setattr__(new, "hi", np.asarray(hi))
        return new

    @classmethod
    def exact(cls, values: Any) -> Interval:
        """[v, v]; a Python integer without an exact float64 becomes its two neighbours."""
        if isinstance(values, int) and abs(values) > 2**53:
            return cls._of(_down(float(values)), _up(float(values)))
        v = np.asarray(values, dtype=np.float64)
        if np.isnan(v).any():
            raise ValueError("Interval: a constant is not a number (NaN); give finite numbers")
        return cls._of(v, v)

    @classmethod
    def hull(cls, *parts: Any) -> Interval:
        """The smallest intervals that contain all parts (numbers, arrays or Intervals), elementwise."""
        first, *rest = (_lift(p) for p in parts)
        lo, hi = first.lo, first.hi
        for p in rest:
            lo, hi = np.minimum(lo, p.lo), np.maximum(hi, p.hi)
        return cls._of(lo, hi)

    @classmethod
    def around(cls, middle: Any, radius: Any) -> Interval:
        """[m − r, m + r], rounded outwards; r >= 0."""
        return cls(_down(np.subtract(middle, radius)), _up(np.add(middle, radius)))

    @property
    def shape(self) -> tuple[int, ...]:
        return self.lo.shape

    def __len__(self) -> int:
        return len(self.lo)

    def __getitem__(self, index: Any) -> Interval:
        return Interval._of(self.lo[index], self.hi[index])

    def reshape(self, *shape: int) -> Interval:
        return Interval._of(self.lo.reshape(*shape), self.hi.reshape(*shape))

    @property
    def mid(self) -> Array:
        """A point near the middle, inside; 0 for the whole line."""
        m = np.clip(self.lo / 2 + self.hi / 2, self.lo, self.hi) if self.finite else _middle(self.lo, self.hi)
        return np.asarray(m)

    @property
    def rad(self) -> Array:
        """max |v − mid|, rounded up."""
        m = self.mid
        return _up(np.maximum(self.hi - m, m - self.lo))

    @property
    def mag(self) -> Array:
        """max |v|, exact."""
        return np.asarray(np.maximum(np.abs(self.lo), np.abs(self.hi)))

    @property
    def width(self) -> Array:
        """hi − lo, rounded up."""
        return _up(self.hi - self.lo)

    @property
    def finite(self) -> bool:
        return bool(np.isfinite(self.lo).all() and np.isfinite(self.hi).all())

    def contains(self, values: Any) -> Bools:
        """Elementwise: is the point, or the whole interval, inside?"""
        lo, hi = (values.lo, values.hi) if isinstance(values, Interval) else (values, values)
        return np.asarray((self.lo <= lo) & (hi <= self.hi))

    def intersect(self, other: Interval) -> Interval:
        """Common part; ValueError where there is none."""
        return Interval(np.maximum(self.lo, other.lo), np.minimum(self.hi, other.hi))

    def __neg__(self) -> Interval:
        return Interval._of(-self.hi, -self.lo)

    def __pos__(self) -> Interval:
        return self

    def __abs__(self) -> Interval:
        return Interval._of(np.maximum(np.maximum(self.lo, -self.hi), 0.0), self.mag)

    def __add__(self, other: Any) -> Interval:
        if _foreign(other):
            return NotImplemented
        o = _lift(other)
        with np.errstate(invalid="ignore", over="ignore"):
            return _outward(self.lo + o.lo, self.hi + o.hi)

    __radd__ = __add__

    def __sub__(self, other: Any) -> Interval:
        if _foreign(other):
            return NotImplemented
        o = _lift(other)
        with np.errstate(invalid="ignore", over="ignore"):
            return _outward(self.lo - o.hi, self.hi - o.lo)

    def __rsub__(self, other: Any) -> Interval:
        return _lift(other) - self

    def __mul__(self, other: Any) -> Interval:
        if _foreign(other):
            return NotImplemented
        if other is self:
            return _even(self, 2)
        o = _lift(other)
        with np.errstate(invalid="ignore", over="ignore"):
            if o.lo is o.hi and o.lo.ndim == 0:
                ends = (self.lo, self.hi) if o.lo >= 0 else (self.hi, self.lo)
                lo, hi = ends[0] * o.lo, ends[1] * o.lo
            else:
                a, b, c, d = self.lo * o.lo, self.lo * o.hi, self.hi * o.lo, self.hi * o.hi
                lo, hi = np.minimum(np.minimum(a, b), np.minimum(c, d)), np.maximum(np.maximum(a, b), np.maximum(c, d))
            low, high = _down(lo), _up(hi)
            if (low <= high).all():
                return Interval._of(low, high)
            if not (o.lo is o.hi and o.lo.ndim == 0):
                lo, hi = np.fmin(np.fmin(a, b), np.fmin(c, d)), np.fmax(np.fmax(a, b), np.fmax(c, d))
        # 0 · ∞ is the only NaN here, and zero times any real number is zero.
        return _outward(np.where(np.isnan(lo), 0.0, lo), np.where(np.isnan(hi), 0.0, hi))

    __rmul__ = __mul__

    def __truediv__(self, other: Any) -> Interval:
        if _foreign(other):
            return NotImplemented
        o = _lift(other)
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            a, b, c, d = self.lo / o.lo, self.lo / o.hi, self.hi / o.lo, self.hi / o.hi
            lo, hi = np.fmin(np.fmin(a, b), np.fmin(c, d)), np.fmax(np.fmax(a, b), np.fmax(c, d))
        zero = (o.lo <= 0) & (o.hi >= 0)
        return _outward(np.where(zero, -np.inf, lo), np.where(zero, np.inf, hi))

    def __rtruediv__(self, other: Any) -> Interval:
        return _lift(other) / self

    def __pow__(self, exponent: Any) -> Interval:
        """Integer powers directly, 1/2 as sqrt, any other exponent as exp(p log x) over x >= 0."""
        if isinstance(exponent, int | float) and float(exponent).is_integer():
            n = int(exponent)
            if n < 0:
                return Interval.exact(1.0) / self.__pow__(-n)
            return _even(self, n) if n % 2 == 0 else _odd(self, n)
        return self.sqrt() if isinstance(exponent, float) and exponent == 0.5 else (self.log() * _lift(exponent)).exp()

    def __rpow__(self, base: Any) -> Interval:
        return (_lift(base).log() * self).exp()

    def sqrt(self) -> Interval:
        lo, hi, outside = _domain(self, 0.0, np.inf)
        return _whole(outside, np.fmax(_down(np.sqrt(lo)), 0.0), _up(np.sqrt(hi)))

    def exp(self) -> Interval:
        with np.errstate(over="ignore", under="ignore"):
            out = _library(np.exp(self.lo), np.exp(self.hi))
        return Interval._of(np.maximum(out.lo, 0.0), out.hi)

    def log(self) -> Interval:
        lo, hi, outside = _domain(self, 0.0, np.inf)
        with np.errstate(divide="ignore"):
            out = _library(np.log(lo), np.log(hi))
        return _whole(outside, out.lo, out.hi)

    def tanh(self) -> Interval:
        out = _library(np.tanh(self.lo), np.tanh(self.hi))
        return Interval._of(np.maximum(out.lo, -1.0), np.minimum(out.hi, 1.0))

    def arctan(self) -> Interval:
        return _library(np.arctan(self.lo), np.arctan(self.hi))

    def arcsin(self) -> Interval:
        lo, hi, outside = _domain(self, -1.0, 1.0)
        out = _library(np.arcsin(lo), np.arcsin(hi))
        return _whole(outside, out.lo, out.hi)

    def arccos(self) -> Interval:
        lo, hi, outside = _domain(self, -1.0, 1.0)
        out = _library(np.arccos(hi), np.arccos(lo))
        return _whole(outside, out.lo, out.hi)

    def sin(self) -> Interval:
        return _wave(self, np.sin, 0.25)

    def cos(self) -> Interval:
        return _wave(self, np.cos, 0.0)

    def tan(self) -> Interval:
        wild = _wild(self)
        pole = wild | _holds_integer(self, np.pi, 0.5)
        lo, hi = np.where(wild, 0.0, self.lo), np.where(wild, 0.0, self.hi)
        out = _library(np.tan(lo), np.tan(hi))
        return _whole(pole, out.lo, out.hi)

    def sign(self) -> Interval:
        return Interval._of(np.sign(self.lo), np.sign(self.hi))

    def minimum(self, other: Any) -> Interval:
        o = _lift(other)
        return Interval._of(np.minimum(self.lo, o.lo), np.minimum(self.hi, o.hi))

    def maximum(self, other: Any) -> Interval:
        o = _lift(other)
        return Interval._of(np.maximum(self.lo, o.lo), np.maximum(self.hi, o.hi))

    def sum(self, axis: int = -1) -> Interval:
        # |fl(sum of n) − sum| <= n u sum |x_i| in any order, u = eps / 2; the other half covers the error of sum |x_i|.
        slack = self.shape[axis] * _EPS
        with np.errstate(invalid="ignore"):
            lo = self.lo.sum(axis) - slack * np.abs(self.lo).sum(axis)
            hi = self.hi.sum(axis) + slack * np.abs(self.hi).sum(axis)
        return _outward(lo, hi)

    @staticmethod
    def dot(a: Any, b: Any) -> Interval:
        """Σ_j a[…, j] b[…, j], outward-rounded; with a of shape (…, m, n) and b (…, 1, n) a matrix times a vector."""
        return (_lift(a) * _lift(b)).sum(-1)

    @staticmethod
    def stack(parts: Sequence[Any], axis: int = 0) -> Interval:
        lifted = [_lift(p) for p in parts]
        return Interval._of(np.stack([p.lo for p in lifted], axis), np.stack([p.hi for p in lifted], axis))

    @staticmethod
    def concatenate(parts: Sequence[Any], axis: int = 0) -> Interval:
        lifted = [_lift(p) for p in parts]
        return Interval._of(np.concatenate([p.lo for p in lifted], axis), np.concatenate([p.hi for p in lifted], axis))

    def cut(self, axis: Ints, at: Array | None = None) -> Interval:
        """Boxes (n, d), each cut across an axis (n,) at its middle, or as near to `at` (n,) as may be; lower parts first."""
        rows, low, high = np.arange(len(self)), self.lo.copy(), self.hi.copy()
        where = self.mid[rows, axis] if at is None else np.clip(at, low[rows, axis], high[rows, axis])
        low[rows, axis] = high[rows, axis] = where
        return Interval.concatenate([Interval(self.lo, high), Interval(low, self.hi)])


def norm(values: Array) -> Array:
    """‖v‖₂ over the last axis, rounded up."""
    v = Interval.exact(values)
    square, total = (v * v).hi, np.zeros(v.shape[:-1])
    for j in range(v.shape[-1]):
        total = np.nextafter(total + square[..., j], np.inf)
    return np.asarray(np.nextafter(np.sqrt(total), np.inf))


def _foreign(value: Any) -> bool:
    """Is the right operand a number type of its own, which then decides?"""
    return getattr(value, "__array_ufunc__", True) is None and not isinstance(value, Interval)


def _lift(value: Any) -> Interval:
    return value if isinstance(value, Interval) else Interval.exact(value)


def _outward(lo: Array, hi: Array) -> Interval:
    """One rounding step outwards; NaN (∞ − ∞) means nothing is known on that side."""
    with np.errstate(invalid="ignore", over="ignore"):
        lo, hi = _down(lo), _up(hi)
    # One comparison finds what is no number on either side.
    if not (lo <= hi).all():
        lo, hi = np.where(np.isnan(lo), -np.inf, lo), np.where(np.isnan(hi), np.inf, hi)
    return Interval._of(lo, hi)


def _library(lo: Array, hi: Array) -> Interval:
    """Outwards by the error of a library function; overflowed ends fall back to the largest finite number."""
    with np.errstate(invalid="ignore", over="ignore"):
        low, high = lo - _pad(lo), hi + _pad(hi)
    return Interval._of(np.where(lo == np.inf, _MAX, low), np.where(hi == -np.inf, -_MAX, high))


def _domain(x: Interval, low: float, high: float) -> tuple[Array, Array, Bools]:
    return np.clip(x.lo, low, high), np.clip(x.hi, low, high), np.asarray((x.hi < low) | (x.lo > high))


def _whole(where: Bools, lo: Array, hi: Array) -> Interval:
    return Interval._of(np.where(where, -np.inf, lo), np.where(where, np.inf, hi))


def _wild(x: Interval) -> Bools:
    return np.asarray(~((np.abs(x.lo) < _HUGE) & (np.abs(x.hi) < _HUGE)))


def _holds_integer(x: Interval, period: float, shift: float) -> Bools:
    """May x / period − shift contain an integer? Never a wrong no.

    Each quotient errs by less than 4 eps (|t| + 1), with the error of the float period included.
    """
    with np.errstate(invalid="ignore"):
        a, b = x.lo / period - shift, x.hi / period - shift
        a, b = a - 4 * _EPS * (np.abs(a) + 1), b + 4 * _EPS * (np.abs(b) + 1)
    return np.asarray(np.floor(b) >= np.ceil(a))


def _wave(x: Interval, function: np.ufunc, peak: float) -> Interval:
    """Range of a sinusoid whose maxima lie at (peak + k) 2π and minima half a period later."""
    wild = _wild(x)
    ends = function(np.where(wild, 0.0, x.lo)), function(np.where(wild, 0.0, x.hi))
    out = _library(np.minimum(*ends), np.maximum(*ends))
    top = wild | _holds_integer(x, 2 * np.pi, peak)
    bottom = wild | _holds_integer(x, 2 * np.pi, peak + 0.5)
    return Interval._of(np.where(bottom, -1.0, np.maximum(out.lo, -1.0)), np.where(top, 1.0, np.minimum(out.hi, 1.0)))


def _positive_power(lo: Array, hi: Array, n: int) -> tuple[Array, Array]:
    """[lo, hi]^n for 0 <= lo by squaring and multiplying, each product rounded outwards."""
    low, high = np.ones_like(lo), np.ones_like(hi)
    exact = True
    with np.errstate(over="ignore", invalid="ignore"):
        while n:
            if n & 1:
                low, high = (lo, hi) if exact else (np.fmax(_down(low * lo), 0.0), _up(high * hi))
                exact = False
            n >>= 1
            if n:
                lo, hi = np.fmax(_down(lo * lo), 0.0), _up(hi * hi)
    return low, high


def _even(x: Interval, n: int) -> Interval:
    a = abs(x)
    return Interval._of(*_positive_power(a.lo, a.hi, n))


def _odd(x: Interval, n: int) -> Interval:
    a, b = np.abs(x.lo), np.abs(x.hi)
    (a_low, a_high), (b_low, b_high) = _positive_power(a, a, n), _positive_power(b, b, n)
    return Interval._of(np.where(x.lo >= 0, a_low, -a_high), np.where(x.hi >= 0, b_high, -b_low))


def _middle(lo: Array, hi: Array) -> Array:
    """A finite point of [lo, hi], whose ends may be infinite."""
    return np.asarray(np.clip(np.clip(lo, -_MAX, _MAX) / 2 + np.clip(hi, -_MAX, _MAX) / 2, lo, hi))
