"""Route dominate: shifts that lift a known function above an envelope on the whole domain, proved by branch and bound.

Let t(z) = min_k g_k + Σ_j L_j |z_j − z_kj| + s be the upper side of an envelope, and q any function. Over a box with centre c
and half-widths h, where q(z) ≥ q̲ + m · (z − c), for every sample k

    t(z) − q(z) ≤ g_k + s − q̲ + Σ_j max(A_j(+h_j), A_j(−h_j)),   A_j(τ) = L_j |c_j + τ − z_kj| − m_j τ,

since A_j is convex in τ. Shifts hold per cell of a coarse table. The lower side is the upper one of −g and −q.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Protocol, final

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from gapcert.plugin import Array, Interval, UsageError, Zone, highest, interpolate, rounding

from .bounded_function import Function

Index = npt.NDArray[np.intp]

_EPS = float(np.finfo(np.float64).eps)
_BATCH = 4096  # boxes that are cut in a round; chosen, not measured
_NEAR = 24  # samples that a box looks at


@final
@dataclass(frozen=True)
class Table:
    """Cells between `edges` (per axis, increasing, both ends of Z included), last axis fastest; a point on a shared face
    belongs to the cell below it."""

    edges: tuple[Array, ...]

    @classmethod
    def uniform(cls, low: Sequence[float], high: Sequence[float], counts: Sequence[int]) -> Table:
        """`counts` cells of equal size per axis."""
        if len(counts) != len(low) or min(counts) < 1:
            raise UsageError(f"gap.cells: found {list(counts)}; expected {len(low)} numbers from 1 on, one per state and input")
        return cls(tuple(np.linspace(a, b, n + 1) for a, b, n in zip(low, high, counts, strict=True)))

    @property
    def counts(self) -> tuple[int, ...]:
        return tuple(len(e) - 1 for e in self.edges)

    def __len__(self) -> int:
        return int(np.prod(self.counts))

    @cached_property
    def boxes(self) -> Interval:
        """The closed cells, (m, nz)."""
        sides = [np.stack(np.meshgrid(*part, indexing="ij"), axis=-1).reshape(-1, len(self.edges)) for part in self._ends]
        return Interval(sides[0], sides[1])

    @property
    def _ends(self) -> tuple[list[Array], list[Array]]:
        return [e[:-1] for e in self.edges], [e[1:] for e in self.edges]

    def at(self, z: Array) -> Index:
        """Per axis, the number of each point's cell, (n, nz); points outside belong to the nearest cell."""
        return np.stack([np.searchsorted(e[1:-1], z[:, j], side="left") for j, e in enumerate(self.edges)], axis=1)

    def locate(self, z: Array) -> Index:
        """(n,) the cell of each point."""
        return np.asarray(np.ravel_multi_index(tuple(self.at(z).T), self.counts))


class Bounded(NamedTuple):
    """Per box (n,): upper ≥ t − q over it; about t − q at its centre; and where to cut it, across which axis."""

    upper: Array
    reached: Array
    axis: Index
    cut: Array

    def at(self, rows: Index) -> Bounded:
        return Bounded(*(a[rows] for a in self._asdict().values()))


class Part(Protocol):
    """t on a closed box (1, nz) of Z, from `len` samples."""

    @property
    def box(self) -> Interval: ...

    def __len__(self) -> int: ...

    def lifted(self, boxes: Interval, slope: Array, bend: Array) -> Bounded: ...


@final
@dataclass(frozen=True)
class Cones:
    """t(z) = min_k g_k + Σ_j L_j |z_j − z_kj| + s on a closed box; z (N, nz), g (N,), constants L (nz,)."""

    box: Interval
    z: Array
    g: Array
    constants: Array
    slack: float

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.z * self.constants)

    def __len__(self) -> int:
        return len(self.z)

    def near(self, z: Array) -> Index:
        """(n, k): some samples near each point, as the constants measure distance."""
        k = min(_NEAR, len(self.z))
        return np.asarray(self._tree.query(z * self.constants, k=k, p=1.0)[1]).reshape(len(z), k)

    def lifted(self, boxes: Interval, slope: Array, bend: Array) -> Bounded:
        """t(z) − slope · (z − c) over boxes. bend (nz,): about how much the slopes of q change along each axis."""
        centre, h, rows = boxes.mid, boxes.rad, np.arange(len(boxes))
        near = self.near(centre)
        g, d, m = self.g[near], centre[:, None, :] - self.z[near], slope
        at_centre = np.abs(d) * self.constants
        ends = [np.abs(d + side * h[:, None, :]) * self.constants + (-side * m * h)[:, None, :] for side in (1, -1)]
        largest = np.maximum(*ends)
        sums = g + largest.sum(axis=2)
        best = sums.argmin(axis=1)
        own = at_centre[rows, best]
        # Of every term's size, for its own rounding and that of the sums.
        size = np.abs(g[rows, best]) + (own + (self.constants + np.abs(m)) * h).sum(axis=1) + self.slack
        upper = sums[rows, best] + self.slack + 64 * _EPS * size
        at = g + at_centre.sum(axis=2)
        axis = np.where(h > 0, largest[rows, best] - own + bend * h / 4, -np.inf).argmax(axis=1)
        side = np.where(ends[0][rows, best, axis] >= ends[1][rows, best, axis], 1.0, -1.0)
        ridge = _ridge(at - at_centre[rows, :, axis], d[rows, :, axis], h[rows, axis], best, self.constants[axis], side)
        return Bounded(upper, at.min(axis=1) + self.slack, axis, centre[rows, axis] + ridge)


