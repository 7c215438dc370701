"""Reach by what is watched at a cell gives the same values and inputs as by lists of all pairs."""

from __future__ import annotations

import os

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gapcert import Box, StateSpec
from gapcert.plugin import Automaton, Bools
from gapcert_cells import Along
from gapcert_symbolic.cells.abstraction import Windows
from gapcert_symbolic.cells.grid import Grid
from gapcert_symbolic.games import games
from gapcert_symbolic.kernels import reach, repeats
from gapcert_symbolic.solvers.problem import Play

TURN = 2 * np.pi


def drawn(rng: np.random.Generator, counts: tuple[int, ...], m: int, wraps: tuple[bool, ...], relations: bool) -> Windows:
    """Windows of a few cells, none of which depends on the first axis; on which others each depends is drawn."""
    states = tuple(StateSpec(f"x{k}", "rad", "angle") if w else StateSpec(f"x{k}") for k, w in enumerate(wraps))
    grid = Grid(Box(states, (0.0,) * len(counts), tuple(TURN if w else 1.0 for w in wraps)), counts)
    axes = []
    for k, n in enumerate(counts):
        moves = bool(k == 0 or rng.random() < 0.7)
        on = tuple(d for d in range(1, len(counts)) if (d != k and rng.random() < 0.4) or (d == k and not moves))
        column = rng.integers(1 + rng.integers(m), size=m)
        size = int(np.prod([counts[d] for d in on])), int(column.max()) + 1
        first = rng.integers(-3, 3, size) if moves else rng.integers(-1, n + 1, size)
        first = first % n if wraps[k] else first
        last = first + rng.integers(0, min(3, n), size)
        axes.append(Along(on, moves, column, first.astype(np.int32), last.astype(np.int32)))
    allowed = rng.random((grid.size, m)) < 0.8 if relations else None
    return Windows(grid, tuple(axes), allowed)


def both(windows: Windows, safe: Bools, target: Bools) -> list[tuple[np.ndarray, np.ndarray]]:
    """(values, bits) by either way."""
    start, out = np.where(target & safe, 0, np.where(safe, -1, -2)).astype(np.int32), []
    given = repeats.inverse(windows, np.int64)
    assert given is not None
    for threads in (1, 2):
        values, bits = start.copy(), windows.no_bits
        repeats.reach(given, values, bits, windows.permitted, threads)
        out.append((values, bits))
    assert np.array_equal(out[0][0], out[1][0])
    assert np.array_equal(out.pop()[1], out[0][1])
    values, bits = start.copy(), windows.no_bits
    reach.reach(windows.game, values, bits)
    return [*out, (values, bits)]


@pytest.mark.exam
@settings(max_examples=150, deadline=None, derandomize=True)
@given(st.integers(1, 4), st.integers(1, 12), st.integers(0, 2**32 - 1), st.booleans())
def test_both_ways_agree(n: int, m: int, seed: int, relations: bool) -> None:
    rng = np.random.default_rng(seed)
    counts = (int(rng.integers(4, 40)), *(int(v) for v in rng.integers(1, {1: 2, 2: 20, 3: 9, 4: 5}[n], n - 1)))
    wraps = (False, *(bool(v) for v in rng.random(n - 1) < 0.4))
    windows = drawn(rng, counts, m, wraps, relations)
    size = windows.grid.size
    (values, bits), (other, kept) = both(windows, rng.random(size) < 0.97, rng.random(size) < 0.1)
    assert np.array_equal(values, other)
    assert np.array_equal(bits, kept)


@pytest.mark.parametrize("nodes", [1, 1 << 12])
def test_nodes_run_out(monkeypatch: pytest.MonkeyPatch, nodes: int) -> None:
    """More windows hang on cells than there is room for at first; several rounds, and neither nothing nor everything won."""
    monkeypatch.setattr(repeats, "NODES", nodes)
    rng = np.random.default_rng(11)
    windows = drawn(rng, (60, 9, 8), 12, (False, False, True), False)
    size = windows.grid.size
    (values, bits), (other, kept) = both(windows, rng.random(size) < 0.98, np.arange(size) < 160)
    assert np.array_equal(values, other)
    assert np.array_equal(bits, kept)
    assert values.max() > 5
    assert 0.2 < (values >= 0).mean() < 0.99


def test_no_classes_where_every_axis_matters() -> None:
    grid = Grid(Box((StateSpec("a"), StateSpec("b")), (0, 0), (1, 1)), (5, 6))
    column = np.zeros(1, dtype=int)

    def axis(on: tuple[int, ...], rows: int) -> Along:
        return Along(on, True, column, np.zeros((rows, 1), dtype=np.int32), np.zeros((rows, 1), dtype=np.int32))

    assert repeats.inverse(Windows(grid, (axis((1,), 6), axis((0,), 5))), np.int32) is None
    assert repeats.inverse(Windows(grid, (axis((1,), 6), axis((), 1))), np.int32) is not None


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.integers(1, 3), st.integers(1, 9), st.integers(0, 2**32 - 1), st.booleans())
def test_both_ways_agree_on_positions(n: int, m: int, seed: int, relations: bool) -> None:
    """With automata that are drawn, whose letters a cell may be read as in several ways."""
    rng = np.random.default_rng(seed)
    counts = (int(rng.integers(8, 40)), *(int(v) for v in rng.integers(1, {1: 2, 2: 12, 3: 6}[n], n - 1)))
    wraps = (False, *(bool(v) for v in rng.random(n - 1) < 0.4))
    windows = drawn(rng, counts, m, wraps, relations)
    size, states = windows.grid.size, int(rng.integers(2, 6))
    after = rng.integers(-1 if rng.random() < 0.3 else 0, states, (states, 4))
    accepting = rng.random(states) < 0.4
    if rng.random() < 0.7:
        after[-1], accepting[-1] = states - 1, True
    automaton = Automaton(("a", "b"), tuple(map(tuple, after.tolist())), tuple(accepting.tolist()))
    must = rng.choice(4, size, p=[0.7, 0.1, 0.1, 0.1])
    labels = games.Labels(must, must | rng.choice(4, size, p=[0.8, 0.1, 0.05, 0.05]))
    safe, found = rng.random(size) < 0.97, []
    play = Play(windows, safe, automaton, *games.leads_of(automaton, labels))
    for game in (games.Watched(play) for _ in range(2)):
        assert game.repeats is not None
        if found:
            game.repeats = None
        assumed = np.broadcast_to(safe, game.values.shape)
        for _ in range(2):
            rounds = game.least(assumed)
            found.append((game.values.copy(), game.bits.copy(), rounds))
            assumed = game.values >= 0
    for (values, bits, rounds), (other, kept, levels) in zip(found[:2], found[2:], strict=True):
        assert np.array_equal(values, other)
        assert np.array_equal(bits, kept)
        assert rounds == levels


def test_threads_are_used_where_they_pay_or_are_asked_for() -> None:
    cores = len(os.sched_getaffinity(0))
    assert [games.usable(None, pairs) for pairs in (games.THRESHOLDS.threaded_pairs - 1, games.THRESHOLDS.threaded_pairs)] == [
        1,
        cores,
    ]
    assert games.usable(3, 10) == 3
