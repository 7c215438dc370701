"""Weighted sums of products and expressions: known functions whose numbers are their weights."""

from __future__ import annotations

import functools
import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal, final

import numpy as np

from gapcert.plugin import Array, Interval

from .bounded_function import Function
from .expression import Expression

_EPS = float(np.finfo(np.float64).eps)
_TINY = float(np.finfo(np.float64).tiny)


@final
@dataclass(frozen=True)
class Factor:
    """x^number, |x|^number, sin(number x) or cos(number x) of the coordinate x of one axis."""

    axis: int
    kind: Literal["power", "abs", "sin", "cos"]
    number: float

    def __post_init__(self) -> None:
        wave = self.kind in ("sin", "cos") and np.isfinite(self.number) and self.number >= 0
        if not (self.axis >= 0 and (wave or (self.kind in ("power", "abs") and self.number in range(1, 1000)))):
            raise ValueError(f"[{self.axis}, {self.kind!r}, {self.number}] is no factor")

    def value(self, x: Array) -> Array:
        if self.kind in ("sin", "cos"):
            return np.asarray((np.sin if self.kind == "sin" else np.cos)(x if self.number == 1 else x * self.number))
        out = base = np.abs(x) if self.kind == "abs" else x
        for _ in range(int(self.number) - 1):
            out = out * base
        return out

    def over(self, x: Interval) -> Interval:
        if self.kind in ("sin", "cos"):
            y = x * self.number
            return y.sin() if self.kind == "sin" else y.cos()
        return (abs(x) if self.kind == "abs" else x) ** int(self.number)

    def derivative_over(self, x: Interval) -> Interval:
        """Contains the derivative everywhere in x; across the kink of abs, both slopes with all between."""
        if self.kind in ("sin", "cos"):
            y = x * self.number
            return y.cos() * self.number if self.kind == "sin" else y.sin() * -self.number
        n = int(self.number)
        if self.kind == "power":
            return x ** (n - 1) * n
        return abs(x) ** (n - 1) * x.sign() * n

    def error(self, largest: float) -> float:
        """Bound on |computed value − value| for |x| ≤ largest."""
        if self.kind in ("sin", "cos"):
            return _EPS * (4 + self.number * largest)
        return _EPS * self.number * float(largest**self.number)


@final
@dataclass(frozen=True)
class Term:
    """A product of factors; none at all is the constant 1."""

    text: str
    factors: tuple[Factor, ...]

    def value(self, z: Array) -> Array:
        """(n, nz) → (n,)."""
        if not self.factors:
            return np.ones(len(z))
        return np.asarray(functools.reduce(operator.mul, [f.value(z[:, f.axis]) for f in self.factors]))

    def over(self, boxes: Interval) -> Interval:
        """(n, nz) → (n,)."""
        return _product(boxes, [f.over(boxes[:, f.axis]) for f in self.factors])

    def derivative_over(self, boxes: Interval, j: int) -> Interval:
        """Contains ∂/∂z_j over each box, by the product rule."""
        total = Interval.exact(np.zeros(len(boxes)))
        for k, f in enumerate(self.factors):
            if f.axis == j:
                others = [g.over(boxes[:, g.axis]) for m, g in enumerate(self.factors) if m != k]
                total = total + _product(boxes, [f.derivative_over(boxes[:, j]), *others])
        return total

    @property
    def axes(self) -> set[int]:
        """The axes that it involves."""
        return {f.axis for f in self.factors}

    def slope(self, box: Interval) -> Array:
        """(nz,) sup |∂/∂z_j| over a box (1, nz), rounded up."""
        return np.array([self.derivative_over(box, j).mag[0] for j in range(box.shape[1])])

    def mean(self, box: Interval) -> float:
        """Over a box (1, nz): one-dimensional Gauss–Legendre integrals, split at the kink of abs."""
        total = 1.0
        for j in self.axes:
            low, high = float(box.lo[0, j]), float(box.hi[0, j])
            ends = [low, 0.0, high] if low < 0 < high else [low, high]
            total *= sum(self._integral(j, a, b) for a, b in pairwise(ends)) / (high - low)
        return total

    def _integral(self, j: int, low: float, high: float) -> float:
        nodes, weights = np.polynomial.legendre.leggauss(64)
        x = (low + high) / 2 + (high - low) / 2 * nodes
        values = np.prod([f.value(x) for f in self.factors if f.axis == j], axis=0)
        return float(weights @ values * (high - low) / 2)

    def error(self, box: Interval) -> float:
        """Bound on |computed value − value| over a box (1, nz)."""
        largest = box.mag[0]
        sizes = [float(f.over(box[:, f.axis]).mag[0]) for f in self.factors]
        total = len(sizes) * _EPS * float(np.prod(sizes))
        for k, f in enumerate(self.factors):
            total += f.error(float(largest[f.axis])) * float(np.prod(sizes[:k] + sizes[k + 1 :]))
        return 2 * total

    def data(self) -> list[list[object]]:
        return [[f.axis, f.kind, f.number] for f in self.factors]


