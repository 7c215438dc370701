"""What `lazy` does with blocks of cells, compiled.

A pair is a block with an input, and has a window of cells. A block is settled where the window of one of its pairs is alive;
it relies on this pair, which is watched at every tile of 2^SHIFT cells per axis that its window touches.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gapcert import Array
from gapcert.plugin import Bools, Ints

from .kernels import Bits, Marks, _on, _row, _strides, borrowing, compiled, inlined

Small = npt.NDArray[np.int32]
FACTOR = 4  # parts of a block per axis
SHIFT = 3
SETTLED, WAITS, GONE = 0, 1, 2
NONE, SOME, ALL = 0, 1, 2
FREE, ROOM, QUEUE, LENGTH, LOOKED, TILE, ENTRY = range(7)


class Cells(NamedTuple):
    """alive (cells,): 1 or 0. allowed (cells, inputs), or empty."""

    counts: Ints
    wraps: Bools
    strides: Ints
    alive: Marks
    allowed: Bools


class Tree(NamedTuple):
    """Blocks: first cell per axis, cells per axis as far as the grid goes, first pair and the one after the last, the pair it
    relies on or −1, and what became of it. Pairs: block, input, window; open: not ruled out; whole: allowed in all cells.
    """

    corner: Small
    size: Small
    begin: Ints
    end: Ints
    witness: Ints
    state: Marks
    block: Small
    which: Small
    first: Small
    last: Small
    open: Bools
    whole: Bools


class Watch(NamedTuple):
    """Lists of pairs, one per tile: head (tiles,) into pair and after, −1 at their ends. queue: tiles where a cell has died
    since their lists were looked at, in a ring; queued: is a tile among them? at: the first entry that is free (FREE) and how
    many are (ROOM), the first of the queue (QUEUE) and how many it has (LENGTH), the first block that was not looked at
    (LOOKED), and the tile of the list in hand (TILE) with what is left of it (ENTRY).
    """

    tiles: Ints
    head: Small
    pair: Small
    after: Small
    queue: Small
    queued: Bools
    at: Ints


@inlined
def _scan(cells: Any, work: Ints) -> int:
    """Are all, some or none of the cells of a box alive? An axis that wraps may go on beyond its end."""
    counts, n, low, high, at = cells.counts, len(cells.counts) - 1, work[0], work[1], work[2]
    inner, beyond, some, every = min(high[n], counts[n] - 1) + 1, high[n] + 1 - counts[n], np.uint8(0), np.uint8(1)
    for k in range(n):
        at[k] = low[k]
    while True:
        row = _row(counts, cells.strides, at)
        for i in range(row + low[n], row + inner):
            some |= cells.alive[i]
            every &= cells.alive[i]
        for i in range(row, row + beyond):
            some |= cells.alive[i]
            every &= cells.alive[i]
        if some > every:
            return SOME
        if not _on(low, high, at, n):
            return ALL if every else NONE


@inlined
def _look(cells: Any, first: Small, last: Small, work: Ints) -> int:
    """Are all, some or none of a window's cells alive? What is outside the grid is not."""
    counts, low, high, inside = cells.counts, work[0], work[1], True
    for k in range(len(counts)):
        low[k], high[k] = first[k], last[k]
        if not cells.wraps[k] and (low[k] < 0 or high[k] >= counts[k]):
            low[k], high[k], inside = max(low[k], 0), min(high[k], counts[k] - 1), False
        if low[k] > high[k]:
            return NONE
    found = _scan(cells, work)
    return found if inside else min(found, SOME)


@inlined
def _still(watch: Any, cells: Any, first: Small, last: Small, tile: int, work: Ints) -> bool:
    """Is what a window in the grid has in a tile alive?"""
    for k in range(len(cells.counts) - 1, -1, -1):
        work[0, k], work[1, k], begin = first[k], last[k], tile % watch.tiles[k] << SHIFT
        if last[k] < cells.counts[k]:
            work[0, k], work[1, k] = max(first[k], begin), min(last[k], begin + (1 << SHIFT) - 1)
        tile //= watch.tiles[k]
    return _scan(cells, work) == ALL


