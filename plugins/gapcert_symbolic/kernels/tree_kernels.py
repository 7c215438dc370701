"""Games on cells of which some are split (`gapcert.Splits`), compiled.

Values are per node: 0 or more for cells that are won, −1 for cells that may be, less for others. Bits, allowed inputs, runs and
lists are per node of the last level, which is in play.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gapcert.plugin import Bools, Ints

from .kernels import Bits, Values, _keep, _on, _range, _strides, _unravel, borrowing, compiled

Marks = npt.NDArray[np.uint8]
LOOKS = 4  # nodes that are looked at in a window, or so


class Game(NamedTuple):
    """roots: cells per axis of level 0; first: the first child of each node, or 0. The last level has the number `level` and
    `counts` cells per axis; its nodes are start, start + 1, … with the flat numbers `flat` on its grid. tables: (first, last,
    start, width, moves, column, rows) of its windows; the entry of axis k is at start_k + rows_ki width_k + column_kj.
    """

    roots: Ints
    level: int
    first: Ints
    counts: Ints
    wraps: Bools
    tables: Any
    start: int
    flat: Ints


@borrowing
def _window(game: Any, i: int, index: Ints, j: int, a: Ints, b: Ints) -> bool:
    """As `kernels._window`, of the node start + i."""
    first, last, start, width, moves, column, rows = game.tables
    counts, inside = game.counts, True
    for k in range(len(counts)):
        at, own = start[k] + rows[k, i] * width[k] + column[k, j], index[k] if moves[k] else 0
        a[k], b[k], within = _range(counts[k], game.wraps[k], own + first[at], own + last[at])
        inside = inside and within
    return inside


@borrowing
def _node(game: Any, c: Ints) -> tuple[int, int]:
    """The whole node that holds the cell c of the last level, and how many levels above it lies."""
    at, shift, counts = 0, game.level, game.counts
    for k in range(len(c)):
        i = c[k] if c[k] < counts[k] else c[k] - counts[k]
        at = at * game.roots[k] + (i >> shift)
    while shift and game.first[at]:
        shift -= 1
        child = 0
        for k in range(len(c)):
            i = c[k] if c[k] < counts[k] else c[k] - counts[k]
            child = 2 * child + ((i >> shift) & 1)
        at = game.first[at] + child
    return at, shift


@compiled
def _room(counts: Ints) -> Any:
    """Strides, and room for an index, and for a window and a cell of it."""
    return _strides(counts), np.zeros(len(counts), np.int64), np.zeros((3, len(counts)), np.int64)


@borrowing
def _skip(c: Ints, above: int) -> None:
    """c moves on to the last cell of its row in a node so many levels above; counts are multiples of its width."""
    c[len(c) - 1] |= (1 << above) - 1


@borrowing
def _meets(game: Any, node: int, index: Ints, marks: Marks, work: Any) -> bool:
    """Does the window of any input meet a marked node?"""
    a, b, c = work
    for j in range(game.tables[5].shape[1]):
        _window(game, node, index, j, a, b)
        some = True
        for k in range(len(c)):
            if not game.wraps[k]:
                a[k], b[k] = max(a[k], 0), min(b[k], game.counts[k] - 1)
            some = some and a[k] <= b[k]
            c[k] = a[k]
        while some:
            q, above = _node(game, c)
            if marks[q]:
                return True
            _skip(c, above)
            some = _on(a, b, c, len(c))
    return False


@compiled
def hopeful(game: Any, asked: Bools, marks: Marks, greatest: int) -> None:
    """marks (nodes,) become the greatest or the least set, from what is marked on, in which each node that is asked for has an
    input whose window meets a marked node.
    """
    strides, index, work = _room(game.counts)
    n, sweep, changed = len(game.flat), 0, True
    while changed:
        changed = False
        for t in range(n):
            i = t if sweep % 2 == 0 else n - 1 - t
            if asked[i] and marks[game.start + i] == greatest:
                _unravel(strides, game.flat[i], index)
                if _meets(game, i, index, marks, work) != greatest:
                    marks[game.start + i], changed = 1 - greatest, True
        sweep += 1


@borrowing
def _leads(game: Any, i: int, index: Ints, j: int, values: Values, run: Marks, work: Any) -> bool:
    """Is the window inside the grid, and won?"""
    a, b, c = work
    if not _window(game, i, index, j, a, b):
        return False
    for k in range(len(c)):
        c[k] = a[k]
    while True:
        q, above = _node(game, c)
        if values[q] < 0:
            return False
        if q >= game.start:
            c[len(c) - 1] += run[q - game.start] - 1
        else:
            _skip(c, above)
        if not _on(a, b, c, len(c)):
            return True


@compiled
def _runs(game: Any, values: Values, most: int) -> Marks:
    """So many cells along the last axis, from each one on, are known to be won; at most `most`.

    Runs end at the grid's edge. They may be too short, never too long.
    """
    counts, run, n = game.counts, np.ones(len(game.flat), np.uint8), len(game.counts) - 1
    strides, c = _strides(counts), np.zeros(n + 1, np.int64)
    for i in np.argsort(game.flat)[::-1]:
        _unravel(strides, game.flat[i], c)
        length = 1
        c[n] += 1
        while c[n] < counts[n] and length < most:
            q, above = _node(game, c)
            if values[q] < 0:
                break
            if q >= game.start:
                length += run[q - game.start]
                break
            before = c[n]
            _skip(c, above)
            length += c[n] + 1 - before
            c[n] += 1
        run[i] = min(length, most)
    return run


@compiled
def _cut(game: Any, values: Values, run: Marks, most: int, lost: int, c: Ints) -> None:
    """Runs end before the node of the last level that is lost."""
    n = len(c) - 1
    _unravel(_strides(game.counts), game.flat[lost], c)
    end = c[n]
    c[n] -= 1
    while c[n] >= 0 and end - c[n] < most:
        q, above = _node(game, c)
        if values[q] < 0:
            return
        if q >= game.start:
            run[q - game.start] = min(run[q - game.start], end - c[n])
        c[n] = (c[n] >> above << above) - 1


@compiled
def _disturbed(game: Any, values: Values, near: Ints, lost: int, witness: Any, dirty: Marks) -> None:
    """Marks those whose window, under the input that they rely on, holds the node of the last level that is lost."""
    counts, wraps, n = game.counts, game.wraps, len(game.counts)
    at, low, high, index, c, a, b = np.zeros((7, n), np.int64)
    _unravel(_strides(counts), game.flat[lost], at)
    for k in range(n):
        low[k], high[k] = at[k] - near[1, k], at[k] - near[0, k]
        if not wraps[k]:
            low[k], high[k] = max(low[k], 0), min(high[k], counts[k] - 1)
        elif high[k] - low[k] >= counts[k]:
            low[k], high[k] = 0, counts[k] - 1
        if low[k] > high[k]:
            return
        c[k] = low[k]
    while True:
        for k in range(n):
            index[k] = c[k] % counts[k]
        q, above = _node(game, index)
        i = q - game.start
        if i >= 0 and values[q] == 0 and not dirty[i]:
            _window(game, i, index, witness[i], a, b)
            inside = True
            for k in range(n):
                inside = inside and a[k] <= (at[k] if at[k] >= a[k] else at[k] + counts[k]) <= b[k]
            if inside:
                dirty[i] = 1
        _skip(c, above)
        if not _on(low, high, c, len(c)):
            return


@borrowing
def _witnessed(
    game: Any, values: Values, allowed: Bools, i: int, j: int, index: Ints, run: Marks, work: Any, bits: Bits, every: bool
) -> int:
    """From j on, the first input that leads into what is won, or the number of inputs; `every` keeps all of them in bits."""
    m = game.tables[5].shape[1]
    while j < m:
        if (not allowed.size or allowed[i, j]) and _leads(game, i, index, j, values, run, work):
            if not every:
                return j
            _keep(bits, i, j)
        j += 1
    return j


@compiled
def invariance(game: Any, values: Values, bits: Bits, allowed: Bools, near: Ints) -> int:
    """The largest set of nodes of the last level with value 0 that have an input whose window is won; values become −1
    elsewhere, and bits are filled. near (2, axes): least and largest offset of windows. The number of sweeps is returned.
    """
    counts, n, start, m, sweeps, lost, around = game.counts, len(game.flat), game.start, game.tables[5].shape[1], 0, 1, 1
    for k in range(len(counts)):
        around *= min(near[1, k] - near[0, k] + 1, counts[k])
    most, strides = min(near[1, -1] - near[0, -1] + 1, 255), _strides(counts)
    index, c, work = np.zeros(len(counts), np.int64), np.zeros(len(counts), np.int64), np.zeros((3, len(counts)), np.int64)
    run, witness, dirty, dead = _runs(game, values, most), np.zeros(n, np.int32), np.ones(n, np.uint8), np.empty(n, np.int64)
    while lost:
        lost = 0
        for t in range(n):
            i = t if sweeps % 2 == 0 else n - 1 - t
            if dirty[i] and values[start + i] == 0:
                _unravel(strides, game.flat[i], index)
                # What led out of a larger set leads out of a smaller one.
                witness[i] = _witnessed(game, values, allowed, i, witness[i], index, run, work, bits, False)
                if witness[i] == m:
                    values[start + i], dead[lost] = -1, i
                    lost += 1
                    _cut(game, values, run, most, i, c)
        sweeps += 1
        # All that rely on what is lost are looked for where that takes less than to look at all windows again.
        dirty[:] = lost * around > n * LOOKS
        if lost * around <= n * LOOKS:
            for t in range(lost):
                _disturbed(game, values, near, dead[t], witness, dirty)
    for i in range(n):
        if values[start + i] == 0:
            _unravel(strides, game.flat[i], index)
            _witnessed(game, values, allowed, i, witness[i], index, run, work, bits, True)
    return sweeps


@compiled
def leading(game: Any, values: Values, asked: Bools, bits: Bits, allowed: Bools, near: Ints) -> None:
    """bits of the nodes of the last level that are asked for get all inputs whose window is won. near: as in `invariance`."""
    counts, run = game.counts, _runs(game, values, min(near[1, -1] - near[0, -1] + 1, 255))
    strides, index, work = _strides(counts), np.zeros(len(counts), np.int64), np.zeros((3, len(counts)), np.int64)
    for i in range(len(game.flat)):
        if asked[i]:
            _unravel(strides, game.flat[i], index)
            _witnessed(game, values, allowed, i, 0, index, run, work, bits, True)


@borrowing
def _tried(game: Any, values: Values, level: int, pair: int, lists: Any, work: Any) -> bool:
    """Is the window, from c on, won in fewer than `level` steps? Else the pair hangs on what is not, if that may yet be."""
    a, b, c = work
    head, waiting, following = lists
    while True:
        q, above = _node(game, c)
        if values[q] < 0 or values[q] >= level:
            break
        _skip(c, above)
        if not _on(a, b, c, len(c)):
            return True
    if q >= game.start and values[q] >= -1:
        following[pair], head[q - game.start] = head[q - game.start], pair
    elif q < game.start and values[q] >= 0:
        following[pair], waiting[values[q]] = waiting[values[q]], pair
    return False


@borrowing
def _won(values: Values, bits: Bits, start: int, i: int, j: int, level: int, later: Any, number: int) -> int:
    _keep(bits, i, j)
    if values[start + i] == -1:
        values[start + i], later[number] = level, i
        return number + 1
    return number


@borrowing
def _again(
    game: Any, values: Values, bits: Bits, level: int, pair: int, q: int, lists: Any, room: Any, later: Any, number: int
) -> int:
    """The list of pairs from `pair` on, which hang on node q of the last level, or on a larger cell where q is −1."""
    counts, m, following = game.counts, game.tables[5].shape[1], lists[2]
    strides, index, work = room
    a, b, c = work
    while pair >= 0:
        after, i = following[pair], pair // m
        value = values[game.start + i]
        if value == -1 or value == level:
            _unravel(strides, game.flat[i], index)
            _window(game, i, index, pair - i * m, a, b)
            if q >= 0:
                _unravel(strides, game.flat[q], c)
            for k in range(len(counts)):
                c[k] = a[k] if q < 0 else (c[k] if c[k] >= a[k] else c[k] + counts[k])
            if _tried(game, values, level, pair, lists, work):
                number = _won(values, bits, game.start, i, pair - i * m, level, later, number)
        pair = after
    return number


@borrowing
def _begun(game: Any, values: Values, bits: Bits, allowed: Bools, lists: Any, room: Any, won: Any) -> int:
    """Every pair is tried for the first time; the number of cells that are won in one step."""
    m, number, start = game.tables[5].shape[1], 0, game.start
    strides, index, work = room
    a, b, c = work
    for i in range(len(game.flat)):
        if values[start + i] == -1:
            _unravel(strides, game.flat[i], index)
            for j in range(m):
                if (allowed.size and not allowed[i, j]) or not _window(game, i, index, j, a, b):
                    continue
                for k in range(len(index)):
                    c[k] = a[k]
                if _tried(game, values, 1, i * m + j, lists, work):
                    number = _won(values, bits, start, i, j, 1, won, number)
    return number


@compiled
def reach(game: Any, values: Values, bits: Bits, allowed: Bools, lists: Any) -> int:
    """Nodes of the last level with value −1 are won in the fewest steps, given those that are won; the largest such number.

    Those of the last level that are given have value 0. lists: head (nodes) and waiting (values that are given) of −1,
    following (pairs). A pair of a cell and an input hangs on one node of its window that is not won in fewer steps than are
    counted so far: on one of this level until it is won, on a larger cell until its value is passed.
    """
    head, waiting, _ = lists
    won, later = np.empty((2, len(game.flat)), head.dtype)
    room = _room(game.counts)
    number, level, top = _begun(game, values, bits, allowed, lists, room, won), 1, 0
    while number or level < len(waiting):
        top = level if number else top
        level += 1
        fresh = 0
        if level <= len(waiting):
            fresh = _again(game, values, bits, level, waiting[level - 1], -1, lists, room, later, fresh)
        for t in range(number):
            fresh = _again(game, values, bits, level, head[won[t]], won[t], lists, room, later, fresh)
        number, won, later = fresh, later, won
    return top
