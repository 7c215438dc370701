"""What floating-point arithmetic may miss: a running error analysis along the operations of a tape, over boxes.

A computed number differs from the exact one by at most `error`: every operation hands on what its operands may be wrong by,
and adds its own rounding, u |result| with u = 2⁻⁵³ (Higham, Accuracy and Stability of Numerical Algorithms, 2nd ed., 3.3). It
holds for NumPy, for the compiled interpreter and for JAX: a fused multiply-add rounds once where two roundings are counted, a
division may be a product with a reciprocal, and the functions of each of them err by at most 4 ulp.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, final

import numpy as np

from gapcert import Array, Interval
from gapcert.plugin import Bools

from .arithmetic import INTERVAL, Dual, dual_table, power, slope_table
from .tape import Columns, Table

if TYPE_CHECKING:
    from gapcert_equations.mechanics.dynamics import Dynamics

_U = 2.0**-53
_TINY = float(np.finfo(np.float64).tiny)  # what is smaller may be flushed to zero
_LIBRARY = 8 * _U  # 4 ulp of the result: one ulp of v is at most 2 u |v|
_MORE = 1 + 2.0**-48  # more than a dozen sums and products of positive numbers round by
_LONGEST = 60  # characters of a term that is named
_SLOPES = slope_table(INTERVAL)


@final
class Rounded:
    """The range of an exact value over boxes, by how much at most the computed one differs, and whose rounding that is.

    error: (n,) or a number; ∞ where nothing bounds it. text: the expression, cut where it is long. cause: the term whose
    rounding has the largest share in the error, and that share.
    """

    __array_ufunc__ = None
    __slots__ = ("cause", "error", "text", "value")

    def __init__(self, value: Interval, error: Any, text: str, cause: tuple[float, str] = (0.0, "")) -> None:
        self.value, self.error, self.text, self.cause = value, error, text, cause

    @classmethod
    def exact(cls, value: Any, text: str = "") -> Rounded:
        """Without an error."""
        return cls(value if isinstance(value, Interval) else Interval.exact(value), 0.0, text or f"{float(value):g}")

    @property
    def around(self) -> Interval:
        """Contains the exact and the computed value."""
        if not np.any(self.error):
            return self.value
        return Interval(_less(self.value.lo, self.error), -_less(-self.value.hi, self.error))

    @property
    def number(self) -> float:
        """The constant that it is, without an error; else NaN."""
        lo, hi = self.value.lo, self.value.hi
        return float(lo) if lo.ndim == 0 and lo == hi and not np.any(self.error) else math.nan

    def __neg__(self) -> Rounded:
        return Rounded(-self.value, self.error, f"-{self.text}", self.cause)

    def __abs__(self) -> Rounded:
        return Rounded(abs(self.value), self.error, f"abs({self.text})", self.cause)

    def __add__(self, other: Any) -> Rounded:
        return _sum(self, lifted(other), 1.0)

    def __radd__(self, other: Any) -> Rounded:
        return _sum(lifted(other), self, 1.0)

    def __sub__(self, other: Any) -> Rounded:
        return _sum(self, lifted(other), -1.0)

    def __rsub__(self, other: Any) -> Rounded:
        return _sum(lifted(other), self, -1.0)

    def __mul__(self, other: Any) -> Rounded:
        o = lifted(other)
        left, right = _times(o.around.mag, self.error), _times(self.value.mag, o.error)
        value = self.value * (self.value if o is self else o.value)
        # Powers of two only shift the exponent.
        shifts = any(abs(math.frexp(v.number)[0]) in (0.0, 0.5) for v in (self, o))
        return _made(value, 0.0 if shifts else _U, f"{self.text}*{o.text}", (self, left), (o, right))

    def __rmul__(self, other: Any) -> Rounded:
        return lifted(other) * self

    def __truediv__(self, other: Any) -> Rounded:
        if lifted(other).number == 1:
            return self
        # (a + α)/(b + β) − a/b = (α − β a/b)/(b + β), and 1/(b + β) may be rounded before it is multiplied.
        o = lifted(other)
        value, least = self.value / o.value, abs(o.around).lo
        inverse = np.where(least > 0, 1 / np.where(least > 0, least, 1.0), np.inf)
        left, right = _times(inverse, self.error), _times(value.mag * inverse, o.error)
        text, spare = f"{self.text}/{o.text}", self.around.mag * _TINY
        return _made(value, 2 * _U * (1 + _U), text, (self, left), (o, right), spare=spare)

    def __rtruediv__(self, other: Any) -> Rounded:
        return lifted(other) / self


def lifted(value: Any) -> Rounded:
    """A number as one that is exact."""
    return value if isinstance(value, Rounded) else Rounded.exact(float(value))


def _less(value: Array, error: Any) -> Array:
    """Below value − error."""
    below = value - error - 4 * _U * (np.abs(value) + error)
    return np.asarray(np.where(np.isnan(below), -np.inf, below))


def _times(factor: Any, error: Any) -> Any:
    """factor · error, nothing where there is no error, however large the factor."""
    return np.where(np.equal(error, 0), 0.0, factor * error)


def _made(value: Interval, u: float, text: str, *parts: tuple[Rounded, Any], spare: Any = 0.0) -> Rounded:
    """A result from what its operands' errors move it by, and its own rounding u |result|; spare: what may be lost besides."""
    moved: Any = sum((m for _, m in parts), 0.0)
    own = u * (value.mag + moved) + (_TINY + spare)
    error = (moved + own) * _MORE
    error = np.where(np.isnan(error), np.inf, error)
    text = text if len(text) <= _LONGEST else text[: _LONGEST - 1] + "…"
    largest = max((_share(r, m, text) for r, m in parts), key=lambda c: c[0], default=(0.0, ""))
    # Of sums that round alike the innermost is named.
    return Rounded(value, error, text, (_top(own), text) if _top(own) > 2 * largest[0] else largest)


