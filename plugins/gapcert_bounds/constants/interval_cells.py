"""The domain cut into convex cells where slopes proved by intervals differ, so that a steep part costs nothing elsewhere."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import final

import numpy as np

from gapcert import Array, Domain, Interval
from gapcert.plugin import Cells
from gapcert_bounds.thresholds import THRESHOLDS

from .cell_tree import Leaf, Tree


@final
@dataclass(frozen=True)
class Slopes:
    """What cells are cut by: `of` boxes (n, nz), bounds (n, nx, nz) of |∂g_i/∂z_j|; `everywhere` (nx, nz) holds on Z; `axes`
    that may be cut; a cell is looked at in about `parts` boxes."""

    domain: Domain
    of: Callable[[Interval], Array]
    everywhere: Array
    axes: tuple[int, ...]
    parts: int

    @property
    def counts(self) -> tuple[int, ...]:
        """Parts of a cell per axis: 2, 4 or 8, and 1 along axes that are not cut."""
        most = int(np.log2(max(1, self.parts)) / max(1, len(self.axes)))
        count = int(np.clip(2**most, 2, THRESHOLDS.finest_cut))
        return tuple(count if j in self.axes else 1 for j in range(len(self.domain.low)))

    @property
    def price(self) -> Array:
        """(nx, nz): what a constant adds to a band, all states alike: Σ_j L_ij width_j relative to that of the whole domain."""
        each = self.everywhere * self.domain.width
        return np.asarray(self.domain.width / np.maximum(each.sum(axis=1, keepdims=True), np.finfo(float).tiny))


@final
class _Patch:
    """A leaf, and bounds of the slopes in each of its parts (*counts, nx, nz), none above `known`."""

    def __init__(self, leaf: Leaf, slopes: Slopes, known: Array) -> None:
        self.leaf, self.slopes = leaf, slopes
        counts = slopes.counts
        self.edges = [np.linspace(a, b, n + 1) for a, b, n in zip(leaf.low, leaf.high, counts, strict=True)]
        low, high = (np.stack(np.meshgrid(*ends, indexing="ij"), axis=-1) for ends in self._ends)
        boxes = Interval(low.reshape(-1, len(counts)), high.reshape(-1, len(counts)))
        found = np.minimum(slopes.of(boxes), known)
        # Z and a cell are convex: between two points of both no slope is met in parts that do not meet Z.
        found[slopes.domain.outside(boxes)] = 0.0
        self.found = found.reshape(*counts, *known.shape)
        each = (self.found * slopes.price).sum(axis=(-2, -1))
        # What would be gained if every part were a cell.
        self.promise = float(np.prod(leaf.width / slopes.domain.width)) * (self._cost(self.found) - float(each.mean()))

    @property
    def _ends(self) -> tuple[list[Array], list[Array]]:
        return [e[:-1] for e in self.edges], [e[1:] for e in self.edges]

    @property
    def constants(self) -> Array:
        """(nx, nz): hold in the closed cell."""
        return _largest(self.found)

    def cuts(self) -> Iterator[tuple[int, float, Array, Array]]:
        """(axis, cut, constants of either half) of every cut between parts, the one that gains most first."""
        made, whole = [], self._cost(self.found)
        for j in self.slopes.axes:
            n = self.found.shape[j]
            for k in range(1, n):
                halves = np.split(self.found, [k], axis=j)
                left = k / n * self._cost(halves[0]) + (1 - k / n) * self._cost(halves[1])
                # Where no single cut gains anything, the middle of a wide axis comes first.
                wide = self.leaf.width[j] / self.slopes.domain.width[j]
                gain = float(np.round(1 - left / whole, 12)) if whole else 0.0
                if self.leaf.low[j] < self.edges[j][k] < self.leaf.high[j]:
                    made.append(((-gain, -wide, abs(2 * k - n), j, k), halves))
        for (_, _, _, j, k), (below, above) in sorted(made, key=lambda m: m[0]):
            yield j, float(self.edges[j][k]), _largest(below), _largest(above)

    def _cost(self, found: Array) -> float:
        return float((_largest(found) * self.slopes.price).sum())


def cells(slopes: Slopes, most: int) -> Cells:
    """At most so many cells, cut one by one where that promises most, with constants that are proved in each."""
    domain = slopes.domain
    tree = Tree(domain.low, domain.high)
    patches = [_Patch(tree.leaves[0], slopes, slopes.everywhere)]
    total, closed = float((slopes.everywhere * slopes.price).sum()), set[int]()
    while len(patches) < most:
        promises = [0.0 if id(p.leaf) in closed else p.promise for p in patches]
        if sum(promises) <= THRESHOLDS.cut_gain * total:
            break
        at = int(np.argmax(promises))
        patch = patches[at]
        for axis, cut, *known in patch.cuts():
            halves = patch.leaf.halves(axis, cut)
            if all(_point(half, domain) is not None for half in halves):
                tree.replace(patch.leaf, axis, cut, halves)
                patches[at : at + 1] = [_Patch(half, slopes, own) for half, own in zip(halves, known, strict=True)]
                break
        else:
            closed.add(id(patch.leaf))
    constants = np.array([p.constants for p in patches])
    anchors = np.array([point for p in patches if (point := _point(p.leaf, domain)) is not None])
    return Cells(domain.low, domain.high, *tree.cuts(), constants, np.zeros(constants.shape[:2]), anchors)


def _largest(found: Array) -> Array:
    return np.asarray(found.max(axis=tuple(range(found.ndim - 2))))


def _point(leaf: Leaf, domain: Domain) -> Array | None:
    """A point of Z in the cell: its middle, moved where relations ask for it; None where none is found."""
    (point,), (known,) = leaf.within(domain, Interval(leaf.low[None], leaf.high[None]).mid)
    return point if known else None
