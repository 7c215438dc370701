"""Second derivatives along one axis over boxes, through the same tape."""

from __future__ import annotations

from typing import Any, final

import numpy as np
import numpy.typing as npt

from gapcert import Interval

from .arithmetic import INTERVAL, round_slope, sign_slope, slope_table, whole_number
from .tape import Table


@final
class Jet:
    """The range of a value that changes along one axis, and of its first and second derivative there; None is zero."""

    __array_ufunc__ = None
    __slots__ = ("bend", "slope", "value")

    def __init__(self, value: Any, slope: Any, bend: Any = None) -> None:
        self.value, self.slope, self.bend = value, slope, bend

    def __neg__(self) -> Jet:
        return Jet(-self.value, _times(self.slope, -1.0), _times(self.bend, -1.0))

    def __add__(self, other: Any) -> Jet:
        value, slope, bend = _parts(other)
        return Jet(self.value + value, _sum(self.slope, slope), _sum(self.bend, bend))

    __radd__ = __add__

    def __sub__(self, other: Any) -> Jet:
        return self.__add__(-other)

    def __rsub__(self, other: Any) -> Jet:
        return (-self).__add__(other)

    def __mul__(self, other: Any) -> Jet:
        value, slope, bend = _parts(other)
        both = _times(_times(self.slope, slope), 2.0)
        return Jet(
            self.value * value,
            _sum(_times(self.slope, value), _times(slope, self.value)),
            _sum(_sum(_times(self.bend, value), both), _times(bend, self.value)),
        )

    __rmul__ = __mul__

    def __truediv__(self, other: Any) -> Jet:
        # q b = a, so q′ b = a′ − q b′ and q″ b = a″ − 2 q′ b′ − q b″.
        value, slope, bend = _parts(other)
        quotient = self.value / value
        first = _over(_sum(self.slope, _times(slope, -quotient)), value)
        crossed = _times(_times(first, slope), -2.0)
        return Jet(quotient, first, _over(_sum(_sum(self.bend, crossed), _times(bend, -quotient)), value))

    def __rtruediv__(self, other: Any) -> Jet:
        return Jet(other, None).__truediv__(self)


def _parts(x: Any) -> tuple[Any, Any, Any]:
    return (x.value, x.slope, x.bend) if isinstance(x, Jet) else (x, None, None)


def _value(x: Any) -> Any:
    return x.value if isinstance(x, Jet) else x


def _sum(a: Any, b: Any) -> Any:
    return b if a is None else a if b is None else a + b


def _times(a: Any, factor: Any) -> Any:
    return None if a is None or factor is None else a * factor


def _over(a: Any, divisor: Any) -> Any:
    return None if a is None else a / divisor


def _chained(x: Jet, value: Any, slope: Any, bend: Any) -> Jet:
    """φ(x) from φ, φ′ and φ″ at its value."""
    square = None if x.slope is None else x.slope * x.slope
    return Jet(value, _times(x.slope, slope), _sum(_times(square, bend), _times(x.bend, slope)))


_SLOPES = slope_table(INTERVAL)
# φ″ of each function at x, from x, y = φ(x) and d = φ′(x).
_BENDS: Table = {
    "sin": lambda x, y, d: -y,
    "cos": lambda x, y, d: -y,
    "tan": lambda x, y, d: y * d * 2.0,
    "exp": lambda x, y, d: y,
    "log": lambda x, y, d: -(d**2),
    "sqrt": lambda x, y, d: d / x * -0.5,
    "tanh": lambda x, y, d: y * d * -2.0,
    "atan": lambda x, y, d: x * d**2 * -2.0,
    "asin": lambda x, y, d: x * d**3,
    "acos": lambda x, y, d: x * d**3,
}


def _smooth(name: str) -> Any:
    def apply(x: Any) -> Any:
        if not isinstance(x, Jet):
            return INTERVAL[name](x)
        y = INTERVAL[name](x.value)
        d = _SLOPES[name](x.value, y)
        return _chained(x, y, d, _BENDS[name](x.value, y, d))

    return apply


def _pow(x: Any, n: int) -> Any:
    if not isinstance(x, Jet):
        return INTERVAL["pow"](x, n)
    if n == 1:
        return x
    bend = 2.0 if n == 2 else x.value ** (n - 2) * float(n * (n - 1))
    return _chained(x, x.value**n, x.value ** (n - 1) * float(n), bend)


def _power(x: Any, e: Any) -> Any:
    if isinstance(e, Jet):
        return _smooth("exp")(e * _smooth("log")(x))
    if not isinstance(x, Jet) or (n := whole_number(e)) == 0:
        return INTERVAL["power"](_value(x), e)
    if n is not None:
        return _pow(x, n)
    first, second = (INTERVAL["power"](x.value, e - k) for k in (1.0, 2.0))
    return _chained(x, INTERVAL["power"](x.value, e), e * first, e * (e - 1.0) * second)


def _straight(value: Any, certain: npt.NDArray[np.bool_], *parts: tuple[Any, Any]) -> Any:
    """φ(x, …) that is piecewise linear, from its slopes by each; where its piece is not certain, there may be a kink."""
    if not any(isinstance(x, Jet) for x, _ in parts):
        return value
    slope, bend = None, Interval(np.where(certain, 0.0, -np.inf), np.where(certain, 0.0, np.inf))
    for x, factor in parts:
        slope = _sum(slope, _times(_parts(x)[1], factor))
        if (own := _parts(x)[2]) is not None:
            bend = bend + own * factor
    return Jet(value, slope, bend)


def _abs(x: Any) -> Any:
    sign = _value(x).sign()
    return _straight(abs(_value(x)), (sign.lo == sign.hi) & (sign.lo != 0), (x, sign))


def _sign(x: Any) -> Any:
    y = _value(x).sign()
    slope = sign_slope(_value(x), y)
    return _straight(y, slope.lo == slope.hi, (x, slope))


def _round(x: Any) -> Any:
    y = INTERVAL["round"](_value(x))
    return _straight(y, y.lo == y.hi, (x, round_slope(_value(x), y)))


def _extreme(name: str, first: float) -> Any:
    """min and max; `first` is the slope by a where a < b."""

    def apply(a: Any, b: Any) -> Any:
        p, q = _value(a), _value(b)
        by_a, by_b = (INTERVAL["pick"](p, q, s, 1.0 - s) for s in (first, 1.0 - first))
        return _straight(INTERVAL[name](p, q), (p.hi < q.lo) | (p.lo > q.hi), (a, by_a), (b, by_b))

    return apply


def _soft(v: Any, k: Any) -> Any:
    slips = INTERVAL["slips"](_value(v), _value(k))
    by_k = -(slips * _value(v).sign())
    return _straight(INTERVAL["soft"](_value(v), _value(k)), slips.lo == slips.hi, (v, slips), (k, by_k))


def _stop(v: Any, d: Any, k: Any) -> Any:
    values = [_value(x) for x in (v, d, k)]
    slopes = INTERVAL["stop_slopes"](*values)
    # Slopes are those of slipping, ±1, where it is certain that no motion is stopped; otherwise the piece is not even linear.
    return _straight(INTERVAL["stop"](*values), slopes[0].lo == 1.0, *zip((v, d, k), slopes, strict=True))


JET: Table = {
    **INTERVAL,
    **{name: _smooth(name) for name in _BENDS},
    "pow": _pow,
    "power": _power,
    "abs": _abs,
    "sign": _sign,
    "round": _round,
    "min": _extreme("min", 1.0),
    "max": _extreme("max", 0.0),
    "soft": _soft,
    "stop": _stop,
}
