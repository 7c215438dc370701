"""Reaching on nodes × states of an automaton, compiled: `positions` on cells of which some are split (`tree_kernels`).

pos and good are as in `positions`, per node; pos is 0 or more where it is given. bits, allowed inputs and the lists
of pairs are of the last level's nodes, which have the positions to be won.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from gapcert.plugin import Bools, Ints

from .kernels import Bits, _keep, _on, _unravel, borrowing, compiled
from .positions import _spread
from .tree_kernels import Marks, _meets, _node, _room, _skip, _window


@compiled
def meeting(game: Any, asked: Bools, marks: Marks) -> Bools:
    """(nodes of the last level,): those that are asked for and have an input whose window meets a marked node."""
    out = np.zeros(len(game.flat), np.bool_)
    strides, index, work = _room(game.counts)
    for i in range(len(game.flat)):
        if asked[i]:
            _unravel(strides, game.flat[i], index)
            out[i] = _meets(game, i, index, marks, work)
    return out


@borrowing
def _closed(game: Any, good: Ints, level: int, work: Any) -> int:
    """From c on, the first node of the window that cannot be entered in fewer than `level` steps, or −1."""
    a, b, c = work
    while True:
        q, above = _node(game, c)
        if good[q] < 0 or good[q] >= level:
            return q
        _skip(c, above)
        if not _on(a, b, c, len(c)):
            return -1


@compiled
def _hang(
    game: Any, pos: Any, good: Any, bits: Bits, allowed: Bools, active: Bools, head: Any, following: Any, won: Ints
) -> int:
    """As `positions._hang`."""
    m, nodes, number = game.tables[5].shape[1], pos.shape[1], 0
    strides, index, work = _room(game.counts)
    a, b, c = work
    for i in range(len(game.flat)):
        node, some = game.start + i, False
        for q in range(len(active)):
            some = some or (active[q] and pos[q, node] == -1)
        if not some:
            continue
        _unravel(strides, game.flat[i], index)
        for j in range(m):
            if (allowed.size and not allowed[i, j]) or not _window(game, i, index, j, a, b):
                continue
            for q in range(len(active)):
                if not active[q] or (pos[q, node] != -1 and pos[q, node] != -3):
                    continue
                for k in range(len(c)):
                    c[k] = a[k]
                found = _closed(game, good[q], 1, work)
                if found >= 0:
                    following[q, i * m + j], head[q, found] = head[q, found], i * m + j
                else:
                    _keep(bits[q], i, j)
                    if pos[q, node] == -1:
                        pos[q, node], won[number] = -3, q * nodes + node
                        number += 1
    for f in range(number):
        pos[won[f] // nodes, won[f] % nodes] = 1
    return number


@compiled
def _pull(
    game: Any, fixed: Any, pos: Any, good: Any, bits: Bits, level: int, head: Any, following: Any, fresh: Ints, won: Ints
) -> int:
    """As `positions._pull`; `fixed` positions are those that were given."""
    m, nodes, number = game.tables[5].shape[1], pos.shape[1], 0
    strides, index, work = _room(game.counts)
    a, b, c = work
    for entry in fresh:
        q, cell = entry // nodes, entry % nodes
        pair = head[q, cell]
        while pair >= 0:
            after, i = following[q, pair], pair // m
            value = pos[q, game.start + i]
            if value == -1 or (value == level and not fixed[q, game.start + i]):
                j = pair - i * m
                _unravel(strides, game.flat[i], index)
                _window(game, i, index, j, a, b)
                if cell >= game.start:
                    _unravel(strides, game.flat[cell - game.start], c)
                for k in range(len(c)):
                    c[k] = a[k] if cell < game.start else (c[k] if c[k] >= a[k] else c[k] + game.counts[k])
                found = _closed(game, good[q], level, work)
                if found >= 0:
                    following[q, pair], head[q, found] = head[q, found], pair
                else:
                    _keep(bits[q], i, j)
                    if value == -1:
                        pos[q, game.start + i], won[number] = level, q * nodes + game.start + i
                        number += 1
            pair = after
    return number


@compiled
def least(
    game: Any,
    leads: Any,
    kind: Ints,
    missing: Any,
    pos: Any,
    good: Any,
    bits: Bits,
    allowed: Bools,
    active: Bools,
    head: Any,
    following: Any,
    due: Ints,
) -> int:
    """Values and inputs of all positions that can be won; the largest value. due: the positions that are given, by value."""
    states, nodes = pos.shape
    won, fresh, fixed = np.empty(states * nodes, np.int64), np.empty(states * nodes, np.int64), pos >= 0
    done, number, level = 0, 0, 0
    while done < len(due) and pos[due[done] // nodes, due[done] % nodes] == 0:
        done += 1
    _spread(leads, active, kind, missing, good, 0, due[:done], fresh)
    number = _hang(game, pos, good, bits, allowed, active, head, following, won)
    while number or done < len(due):
        level += 1
        while done < len(due) and pos[due[done] // nodes, due[done] % nodes] <= level:
            won[number] = due[done]
            done, number = done + 1, number + 1
        entered = _spread(leads, active, kind, missing, good, level, won[:number], fresh)
        number = _pull(game, fixed, pos, good, bits, level + 1, head, following, fresh[:entered], won)
    return level
