"""Invariance where successors depend on all states at once: f is asked over blocks of cells, and over their parts where needed.

A block's window holds all successors of its cells under an input. Where it is alive, the input is valid in all of them; where
none of it is, in none of them; else the block is split. What is alive shrinks from all safe cells on: a block stays while the
window of some input of it is alive, is split where there is none, and dies where its inputs are ruled out, which those of a
cell are where not all of a window is alive. So every cell left has an input that leads back into what is left; and where the
windows of parts lie in those of blocks, none is lost that has one by the windows of cells.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, final

import numpy as np

from gapcert import Array, Interval
from gapcert.plugin import Bools, Ints
from gapcert_symbolic.cells.abstraction import EPS, size_of, touched
from gapcert_symbolic.cells.bounds import Bound, Nominal, structure
from gapcert_symbolic.cells.gaps import Disturbance, fitted
from gapcert_symbolic.cells.grid import Grid, View, combined
from gapcert_symbolic.kernels import lazy_kernels as kernels
from gapcert_symbolic.kernels.kernels import Bits, _strides
from gapcert_symbolic.kernels.lazy_kernels import Cells, Small, Tree, Watch
from gapcert_symbolic.thresholds import THRESHOLDS

from .problem import Problem, Solution

PAIRS = 400_000
LEAST = 1 << 15  # entries that arrays have room for, once they grow
Ask = Callable[[Small, Small, Small, Small], tuple[Small, Small]]


@final
class BlockWindows:
    """Windows of blocks: of f + [l, u] over all of a block."""

    def __init__(self, bound: Bound, grid: Grid, axes: tuple[Array, ...], added: Disturbance | None) -> None:
        self.bound, self.grid, self.states = bound, grid, list(grid.states)
        self.points = combined(axes)
        self.sizes = np.array(_sizes(max(grid.counts)))
        self.spread = bound.spread(np.array([_half(grid, int(size)) for size in self.sizes]), self.points)
        self.still = bound.unmoved(self.points)[:, self.states]
        # As tables have it, with its suprema where it hardly changes.
        self.added = added = None if added is None else fitted(added, structure(bound, grid, axes), grid, axes, grid.size).added
        if added is not None:
            self.cell, self.input = added.of(grid, np.arange(grid.size)), added.of_inputs
            self.r = Interval(*(np.ascontiguousarray(end[:, :, self.states]) for end in (added.r.lo, added.r.hi)))
            self.still &= ~self.r.mag.any(axis=(0, 1))
        self.stays = bool(self.still.any())

    def __call__(self, corner: Small, size: Small, block: Small, which: Small) -> tuple[Small, Small]:
        """First and last cell per axis (pairs, axes), of pairs of an input and a block, which has so many cells per axis from a
        corner on, as far as the grid goes.
        """
        first, last = np.empty((2, len(block), len(self.grid.counts)), dtype=np.int32)
        end = np.minimum(corner + size[:, None], self.grid.counts) - 1
        (low, high), level = self.grid.spanned(corner, end), np.searchsorted(self.sizes, size)
        for part in (slice(k, k + PAIRS) for k in range(0, len(block), PAIRS)):
            i, j = block[part].astype(np.int64), which[part].astype(np.int64)
            spread = None if self.spread is None else self.spread[level.take(i), j]
            f = self.bound.over(low.take(i, axis=0), high.take(i, axis=0), self.points, j, spread)
            r = None if self.added is None else self._gap(corner, end, i, j)
            for k, state in enumerate(self.states):
                own = f[:, state]
                lo, hi, error = own.lo, own.hi, 2 * EPS * size_of(own)
                if r is not None:
                    lo, hi, error = lo + r.lo[:, k], hi + r.hi[:, k], error + 8 * EPS * size_of(r[:, k])
                first[part, k], last[part, k] = touched(self.grid, k, lo, hi, error, moves=False)
            if self.stays:
                # As for the cells: what an input leaves where it is stays in its block.
                still = self.still[j]
                first[part][still], last[part][still] = corner[i][still], end[i][still]
        return first, last

    def _gap(self, corner: Small, end: Ints, block: Ints, which: Ints) -> Interval:
        """[l, u] over blocks, per pair."""
        counts, of = np.array(self.grid.counts), self.input[which]
        lo, hi = kernels.suprema(counts, self.cell, self.r.lo, self.r.hi, corner, end)
        return Interval(lo[block, of], hi[block, of])


def solve(problem: Problem) -> Solution | None:
    """Invariance; None where tables are as good, or blocks do not do."""
    if problem.dynamics is None:
        return None
    bound, grid, axes, added, allowed = problem.dynamics
    if not suits(bound, grid, axes):
        return None
    ask = BlockWindows(bound, grid, axes, added)
    found, nested = invariance(ask, grid, problem.safe, len(ask.points), allowed)
    # A bound on trust that does not grow with the radius may have been meant for cells, and tell nothing of blocks.
    return found if nested or ask.spread is None else None


def suits(bound: Bound, grid: Grid, axes: tuple[Array, ...]) -> bool:
    """Would tables be as long as the grid, with f to be asked for each input on its own?"""
    if any(part.rows(grid) < grid.size for part in structure(bound, grid, axes)):
        return False
    if not bound.groups:
        return True
    # Where inputs cannot share f in some cells, they cannot in all.
    number = min(grid.size, THRESHOLDS.single_pairs // math.prod(len(a) for a in axes) + 1)
    some = np.linspace(0, grid.size - 1, number).astype(np.int64)
    return Nominal.coarsest(bound, View(grid, tuple(range(len(grid.counts))), some), axes).direct


def invariance(ask: Ask, grid: Grid, safe: Bools, inputs: int, allowed: Bools | None) -> tuple[Solution, bool]:
    """The greatest set of safe cells that blocks and cells have shown can be kept, and all inputs that keep in it; and have all
    windows of parts been in those of the whole?

    ask (corner, size, block, which): as `BlockWindows`.
    """
    counts = np.array(grid.counts)
    offered = np.empty((0, 0), dtype=bool) if allowed is None else allowed
    cells = Cells(counts, np.array(grid.wraps), _strides(counts), safe.astype(np.uint8), offered)
    blocks, sizes = _Blocks(cells, inputs, ask), _sizes(max(grid.counts))
    blocks.split(np.zeros(1, dtype=np.int32), np.array(sizes[-1:], dtype=np.int32))
    rounds = 1
    while len(waiting := blocks.waiting()):
        blocks.split(waiting)
        rounds += 1
    bits = np.zeros((grid.size, (inputs + 7) // 8), dtype=np.uint8)
    for size in sizes[::-1]:
        if len(parents := blocks.kept(size, bits)):
            blocks.split(parents)
    return Solution(cells.alive.view(np.int8) - np.int8(1), bits, rounds), blocks.nested


def _half(grid: Grid, size: int) -> Array:
    """(nx,): half the width of the widest block of so many cells per axis."""
    blocks = -(-max(grid.counts) // size)
    first = np.minimum(np.arange(blocks)[:, None] * size, np.array(grid.counts) - 1)
    low, high = grid.spanned(first, np.minimum(first + size, grid.counts) - 1)
    return np.asarray(((high - low) / 2).max(axis=0))


def _sizes(longest: int) -> list[int]:
    """Cells per axis of the blocks of each level, down to 1."""
    sizes = [1]
    while sizes[-1] * kernels.FACTOR * THRESHOLDS.first_blocks <= longest:
        sizes.append(sizes[-1] * kernels.FACTOR)
    return sizes


class _Blocks:
    """Blocks as they grow, from one that holds all cells and has no window."""

    def __init__(self, cells: Cells, inputs: int, ask: Ask) -> None:
        n, tiles = len(cells.counts), ((cells.counts - 1) >> kernels.SHIFT) + 1
        number = math.prod(tiles.tolist())
        self.cells, self.ask, self.number, self.pairs, self.waits, self.nested = cells, ask, 1, inputs, 0, True
        self.tree = Tree(
            np.zeros((1, n), dtype=np.int32),
            np.array([cells.counts.max()], dtype=np.int32),
            np.zeros(1, dtype=np.int64),
            np.array([inputs]),
            np.full(1, -1),
            np.full(1, kernels.WAITS, dtype=np.uint8),
            np.zeros(inputs, dtype=np.int32),
            np.arange(inputs, dtype=np.int32),
            np.zeros((inputs, n), dtype=np.int32),
            np.zeros((inputs, n), dtype=np.int32),
            np.ones(inputs, dtype=bool),
            np.full(inputs, not cells.allowed.size),
        )
        empty = np.empty(0, dtype=np.int32)
        at = np.zeros(7, dtype=np.int64)
        at[kernels.LOOKED], at[kernels.ENTRY], at[kernels.FREE] = 1, -1, -1
        head, queue = np.full(number, -1, dtype=np.int32), np.empty(number, dtype=np.int32)
        self.watch = Watch(tiles, head, empty, empty, queue, np.zeros(number, dtype=bool), at)
        self.list, self.work = empty, np.zeros((6, n), dtype=np.int64)

    def split(self, parents: Small, sizes: Small | None = None) -> None:
        """Blocks in place of their parents, of so many cells per axis each."""
        tree = self.tree
        sizes = tree.size[parents] // kernels.FACTOR if sizes is None else sizes
        parts = self._parts(parents, sizes)
        new, pairs = kernels.split(tree, self.cells, parents, sizes, parts, self.work)
        corner, size, end = (part[:new] for part in parts[:3])
        block, which, whole, above = (part[:pairs] for part in parts[3:])
        first, last = self.ask(corner, size, block, which)
        self.nested = self.nested and (self.number == 1 or kernels.nested(tree, self.cells, above, first, last))
        begin = np.concatenate([[0], end])[:-1]
        state, witness, opened = np.full(new, kernels.SETTLED), np.full(new, -1), np.ones(pairs, dtype=bool)
        of_blocks = (corner, size, begin + self.pairs, end + self.pairs, witness, state)
        of_pairs = (block + self.number, which, first, last, opened, whole)
        grown = [_put(old, self.number, more) for old, more in zip(tree[:6], of_blocks, strict=True)]
        grown += [_put(old, self.pairs, more) for old, more in zip(tree[6:], of_pairs, strict=True)]
        self.tree = Tree(*grown)
        self.number, self.pairs = self.number + new, self.pairs + pairs

    def _parts(self, parents: Small, sizes: Small) -> tuple[Any, ...]:
        """Room for the parts of blocks, and the pairs of these."""
        tree, n = self.tree, len(self.cells.counts)
        extent = np.minimum(tree.size[parents][:, None], self.cells.counts - tree.corner[parents])
        number = ((extent - 1) // sizes[:, None] + 1).prod(axis=1)
        blocks, pairs = number.sum(), (number * (tree.end[parents] - tree.begin[parents])).sum()
        corner, (size, end) = np.empty((blocks, n), np.int32), (np.empty(blocks, kind) for kind in (np.int32, np.int64))
        block, which, above = np.empty((3, pairs), np.int32)
        return corner, size, end, block, which, np.empty(pairs, bool), above

    def kept(self, size: int, bits: Bits) -> Small:
        """The blocks of a size whose parts differ in their inputs; what all of a block has is in bits then."""
        found, mine = np.empty(self.number, dtype=np.int32), np.empty(bits.shape[1], dtype=np.uint8)
        return found[: kernels.kept(self.tree, self.cells, self.number, size, bits, mine, found, self.work)]

    def waiting(self) -> Small:
        """The blocks that no input keeps as they are, once all are settled."""
        while True:
            if len(self.list) < self.number:
                self.list = _put(self.list, self.waits, np.empty(len(self.tree.size), dtype=np.int32))
            self.waits = kernels.settle(self.tree, self.watch, self.cells, self.number, self.list, self.waits, self.work)
            if self.waits >= 0:
                break
            self.waits = -1 - self.waits
            self._room()
        return self.list[: self.waits].copy()

    def _room(self) -> None:
        """More entries to watch with."""
        watch, old = self.watch, len(self.watch.pair)
        new = old + 4 * len(watch.head)
        after = np.arange(1, new + 1, dtype=np.int32)
        after[:old], after[-1] = watch.after, watch.at[kernels.FREE]
        watch.at[kernels.FREE], watch.at[kernels.ROOM] = old, watch.at[kernels.ROOM] + new - old
        self.watch = watch._replace(pair=np.resize(watch.pair, new), after=after)


def _put(old: Any, at: int, more: Any) -> Any:
    """What is in an array up to an index, and more: in its place, where there is room."""
    if at + len(more) > len(old):
        room = np.empty((max(at + len(more), 2 * len(old), LEAST), *old.shape[1:]), dtype=old.dtype)
        room[:at], old = old[:at], room
    old[at : at + len(more)] = more
    return old
