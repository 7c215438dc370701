"""One side of a multilinear band, as what route dominate lifts functions above: smooth where an envelope has ridges."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np
import numpy.typing as npt

from gapcert.plugin import Array, Interval, highest, interpolate, rounding

from .lifting import Bounded

_EPS = float(np.finfo(np.float64).eps)


@final
@dataclass(frozen=True)
class Band:
    """t(z) = I g + Σ_j b_j(z_j) + s between the nodes `axes`, of which there is one or that reach to both ends of the box.

    g (n_0, …) are the nodes' values. b_j = f_j (z_j − a)(b − z_j) in the cell [a, b] of axis j, with f_j = min(H_j / 2,
    2 L_j / (b − a)) in `factors` (cells,); b_j = L_j |z_j − a| along an axis with the single node a.
    """

    box: Interval
    axes: tuple[Array, ...]
    g: Interval
    factors: tuple[Array, ...]
    constants: Array
    slack: float

    @classmethod
    def of(
        cls, box: Interval, axes: Sequence[Array], g: Interval, bends: Sequence[Array], constants: Array, slack: float
    ) -> Band:
        """bends: H_j (cells,) per axis, ∞ where nothing is known of it."""
        made = []
        for a, bend, constant in zip(axes, bends, constants, strict=True):
            # Three roundings, each by half an eps.
            made.append(np.minimum(bend / 2, 2 * constant / np.diff(a) * (1 + 4 * _EPS)) if len(a) > 1 else np.zeros(0))
        return cls(box, tuple(axes), g, tuple(made), constants, slack)

    def __len__(self) -> int:
        return int(np.prod(self.g.shape))

    @cached_property
    def size(self) -> float:
        """max |g|."""
        return float(self.g.mag.max())

    def lifted(self, boxes: Interval, slope: Array, bend: Array) -> Bounded:
        """I g − m · (z − c) is largest at a corner of what nodes cut out of the box; b_j are bounded apart."""
        centre, h = boxes.mid, boxes.rad
        most = highest(self.axes, self.g.mid[..., None], boxes.lo, boxes.hi, slope)
        steep = (np.abs(slope) * h).sum(axis=1)
        for j in range(len(self.axes)):
            most = most + self._bump(j, boxes.lo[:, j], boxes.hi[:, j])
        # Errors of interpolated values and of the nodes', and some forty roundings of sums of the sizes that follow.
        error = rounding(len(self.axes)) * self.size + float(self.g.rad.max()) + 64 * _EPS * (self.size + steep + np.abs(most))
        at = self._value(centre)
        axis = np.where(h > 0, bend * h, -np.inf).argmax(axis=1)
        return Bounded(most + self.slack + error, at, axis, self._knot(boxes, centre, axis))

    def _bump(self, j: int, low: Array, high: Array) -> Array:
        """sup b_j over [low, high], (n,), rounded up."""
        a, f = self.axes[j], self.factors[j]
        if len(a) < 2:
            return np.asarray(np.maximum(np.abs(low - a[0]), np.abs(high - a[0])) * self.constants[j] * (1 + 4 * _EPS))
        first = np.clip(np.searchsorted(a, low, "right") - 1, 0, len(f) - 1)
        last = np.maximum(first, np.clip(np.searchsorted(a, high) - 1, 0, len(f) - 1))
        parts = []
        for k in (first, last):
            x = np.clip((a[k] + a[k + 1]) / 2, low, high)
            # A middle that is off by d falls short of the top by d², and d is below an eps of the ends.
            missed = (_EPS * np.maximum(np.abs(a[k]), np.abs(a[k + 1]))) ** 2
            parts.append(f[k] * (np.maximum(x - a[k], 0) * np.maximum(a[k + 1] - x, 0) + missed))
        top = float((f * np.diff(a) ** 2).max()) / 4
        most = np.where(last - first > 1, top, np.maximum(*parts))
        return np.asarray(most * (1 + 16 * _EPS))

    def _value(self, z: Array) -> Array:
        """About t at points."""
        inner = interpolate(self.axes, self.g.mid[..., None], z)[:, 0] + self.slack
        for j in range(len(self.axes)):
            inner = inner + self._bump(j, z[:, j], z[:, j])
        return np.asarray(inner)

    def _knot(self, boxes: Interval, centre: Array, axis: npt.NDArray[np.intp]) -> Array:
        """The node nearest to the middle, where there is one inside; else the middle."""
        rows = np.arange(len(axis))
        x, half = centre[rows, axis], (boxes.hi - boxes.lo)[rows, axis] / 2
        for j, a in enumerate(self.axes):
            own = np.flatnonzero(axis == j)
            k = np.clip(np.searchsorted(a, x[own]), 1, max(1, len(a) - 1))
            pair = np.stack([a[k - 1], a[np.minimum(k, len(a) - 1)]])
            near = np.where(np.abs(pair[0] - x[own]) <= np.abs(pair[1] - x[own]), *pair)
            x[own] = np.where(np.abs(near - x[own]) < 0.9 * half[own], near, x[own])
        return np.asarray(x)