@inlined
def _block(counts: Ints, corner: Small, size: int, work: Ints) -> None:
    """First and last cell of a block, and its first one to go on from."""
    for k in range(len(counts)):
        work[0, k], work[1, k], work[2, k] = corner[k], min(corner[k] + size, counts[k]) - 1, corner[k]


@inlined
def _watched(tree: Any, watch: Any, cells: Any, p: int, work: Ints) -> None:
    """The pair is put down at each tile that its window touches."""
    low, high, at, n = work[0], work[1], work[2], len(cells.counts)
    for k in range(n):
        low[k], high[k] = tree.first[p, k] >> SHIFT, tree.last[p, k] >> SHIFT
        if tree.last[p, k] >= cells.counts[k]:
            # Over the end and on from the beginning: all tiles, which is no fewer than it touches.
            low[k], high[k] = 0, watch.tiles[k] - 1
        at[k] = low[k]
    while True:
        tile = 0
        for k in range(n):
            tile = tile * watch.tiles[k] + at[k]
        entry = watch.at[FREE]
        watch.at[FREE], watch.at[ROOM] = watch.after[entry], watch.at[ROOM] - 1
        watch.pair[entry], watch.after[entry], watch.head[tile] = p, watch.head[tile], entry
        if not _on(low, high, at, n):
            return


@inlined
def _die(tree: Any, watch: Any, cells: Any, i: int, work: Ints) -> None:
    """The cells of a block are alive no more; tiles that they are in are put into the queue."""
    low, high, at, n = work[0], work[1], work[2], len(cells.counts)
    tree.state[i] = GONE
    _block(cells.counts, tree.corner[i], tree.size[i], work)
    while True:
        row = _row(cells.counts, cells.strides, at)
        cells.alive[row + low[n - 1] : row + high[n - 1] + 1] = 0
        if not _on(low, high, at, n - 1):
            break
    for k in range(n):
        low[k], high[k] = low[k] >> SHIFT, high[k] >> SHIFT
        at[k] = low[k]
    while True:
        tile = 0
        for k in range(n):
            tile = tile * watch.tiles[k] + at[k]
        if not watch.queued[tile]:
            watch.queued[tile] = True
            last = watch.at[QUEUE] + watch.at[LENGTH]
            watch.queue[last if last < len(watch.queue) else last - len(watch.queue)] = tile
            watch.at[LENGTH] += 1
        if not _on(low, high, at, n):
            return


@inlined
def _settle(tree: Any, watch: Any, cells: Any, i: int, work: Ints) -> None:
    """A block relies on another pair whose window is alive; or waits for its parts, where there is none; or is lost."""
    waits, tree.witness[i] = False, -1
    for p in range(tree.begin[i], tree.end[i]):
        if tree.open[p]:
            found = _look(cells, tree.first[p], tree.last[p], work)
            if found == ALL and tree.whole[p]:
                tree.witness[i], tree.state[i] = p, SETTLED
                _watched(tree, watch, cells, p, work)
                return
            # No part of a block has a window with a cell alive where the whole of it has none.
            tree.open[p] = found != NONE and tree.size[i] > 1
            waits = waits or tree.open[p]
    tree.state[i] = WAITS
    if not waits:
        _die(tree, watch, cells, i, work)


@inlined
def _next(tree: Any, watch: Any, cells: Any, work: Ints) -> int:
    """The next entry of the list in hand: its block, where that relies on it and has to settle again, or −1."""
    tile, entry = watch.at[TILE], watch.at[ENTRY]
    p, watch.at[ENTRY] = watch.pair[entry], watch.after[entry]
    i = tree.block[p]
    relies = tree.witness[i] == p
    # Other tiles have their turn where something has died in them.
    if relies and _still(watch, cells, tree.first[p], tree.last[p], tile, work):
        watch.after[entry], watch.head[tile] = watch.head[tile], entry
        return -1
    watch.after[entry], watch.at[FREE] = watch.at[FREE], entry
    watch.at[ROOM] += 1
    return i if relies else -1


