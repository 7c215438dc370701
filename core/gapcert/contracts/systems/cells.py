"""Convex cells that tile a domain, each with its own constants and jumps: what bounds a residual with contact in it."""

from __future__ import annotations

import heapq
from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np

from gapcert.contracts.systems.domain import Domain
from gapcert.numerics.arrays import Array, Bools, Ints
from gapcert.numerics.errors import UsageError
from gapcert.numerics.intervals import Interval


@final
@dataclass(frozen=True)
class Cells:
    """|g_i(z) − g_i(z′)| ≤ Σ_j constants_cij |z_j − z′_j| + jumps_ci + 2 e_i for all z, z′ of Z in the closed cell c.

    The m cells are the leaves of a tree of cuts, so they tile [low, high] by construction: node k (root 0) sends z_axis ≤ cut
    to child[k, 0] and all other z to child[k, 1]; a child of −1 − c is cell c. constants (m, nx, nz); jumps (m, nx), 0 where
    nothing jumps; anchors (k, nz): points of Z at which samples are to be taken, at least one in every cell that meets Z.
    """

    low: Array
    high: Array
    axis: Ints
    cut: Array
    child: Ints
    constants: Array
    jumps: Array
    anchors: Array

    def __post_init__(self) -> None:
        nodes, m = len(self.axis), len(self.constants)
        leaves = np.sort(-1 - self.child[self.child < 0]) if nodes else np.zeros(1)
        inner = np.sort(self.child[self.child >= 0])
        ordered = (self.child > np.arange(nodes)[:, None]) | (self.child < 0)
        if not (np.array_equal(leaves, np.arange(m)) and np.array_equal(inner, np.arange(1, nodes)) and ordered.all()):
            raise UsageError("cells: the cuts are no tree; every node and every cell is the child of one node before it")
        for name, values in (("constants", self.constants), ("jumps", self.jumps)):
            if not (np.isfinite(values).all() and (values >= 0).all()):
                raise UsageError(f"cells: {name} hold a negative or non-finite number")
        _ = self.boxes

    def __len__(self) -> int:
        return len(self.constants)

    @cached_property
    def boxes(self) -> Interval:
        """The closed cells, (m, nz)."""
        return self._boxes(self.low, self.high)

    @cached_property
    def reach(self) -> Interval:
        """The cells with every side that lies on the border of the domain moved to infinity."""
        return self._boxes(np.full(len(self.low), -np.inf), np.full(len(self.low), np.inf))

    @property
    def marked(self) -> Bools:
        """(m,): where something jumps."""
        return np.asarray((self.jumps > 0).any(axis=1))

    @property
    def volume(self) -> Array:
        """(m,) share of the box [low, high]."""
        return np.asarray(np.prod((self.boxes.hi - self.boxes.lo) / (self.high - self.low), axis=1))

    @property
    def worst(self) -> Array:
        """(nx, nz): the largest constants of all cells; where nothing jumps they hold across cells as well."""
        return np.asarray(self.constants.max(axis=0))

    def locate(self, z: Array) -> Ints:
        """(n,) the cell of each point; a point on a shared face belongs to the cell below it."""
        return self._walk(z, z, closed=False)[1]

    def meeting(self, boxes: Interval) -> tuple[Ints, Ints]:
        """(row, cell) of every cell that holds a point of a box, in order of rows; points belong to cells as in `locate`."""
        return self._walk(boxes.lo, boxes.hi, closed=False)

    def closures(self, z: Array) -> list[Ints]:
        """Per cell, the rows of z that lie in the closed cell: one on a shared face serves the cells on both sides."""
        rows, leaf = self._walk(z, z, closed=True)
        order = np.argsort(leaf, kind="stable")
        return np.split(rows[order], np.searchsorted(leaf[order], np.arange(1, len(self))))

    def bare(self, domain: Domain, z: Array) -> Ints:
        """The cells that may meet Z and whose closure holds none of the points z: nothing is known there."""
        empty = np.array([not len(rows) for rows in self.closures(z)])
        return np.flatnonzero(empty & ~domain.outside(self.boxes))

    def points(self, domain: Domain, r: Array, budget: int) -> Array:
        """The anchors, and up to `budget` points (n, nz) of Z: boxes, first the cells, are cut in three where bands are loose.

        A box with half-widths h leaves a band of about Σ_j L_cij h_j in state i; its cost is that, relative to the mean gap of
        the state (r: residuals seen) and weighted by volume. The jump of a cell is the same for all its boxes.
        """
        scale = np.maximum(np.abs(r).mean(axis=0), np.finfo(float).tiny)
        weights = (self.constants / scale[:, None]).sum(axis=1)
        boxes = self.boxes
        heap = [_entry(c, c, boxes.mid[c], boxes.rad[c], weights[c]) for c in range(len(self))]
        heapq.heapify(heap)
        points = list(self.anchors)
        age, most = len(heap), len(points) + budget
        while len(points) + 2 <= most and heap[0][0] < 0:
            _, _, c, centre, h = heapq.heappop(heap)
            j = int(np.argmax(weights[c] * h))
            third = h.copy()
            third[j] /= 3
            for side in (-1, 0, 1):
                child = centre.copy()
                child[j] += 2 * third[j] * side
                heapq.heappush(heap, _entry(age, c, child, third, weights[c]))
                age += 1
                if side and domain.contains(child[None])[0]:
                    points.append(child)
        return np.array(points)

    def arrays(self) -> dict[str, Array]:
        """What a certificate stores of them."""
        tree = {"axis": self.axis.astype(np.float64), "cut": self.cut, "child": self.child.astype(np.float64)}
        return {f"cells.{k}": v for k, v in {**tree, "L": self.constants, "J": self.jumps}.items()}

    def _boxes(self, low: Array, high: Array) -> Interval:
        lo, hi = np.empty((2, len(self), len(low)))
        waiting = {0: (low, high)} if len(self.axis) else {-1: (low, high)}
        for k, (j, cut) in enumerate(zip(self.axis, self.cut, strict=True)):
            a, b = waiting.pop(k)
            if not a[j] < cut < b[j]:
                raise UsageError(f"cells: cut {k} at {cut:g} lies outside the box that it divides, [{a[j]:g}, {b[j]:g}]")
            for child, (side_lo, side_hi) in zip(self.child[k], ((a, _moved(b, j, cut)), (_moved(a, j, cut), b)), strict=True):
                waiting[int(child)] = side_lo, side_hi
        for child, (a, b) in waiting.items():
            lo[-1 - child], hi[-1 - child] = a, b
        return Interval(lo, hi)

    def _walk(self, low: Array, high: Array, closed: bool) -> tuple[Ints, Ints]:
        """(row, cell) pairs of rows [low, high] and cells that they meet, by row and then by cell."""
        rows = np.arange(len(low))
        node = np.full(len(low), 0 if len(self.axis) else -1, dtype=np.intp)
        found: list[tuple[Ints, Ints]] = []
        while len(rows):
            leaf = node < 0
            found.append((rows[leaf], -1 - node[leaf]))
            rows, node = rows[~leaf], node[~leaf]
            j, cut = self.axis[node], self.cut[node]
            below = low[rows, j] <= cut
            above = high[rows, j] >= cut if closed else high[rows, j] > cut
            node = np.concatenate([self.child[node[below], 0], self.child[node[above], 1]])
            rows = np.concatenate([rows[below], rows[above]])
        row, cell = (np.concatenate(part) if found else np.zeros(0, dtype=np.intp) for part in zip(*found, strict=True))
        order = np.lexsort((cell, row))
        return row[order], cell[order]


def _moved(side: Array, axis: int, value: float) -> Array:
    out = side.copy()
    out[axis] = value
    return out


def _entry(age: int, cell: int, centre: Array, half: Array, weight: Array) -> tuple[float, int, int, Array, Array]:
    # Ages are unique, so that equal costs never compare arrays, and the order is that of creation.
    return -float(np.prod(half) * (weight @ half)), age, cell, centre, half
