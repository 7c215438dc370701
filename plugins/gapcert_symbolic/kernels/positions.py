"""Reaching on cells × states of an automaton, compiled: watched successors, each state of the automaton with its own lists.

All states of the automaton are solved at once, level by level: one problem of reaching for each, on the same windows.

Per state q: pos (cells,) are the values of positions, 0 where given, −1 to be won, less elsewhere; good (cells,) the level at
which a cell can be entered in state q, −1 before; missing (cells,) how many of the positions that it may turn into are not won
yet.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from gapcert.plugin import Bools, Ints

from . import inverse
from .inverse import Lists
from .kernels import _advance, _keep, _next, _strides, _unravel, _window, borrowing, compiled


@borrowing
def _spread(leads: Any, active: Bools, kind: Ints, missing: Any, good: Any, mark: int, won: Any, fresh: Any) -> int:
    """Positions `won` are won; pairs of an active state and a cell that can be entered now get the mark, and go to `fresh`."""
    n, number = len(kind), 0
    for f in range(len(won)):
        t, c = won[f] // n, won[f] % n
        for q in range(leads.shape[0]):
            if active[q] and leads[q, kind[c], t]:
                missing[q, c] -= 1
                if missing[q, c] == 0:
                    good[q, c], fresh[number] = mark, q * n + c
                    number += 1
    return number


@borrowing
def _hang(
    counts: Ints,
    wraps: Bools,
    packed: Any,
    pos: Any,
    good: Any,
    bits: Any,
    allowed: Bools,
    active: Bools,
    head: Any,
    following: Any,
    won: Ints,
    room: Ints,
) -> int:
    """Hang every pair of a cell and an input on the first cell of its window that cannot be entered yet; those that have none
    win. How many positions do, their numbers in `won`. room: strides, and four rows for places in the grid, the first of zeros.
    """
    m, n, number = packed[5].shape[1], pos.shape[1], 0
    strides, index, a, b, c = room[0], room[1], room[2], room[3], room[4]
    for i in range(n):
        for j in range(m):
            if (allowed.size and not allowed[i, j]) or not _window(counts, wraps, packed, index, j, a, b):
                continue
            for q in range(len(active)):
                if not active[q] or (pos[q, i] != -1 and pos[q, i] != 1):
                    continue
                for k in range(len(counts)):
                    c[k] = a[k]
                found = _advance(counts, strides, a, b, c, good[q], 1)
                if found >= 0:
                    following[q, i * m + j], head[q, found] = head[q, found], i * m + j
                else:
                    _keep(bits[q], i, j)
                    if pos[q, i] == -1:
                        pos[q, i], won[number] = 1, q * n + i
                        number += 1
        _next(counts, index)
    return number


@borrowing
def _pull(
    counts: Ints,
    wraps: Bools,
    packed: Any,
    pos: Any,
    good: Any,
    bits: Any,
    level: int,
    head: Any,
    following: Any,
    fresh: Ints,
    won: Ints,
    room: Ints,
) -> int:
    """What hangs on the cells that can be entered now wins at `level`, or hangs on another cell then."""
    m, n, number = packed[5].shape[1], pos.shape[1], 0
    strides, index, a, b, c = room[0], room[1], room[2], room[3], room[4]
    for entry in fresh:
        q, cell = entry // n, entry % n
        pair = head[q, cell]
        while pair >= 0:
            after, i = following[q, pair], pair // m
            value = pos[q, i]
            if value == -1 or value == level:
                j = pair - i * m
                _unravel(strides, i, index)
                _window(counts, wraps, packed, index, j, a, b)
                _unravel(strides, cell, c)
                for k in range(len(counts)):
                    if c[k] < a[k]:
                        c[k] += counts[k]
                found = _advance(counts, strides, a, b, c, good[q], level)
                if found >= 0:
                    following[q, pair], head[q, found] = head[q, found], pair
                else:
                    _keep(bits[q], i, j)
                    if value == -1:
                        pos[q, i], won[number] = level, q * n + i
                        number += 1
            pair = after
    return number


@compiled
def least(
    counts: Ints,
    wraps: Bools,
    packed: Any,
    leads: Any,
    kind: Ints,
    missing: Any,
    pos: Any,
    good: Any,
    bits: Any,
    allowed: Bools,
    active: Bools,
    head: Any,
    following: Any,
) -> int:
    """Values and inputs of all positions that can be won; the largest value. Only `active` states have positions to be won."""
    states, n = pos.shape
    won, fresh = np.empty((2, states * n), np.int64)
    number = 0
    for q in range(states):
        for c in range(n):
            if pos[q, c] == 0:
                won[number] = q * n + c
                number += 1
    _spread(leads, active, kind, missing, good, 0, won[:number], fresh)
    room = np.zeros((5, len(counts)), np.int64)
    room[0] = _strides(counts)
    number = _hang(counts, wraps, packed, pos, good, bits, allowed, active, head, following, won, room)
    level = 0
    while number:
        level += 1
        entered = _spread(leads, active, kind, missing, good, level, won[:number], fresh)
        number = _pull(counts, wraps, packed, pos, good, bits, level + 1, head, following, fresh[:entered], won, room)
    return level


@compiled
def repeated(
    given: Any,
    leads: Any,
    kind: Ints,
    missing: Any,
    found: Any,
    state: Any,
    active: Bools,
    nodes: Any,
) -> int:
    """As `least`, where windows repeat: `given` is of `repeats.inverse`. state (states, cells) is found.state
    and what `good` is in `least`; nodes (n, 4): made longer if need be.
    """
    won, fresh = np.empty(state.size, nodes.dtype), np.empty(state.size, nodes.dtype)
    number, level = 0, 0
    for p in range(state.size):
        if found.own[p] == inverse.WON:
            won[number] = p
            number += 1
    head, spare, index = np.full(state.size, -1, nodes.dtype), np.array([-1, 0]), np.zeros(len(given.counts), np.int64)
    while True:
        entered = _spread(leads, active, kind, missing, state, inverse.WON, won[:number], fresh)
        done, number = 0, 0
        while done < entered:
            lists, alone = Lists(head, nodes, spare, index), (1, 0, 0, 0, 0)
            done, number = inverse._round(given, found, lists, level + 1, fresh[:entered], won, done, number, alone)
            if done < entered:
                longer = np.empty((len(nodes) * 3 // 2 + len(given.back), 4), nodes.dtype)
                longer[: len(nodes)] = nodes
                nodes = longer
        if number == 0:
            return level
        level += 1
        for f in range(number):
            found.own[won[f]] = inverse.WON