@borrowing
def settle(tree: Any, watch: Any, cells: Any, blocks: int, waiting: Small, number: int, work: Ints) -> int:
    """Blocks up to so many that were not looked at are, and all again that rely on what dies. waiting: the blocks that wait for
    their parts, so many before; how many now. Less than 0, by one more, where more room is needed for what is watched.
    """
    at, died, turn = watch.at, False, 0
    while True:
        i, listed = -1, False
        # A window touches no more than all tiles.
        if at[ROOM] < len(watch.head):
            return -number - 1
        if at[LOOKED] < blocks:
            i, at[LOOKED] = at[LOOKED], at[LOOKED] + 1
        elif at[ENTRY] >= 0:
            i = _next(tree, watch, cells, work)
        elif at[LENGTH]:
            tile, at[LENGTH], died = watch.queue[at[QUEUE]], at[LENGTH] - 1, True
            at[QUEUE] = at[QUEUE] + 1 if at[QUEUE] + 1 < len(watch.queue) else 0
            at[TILE], at[ENTRY], watch.head[tile], watch.queued[tile] = tile, watch.head[tile], -1, False
        elif turn < number:
            i, listed = waiting[turn], True
        elif died:
            turn, died = 0, False
        else:
            return number
        if i >= 0 and tree.state[i] != GONE:
            _settle(tree, watch, cells, i, work)
        if listed and tree.state[i] == WAITS:
            turn += 1
        elif listed:
            number -= 1
            waiting[turn] = waiting[number]
        elif i >= 0 and tree.state[i] == WAITS:
            waiting[number] = i
            number += 1


@inlined
def _offered(cells: Any, j: int, work: Ints) -> int:
    """Is an input allowed in all, some or none of the cells of a box that are alive? Without an input: is any alive?"""
    low, high, at, n, some, all_ = work[0], work[1], work[2], len(cells.counts) - 1, False, True
    for k in range(n):
        at[k] = low[k]
    while True:
        row = _row(cells.counts, cells.strides, at)
        for i in range(row + low[n], row + high[n] + 1):
            if cells.alive[i]:
                offered = j < 0 or cells.allowed[i, j]
                some, all_ = some or offered, all_ and offered
        if (j < 0 and some) or not _on(low, high, at, n):
            return (ALL if all_ else SOME) if some else NONE


@borrowing
def split(tree: Any, cells: Any, parents: Small, sizes: Small, parts: Any, work: Ints) -> tuple[int, int]:
    """Parents cut into blocks of so many cells per axis each, as far as any is alive, with the pairs that are open in them.

    How many blocks and pairs. parts: their corners, sizes, and where their pairs end; block, input and whole of the pairs, and
    the pair of the parent.
    """
    corner, own, end, block, which, whole, above = parts
    low, high, at, n, blocks, pairs = work[3], work[4], work[5], len(cells.counts), 0, 0
    for t in range(len(parents)):
        i, size = parents[t], sizes[t]
        tree.state[i] = GONE
        for k in range(n):
            low[k], high[k], at[k] = 0, (min(tree.size[i], cells.counts[k] - tree.corner[i, k]) - 1) // size, 0
        more = True
        while more:
            for k in range(n):
                corner[blocks, k] = tree.corner[i, k] + size * at[k]
            _block(cells.counts, corner[blocks], size, work)
            if _offered(cells, -1, work) != NONE:
                for p in range(tree.begin[i], tree.end[i]):
                    j = tree.which[p]
                    found = NONE if not tree.open[p] else (_offered(cells, j, work) if cells.allowed.size else ALL)
                    if found != NONE:
                        block[pairs], which[pairs], whole[pairs], above[pairs] = blocks, j, found == ALL, p
                        pairs += 1
                own[blocks], end[blocks] = size, pairs
                blocks += 1
            more = _on(low, high, at, n)
    return blocks, pairs


