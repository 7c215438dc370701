"""What the operations of a tape mean for each number type: float64 arrays, Intervals, derivatives of either, and zeros."""

from __future__ import annotations

import functools
import operator
from typing import Any, final

import numpy as np

from gapcert import Interval

from .tape import Table

_COMMON: Table = {
    "add": operator.add,
    "sub": operator.sub,
    "mul": operator.mul,
    "div": operator.truediv,
    "neg": operator.neg,
    "abs": abs,
}


def _functions(of: Any) -> Table:
    """What NumPy, and who goes by it, calls our functions."""
    names = {"atan": "arctan", "asin": "arcsin", "acos": "arccos", "min": "minimum", "max": "maximum"}
    names |= {n: n for n in ("sin", "cos", "tan", "exp", "log", "sqrt", "tanh", "sign")}
    return {ours: getattr(of, theirs) for ours, theirs in names.items()}


def power(x: Any, n: int) -> Any:
    """x^n for n >= 1 by squaring and multiplying, in the order in which Intervals do it."""
    out = None
    while n:
        if n & 1:
            out = x if out is None else out * x
        n >>= 1
        if n:
            x = x * x
    return out


def array_table(xp: Any) -> Table:
    """Operations on arrays of NumPy, or of a namespace like it."""
    return {
        **_COMMON,
        **_functions(xp),
        "round": xp.rint,
        "power": xp.power,
        "number": lambda p, q: np.float64(p) / q,
        "pow": power,
        "pick": lambda a, b, p, q: xp.where(a <= b, p, q),
        "soft": lambda v, k: v - xp.clip(v, -k, k),
        "stop": functools.partial(_stop, xp),
        "stop_slopes": functools.partial(_stop_slopes, xp),
        "slips": lambda v, k: xp.where(abs(v) > k, 1.0, 0.0),
    }


def _stop(xp: Any, v: Any, d: Any, k: Any) -> Any:
    """The velocity after a sub-step that would change it by d, against friction that can change it by k >= 0.

    While it slips from v the change is a = d − k sign v. Where that brings it to zero within the sub-step, at the share
    τ = −v/a, it rests there if |d| <= k, and turns round else.
    """
    sign = xp.sign(v)
    a = d - k * sign
    turned = (d - xp.clip(d, -k, k)) * (1.0 + v / xp.where(a == 0, 1.0, a))
    return xp.where((v + a) * sign > 0, v + a, turned)


def _stop_slopes(xp: Any, v: Any, d: Any, k: Any) -> tuple[Any, Any, Any]:
    """∂/∂(v, d, k) of `stop`."""
    sign = xp.sign(v)
    a, left = d - k * sign, d - xp.clip(d, -k, k)
    over = xp.where(a == 0, 1.0, a)
    rest, moves, slips = 1.0 + v / over, xp.where(left == 0, 0.0, 1.0), (v + a) * sign > 0
    by_v, by_d = left / over, rest * moves - left * v / over**2
    by_k = -xp.sign(d) * rest * moves + left * v * sign / over**2
    return xp.where(slips, 1.0, by_v), xp.where(slips, 1.0, by_d), xp.where(slips, -sign, by_k)


def _interval_stop(v: Interval, d: Interval, k: Interval) -> Interval:
    """Increasing in v and d, and |∂/∂k| <= 1; widened by more than the rounding of the formula."""
    middle = k.mid
    low, high = (_stop(np, *ends, middle) for ends in ((v.lo, d.lo), (v.hi, d.hi)))
    size = np.maximum(np.abs(v.lo), np.abs(v.hi)) + np.maximum(np.abs(d.lo), np.abs(d.hi)) + k.hi
    wide = np.maximum(k.hi - middle, middle - k.lo) + 1e-14 * size
    return Interval(np.nan_to_num(low - wide, nan=-np.inf), np.nan_to_num(high + wide, nan=np.inf))