def _top(values: Any) -> float:
    top = float(values) if np.ndim(values) == 0 else float(values.max())
    return math.inf if math.isnan(top) else top


def _share(r: Rounded, moved: Any, text: str) -> tuple[float, str]:
    """What the largest cause of an operand's error has become."""
    before, after = _top(r.error), _top(moved)
    if after == 0:
        return 0.0, ""
    if not math.isfinite(after):
        return math.inf, r.cause[1] if not math.isfinite(before) else text
    return after * min(1.0, r.cause[0] / before), r.cause[1]


def _sum(a: Rounded, b: Rounded, sign: float) -> Rounded:
    if b.number == 0:
        return a
    if a.number == 0:
        return b if sign > 0 else -b
    value = a.value + b.value if sign > 0 else a.value - b.value
    return _made(value, _U, f"({a.text} {'+' if sign > 0 else '-'} {b.text})", (a, a.error), (b, b.error))


def _number(p: Any, q: Any) -> Rounded:
    """p / q, whose whole numbers may not be floats themselves."""
    if q == 1 and float(p) == p:
        return Rounded.exact(p, f"{p}")
    exact = max(abs(p), q) <= 2**53
    return _made(Interval.exact(p) / Interval.exact(q), _U if exact else 4 * _U, f"{p}/{q}")


def _function(name: str) -> Callable[[Any], Rounded]:
    """φ(x̃) − φ(x) is at most the largest |φ′| on the way times the error of x; where that is infinite, see `_STEEP`."""

    def apply(x: Any) -> Rounded:
        x = lifted(x)
        text = f"{name}({x.text})"
        if not np.any(x.error):
            return _made(INTERVAL[name](x.value), _LIBRARY, text)
        around = x.around
        moved = _times(_SLOPES[name](around, INTERVAL[name](around)).mag, x.error)
        if name in _STEEP:
            moved = np.fmin(moved, _STEEP[name](x.error))
        return _made(INTERVAL[name](x.value), _LIBRARY, text, (x, moved))

    return apply