@borrowing
def nested(tree: Any, cells: Any, above: Small, first: Small, last: Small) -> bool:
    """Do windows lie in those of the pairs that they are parts of?"""
    for q in range(len(above)):
        p = above[q]
        for k in range(len(cells.counts)):
            before, after = first[q, k] - tree.first[p, k], tree.last[p, k] - last[q, k]
            if cells.wraps[k] and before < 0:
                before, after = before + cells.counts[k], after - cells.counts[k]
            if min(before, after) < 0 and not (cells.wraps[k] and tree.last[p, k] - tree.first[p, k] == cells.counts[k] - 1):
                return False
    return True


@inlined
def _mark(bits: Bits, alive: Marks, begin: int, end: int, mine: Bits) -> None:
    if len(mine) == 1:
        # Many cells at once.
        flat, byte = bits.reshape(-1), mine[0]
        for i in range(begin, end):
            flat[i] |= alive[i] * byte
    else:
        for i in range(begin, end):
            for b in range(len(mine)):
                bits[i, b] |= alive[i] * mine[b]


@borrowing
def kept(tree: Any, cells: Any, blocks: int, size: int, bits: Bits, mine: Bits, found: Small, work: Ints) -> int:
    """The inputs whose windows are alive are kept in the cells of blocks of a size. How many blocks have to be split for
    others, which alone are open then, and in `found` which. mine (bytes,): room for the inputs of a block.
    """
    low, high, at, number, n = work[0], work[1], work[2], 0, len(cells.counts) - 1
    for i in range(blocks):
        if tree.size[i] != size or tree.state[i] != SETTLED:
            continue
        mine[:] = 0
        more = waits = False
        for p in range(tree.begin[i], tree.end[i]):
            if tree.open[p]:
                alive = _look(cells, tree.first[p], tree.last[p], work)
                valid = alive == ALL and tree.whole[p]
                tree.open[p] = size > 1 and alive != NONE and not valid
                waits, more = waits or tree.open[p], more or valid
                if valid:
                    mine[tree.which[p] >> 3] |= 128 >> (tree.which[p] & 7)
        if waits:
            found[number] = i
            number += 1
        _block(cells.counts, tree.corner[i], size, work)
        while more:
            row = _row(cells.counts, cells.strides, at)
            _mark(bits, cells.alive, row + low[n], row + high[n] + 1, mine)
            more = _on(low, high, at, n)
    return number


@compiled
def suprema(counts: Ints, cell: Ints, lo: Array, hi: Array, corner: Small, end: Ints) -> tuple[Array, Array]:
    """The least lo and the greatest hi (blocks, inputs, axes) over the cells of blocks, of those (parts, inputs, axes) of the
    part that a cell is in.
    """
    least, most = np.empty((2, len(corner), lo.shape[1], lo.shape[2]))
    strides, at, n = _strides(counts), np.zeros(len(counts), np.int64), len(counts) - 1
    for i in range(len(corner)):
        before = -1
        at[:] = corner[i]
        more = True
        while more:
            row = _row(counts, strides, at)
            for c in range(row + corner[i, n], row + end[i, n] + 1):
                # Cells that follow each other are mostly in the same part.
                if cell[c] != before:
                    if before < 0:
                        least[i], most[i] = lo[cell[c]], hi[cell[c]]
                    else:
                        least[i], most[i] = np.minimum(least[i], lo[cell[c]]), np.maximum(most[i], hi[cell[c]])
                    before = cell[c]
            more = _on(corner[i], end[i], at, n)
    return least, most
