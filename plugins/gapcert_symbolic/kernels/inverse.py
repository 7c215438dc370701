"""Reach where windows repeat, compiled: pairs are found from the first cell of their windows (`repeats`), not stored."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gapcert.plugin import Bools, Ints, compiler
from gapcert_symbolic.cells.repeats import Inverse

from .kernels import Bits, Values, _keep, _unravel, borrowing, together
from .reach import Positions, _spread

States = npt.NDArray[np.uint8]
LOST, OPEN, FRESH, WON = 0, 1, 2, 3  # FRESH: won in this round
NODES = 1 << 12
APART = 32  # numbers between what threads write, which would wait for each other at one line of a cache
STRIPE = 4  # times as far as a window reaches, at least: most windows then are one thread's


# Calls with this many arrays cost more than what they do.
small = compiler(inline="always", error_model="numpy")


class Lists(NamedTuple):
    """head (positions,): the first node that hangs on a position, or −1. nodes (n, 4): first position of the window, entry,
    place in the shape, next node. spare: the first node to be used again, or −1, and the number of nodes ever used. at
    (axes,): room for the place of a cell in the grid.
    """

    head: Any
    nodes: Any
    spare: Ints
    at: Ints


class Found(NamedTuple):
    """Positions are cells, or with an automaton, cell + cells · q for each of its states q. state: what each is as the cell of
    a window; own: what it is itself, the same array unless an automaton makes the difference. allowed (cells, inputs).
    """

    state: States
    own: States
    values: Values
    bits: Bits
    allowed: Bools


@small
def _own(given: Any, index: Ints, e: int) -> bool:
    """Is the own cell of an entry that is watched at the cell `index` in the grid?"""
    f, inside = 0, True
    for k in range(len(index)):
        if given.free[k]:
            inside = inside and 0 <= index[k] - given.lows[e, f] < given.counts[k]
            f += 1
    return inside


@small
def _fits(given: Any, index: Ints, s: int) -> bool:
    """Is a window of shape s that is watched at the cell `index` in the grid?"""
    inside = True
    for k in range(len(index)):
        if given.free[k]:
            inside = inside and index[k] >= given.reach[s, 0, k] and index[k] + given.reach[s, 1, k] < given.counts[k]
    return inside


@small
def _place(given: Any, state: States, low: int, place: int, end: int) -> int:
    """From `place` on, where the shape's first cell is that is not won; `end` if there is none."""
    # Of indices without a sign, none is looked at for being negative.
    while place < end and state[np.uintp(low + given.cells[np.uintp(place)])] == WON:
        place += 1
    return place


@small
def _win(given: Any, found: Any, later: Any, number: int, level: int, i: int, e: int) -> int:
    """Position i wins by the inputs of entry e, as far as they are allowed."""
    # Outside the loop: a division in it makes all of reach slower by half, even where it is not done.
    won, cell = False, i % len(found.allowed) if found.allowed.size else 0
    for t in range(given.first[e], given.first[e + 1]):
        j = given.input[t]
        if not found.allowed.size or found.allowed[cell, j]:
            _keep(found.bits, i, j)
            won = True
    if won and found.own[i] == OPEN:
        found.own[i], found.values[i], later[number] = FRESH, level, i
        return number + 1
    return number


@small
def _hang(lists: Any, z: int, q: int, e: int, place: int) -> None:
    node = lists.spare[0]
    if node >= 0:
        lists.spare[0] = lists.nodes[node, 3]
    else:
        node = lists.spare[1]
        lists.spare[1] += 1
    lists.nodes[node, 0], lists.nodes[node, 1], lists.nodes[node, 2] = q, e, place
    lists.nodes[node, 3], lists.head[z] = lists.head[z], node


@small
def _mine(i: int, part: Any) -> bool:
    """Is a cell one of those whose pairs this thread has?"""
    number, own, stripe = part
    return bool(number == 1 or (i >> stripe) % number == own)


@small
def _first(given: Any, found: Any, lists: Any, near: Any, q: int, c: int, level: int, later: Any, number: int) -> int:
    """The windows that are watched at q, which is won: they win, or hang on another cell."""
    inside, part = near
    for g in range(given.start[c], given.start[c + 1]):
        begin = given.entry[g]
        if not inside and not _own(given, lists.at, begin):
            continue
        i = q - given.back[begin]
        own = found.own[np.uintp(i)]
        if _mine(i, part) and own in (OPEN, FRESH):
            for e in range(begin, given.entry[g + 1]):
                s = given.shape[e]
                if inside or _fits(given, lists.at, s):
                    place = _place(given, found.state, q, given.begin[s], given.begin[s + 1])
                    if place == given.begin[s + 1]:
                        number = _win(given, found, later, number, level, i, e)
                    elif found.own[i] == OPEN and found.state[q + given.cells[place]] != LOST:
                        _hang(lists, q + given.cells[place], q, e, place)
    return number


