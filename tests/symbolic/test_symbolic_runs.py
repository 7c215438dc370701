"""Inputs whose windows lie in their order along the last axis are looked at together, with the same answer as one by one."""

from __future__ import annotations

import numpy as np
import pytest
import touched
from hypothesis import given, settings
from hypothesis import strategies as st

from gapcert import Box, StateSpec
from gapcert_cells import Along
from gapcert_symbolic.cells.abstraction import Windows
from gapcert_symbolic.cells.grid import Grid
from gapcert_symbolic.solvers import runs


def drawn(n: int, m: int, seed: int, order: int) -> tuple[Windows, np.ndarray]:
    """Windows that differ between inputs along the last axis alone: there in the order of the inputs (1), in the opposite one
    (−1), or in none (0); and safe cells.
    """
    rng = np.random.default_rng(seed)
    counts, axes = tuple(int(v) for v in rng.integers(2, {1: 60, 2: 25, 3: 9}[n], n)), list[Along]()
    for k, count in enumerate(counts):
        moves = bool(rng.random() < 0.7)
        on = tuple(d for d in range(n) if (d != k and rng.random() < 0.6) or (d == k and not moves))
        size = int(np.prod([counts[d] for d in on])), m if k == n - 1 else 1
        first = rng.integers(-2, 2, size) if moves else rng.integers(-1, count + 1, size)
        last, column = first + rng.integers(0, 3, size), np.arange(m) if k == n - 1 else np.zeros(m, dtype=np.int64)
        if k == n - 1 and order:
            first, last = (np.sort(end, axis=1)[:, ::order] for end in (first, last))
        axes.append(Along(on, moves, column, first.astype(np.int32), last.astype(np.int32)))
    grid = Grid(Box(tuple(StateSpec(f"x{k}") for k in range(n)), (0.0,) * n, (1.0,) * n), counts)
    return Windows(grid, tuple(axes)), rng.random(grid.size) < 0.97


def solved(windows: Windows, safe: np.ndarray, allowed: np.ndarray, threads: int = 1) -> tuple[np.ndarray, np.ndarray]:
    alive, bits = np.where(safe, 0, -1).astype(np.int32), windows.no_bits
    runs.invariance(threads, windows.game._replace(allowed=allowed), alive, bits, *windows.rows)
    return alive, bits


def textbook(windows: Windows, safe: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """As `solved`, from the window of every pair, looked at again until nothing changes."""
    m, counts, alive = windows.inputs, windows.grid.counts, safe.copy()
    pairs = np.indices((len(safe), m)).reshape(2, -1)
    first, last = touched.ends(windows, pairs[0], pairs[1])
    inside = ((first >= 0) & (last < np.array(counts))).all(axis=1)
    while True:
        whole, valid = alive.reshape(counts), np.zeros((len(safe), m), dtype=bool)
        for p in np.flatnonzero(inside & alive[pairs[0]]):
            valid[pairs[0][p], pairs[1][p]] = whole[
                tuple(slice(a, b + 1) for a, b in zip(first[p], last[p], strict=True))
            ].all()
        if np.array_equal(valid.any(axis=1), alive):
            return np.where(alive, 0, -1), np.packbits(valid, axis=1)
        alive = valid.any(axis=1)


@pytest.mark.exam
@settings(max_examples=80, deadline=None, derandomize=True)
@given(st.integers(1, 3), st.integers(1, 20), st.integers(0, 2**32 - 1), st.sampled_from([1, -1, 0]))
def test_in_order_as_one_by_one(n: int, m: int, seed: int, order: int) -> None:
    windows, safe = drawn(n, m, seed, order)
    assert order == 0 or runs._sense(windows.game) in (order, 1)  # windows that are the same are in both orders
    both = np.empty((0, 0), dtype=bool), np.ones((len(safe), m), dtype=bool)
    found = [solved(windows, safe, allowed, threads) for allowed in both for threads in (1, 2)]
    for alive, bits in found:
        assert np.array_equal(alive, found[0][0])
        assert np.array_equal(bits, found[0][1])


@settings(max_examples=30, deadline=None, derandomize=True)
@given(st.integers(1, 3), st.integers(1, 9), st.integers(0, 2**32 - 1), st.sampled_from([1, -1, 0]))
def test_as_the_textbook_has_it(n: int, m: int, seed: int, order: int) -> None:
    windows, safe = drawn(n, m, seed, order)
    (alive, bits), (values, valid) = solved(windows, safe, np.empty((0, 0), dtype=bool)), textbook(windows, safe)
    assert np.array_equal(alive, values)
    assert np.array_equal(bits, valid)


def test_windows_in_no_order_are_not_taken_together() -> None:
    """What is done for windows in order would be wrong for others."""
    wrong = 0
    for seed in range(10):
        windows, safe = drawn(2, 9, seed, 0)
        game, (alive, bits) = windows.game, solved(windows, safe, np.empty((0, 0), dtype=bool))
        assert runs._sense(game) == 0
        run, other, room = np.empty(len(safe), np.int32), windows.no_bits, np.zeros((4, len(game.counts)), np.int64)
        runs._count(alive, game.counts[-1], run)
        own = runs.Own(run, room[0], room[1:], np.zeros((2, 0), np.int64))
        runs._valid_in_order(game, alive, own, 1, other, 0, game.counts[0])
        wrong += not np.array_equal(bits, other)
    assert wrong > 0


def test_threads_that_do_not_learn_what_died_keep_too_much(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stretches of rows are each swept with runs of their own; what others lost has to reach them."""
    kept, none = [], np.empty((0, 0), dtype=bool)
    for fault in (False, True):
        if fault:
            monkeypatch.setattr(runs, "_learn", lambda *_: None)
        for seed in range(8):
            windows, safe = drawn(2, 3, seed, seed % 2)
            alive, bits = solved(windows, safe, none)
            other, offered = solved(windows, safe, none, 3)
            if fault:
                kept.append(bool((other > alive).any()))
            else:
                assert np.array_equal(alive, other)
                assert np.array_equal(bits, offered)
    assert any(kept)


def test_an_axis_that_wraps_is_in_no_order() -> None:
    windows, _ = drawn(2, 5, 3, 1)
    assert runs._sense(windows.game) == 1
    assert runs._sense(windows.game._replace(wraps=np.array([False, True]))) == 0


@settings(max_examples=40, deadline=None, derandomize=True)
@given(st.integers(1, 3), st.integers(1, 6), st.integers(0, 2**32 - 1))
def test_rows_that_windows_touch(n: int, m: int, seed: int) -> None:
    windows, safe = drawn(n, m, seed, 0)
    pairs = np.indices((len(safe), m)).reshape(2, -1)
    ends, n0 = touched.ends(windows, pairs[0], pairs[1]), windows.grid.counts[0]
    first, last = (end[:, 0].reshape(n0, -1) for end in ends)
    least, most = (np.clip(end, -1, n0) for end in windows.rows)
    assert np.array_equal(least, first.min(axis=1))
    assert np.array_equal(most, last.max(axis=1))
