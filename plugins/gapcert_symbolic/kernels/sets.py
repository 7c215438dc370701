"""Sets of cells in play that are kept or may be won, compiled; of cells some of which are halved, too (`kernels.Game`)."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from gapcert.plugin import Bools, Ints

from .kernels import Bits, Marks, Values, _cell, _keep, _node, _on, _room, _skip, _window, borrowing, compiled, inlined

LOOKS = 4  # nodes that are looked at in a window, or so
MOST = 255  # cells that a run may have: what a byte holds


@borrowing
def _meets(game: Any, node: int, index: Ints, marks: Marks, work: Any) -> bool:
    """Does the window of any input meet a marked node?"""
    a, b, c = work
    for j in range(game.packed.column.shape[1]):
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
    (index, work), n, sweep, changed = _room(len(game.counts)), game.size, 0, True
    while changed:
        changed = False
        for t in range(n):
            i = t if sweep % 2 == 0 else n - 1 - t
            if asked[i] and marks[game.start + i] == greatest:
                _cell(game, i, index)
                if _meets(game, i, index, marks, work) != greatest:
                    marks[game.start + i], changed = 1 - greatest, True
        sweep += 1


class Kept(NamedTuple):
    """values (nodes,), 0 or more where won; bits of the cells in play; run: so many cells along the last axis,
    from each one on, are known to be won, and at most `most`.

    Runs end at the grid's edge. They may be too short, never too long.
    """

    values: Values
    bits: Bits
    run: Marks
    most: int


@inlined
def _leads(game: Any, on: Any, i: int, index: Ints, j: int, work: Any) -> bool:
    """Is the window inside the grid, and won?"""
    a, b, c = work
    if not _window(game, i, index, j, a, b):
        return False
    for k in range(len(c)):
        c[k] = a[k]
    while True:
        q, above = _node(game, c)
        if on.values[q] < 0:
            return False
        if q >= game.start:
            c[len(c) - 1] += on.run[q - game.start] - 1
        else:
            _skip(c, above)
        if not _on(a, b, c, len(c)):
            return True


@compiled
def _runs(game: Any, values: Values, most: int) -> Marks:
    """`Kept.run`."""
    counts, run, n = game.counts, np.ones(game.size, np.uint8), len(game.counts) - 1
    c, order = np.zeros(n + 1, np.int64), np.argsort(game.flat) if game.level else np.arange(game.size)
    for i in order[::-1]:
        _cell(game, i, c)
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
def _cut(game: Any, on: Any, lost: int, c: Ints) -> None:
    """Runs end before a cell in play that is lost."""
    n = len(c) - 1
    _cell(game, lost, c)
    end = c[n]
    c[n] -= 1
    while c[n] >= 0 and end - c[n] < on.most:
        q, above = _node(game, c)
        if on.values[q] < 0:
            return
        if q >= game.start:
            on.run[q - game.start] = min(on.run[q - game.start], end - c[n])
        c[n] = (c[n] >> above << above) - 1


@compiled
def _disturbed(game: Any, values: Values, near: Ints, lost: int, witness: Any, dirty: Marks) -> None:
    """Marks those whose window, under the input that they rely on, holds the node of the last level that is lost."""
    counts, wraps, n = game.counts, game.wraps, len(game.counts)
    at, low, high, index, c, a, b = np.zeros((7, n), np.int64)
    _cell(game, lost, at)
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
def _witnessed(game: Any, on: Any, i: int, j: int, room: Any, every: bool) -> int:
    """From j on, the first input that leads into what is won, or the number of inputs; `every` keeps all of them in bits."""
    m, (index, work) = game.packed.column.shape[1], room
    _cell(game, i, index)
    while j < m:
        if (not game.allowed.size or game.allowed[i, j]) and _leads(game, on, i, index, j, work):
            if not every:
                return j
            _keep(on.bits, i, j)
        j += 1
    return j


@compiled
def invariance(game: Any, values: Values, bits: Bits, near: Ints) -> int:
    """The largest set of cells in play with value 0 that have an input whose window is won; values become −1 elsewhere, and
    bits are filled. near (2, axes): least and largest offset of windows. The number of sweeps is returned.
    """
    counts, n, start, m, sweeps, lost, around = game.counts, game.size, game.start, game.packed.column.shape[1], 0, 1, 1
    for k in range(len(counts)):
        around *= min(near[1, k] - near[0, k] + 1, counts[k])
    # Longer runs are not asked for.
    most = min(near[1, -1] - near[0, -1] + 1, MOST)
    on, room, c = Kept(values, bits, _runs(game, values, most), most), _room(len(counts)), np.zeros(len(counts), np.int64)
    witness, dirty, dead = np.zeros(n, np.int32), np.ones(n, np.uint8), np.empty(n, np.int64)
    while lost:
        lost = 0
        for t in range(n):
            i = t if sweeps % 2 == 0 else n - 1 - t
            if dirty[i] and values[start + i] == 0:
                # What led out of a larger set leads out of a smaller one.
                witness[i] = _witnessed(game, on, i, witness[i], room, False)
                if witness[i] == m:
                    values[start + i], dead[lost] = -1, i
                    lost += 1
                    _cut(game, on, i, c)
        sweeps += 1
        # All that rely on what is lost are looked for where that takes less than to look at all windows again.
        dirty[:] = lost * around > n * LOOKS
        if lost * around <= n * LOOKS:
            for t in range(lost):
                _disturbed(game, values, near, dead[t], witness, dirty)
    for i in range(n):
        if values[start + i] == 0:
            _witnessed(game, on, i, witness[i], room, True)
    return sweeps


@compiled
def leading(game: Any, values: Values, asked: Bools, bits: Bits) -> None:
    """bits of the cells in play that are asked for get all inputs whose window is won."""
    on, room = Kept(values, bits, _runs(game, values, MOST), MOST), _room(len(game.counts))
    for i in range(game.size):
        if asked[i]:
            _witnessed(game, on, i, 0, room, True)


@compiled
def meeting(game: Any, asked: Bools, marks: Marks) -> Bools:
    """(cells in play,): those that are asked for and have an input whose window meets a marked node."""
    out, (index, work) = np.zeros(game.size, np.bool_), _room(len(game.counts))
    for i in range(game.size):
        if asked[i]:
            _cell(game, i, index)
            out[i] = _meets(game, i, index, marks, work)
    return out