def _interval_stop_slopes(v: Interval, d: Interval, k: Interval) -> tuple[Interval, Interval, Interval]:
    """0 <= ∂/∂v, ∂/∂d <= 1 and |∂/∂k| <= 1; those of slipping where no motion in the box is stopped."""
    up, down = (v.lo > 0) & (v.lo + d.lo > k.hi), (v.hi < 0) & (-v.hi - d.hi > k.hi)
    low = np.where(up | down, 1.0, 0.0)
    by_k = Interval(np.where(down, 1.0, -1.0), np.where(up, -1.0, 1.0))
    return Interval(low, np.ones_like(low)), Interval(low, np.ones_like(low)), by_k


def _interval_pick(a: Interval, b: Interval, p: Any, q: Any) -> Interval:
    """p where a <= b, q where a >= b, and both where that is open."""
    p, q = Interval.hull(p), Interval.hull(q)
    first, second = a.hi < b.lo, a.lo > b.hi
    lo = np.where(first, p.lo, np.where(second, q.lo, np.minimum(p.lo, q.lo)))
    return Interval(lo, np.where(first, p.hi, np.where(second, q.hi, np.maximum(p.hi, q.hi))))


def _interval_soft(v: Interval, k: Interval) -> Interval:
    """sign(v) max(|v| − k, 0): increasing in v, and nearer to zero for larger k."""
    lo, hi = Interval.exact(v.lo), Interval.exact(v.hi)
    low = np.where(v.lo >= 0, np.maximum((lo - k).lo, 0.0), np.minimum((lo + k).lo, 0.0))
    high = np.where(v.hi >= 0, np.maximum((hi - k).hi, 0.0), np.minimum((hi + k).hi, 0.0))
    return Interval(low, high)


def _interval_slips(v: Interval, k: Interval) -> Interval:
    size = abs(v)
    return Interval(np.where(size.lo > k.hi, 1.0, 0.0), np.where(size.hi > k.lo, 1.0, 0.0))


def whole_number(e: Any) -> int | None:
    """n where the exponent is the integer n and nothing else."""
    n = float(e.lo.flat[0]) if isinstance(e, Interval) and e.lo.size else np.nan
    return int(n) if n.is_integer() and (e.lo == n).all() and (e.hi == n).all() else None


def _interval_power(b: Interval, e: Any) -> Interval:
    """b^e = exp(e log b); a negative base has a power for integers alone."""
    e = Interval.hull(e)
    if (n := whole_number(e)) is not None:
        return b**n
    out = (b.log() * e).exp()
    signed = (b.lo < 0) & (np.floor(e.hi) >= np.ceil(e.lo))
    return Interval(np.where(signed, -np.inf, out.lo), np.where(signed, np.inf, out.hi))


INTERVAL: Table = {
    **_COMMON,
    **_functions(Interval),
    "round": lambda v: Interval(np.rint(v.lo), np.rint(v.hi)),
    "number": lambda p, q: Interval.exact(p) / q if q != 1 else Interval.exact(p),
    "pow": operator.pow,
    "power": _interval_power,
    "pick": _interval_pick,
    "soft": _interval_soft,
    "stop": _interval_stop,
    "stop_slopes": _interval_stop_slopes,
    "slips": _interval_slips,
}
ARRAY: Table = array_table(np)


