"""One side of a multilinear band, as what route dominate lifts functions above: smooth where an envelope has ridges."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np
import numpy.typing as npt

from gapcert.interpolated import interpolated
from gapcert.interpolation import cells, rounding, slopes
from gapcert.intervals import Interval
from gapcert.lifting import Bounded

Array = npt.NDArray[np.float64]

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

    def lifted(self, boxes: Interval, slope: Array) -> Bounded:
        """t(z) − m · (z − c) ≤ t(c) + Σ_j sup |∂_j t − m_j| h_j."""
        centre, h = boxes.mid, boxes.rad
        at = self.at(centre)
        moved = Interval.exact((self.gradient_over(boxes) - slope).mag) * Interval.exact(h)
        gain = np.where(h > 0, moved.hi, -np.inf)
        axis = gain.argmax(axis=1)
        return Bounded((at + moved.sum(-1)).hi, at.lo, axis, self._knot(boxes, centre, axis))

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

    def at(self, z: Array) -> Interval:
        """Contains t at points, (n,)."""
        total = interpolated(self.axes, self.g.reshape(*self.g.shape, 1), z)[:, 0] + self.slack
        cell, _ = cells(self.axes, z, z)
        for j, (a, f) in enumerate(zip(self.axes, self.factors, strict=True)):
            if len(a) < 2:
                total = total + abs(Interval.exact(z[:, j]) - float(a[0])) * float(self.constants[j])
                continue
            x, low, high = np.clip(z[:, j], a[0], a[-1]), a[cell[:, j]], a[cell[:, j] + 1]
            total = total + (Interval.exact(x) - low) * (Interval.exact(high) - x) * Interval.exact(f[cell[:, j]])
        return total

    def gradient_over(self, boxes: Interval) -> Interval:
        """Contains every difference quotient of t along each axis inside boxes, (n, nz)."""
        middle = self.g.mid[..., None]
        low, high = (part[:, 0] for part in slopes(self.axes, middle, boxes.lo, boxes.hi, closed=False))
        shortest = np.array([np.diff(a).min(initial=np.inf) for a in self.axes])
        pad = (4 * rounding(len(self.axes)) * self.size + 2 * float(self.g.rad.max())) / shortest
        total = [Interval.around((low + high)[:, j] / 2, (high - low)[:, j] / 2 + pad[j]) for j in range(len(self.axes))]
        first, last = cells(self.axes, boxes.lo, boxes.hi)
        for j, (a, f) in enumerate(zip(self.axes, self.factors, strict=True)):
            if len(a) < 2:
                steep = Interval(np.full(len(boxes), -1.0), np.ones(len(boxes))) * float(self.constants[j])
                total[j] = total[j] + steep
                continue
            k = first[:, j]
            # f (a + b − 2 x) falls from f (b − a) to its negative in every cell.
            inside = (Interval.exact(a[k]) + a[k + 1] - boxes[:, j] * 2.0) * Interval.exact(f[k])
            most = (f * np.diff(a)).max() * (1 + 4 * _EPS)
            alone = last[:, j] == k
            own = Interval(np.where(alone, inside.lo, -most), np.where(alone, inside.hi, most))
            total[j] = total[j] + own
        return Interval.stack(total, axis=1)
