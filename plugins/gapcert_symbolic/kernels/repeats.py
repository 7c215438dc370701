"""Reach where windows repeat, compiled: pairs are found from the first cell of their windows, not stored.

Along axes on which no window depends, and which do not wrap, all windows move with the own cell. So the pairs whose window
begins at a given cell are the same for all cells of a class: those that agree in the other axes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gapcert.plugin import Bools, Ints, compiler
from gapcert_symbolic.cells.abstraction import Windows
from gapcert_symbolic.thresholds import THRESHOLDS

from .kernels import Bits, Values, _keep, _next, _strides, _unravel, _window, borrowing, compiled, together
from .reach import Positions, _spread

States = npt.NDArray[np.uint8]
LOST, OPEN, FRESH, WON = 0, 1, 2, 3  # FRESH: won in this round
SHAPES = 1 << 18  # cells in all shapes of windows together
NODES = 1 << 12
APART = 32  # numbers between what threads write, which would wait for each other at one line of a cache
STRIPE = 4  # times as far as a window reaches, at least: most windows then are one thread's


# Calls with this many arrays cost more than what they do.
small = compiler(inline="always", error_model="numpy")


class Inverse(NamedTuple):
    """Groups start[c] … start[c + 1] − 1 are of the windows that are watched at a cell of class c, by the own cell.

    Group g has the entries entry[g] … entry[g + 1] − 1, which differ in their windows; entry e is for the inputs
    input[first[e]:first[e + 1]]. back: the number of the watched cell less that of the own cell; lows: the same along the axes
    that are free. Its window is the cells[begin[s]:begin[s + 1]] of its shape s, counted from the watched cell, which is left
    out; reach (shapes, 2, axes): how far that goes before and beyond the watched cell. margin (2, axes): how far from the
    grid's ends no window and no own cell is outside along an axis that is free. counts, free, strides, steps (axes,): cells
    along each axis, whether it is free, and what a cell further along it adds to the number of a cell and to its class.
    """

    start: Ints
    entry: Ints
    first: Ints
    back: Any
    lows: Any
    input: Any
    shape: Any
    begin: Ints
    cells: Any
    reach: Ints
    margin: Ints
    counts: Ints
    free: Bools
    strides: Ints
    steps: Ints


@compiled
def _relative(game: Any, free: Bools, index: Ints, j: int, a: Ints, b: Ints) -> bool:
    """Window of a cell that is 0 along the free axes; False where it leaves the grid from every cell of the class."""
    _window(game, 0, index, j, a, b)
    counts, wraps, fits = game.counts, game.wraps, True
    for k in range(len(counts)):
        if free[k]:
            fits = fits and a[k] > -counts[k] and b[k] < counts[k]
        elif not wraps[k]:
            fits = fits and a[k] >= 0 and b[k] < counts[k]
    return fits


@compiled
def _far(counts: Ints, wraps: Bools, index: Ints, a: Ints, b: Ints, k: int) -> int:
    """Is the last cell of the window nearer to the own cell than the first?"""
    ahead = a[k] + b[k] - 2 * index[k]
    return int(-counts[k] < ahead < 0 or ahead > counts[k]) if wraps[k] else int(ahead < 0)


@compiled
def _tally(game: Any, free: Bools, some: Ints, classes: int) -> tuple[Ints, Ints, Ints]:
    """Start of each class, the widest window along each axis, and the margins. some (axes,): counts, and 1 where free."""
    counts, wraps, n, m = game.counts, game.wraps, len(game.counts), game.packed.column.shape[1]
    strides, start = _strides(some), np.zeros(classes + 1, np.int64)
    most, margin = np.ones(n, np.int64), np.zeros((2, n), np.int64)
    index, a, b = np.zeros((3, n), np.int64)
    for _ in range(classes):
        for j in range(m):
            if _relative(game, free, index, j, a, b):
                at = 0
                for k in range(n):
                    most[k] = max(most[k], b[k] - a[k] + 1)
                    low, high = min(a[k], 0), max(b[k], 0)
                    watched = b[k] if _far(counts, wraps, index, a, b, k) else a[k]
                    if free[k]:
                        margin[0, k], margin[1, k] = max(margin[0, k], watched - low), max(margin[1, k], high - watched)
                    else:
                        at += watched % counts[k] * strides[k]
                start[at + 1] += 1
        _next(some, index)
    for c in range(classes):
        start[c + 1] += start[c]
    return start, most, margin


@compiled
def _fill(game: Any, free: Bools, some: Ints, most: Ints, place: Ints, known: Any, entries: Any, seen: Ints) -> int:
    """Fill the entries (back, lows, input, shape) and `seen` (shapes, 2 axes): extent, and cells up to where it wraps."""
    counts, wraps, n, m, shapes = game.counts, game.wraps, len(game.counts), game.packed.column.shape[1], 0
    back, lows, inputs, shape = entries
    narrow = _strides(some)
    index, a, b, c = np.zeros((4, n), np.int64)
    for _ in range(len(place) - 1):
        for j in range(m):
            if _relative(game, free, index, j, a, b):
                at, flat, key, f = 0, 0, 0, 0
                for k in range(n):
                    size, far = b[k] - a[k] + 1, _far(counts, wraps, index, a, b, k)
                    key = (key * most[k] + size - 1) * 2 + far
                    if wraps[k]:
                        key = key * most[k] + min(size, counts[k] - a[k]) - 1
                    c[k] = b[k] if far else a[k]
                    if not free[k]:
                        c[k] = c[k] % counts[k]
                        at += c[k] * narrow[k]
                    flat += (c[k] - index[k]) * game.strides[k]
                e = place[at]
                place[at] = e + 1
                for k in range(n):
                    if free[k]:
                        lows[e, f] = c[k]
                        f += 1
                if known[key] < 0:
                    known[key] = shapes
                    if shapes < len(seen):
                        for k in range(n):
                            seen[shapes, 0, k] = b[k] - a[k] + 1
                            seen[shapes, 1, k] = counts[k] - a[k] if wraps[k] else counts[k]
                            seen[shapes, 2, k] = _far(counts, wraps, index, a, b, k)
                    shapes += 1
                back[e], inputs[e], shape[e] = flat, j, known[key]
        _next(some, index)
    return shapes


@compiled
def _grouped(start: Ints, back: Any, shape: Any) -> Any:
    """Entries of each class, ordered by own cell and shape, with those that differ in the input alone put together: where those
    of a class start, and of a cell; where the inputs of an entry start in the order, which is the last.
    """
    starts, entry, first = np.zeros(len(start), np.int64), np.zeros(len(back) + 1, np.int64), np.zeros(len(back) + 1, np.int64)
    order, groups, entries = np.zeros(len(back), np.int64), 0, 0
    for c in range(len(start) - 1):
        begin, end = start[c], start[c + 1]
        keys = np.empty(end - begin, np.int64)
        for t in range(begin, end):
            keys[t - begin] = np.int64(back[t]) * SHAPES + shape[t]
        sorted_ = np.argsort(keys, kind="mergesort")
        for t in range(begin, end):
            order[t] = begin + sorted_[t - begin]
        for t in range(begin, end):
            e, before = order[t], order[t - 1]
            other = t == begin or back[e] != back[before]
            if other:
                entry[groups] = entries
                groups += 1
            if other or shape[e] != shape[before]:
                first[entries] = t
                entries += 1
        starts[c + 1] = groups
    entry[groups], first[entries] = entries, len(back)
    return starts, entry[: groups + 1], first[: entries + 1], order


def inverse(windows: Windows, whole: Any) -> Inverse | None:
    """Entries with numbers of the type `whole`; None where classes are too small for it to pay."""
    grid, n = windows.grid, len(windows.axes)
    used = {d for axis in windows.axes for d in axis.on} | {k for k, axis in enumerate(windows.axes) if not axis.moves}
    free = np.array([k not in used and not wraps for k, wraps in enumerate(grid.wraps)])
    classes = math.prod(c for c, own in zip(grid.counts, free, strict=True) if not own)
    if grid.size < THRESHOLDS.class_cells * classes:
        return None
    game, counts, wraps = windows.game, np.array(grid.counts), np.array(grid.wraps)
    some = np.where(free, 1, counts)
    start, most, margin = _tally(game, free, some, classes)
    keys, size = 2**n * math.prod(int(w) for w in most) * math.prod(int(w) for w in most[wraps]), int(start[-1])
    if keys > SHAPES:
        return None
    back, lows = np.empty(size, whole), np.empty((size, int(free.sum())), np.int32)
    entries = (back, lows, *np.empty((2, size), np.int32))
    known, seen = np.full(keys, -1, np.int32), np.empty((min(keys, size), 3, n), np.int64)
    shapes = _fill(game, free, some, most, start.copy(), known, entries, seen)
    begin, cells = np.zeros(shapes + 1, np.int64), []
    strides = game.strides
    reach = np.stack([seen[:shapes, 2], 1 - seen[:shapes, 2]], axis=1) * (seen[:shapes, :1] - 1)
    for s, (size, split, far) in enumerate(seen[:shapes]):
        at = np.indices(size).reshape(n, -1).T
        where = np.where(at < split, at, at - counts) @ strides
        first = int(np.ravel_multi_index(tuple(far * (size - 1)), tuple(size)))
        # Corners first: they are the last to be won, and so a pair changes its place least often.
        order = np.argsort(-((at == 0) | (at == size - 1)).sum(axis=1), kind="stable")
        cells.append((where - where[first])[order[order != first]])
        begin[s + 1] = begin[s] + len(cells[-1])
    flat = np.concatenate([*cells, np.empty(0, np.int64)]).astype(whole)
    starts, entry, first, order = _grouped(start, back, entries[3])
    kept, inputs = order[first[:-1]], entries[2][order]
    back, lows, shape = back[kept], lows[kept], entries[3][kept]
    steps = np.where(free, 0, _strides(some))
    return Inverse(starts, entry, first, back, lows, inputs, shape, begin, flat, reach, margin, counts, free, strides, steps)


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