# By how much values differ at most at arguments within an error, wherever these are: √ and its like are steep at an end.
_STEEP: dict[str, Callable[[Any], Any]] = {
    "sin": lambda e: np.minimum(e, 2.0),
    "cos": lambda e: np.minimum(e, 2.0),
    "tanh": lambda e: np.minimum(e, 2.0),
    "sqrt": np.sqrt,
    "asin": lambda e: 2.3 * np.sqrt(e),
    "acos": lambda e: 2.3 * np.sqrt(e),
}


def _pow(x: Any, n: int) -> Rounded:
    """By squaring and multiplying, as it is computed; the range is that of the power."""
    x = lifted(x)
    out = power(x, n)
    return Rounded(x.value**n, out.error, f"{x.text}**{n}", (out.cause[0], out.cause[1] if n == 1 else f"{x.text}**{n}"))


def _power(x: Any, e: Any) -> Rounded:
    """∂ x^e = e x^(e−1) ∂x + x^e log x ∂e; of an exact exponent in (0, 1) also |x̃^e − x^e| ≤ |x̃ − x|^e."""
    x, e = lifted(x), lifted(e)
    text, base, exponent = f"{x.text}**{e.text}", x.around, e.around
    value = INTERVAL["power"](base, exponent)
    left = right = 0.0
    if np.any(x.error):
        left = _times((exponent * INTERVAL["power"](base, exponent - 1.0)).mag, x.error)
        if 0 < e.number < 1:
            left = np.fmin(left, x.error**e.number * _MORE)
    if np.any(e.error):
        right = _times((value * base.log()).mag, e.error)
    return _made(INTERVAL["power"](x.value, e.value), _LIBRARY, text, (x, left), (e, right))


def _extreme(name: str, lower: bool) -> Callable[[Any, Any], Rounded]:
    """min and max move by no more than the operand that may be the one."""

    def apply(a: Any, b: Any) -> Rounded:
        a, b = lifted(a), lifted(b)
        p, q = a.around, b.around
        first, second = (p.hi < q.lo, p.lo > q.hi) if lower else (p.lo > q.hi, p.hi < q.lo)
        value = INTERVAL[name](a.value, b.value)
        left, right = np.where(second, 0.0, a.error), np.where(first, 0.0, b.error)
        made = _made(value, 0.0, f"{name}({a.text}, {b.text})", (a, left), (b, right))
        return Rounded(value, np.maximum(left, right), made.text, made.cause)

    return apply


def _jump(name: str, same: Callable[[Interval], Bools]) -> Callable[[Any], Rounded]:
    """Nothing bounds the error where the computed argument may lie on the other side of a jump."""

    def apply(x: Any) -> Rounded:
        x = lifted(x)
        error = np.where(np.equal(x.error, 0) | same(x.around), 0.0, np.inf)
        text = f"{name}({x.text})"
        return Rounded(INTERVAL[name](x.value), error, text, (_top(error), text))

    return apply


def _soft(v: Any, k: Any) -> Rounded:
    """sign(v) max(|v| − k, 0), which moves by no more than v and k do."""
    v, k = lifted(v), lifted(k)
    return _made(INTERVAL["soft"](v.value, k.value), _U, f"soft({v.text}, {k.text})", (v, v.error), (k, k.error))


def _stop(v: Any, d: Any, k: Any) -> Rounded:
    """Slopes are at most 1 (`_interval_stop`), and its few operations round by at most 8 u (|v| + |d| + k)."""
    v, d, k = lifted(v), lifted(d), lifted(k)
    size = sum((x.around.mag for x in (v, d, k)), 0.0)
    value, parts = INTERVAL["stop"](v.value, d.value, k.value), [(x, x.error) for x in (v, d, k)]
    return _made(value, 0.0, f"stop({v.text}, {d.text}, {k.text})", *parts, spare=8 * _U * size)