@final
class Dual:
    """A value with its partial derivatives {variable: slope}; absent slopes are zero. Forward-mode, so exact."""

    __array_ufunc__ = None
    __slots__ = ("slopes", "value")

    def __init__(self, value: Any, slopes: dict[int, Any]) -> None:
        self.value = value
        self.slopes = slopes

    def _scaled(self, factor: Any) -> dict[int, Any]:
        return {k: factor * s for k, s in self.slopes.items()}

    def __neg__(self) -> Dual:
        return Dual(-self.value, {k: -s for k, s in self.slopes.items()})

    def __add__(self, other: Any) -> Dual:
        if not isinstance(other, Dual):
            return Dual(self.value + other, self.slopes)
        return Dual(self.value + other.value, merged(self.slopes, other.slopes))

    __radd__ = __add__

    def __sub__(self, other: Any) -> Dual:
        return self.__add__(-other)

    def __rsub__(self, other: Any) -> Dual:
        return Dual(other - self.value, (-self).slopes)

    def __mul__(self, other: Any) -> Dual:
        if not isinstance(other, Dual):
            return Dual(self.value * other, self._scaled(other))
        return Dual(self.value * other.value, merged(self._scaled(other.value), other._scaled(self.value)))

    __rmul__ = __mul__

    def __truediv__(self, other: Any) -> Dual:
        if not isinstance(other, Dual):
            return Dual(self.value / other, {k: s / other for k, s in self.slopes.items()})
        quotient = self.value / other.value
        top = merged(self.slopes, other._scaled(-quotient))
        return Dual(quotient, {k: s / other.value for k, s in top.items()})

    def __rtruediv__(self, other: Any) -> Dual:
        return Dual(other, {}).__truediv__(self)


def merged(a: dict[int, Any], b: dict[int, Any]) -> dict[int, Any]:
    """Sum of two sparse gradients."""
    return {k: a[k] + b[k] if k in a and k in b else a.get(k, b.get(k)) for k in {**a, **b}}


def _powers(base: Table) -> Table:
    """x^n for integers n, and x^e, of Duals."""

    def integer_power(x: Any, n: int) -> Any:
        if not isinstance(x, Dual):
            return base["pow"](x, n)
        slope = base["pow"](x.value, n - 1) * float(n) if n != 1 else 1.0
        return Dual(base["pow"](x.value, n), x._scaled(slope))

    def general_power(x: Any, e: Any) -> Any:
        if not _slopes(e) and (n := whole_number(_value(e))):
            return integer_power(x, n)
        value = base["power"](_value(x), _value(e))
        if not isinstance(x, Dual) and not isinstance(e, Dual):
            return value
        # d x^e = e x^(e−1) dx + x^e log(x) de
        by_base = {k: s * (_value(e) * base["power"](x.value, _value(e) - 1.0)) for k, s in _slopes(x).items()}
        by_exponent = {k: s * (value * base["log"](_value(x))) for k, s in _slopes(e).items()}
        return Dual(value, merged(by_base, by_exponent))

    return {"pow": integer_power, "power": general_power}


def slope_table(base: Table) -> Table:
    """φ′ of each function at x, from x and y = φ(x)."""
    return {
        "sin": lambda x, y: base["cos"](x),
        "cos": lambda x, y: -base["sin"](x),
        "tan": lambda x, y: 1.0 + base["pow"](y, 2),
        "exp": lambda x, y: y,
        "log": lambda x, y: 1.0 / x,
        "sqrt": lambda x, y: 0.5 / y,
        "abs": lambda x, y: base["sign"](x),
        "tanh": lambda x, y: 1.0 - base["pow"](y, 2),
        "sign": sign_slope,
        "round": round_slope,
        "atan": lambda x, y: 1.0 / (1.0 + base["pow"](x, 2)),
        "asin": lambda x, y: 1.0 / base["sqrt"](1.0 - base["pow"](x, 2)),
        "acos": lambda x, y: -1.0 / base["sqrt"](1.0 - base["pow"](x, 2)),
    }


