"""Large boxes of winning cells: a set of cells is not convex, and parts of it are."""

from __future__ import annotations

from itertools import product
from typing import NamedTuple, final

import numpy as np

from gapcert.plugin import Bools, Ints
from gapcert_mpc.thresholds import THRESHOLDS


@final
class Box(NamedTuple):
    """Cells first ≤ i < after, per axis."""

    first: Ints
    after: Ints

    @property
    def slices(self) -> tuple[slice, ...]:
        return tuple(slice(a, b) for a, b in zip(self.first.tolist(), self.after.tolist(), strict=True))


@final
class Sums:
    """How many of the cells in a box are winning, by 2ⁿ sums of all cells before a corner."""

    def __init__(self, winning: Bools) -> None:
        self.sums = np.pad(winning.astype(np.int64), [(1, 0)] * winning.ndim)
        for j in range(winning.ndim):
            np.cumsum(self.sums, axis=j, out=self.sums)
        self.corners = [((-1) ** (winning.ndim - sum(c)), c) for c in product((0, 1), repeat=winning.ndim)]

    def whole(self, box: Box) -> bool:
        """Are all of its cells winning?"""
        ends = tuple(zip(box.first.tolist(), box.after.tolist(), strict=True))
        count = sum(sign * int(self.sums[tuple(e[c] for e, c in zip(ends, at, strict=True))]) for sign, at in self.corners)
        return bool(count == np.prod(box.after - box.first))


def inscribed(winning: Bools, room: Ints, most: int) -> list[Box]:
    """At most `most` boxes of winning cells, none part of a larger one, each with more than `room` cells per axis.

    Each grows from a winning cell by layers, as thick ones as fit first, along all axes or along one of them first. Of these
    the boxes are taken one by one that hold most cells no other holds, once half of `room` is left at each edge.
    """
    sums, rng = Sums(winning), np.random.default_rng(0)
    cells = np.argwhere(winning)
    if not len(cells):
        return []
    seeds = cells[np.unique(rng.integers(len(cells), size=THRESHOLDS.inscribed_seeds))]
    orders = [None, *range(winning.ndim)] if winning.ndim > 1 else [None]
    grown = {tuple(np.concatenate(_grown(sums, winning.shape, seed, j)).tolist()) for seed in seeds for j in orders}
    n = winning.ndim
    found = [Box(np.array(b[:n]), np.array(b[n:])) for b in sorted(grown)]
    left = [b for b in found if (b.after - b.first > room).all()]
    covered, out = np.zeros(winning.shape, dtype=bool), list[Box]()
    while left and len(out) < most:
        inner = [Box(b.first + room // 2, b.after - room // 2).slices for b in left]
        gained = [int((~covered[at]).sum()) for at in inner]
        best = int(np.argmax(gained))
        if gained[best] == 0:
            break
        covered[inner[best]] = True
        out.append(left.pop(best))
    return out


def _grown(sums: Sums, counts: tuple[int, ...], seed: Ints, lead: int | None) -> Box:
    """From one cell: along axis `lead` as far as it goes, if one leads, then along all of them in turn."""
    box = Box(seed.copy(), seed + 1)
    for axes in ([lead], range(len(counts))) if lead is not None else (range(len(counts)),):
        step = max(counts) // 4 + 1
        while step:
            moved = False
            for j, up in product(axes, (False, True)):
                first, after = box.first.copy(), box.after.copy()
                if up:
                    after[j] = min(after[j] + step, counts[j])
                else:
                    first[j] = max(first[j] - step, 0)
                then = Box(first, after)
                if (after - first).sum() > (box.after - box.first).sum() and sums.whole(then):
                    box, moved = then, True
            step = step if moved else step // 2
    return box
