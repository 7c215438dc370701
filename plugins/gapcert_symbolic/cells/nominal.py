"""f over cells, for groups of inputs at once."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import final

import numpy as np

from gapcert import Array, Interval
from gapcert.plugin import Ints
from gapcert_symbolic.thresholds import THRESHOLDS

from .bounds import Bound
from .grid import Blocks, Grid, View, corners, flat

ROWS = 20_000


@final
@dataclass(frozen=True)
class Nominal:
    """f over cells at one input value v per group of inputs, and the slope that carries it to the group's other inputs.

    f(x, u) ∈ f(x, v) + J_u (u − v), with J_u the Jacobian over the cell and the group (mean-value theorem in u alone).
    middle, low, high (groups, nu): v and the hull of the group. of (m,), offset (m, nu): group of each input and u − v.
    axes: those whose successors are asked for.
    """

    bound: Bound
    grid: Grid | View
    middle: Array
    low: Array
    high: Array
    of: Ints
    offset: Array
    axes: tuple[int, ...]

    @classmethod
    def of_groups(
        cls, bound: Bound, grid: Grid | View, axes: tuple[Array, ...], size: int, asked: tuple[int, ...] | None = None
    ) -> Nominal:
        """At most `size` groups per input."""
        blocks = [Blocks.cut(len(a), min(len(a), size)) for a in axes]
        ends = [(a[b.starts[:-1]], a[b.starts[1:] - 1]) for a, b in zip(axes, blocks, strict=True)]
        low, high = corners([e[0] for e in ends], [e[1] for e in ends])
        middle, of = low + (high - low) / 2, flat(blocks)
        asked = tuple(range(len(grid.states))) if asked is None else asked
        return cls(bound, grid, middle, low, high, of, corners(list(axes), list(axes))[0] - middle[of], asked)

    @classmethod
    def coarsest(
        cls, bound: Bound, grid: Grid | View, axes: tuple[Array, ...], asked: tuple[int, ...] | None = None
    ) -> Nominal:
        """As few groups as lose at most a thousandth of a cell anywhere; none where there are few pairs."""
        size = (
            1
            if bound.groups and grid.size * math.prod(len(a) for a in axes) > THRESHOLDS.single_pairs
            else max(len(a) for a in axes)
        )
        while not (found := cls.of_groups(bound, grid, axes, size, asked)).tight():
            size *= 2
        return found

    @property
    def direct(self) -> bool:
        """Is every input its own group?"""
        return len(self.middle) == len(self.of)

    def tight(self) -> bool:
        step = max(1, ROWS // len(self.middle))
        return self.direct or all(self._loss(k, k + step) <= THRESHOLDS.shared_change for k in range(0, self.grid.size, step))

    def _loss(self, start: int, stop: int) -> float:
        # Two Jacobians in the interval differ by at most its width; the farthest input is half a group away.
        slope = self.slopes(start, stop)[:, :, [self.grid.states[k] for k in self.axes]]
        with np.errstate(invalid="ignore"):
            loss = ((slope.hi - slope.lo) * (self.high - self.middle)[:, None, :]).sum(-1)
            loss = loss / self.grid.widths[list(self.axes)]
        return float(loss.max()) if np.isfinite(loss).all() else np.inf

    def over(self, start: int, stop: int) -> Interval:
        """f over cells start … stop − 1 at each group's v: (cells, groups, nx)."""
        (low, high), m = self.grid.cells(start, stop), len(self.middle)
        n, nx = low.shape
        box = self.bound.over(np.repeat(low, m, axis=0), np.repeat(high, m, axis=0), self.middle, np.tile(np.arange(m), n))
        return box.reshape(n, m, nx)

    def slopes(self, start: int, stop: int) -> Interval:
        """J_u over cells start … stop − 1 and each group: (cells, groups, nx, nu)."""
        (low, high), (m, nu) = self.grid.cells(start, stop), self.low.shape
        n, nx = low.shape
        z = Interval(
            np.concatenate([np.repeat(low, m, axis=0), np.tile(self.low, (n, 1))], axis=1),
            np.concatenate([np.repeat(high, m, axis=0), np.tile(self.high, (n, 1))], axis=1),
        )
        return self.bound.model.jacobian_enclosure(z)[:, :, nx:].reshape(n, m, nx, nu)
