"""Known functions of z that can be bounded over boxes: what a certificate may store, and what a proof may evaluate again."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np

from gapcert.plugin import Array, Interval


class Sloped(Protocol):
    """What is bounded together with its slopes, such as a predictor."""

    def over(self, boxes: Interval) -> Interval:
        """Contains p over each box, (n, nz) → (n, m)."""
        ...

    def jacobian_over(self, boxes: Interval) -> Interval:
        """Contains ∂p_i/∂z_j over each box, (n, m, nz)."""
        ...


class Function(ABC):
    """q of z, (n, nz) → (n, m), with enclosures of its values and gradients over boxes (n, nz), all rounded outwards.

    `kind` and `data` (JSON-able) say with `arrays` everything that determines it: `gapcert verify` makes it again from them.
    """

    kind: str

    @property
    @abstractmethod
    def n_out(self) -> int:
        """m."""

    @abstractmethod
    def __call__(self, z: Array) -> Array:
        """q(z), (n, nz) → (n, m); the bits of a row depend on no other row."""

    @abstractmethod
    def over(self, boxes: Interval) -> Interval:
        """Contains q over each box, (n, m)."""

    @abstractmethod
    def gradient_over(self, boxes: Interval, i: int) -> Interval:
        """Contains ∂q_i/∂z over each box, (n, nz); at kinks, all slopes on either side and between."""

    @abstractmethod
    def rounding(self, box: Interval) -> Array:
        """(m,): bound on |computed q − q| over the box (1, nz)."""

    @abstractmethod
    def data(self) -> Mapping[str, Any]:
        """What is not numbers."""

    @abstractmethod
    def arrays(self) -> dict[str, Array]:
        """What is."""

    def line_over(self, boxes: Interval, i: int) -> tuple[Array, Interval]:
        """(a, rest): q_i(z) − a · (z − c) lies in rest (n,) for every z of a box with middle c; a (n, nz)."""
        slope = self.gradient_over(boxes, i)
        at, a = self.over(Interval.exact(boxes.mid))[:, i], slope.mid
        return a, at + ((slope - a) * (boxes - boxes.mid)).sum(-1)

    def tight_over(self, boxes: Interval, plus: Sloped | None = None) -> Interval:
        """Contains q, or q + p, over each box, (n, m): from one corner along axes on which it is monotone.

        What is left shrinks with the square of the box. Slopes of q and p are added first, so that what they share cancels.
        """
        over, slope = self.over(boxes), Interval.stack([self.gradient_over(boxes, i) for i in range(self.n_out)], axis=1)
        if plus is None:
            return mean_value(boxes, slope, self.over).intersect(over)
        found = mean_value(boxes, slope + plus.jacobian_over(boxes), lambda z: self.over(z) + plus.over(z))
        return found.intersect(over + plus.over(boxes))


def mean_value(boxes: Interval, slope: Interval, value: Callable[[Interval], Interval]) -> Interval:
    """Contains f over each box, (n, m), where `slope` (n, m, k) contains its slopes there along the first k of nz axes and
    `value` (·, nz) → (·, m) contains f at points; along the other axes the boxes are points.

    f is largest at one end of every axis along which its slope has one sign, and smallest at the other: there it is exact. Of
    the other axes it has the mean-value form (R. E. Moore, Interval Analysis, 1966).
    """
    (n, m, k), nz = slope.shape, boxes.shape[1]
    rises, falls, (low, high) = slope.lo >= 0, slope.hi <= 0, (b[:, None, :k] for b in (boxes.lo, boxes.hi))
    # For the largest value (0) and the smallest (1): what is left of the box, per output.
    left = [
        Interval(np.where(up, high, low), np.where(up, high, np.where(down, low, high)))
        for up, down in ((rises, falls), (falls, rises))
    ]
    points = np.empty((2, n, m, nz))
    points[..., k:] = boxes.mid[:, None, k:]
    points[..., :k] = [part.mid for part in left]
    few, which = points.reshape(-1, nz), np.arange(2 * n * m)
    if m > 1:
        # Outputs often share a corner.
        few, which = np.unique(few, axis=0, return_inverse=True)
    at = value(Interval.exact(few))[which.reshape(2, n, m), np.arange(m)]
    ends = [at[side] + (slope * (part - part.mid)).sum(-1) for side, part in enumerate(left)]
    return Interval(ends[1].lo, ends[0].hi)
