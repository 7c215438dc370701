"""Expressions of z as data, nested lists: values, ranges, slopes over boxes, and what computing them errs by.

A node is a number; ["axis", j]; ["+", a, b, …]; ["*", a, b, …]; ["^", a, n] with a whole n ≥ 1; or [name, a] with a function.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import isfinite, prod
from typing import Any, final

import numpy as np

from gapcert.plugin import Array, Interval

_EPS = float(np.finfo(np.float64).eps)
_TINY = float(np.finfo(np.float64).tiny)
_POINTS = 1 << 16  # of a quadrature over all axes, at most; chosen, not measured


def _tanh_slope(x: Interval) -> Interval:
    t = x.tanh()
    return (1.0 - t * t).maximum(0.0)


# Computed, its range, and the range of its slope; across the kink of abs both slopes with all between. All are unbounded over
# intervals that reach out of where the function is defined, and the slope of sqrt is at 0.
FUNCTIONS: dict[str, tuple[Callable[[Array], Array], Callable[[Interval], Interval], Callable[[Interval], Interval]]] = {
    "abs": (np.abs, abs, Interval.sign),
    "atan": (np.arctan, Interval.arctan, lambda x: 1.0 / (x * x + 1.0)),
    "cos": (np.cos, Interval.cos, lambda x: -x.sin()),
    "exp": (np.exp, Interval.exp, Interval.exp),
    "log": (np.log, Interval.log, lambda x: 1.0 / x),
    "sin": (np.sin, Interval.sin, Interval.cos),
    "sqrt": (np.sqrt, Interval.sqrt, lambda x: 0.5 / x.sqrt()),
    "tanh": (np.tanh, Interval.tanh, _tanh_slope),
}


@final
@dataclass(frozen=True)
class Expression:
    """A function of z (n, nz) → (n,), given by its tree. ValueError where the tree is malformed."""

    text: str
    tree: Any

    def __post_init__(self) -> None:
        _check(self.tree)

    @property
    def axes(self) -> set[int]:
        """The axes that it involves."""
        return _axes(self.tree)

    def value(self, z: Array) -> Array:
        """(n, nz) → (n,)."""
        return np.ascontiguousarray(np.broadcast_to(_evaluated(self.tree, z), (len(z),)))

    def over(self, boxes: Interval) -> Interval:
        """(n, nz) → (n,)."""
        return _full(_evaluated(self.tree, boxes, over=True), len(boxes))

    def derivative_over(self, boxes: Interval, j: int) -> Interval:
        """Contains ∂/∂z_j over each box, (n,), differentiated forwards."""
        slope = _dual(self.tree, boxes, j)[1]
        return _full(Interval.exact(0.0) if slope is None else slope, len(boxes))

    def slope(self, box: Interval) -> Array:
        """(nz,) sup |∂/∂z_j| over a box (1, nz), rounded up."""
        return np.array([self.derivative_over(box, j).mag[0] for j in range(box.shape[1])])

    def mean(self, box: Interval) -> float:
        """Over a box (1, nz): a product of Gauss–Legendre rules over the axes that it involves, about where there are kinks."""
        axes = sorted(self.axes)
        nodes, weights = np.polynomial.legendre.leggauss(min(64, int(_POINTS ** (1 / max(1, len(axes))))))
        z = np.zeros((len(nodes) ** len(axes), box.shape[1]))
        for j, x in zip(axes, np.meshgrid(*[nodes] * len(axes), indexing="ij"), strict=True):
            z[:, j] = (box.lo[0, j] + box.hi[0, j]) / 2 + (box.hi[0, j] - box.lo[0, j]) / 2 * x.reshape(-1)
        weight = np.ones(1)
        for _ in axes:
            weight = np.outer(weight, weights / 2).reshape(-1)
        return float(weight @ self.value(z))

    def error(self, box: Interval) -> float:
        """Bound on |computed value − value| over a box (1, nz); ∞ where the value or a slope inside is unbounded there."""
        with np.errstate(all="ignore"):
            size, error = _running(self.tree, box)
        return error * (1 + 1e-9) if isfinite(size) and isfinite(error) else np.inf

    def data(self) -> Any:
        return self.tree


def _check(node: Any) -> None:
    if isinstance(node, int | float) and isfinite(node):
        return
    op, *parts = node if isinstance(node, list) and node else ("",)
    if op == "axis" and len(parts) == 1 and isinstance(parts[0], int) and parts[0] >= 0:
        return
    whole = op == "^" and len(parts) == 2 and isinstance(parts[1], int) and 1 <= parts[1] < 1000
    if not (whole or (op in ("+", "*") and parts) or (op in FUNCTIONS and len(parts) == 1)):
        raise ValueError(f"{node!r} is no expression")
    for part in parts[:1] if whole else parts:
        _check(part)


def _axes(node: Any) -> set[int]:
    if not isinstance(node, list):
        return set()
    op, *parts = node
    if op == "axis":
        return {parts[0]}
    return set().union(*(_axes(p) for p in (parts[:1] if op == "^" else parts)))


def _evaluated(node: Any, z: Any, over: bool = False) -> Any:
    """A node at points z (n, nz), or over boxes."""
    if not isinstance(node, list):
        return Interval.exact(float(node)) if over else float(node)
    op, *parts = node
    if op == "axis":
        return z[:, parts[0]]
    first = _evaluated(parts[0], z, over)
    if op == "^":
        return first ** parts[1] if over else functools.reduce(operator.mul, [first] * parts[1])
    if op in FUNCTIONS:
        return FUNCTIONS[op][1 if over else 0](first)
    rest = [_evaluated(p, z, over) for p in parts[1:]]
    return functools.reduce(operator.add if op == "+" else operator.mul, rest, first)


def _dual(node: Any, boxes: Interval, j: int) -> tuple[Interval, Interval | None]:
    """Ranges of a node and of its derivative along axis j; None for one that is 0."""
    if j not in _axes(node):
        return _evaluated(node, boxes, over=True), None
    op, *parts = node
    if op == "axis":
        return boxes[:, j], Interval.exact(1.0)
    value, slope = _dual(parts[0], boxes, j)
    if op == "^":
        n = parts[1]
        return value**n, slope if n == 1 or slope is None else value ** (n - 1) * float(n) * slope
    if op in FUNCTIONS:
        return FUNCTIONS[op][1](value), None if slope is None else FUNCTIONS[op][2](value) * slope
    for part in parts[1:]:
        v, s = _dual(part, boxes, j)
        if op == "+":
            value, slope = value + v, _sum(slope, s)
        else:
            slope = _sum(None if slope is None else slope * v, None if s is None else s * value)
            value = value * v
    return value, slope


def _sum(a: Interval | None, b: Interval | None) -> Interval | None:
    return b if a is None else a if b is None else a + b


def _running(node: Any, box: Interval) -> tuple[float, float]:
    """(largest |value|, bound on its computed error) over the box."""
    if not isinstance(node, list):
        return abs(float(node)), 0.0
    op, *parts = node
    size = float(_evaluated(node, box, over=True).mag.max())
    if op == "axis":
        return size, 0.0
    if op in FUNCTIONS:
        argument = _evaluated(parts[0], box, over=True)
        reach = _running(parts[0], box)[1]
        wide = argument + Interval(np.asarray(-reach), np.asarray(reach)) if isfinite(reach) else argument
        slope, value = (float(f(wide).mag.max()) for f in (FUNCTIONS[op][2], FUNCTIONS[op][1]))
        # Values err by 4 ulp at most; a slope that is unbounded stays so although nothing before it errs.
        return size, slope * reach + 5 * _EPS * value + _TINY if isfinite(slope) else np.inf
    found = [_running(parts[0], box)] * parts[1] if op == "^" else [_running(p, box) for p in parts]
    wide_sizes, errors = [m + e for m, e in found], [e for _, e in found]
    if op == "+":
        return size, sum(errors) + len(found) * _EPS * sum(wide_sizes)
    moved = sum(e * _others(wide_sizes, k) for k, e in enumerate(errors))
    lost = _TINY * prod(max(1.0, m) for m in wide_sizes)  # a product that underflows, and is multiplied again
    return size, moved + len(found) * (_EPS * prod(wide_sizes) + lost)


def _others(sizes: Sequence[float], k: int) -> float:
    return prod(m for n, m in enumerate(sizes) if n != k)


def _full(found: Interval, n: int) -> Interval:
    return Interval(np.broadcast_to(found.lo, (n,)), np.broadcast_to(found.hi, (n,)))
