"""Known functions of z that can be bounded over boxes: what a certificate may store, and what a proof may evaluate again."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from gapcert.intervals import Interval

Array = npt.NDArray[np.float64]


class Function(ABC):
    """q of z, (n, nz) → (n, m), with enclosures of its values and gradients over boxes (n, nz), all rounded outwards.

    `kind` and `data` (JSON-able) say with `arrays` everything that determines it: `gapcert.stored.function` makes it again.
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

    def tight_over(self, boxes: Interval) -> Interval:
        """`over`, or the range of lines where that is tighter, as it is on small boxes: (n, m)."""
        moved, parts = boxes - boxes.mid, []
        for i in range(self.n_out):
            a, rest = self.line_over(boxes, i)
            parts.append(rest + (moved * a).sum(-1))
        return Interval.stack(parts, axis=1).intersect(self.over(boxes))
