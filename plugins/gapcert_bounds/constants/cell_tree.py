"""A box cut into cells, one cut at a time, and what is known of each cell while it is searched for jumps."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import final

import numpy as np

from gapcert.plugin import Array, Bools, Domain, Interval, Ints


@final
@dataclass(eq=False)
class Leaf:
    """A cell: its box, the box around it whose pairs make its constants, and how much its edges jump along each axis."""

    low: Array
    high: Array
    region: tuple[Array, Array]
    slot: tuple[int, int] = (-1, 0)
    crossing: Array = field(default_factory=lambda: np.zeros(0))
    searched: bool = False
    whole: bool = False

    @property
    def width(self) -> Array:
        return self.high - self.low

    def holds(self, low: Array, high: Array) -> Bools:
        """(n,): the closed box meets the boxes [low, high] (n, nz)."""
        return np.asarray(((low <= self.high) & (high >= self.low)).all(axis=1))

    def within(self, domain: Domain, z: Array) -> tuple[Array, Bools]:
        """(points z (n, nz) moved into Z, which of them then lie in Z and in the closed box)."""
        boxes = Interval(np.broadcast_to(self.low, z.shape), np.broadcast_to(self.high, z.shape))
        moved = domain.inside(z, boxes)
        return moved, np.asarray(domain.contains(moved) & self.holds(moved, moved))

    def point(self, domain: Domain) -> Array | None:
        """A point of Z in the cell: its middle, moved where relations ask for it; None where none is found."""
        (point,), (known,) = self.within(domain, Interval(self.low[None], self.high[None]).mid)
        return point if known else None

    def halves(self, axis: int, cut: float) -> tuple[Leaf, Leaf]:
        """The two sides of a cut; they keep the region."""
        below, above = self.high.copy(), self.low.copy()
        below[axis] = above[axis] = cut
        return Leaf(self.low, below, self.region), Leaf(above, self.high, self.region)

    def corners(self) -> Array:
        """(2^nz, nz); bit j of a corner's number says at which end of axis j it lies."""
        bits = (np.arange(1 << len(self.low))[:, None] >> np.arange(len(self.low))) & 1
        return np.where(bits == 1, self.high, self.low)


@final
class Tree:
    """Cuts and leaves, as `Cells` wants them."""

    def __init__(self, low: Array, high: Array) -> None:
        self.low, self.high = low, high
        self.leaves = [Leaf(low, high, (low, high))]
        self._axis: list[int] = []
        self._cut: list[float] = []
        self._child: list[list[int]] = []

    def replace(self, leaf: Leaf, axis: int, cut: float, halves: tuple[Leaf, Leaf]) -> None:
        """Cut a leaf in two."""
        node, at = len(self._axis), self.leaves.index(leaf)
        self._axis.append(axis)
        self._cut.append(cut)
        self._child.append([-1, -1])
        if leaf.slot[0] >= 0:
            self._child[leaf.slot[0]][leaf.slot[1]] = node
        for side, half in enumerate(halves):
            half.slot = (node, side)
        self.leaves[at : at + 1] = halves

    def cuts(self) -> tuple[Ints, Array, Ints]:
        """(axis, cut, child) with the leaves numbered in their order here."""
        child = [list(pair) for pair in self._child]
        for number, leaf in enumerate(self.leaves):
            if leaf.slot[0] >= 0:
                child[leaf.slot[0]][leaf.slot[1]] = -1 - number
        shape = np.array(child, dtype=np.intp).reshape(-1, 2)
        return np.array(self._axis, dtype=np.intp), np.array(self._cut, dtype=np.float64), shape


def edges(nz: int) -> tuple[Ints, Ints, Ints]:
    """(corner, other corner, axis) of every edge of a box, corners numbered as in `Leaf.corners`."""
    numbers = np.arange(1 << nz)
    parts = [(numbers[(numbers >> j) & 1 == 0], j) for j in range(nz)]
    first = np.concatenate([low for low, _ in parts])
    axis = np.concatenate([np.full(len(low), j) for low, j in parts])
    return first, first | (1 << axis), axis