@final
@dataclass(frozen=True)
class Band:
    """One side of a multilinear band, smooth where an envelope has ridges: t(z) = I g + Σ_j b_j(z_j) + s.

    Per axis, the nodes `axes` are one, or reach to both ends of the box. g (n_0, …) are the nodes' values. b_j =
    f_j (z_j − a)(b − z_j) in the cell [a, b] of axis j, with f_j = min(H_j / 2, 2 L_j / (b − a)) in `factors` (cells,);
    b_j = L_j |z_j − a| along an axis with the single node a.
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

    def _knot(self, boxes: Interval, centre: Array, axis: Index) -> Array:
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


@final
class Side:
    """One side of an envelope, in parts, against output i of q; sign −1 for the lower side, whose cones hold −g."""

    def __init__(self, parts: Sequence[Part], q: Function, i: int, sign: int) -> None:
        self.parts, self.q, self.i, self.sign = parts, q, i, sign
        whole = Interval.hull(*(p.box for p in parts))
        self.bend = q.gradient_over(whole, i).rad[0]

    def bound(self, boxes: Interval, part: Index) -> Bounded:
        slope, rest = self.q.line_over(boxes, self.i)
        at = self.q(boxes.mid)[:, self.i]
        if self.sign < 0:
            slope, rest, at = -slope, -rest, -at
        n = len(boxes)
        found = Bounded(np.empty(n), np.empty(n), np.zeros(n, dtype=np.intp), np.empty(n))
        for p in np.unique(part):
            rows = np.flatnonzero(part == p)
            own = self.parts[p].lifted(boxes[rows], slope[rows], self.bend)
            found.upper[rows] = own.upper - rest.lo[rows] + 4 * _EPS * (np.abs(own.upper) + rest.mag[rows])
            found.reached[rows], found.axis[rows], found.cut[rows] = own.reached - at[rows], own.axis, own.cut
        return found


def _ridge(a: Array, d: Array, h: Array, best: Index, constant: Array, side: Array) -> Array:
    """Where, from the centre along one axis, the best cone a + L |d + τ| meets the smallest one of the box's end on that side
    (n,), since each half then has one cone; 0 where that is not well inside. a, d (n, k)."""
    rows = np.arange(len(a))
    other = (a + constant[:, None] * np.abs(d + (side * h)[:, None])).argmin(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        rise = side * (a[rows, other] - a[rows, best]) / (2 * constant)
        ridge = rise - (d[rows, best] + d[rows, other]) / 2
    return np.where((other != best) & (np.abs(ridge) < 0.95 * h), ridge, 0.0)


@final
@dataclass(frozen=True)
class Lift:
    """shift (m,) per cell of the table: q + shift ≥ t on Z. `boxes` were looked at; `open`: the share of cells that the budget
    left looser than the tolerance."""

    shift: Array
    boxes: int
    open: float


def lift(
    side: Side,
    table: Table,
    zone: Zone,
    tolerance: float,
    budget: int,
    known: Array | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Lift:
    """Shifts within `tolerance` of the smallest, or as good as `budget` boxes prove. With `known` shifts (m,), only whether
    these hold is decided, and a shift of the answer exceeds them where that was not proved."""
    boxes, cell, part = _first(side, table, zone)
    found = side.bound(boxes, part)
    top, low = np.full(len(table), -np.inf), np.full(len(table), -np.inf)
    np.maximum.at(low, cell, found.reached)
    spent = len(boxes)
    while True:
        goal = low + tolerance if known is None else known
        pending = ~(found.upper <= goal[cell])
        np.maximum.at(top, cell[~pending], found.upper[~pending])
        boxes, cell, part, found = boxes[pending], cell[pending], part[pending], found.at(np.flatnonzero(pending))
        progress(min(spent, budget), budget)
        if not len(boxes) or spent >= budget:
            break
        order = np.argsort(goal[cell] - found.upper, kind="stable")
        first, rest = order[:_BATCH], order[_BATCH:]
        halves = boxes[first].cut(found.axis[first], found.cut[first])
        own, which, parents = np.tile(cell[first], 2), np.tile(part[first], 2), np.tile(found.upper[first], 2)
        if zone.relations:
            keep = ~zone.outside(halves)
            halves, own, which, parents = halves[keep], own[keep], which[keep], parents[keep]
        spent += len(halves)
        new = side.bound(halves, which)
        np.maximum.at(low, own, new.reached)
        # A half lies inside its parent, whose bound holds for it as well.
        new = new._replace(upper=np.minimum(new.upper, parents))
        boxes = Interval.concatenate([boxes[rest], halves])
        cell, part = np.concatenate([cell[rest], own]), np.concatenate([part[rest], which])
        found = Bounded(*(np.concatenate(pair) for pair in zip(found.at(rest), new, strict=True)))
    np.maximum.at(top, cell, found.upper)
    # A cell that meets no point of Z promises nothing; it takes the largest shift of those that do.
    top = np.where(np.isfinite(top), top, top.max())
    return Lift(top, spent, len(np.unique(cell)) / len(table))


def _first(side: Side, table: Table, zone: Zone) -> tuple[Interval, Index, Index]:
    """Every common box of a cell of the table and a part of the envelope that may meet Z."""
    found: list[tuple[Interval, Index, Index]] = []
    for p, own in enumerate(side.parts):
        low, high = np.maximum(table.boxes.lo, own.box.lo), np.minimum(table.boxes.hi, own.box.hi)
        rows = np.flatnonzero((low <= high).all(axis=1))
        boxes = Interval(low[rows], high[rows])
        keep = ~zone.outside(boxes)
        if keep.any() and not len(own):
            raise ValueError("a part of the domain that may meet Z has no sample, and no bound")
        found.append((boxes[keep], rows[keep], np.full(int(keep.sum()), p)))
    boxes = Interval.concatenate([b for b, _, _ in found])
    return boxes, np.concatenate([c for _, c, _ in found]), np.concatenate([p for _, _, p in found])
