"""Weighted sums of products and expressions: known functions whose numbers are their weights."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from gapcert.plugin import Array, Interval

from .bounded_function import Function
from .expression import Expression
from .products import Factor, Term

_EPS = float(np.finfo(np.float64).eps)
_TINY = float(np.finfo(np.float64).tiny)


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