def dual_table(base: Table) -> Table:
    """Operations on Duals over a number type; plain numbers of that type are constants."""
    derivatives = slope_table(base)

    def unary(name: str) -> Any:
        def apply(x: Any) -> Any:
            if not isinstance(x, Dual):
                return base[name](x)
            value = base[name](x.value)
            return Dual(value, x._scaled(derivatives[name](x.value, value)))

        return apply

    def pick(a: Any, b: Any, p: Any, q: Any) -> Any:
        a, b, left, right = _value(a), _value(b), _slopes(p), _slopes(q)
        slopes = {k: base["pick"](a, b, left.get(k, 0.0), right.get(k, 0.0)) for k in {**left, **right}}
        return Dual(base["pick"](a, b, _value(p), _value(q)), slopes)

    def soft(v: Any, k: Any) -> Any:
        slips, sign = base["slips"](_value(v), _value(k)), base["sign"](_value(v))
        by_k = {j: s * (-(slips * sign)) for j, s in _slopes(k).items()}
        return Dual(base["soft"](_value(v), _value(k)), merged({j: s * slips for j, s in _slopes(v).items()}, by_k))

    def stop(v: Any, d: Any, k: Any) -> Any:
        values = [_value(v), _value(d), _value(k)]
        parts = zip((v, d, k), base["stop_slopes"](*values), strict=True)
        scaled = [{j: s * factor for j, s in _slopes(x).items()} for x, factor in parts]
        return Dual(base["stop"](*values), merged(merged(scaled[0], scaled[1]), scaled[2]))

    functions = {n: unary(n) for n in derivatives}
    return {
        **base,
        **functions,
        **_powers(base),
        "pick": pick,
        "min": lambda a, b: Dual(base["min"](_value(a), _value(b)), pick(a, b, a, b).slopes),
        "max": lambda a, b: Dual(base["max"](_value(a), _value(b)), pick(a, b, b, a).slopes),
        "soft": soft,
        "stop": stop,
    }


def _value(x: Any) -> Any:
    return x.value if isinstance(x, Dual) else x


def _slopes(x: Any) -> dict[int, Any]:
    return x.slopes if isinstance(x, Dual) else {}


def sign_slope(x: Any, y: Any) -> Any:
    """0, and over an interval that contains the jump, unbounded."""
    if not isinstance(x, Interval):
        return 0.0 * y
    jump = (x.lo <= 0) & (x.hi >= 0)
    return Interval(np.where(jump, -np.inf, 0.0), np.where(jump, np.inf, 0.0))


def round_slope(x: Any, y: Any) -> Any:
    """0, and over an interval that contains a jump, unbounded upwards: round is increasing."""
    if not isinstance(x, Interval):
        return 0.0 * y
    return Interval(np.zeros_like(y.lo), np.where(y.lo == y.hi, 0.0, np.inf))


# f(0) = 0 exactly, in real numbers and in every library of functions.
_ODD = ("sin", "tan", "tanh", "asin", "atan", "sqrt", "abs", "sign", "round", "pow", "neg")


@final
class Seen:
    """A number of which it is known at most that it is zero: then 0 · x and 0 / p are, p a parameter, and x + 0 is x itself."""

    __array_ufunc__ = None
    __slots__ = ("zero",)

    def __init__(self, zero: bool = False) -> None:
        self.zero = zero

    def __neg__(self) -> Seen:
        return self if self.zero else Seen()

    def __add__(self, other: Any) -> Seen:
        if _zero(other):
            return self
        return other if self.zero and isinstance(other, Seen) else Seen()

    __radd__ = __add__

    def __sub__(self, other: Any) -> Seen:
        return self if _zero(other) else Seen()

    def __rsub__(self, other: Any) -> Seen:
        return -self if _zero(other) else Seen()

    def __mul__(self, other: Any) -> Seen:
        return Seen(self.zero or _zero(other))

    __rmul__ = __mul__

    def __truediv__(self, other: Any) -> Seen:
        return Seen(self.zero and not isinstance(other, Seen) and other != 0)

    def __rtruediv__(self, other: Any) -> Seen:
        return Seen()


def _zero(value: Any) -> bool:
    return value.zero if isinstance(value, Seen) else bool(value == 0)


def _follows(name: str, plain: Any) -> Any:
    def apply(*values: Any) -> Any:
        if not any(isinstance(v, Seen) for v in values):
            return plain(*values)
        return Seen(name in _ODD and _zero(values[0]))

    return apply


_ARITHMETIC = ("add", "sub", "mul", "div", "neg", "number")
SEEN: Table = {name: plain if name in _ARITHMETIC else _follows(name, plain) for name, plain in ARRAY.items()}