ROUNDED: Table = {
    "add": lambda a, b: lifted(a) + b,
    "sub": lambda a, b: lifted(a) - b,
    "mul": lambda a, b: lifted(a) * b,
    "div": lambda a, b: lifted(a) / b,
    "neg": lambda a: -lifted(a),
    "abs": lambda a: abs(lifted(a)),
    **{name: _function(name) for name in ("sin", "cos", "tan", "exp", "log", "sqrt", "tanh", "atan", "asin", "acos")},
    "sign": _jump("sign", lambda x: np.sign(x.lo) == np.sign(x.hi)),
    "round": _jump("round", lambda x: np.rint(x.lo) == np.rint(x.hi)),
    "min": _extreme("min", True),
    "max": _extreme("max", False),
    "number": _number,
    "pow": _pow,
    "power": _power,
    "soft": _soft,
    "stop": _stop,
}


def rounded(dynamics: Dynamics, parameters: Columns, x: Columns, u: Columns, z: Columns) -> list[Rounded]:
    """x⁺ of one period, all columns Rounded: its range, and what its arithmetic may miss."""
    if dynamics.integrator is None or dynamics.substeps == 1:
        after = dynamics.step(ROUNDED, dynamics.prepare(ROUNDED, parameters), x, u, z)[0]
        return [lifted(c) for c in after]
    return _in_substeps(dynamics, parameters, x, u, z)


def _in_substeps(dynamics: Dynamics, parameters: Columns, x: Columns, u: Columns, z: Columns) -> list[Rounded]:
    """Sub-step by sub-step: errors e before it become |A| e + d, A the range of its slopes and d its own from exact arguments.

    So errors shrink where the motion contracts. Ranges are the natural ones, and those of the mean-value form about the middle.
    """
    once, n, moving = dynamics.once, len(x), len(x) + len(z)
    steps = {name: (table, once.prepare(table, given)) for name, table, given in _tables(parameters)}

    def step(name: str, columns: Columns) -> Columns:
        table, prepared = steps[name]
        after, kept = once.step(table, prepared, columns[:n], columns[moving:], columns[n:moving])
        return [*after, *kept]

    now = [*x, *z, *u]
    start = [c.value for c in now]
    middle: Columns = [Interval.exact(v.mid) for v in start]
    slopes = [{j: Interval.exact(1.0)} for j in range(len(now))]
    for _ in range(dynamics.substeps):
        boxes = [c.around for c in now]
        own = [lifted(c) for c in step("rounded", [Rounded(b, 0.0, c.text) for b, c in zip(boxes, now, strict=True)])]
        rows = [_gradient(c) for c in step("dual", [Dual(b, {j: Interval.exact(1.0)}) for j, b in enumerate(boxes)])]
        middle[:moving] = step("interval", middle)
        slopes[:moving] = [_composed(row, slopes) for row in rows]
        for i, (new, row) in enumerate(zip(own, rows, strict=True)):
            line = sum((s * (start[j] - start[j].mid) for j, s in slopes[i].items()), middle[i])
            parts = [(now[j], _times(s.mag, now[j].error)) for j, s in row.items()]
            own[i] = _made(_common(new.value, line), 0.0, new.cause[1], *parts, (new, new.error))
            own[i].text = now[i].text
        now[:moving] = own
    return now[:n]


def _tables(parameters: Columns) -> list[tuple[str, Table, Columns]]:
    exact = [p.value for p in parameters]
    return [("rounded", ROUNDED, parameters), ("interval", INTERVAL, exact), ("dual", _DUAL, exact)]


_DUAL = dual_table(INTERVAL)


def _gradient(column: Any) -> dict[int, Interval]:
    return column.slopes if isinstance(column, Dual) else {}


def _composed(row: dict[int, Interval], slopes: list[dict[int, Interval]]) -> dict[int, Interval]:
    """Σ_j row_j ∂(column j): slopes by what a period begins with."""
    out: dict[int, Interval] = {}
    for j, factor in row.items():
        for k, s in slopes[j].items():
            out[k] = out[k] + factor * s if k in out else factor * s
    return out


def _common(a: Interval, b: Interval) -> Interval:
    return Interval(np.maximum(a.lo, b.lo), np.minimum(a.hi, b.hi))