def _product(boxes: Interval, parts: Sequence[Interval]) -> Interval:
    return functools.reduce(operator.mul, parts, Interval.exact(np.ones(len(boxes))))


def term(data: Any, text: str = "") -> Term | Expression:
    """From what `Term.data` or `Expression.data` gave; ValueError where it is neither."""
    if isinstance(data, list) and all(isinstance(f, list) and len(f) == 3 and isinstance(f[0], int) for f in data):
        return Term(text, tuple(Factor(*f) for f in data))
    return Expression(text, data)


@final
@dataclass(frozen=True)
class WeightedSum(Function):
    """q_i(z) = Σ_l weights_il p_l(z). weights (m, number of terms)."""

    terms: tuple[Term | Expression, ...]
    weights: Array
    kind = "sum"

    @property
    def n_out(self) -> int:
        return len(self.weights)

    def __call__(self, z: Array) -> Array:
        return weighted(self.terms, self.weights, z)

    def over(self, boxes: Interval) -> Interval:
        total = Interval.exact(np.zeros((len(boxes), self.n_out)))
        for k, p in enumerate(self.terms):
            total = total + p.over(boxes)[:, None] * Interval.exact(self.weights[:, k])
        return total

    def gradient_over(self, boxes: Interval, i: int) -> Interval:
        columns = []
        for j in range(boxes.shape[1]):
            total = Interval.exact(np.zeros(len(boxes)))
            for p, w in zip(self.terms, self.weights[i], strict=True):
                if w and j in p.axes:
                    total = total + p.derivative_over(boxes, j) * float(w)
            columns.append(total)
        return Interval.stack(columns, axis=1)

    def rounding(self, box: Interval) -> Array:
        sizes = np.array([p.over(box).mag[0] for p in self.terms])
        errors = np.array([p.error(box) for p in self.terms])
        count = len(self.terms) + 2
        return np.asarray(np.abs(self.weights) @ (errors + 2 * count * _EPS * sizes) + count * _TINY)

    def data(self) -> Mapping[str, Any]:
        return {"functions": [p.data() for p in self.terms], "text": [p.text for p in self.terms]}

    def arrays(self) -> dict[str, Array]:
        return {"weights": self.weights}

    @classmethod
    def stored(cls, data: Mapping[str, Any], arrays: Mapping[str, Array]) -> WeightedSum:
        """From what `data` and `arrays` hold; ValueError where there is not one finite weight per function."""
        terms, weights = tuple(term(p, t) for p, t in zip(data["functions"], data["text"], strict=True)), arrays["weights"]
        if weights.ndim != 2 or weights.shape[1] != len(terms) or not np.isfinite(weights).all():
            raise ValueError(f"weights of shape {weights.shape} for {len(terms)} functions, or some are not finite")
        return cls(terms, weights)


def weighted(terms: Sequence[Term | Expression], weights: Array, z: Array) -> Array:
    """Σ_l w_il p_l(z), (n, nx), summed term by term so that a point's bits do not depend on its batch."""
    total = np.zeros((len(weights), len(z)))
    for k, p in enumerate(terms):
        value = p.value(z)
        for i in range(len(weights)):
            total[i] += value * weights[i, k]
    return np.ascontiguousarray(total.T)
