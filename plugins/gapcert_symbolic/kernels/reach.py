"""Reaching on nodes × states of an automaton, compiled: by watched successors, each state of the automaton with its own lists.

All states of the automaton are solved at once, level by level: one problem of reaching for each, on the same windows. Each pair
of a position and an input hangs on one successor that cannot be entered yet: when it can, the rest of the window is looked
through for another. So a window is passed once, and no transition is stored.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gapcert.plugin import Bools, Ints

from .kernels import Bits, Game, Values, _cell, _keep, _outside, _room, _window, borrowing, compiled, inlined, whole

FRESH = -3  # won in this round


class Positions(NamedTuple):
    """leads[q, kind, t]: a node of that kind may take the automaton from q to t, the last t being nowhere; kind (nodes,).
    Only `active` states have positions to be won.

    Per state q: values (nodes,), 0 or more where given, −1 to be won, less elsewhere; bits of the nodes in play; good (nodes,)
    the level at which a node can be entered in state q, −1 before; missing (nodes,) how many of the positions that it may turn
    into are not won yet.
    """

    leads: Bools
    kind: npt.NDArray[np.integer]
    active: Bools
    values: Any
    bits: Bits
    good: Any
    missing: npt.NDArray[np.int16]


class Lists(NamedTuple):
    """Pairs of a position and an input: head (states, nodes), the first that hangs on a node, or −1, and following (states,
    pairs) the next one. won: room for the numbers of all positions.
    """

    head: Any
    following: Any
    won: Any


@borrowing
def _spread(on: Any, mark: int, won: Any, fresh: Any) -> int:
    """Positions `won` are won; pairs of an active state and a node that can be entered now get the mark, and go to `fresh`."""
    n, number = len(on.kind), 0
    for f in range(len(won)):
        t, c = won[f] // n, won[f] % n
        for q in range(len(on.active)):
            if on.active[q] and on.leads[q, on.kind[c], t]:
                on.missing[q, c] -= 1
                if on.missing[q, c] == 0:
                    on.good[q, c], fresh[number] = mark, q * n + c
                    number += 1
    return number


@inlined
def _tried(game: Any, on: Any, lists: Any, level: int, q: int, pair: int, work: Any, number: int) -> int:
    """Where the window, from c on, can be entered in fewer than `level` steps, the position wins by the input; else the pair
    hangs on what cannot. How many positions have won so far.
    """
    found = _outside(game, on.good[q], level, work)
    if found >= 0:
        lists.following[q, pair], lists.head[q, found] = lists.head[q, found], pair
        return number
    m = game.packed.column.shape[1]
    i = pair // m
    _keep(on.bits[q], i, pair - i * m)
    if on.values[q, game.start + i] == -1:
        on.values[q, game.start + i], lists.won[number] = FRESH, q * len(on.kind) + game.start + i
        return number + 1
    return number


@borrowing
def _hang(game: Any, on: Any, lists: Any, room: Any) -> int:
    """Every pair of a node and an input is tried for the first time. How many positions win, their numbers in `won`."""
    m, number, (index, work) = game.packed.column.shape[1], 0, room
    a, b, c = work
    for i in range(game.size):
        node, some = game.start + i, False
        for q in range(len(on.active)):
            some = some or (on.active[q] and on.values[q, node] == -1)
        if not some:
            continue
        _cell(game, i, index)
        for j in range(m):
            if (game.allowed.size and not game.allowed[i, j]) or not _window(game, i, index, j, a, b):
                continue
            for q in range(len(on.active)):
                if on.active[q] and (on.values[q, node] == -1 or on.values[q, node] == FRESH):
                    for k in range(len(c)):
                        c[k] = a[k]
                    number = _tried(game, on, lists, 1, q, i * m + j, work, number)
    return number


@borrowing
def _pull(game: Any, on: Any, level: int, lists: Any, fresh: Any, room: Any) -> int:
    """What hangs on the nodes that can be entered now is tried again."""
    m, n, number, (index, work) = game.packed.column.shape[1], len(on.kind), 0, room
    a, b, c = work
    for entry in fresh:
        q, node = entry // n, entry % n
        pair = lists.head[q, node]
        while pair >= 0:
            after, i = lists.following[q, pair], pair // m
            value = on.values[q, game.start + i]
            # What was won before has its inputs; what is won in this round may get further ones.
            if value == -1 or value == FRESH:
                _cell(game, i, index)
                _window(game, i, index, pair - i * m, a, b)
                # What a larger cell holds of the window may begin before it: all of it is looked at again.
                if node >= game.start:
                    _cell(game, node - game.start, c)
                for k in range(len(c)):
                    c[k] = a[k] if node < game.start else (c[k] if c[k] >= a[k] else c[k] + game.counts[k])
                number = _tried(game, on, lists, level, q, pair, work, number)
            pair = after
    return number


@compiled
def _least(game: Any, on: Any, lists: Any, due: Ints) -> None:
    """due: the positions that are given, by value."""
    n, room, done, level, number, more = len(on.kind), _room(len(game.counts)), 0, 0, 0, True
    won, fresh = lists.won, np.empty_like(lists.won)
    while more:
        while done < len(due) and on.values[due[done] // n, due[done] % n] <= level:
            won[number] = due[done]
            done, number = done + 1, number + 1
        entered, level = _spread(on, level, won[:number], fresh), level + 1
        number = _hang(game, on, lists, room) if level == 1 else _pull(game, on, level, lists, fresh[:entered], room)
        for f in range(number):
            on.values[won[f] // n, won[f] % n] = level
        more = number > 0 or done < len(due)


def least(game: Game, on: Positions) -> None:
    """Values of all positions that can be won, in the fewest steps, and their inputs."""
    states, pairs = len(on.values), game.size * game.packed.column.shape[1]
    given = on.values >= 0
    if game.level:
        given &= game.children == 0
    due = np.flatnonzero(given)
    due, kind = due[np.argsort(on.values.ravel()[due], kind="stable")], whole(states * pairs)
    following = np.empty((states, pairs if on.active.any() else 0), kind)
    _least(game, on, Lists(np.full(on.values.shape, -1, kind), following, np.empty(on.values.size, kind)), due)


def reach(game: Game, values: Values, bits: Bits) -> None:
    """As `least`, of nodes alone: an automaton with one state, in which a node is entered once it is won."""
    leads, kind = np.array([[[True, False]]]), np.zeros(len(values), np.int64)
    missing = np.ones((1, len(values)), np.int16)
    least(game, Positions(leads, kind, np.ones(1, bool), values[None], bits[None], values[None], missing))