@small
def _again(given: Any, found: Any, lists: Any, q: int, level: int, later: Any, number: int) -> int:
    """The windows that hang on q, which is won: they win, or hang on another cell."""
    node = lists.head[q]
    while node >= 0:
        low, e, place, after = lists.nodes[node, 0], lists.nodes[node, 1], lists.nodes[node, 2], lists.nodes[node, 3]
        i, hung = low - given.back[e], False
        if found.own[i] == OPEN or found.own[i] == FRESH:
            end = given.begin[given.shape[e] + 1]
            place = _place(given, found.state, low, place + 1, end)
            if place == end:
                number = _win(given, found, later, number, level, i, e)
            else:
                z = low + given.cells[place]
                if found.own[i] == OPEN and found.state[z] != LOST:
                    lists.nodes[node, 2], lists.nodes[node, 3], lists.head[z], hung = place, lists.head[z], node, True
        if not hung:
            lists.nodes[node, 3], lists.spare[0] = lists.spare[0], node
        node = after
    return number


@borrowing
def _round(
    given: Any,
    found: Any,
    lists: Any,
    level: int,
    won: Any,
    later: Any,
    begin: int,
    number: int,
    part: Any,
) -> tuple[int, int]:
    """What is watched at won[begin:] or hangs there wins at `level`, or hangs on another cell then; how many of `won` were done
    before nodes ran out, and the number in `later`.

    part: of how many threads this is which one; stripes of 2^stripe cells go to them in turn; and the ends of `back`.
    """
    index, (parts, own, stripe, low, high) = lists.at, part
    cells = given.strides[0] * given.counts[0]
    for f in range(begin, len(won)):
        q, c, inside = won[f], 0, True
        first, last = max(q - high, 0) >> stripe, max(q - low, 0) >> stripe
        if parts > 1 and first == last and first % parts != own:
            number = _again(given, found, lists, q, level, later, number)
            continue
        _unravel(given.strides, q % cells, index)
        for k in range(len(index)):
            if given.free[k]:
                inside = inside and given.margin[0, k] <= index[k] < given.counts[k] - given.margin[1, k]
            else:
                c += index[k] * given.steps[k]
        if lists.spare[1] + given.entry[given.start[c + 1]] - given.entry[given.start[c]] > len(lists.nodes):
            return f, number
        near = inside, (1 if first == last else parts, own, stripe)
        number = _first(given, found, lists, near, q, c, level, later, number)
        number = _again(given, found, lists, q, level, later, number)
    return len(won), number


def fixpoint(given: Inverse, found: Found, threads: int = 1, entered: Callable[[Any], Any] | None = None) -> None:
    """Values and inputs of all positions that can be won, in the fewest steps. entered: of positions that are won, those that
    can be entered now, where an automaton makes the difference.

    A thread has the pairs of its own cells: it alone changes what is known of these, and hangs them on lists of its own. Who
    is won is told to all after the round, so nothing depends on the number of threads.
    """
    size, kind = len(found.state), given.back.dtype
    low, high = int(given.back.min(initial=0)), int(given.back.max(initial=0))
    stripe = max(6, (STRIPE * (high - low)).bit_length())
    later = np.empty((threads, (1 << stripe) * -(-size // (threads << stripe))), kind)
    won, nodes, level = np.empty(size, kind), np.empty((threads, NODES, 4), kind), 0
    head, room = np.full((threads, size), -1, kind), np.zeros((threads, APART + len(given.counts)), np.int64)
    room[:, 0] = -1
    lists = [Lists(head[t], nodes[t], room[t, :2], room[t, APART:]) for t in range(threads)]
    done, fresh = [0] * threads, [0] * threads

    def work(t: int) -> None:
        part = threads, t, stripe, low, high
        done[t], fresh[t] = _round(given, found, lists[t], level, ready, later[t], done[t], fresh[t], part)

    ready = np.flatnonzero(found.own == WON).astype(kind)
    with together(threads) as each:
        while len(ready):
            ready = ready if entered is None else entered(ready)
            level += 1
            done[:], fresh[:] = [0] * threads, [0] * threads
            each(work)
            while min(done) < len(ready):
                longer = np.empty((threads, nodes.shape[1] * 3 // 2 + len(given.back), 4), kind)
                longer[:, : nodes.shape[1]] = nodes
                nodes = longer
                lists = [own._replace(nodes=nodes[t]) for t, own in enumerate(lists)]
                each(work)
            number = 0
            for t in range(threads):
                new = later[t, : fresh[t]]
                found.own[new], won[number : number + len(new)] = WON, new
                number += len(new)
            ready = won[:number]


def states(values: Values) -> States:
    """What is known of positions before the first round."""
    out = np.full(values.shape, LOST, np.uint8)
    out[values == -1], out[values >= 0] = OPEN, WON
    return out


def reach(given: Inverse, values: Values, bits: Bits, allowed: Bools, threads: int = 1) -> None:
    """As `reach.reach`."""
    state = states(values)
    fixpoint(given, Found(state, state, values, bits, allowed), threads)


def least(given: Inverse, on: Positions, allowed: Bools) -> None:
    """As `reach.least`."""
    state, own = np.full(on.missing.shape, LOST, np.uint8), states(on.values)
    state[on.missing < 2 * len(on.missing)] = OPEN
    fresh, on = np.empty(state.size, given.back.dtype), on._replace(good=state)
    found = Found(state.ravel(), own.ravel(), on.values.ravel(), on.bits.reshape(own.size, -1), allowed)
    fixpoint(given, found, 1, lambda won: fresh[: _spread(on, WON, won, fresh)])
