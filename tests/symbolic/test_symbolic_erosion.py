"""Invariance by erosion gives the same domain and the same inputs as by looking at every window."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gapcert import Box, StateSpec
from gapcert_cells import Along
from gapcert_symbolic.cells.abstraction import Windows
from gapcert_symbolic.cells.grid import Grid
from gapcert_symbolic.games.games import solve
from gapcert_symbolic.solvers import erosion, runs
from gapcert_symbolic.solvers.problem import Problem

TURN = 2 * np.pi


def drawn(rng: np.random.Generator, counts: tuple[int, ...], m: int, wraps: tuple[bool, ...], relations: bool) -> Windows:
    """Windows of a few cells; axis k depends on some of the axes before it, and on itself where it does not move."""
    states = tuple(StateSpec(f"x{k}", "rad", "angle") if w else StateSpec(f"x{k}") for k, w in enumerate(wraps))
    grid = Grid(Box(states, (0.0,) * len(counts), tuple(TURN if w else 1.0 for w in wraps)), counts)
    place, axes = rng.permutation(len(counts)), []
    for k, n in enumerate(counts):
        moves = bool(rng.random() < 0.7 or place[k] == len(counts) - 1)
        on = tuple(d for d in range(len(counts)) if (place[d] < place[k] and rng.random() < 0.5) or (d == k and not moves))
        column = rng.integers(1 + rng.integers(m), size=m)
        size = int(np.prod([counts[d] for d in on])), int(column.max()) + 1
        if wraps[k]:
            first = rng.integers(-2, 2, size) % n
        elif moves:
            first = rng.integers(-2, 2, size)
        else:
            first = rng.integers(-1, n + 1, size)
        last = first + rng.integers(0, min(3, n), size)
        if not wraps[k]:
            last = np.minimum(last, n) if not moves else last
        axes.append(Along(on, moves, column, first.astype(np.int32), last.astype(np.int32)))
    allowed = rng.random((grid.size, m)) < 0.8 if relations else None
    return Windows(grid, tuple(axes), allowed)


def looked_at(windows: Windows, safe: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The other solver."""
    alive = np.where(safe, 0, -1).astype(np.int32)
    bits = windows.no_bits
    runs.invariance(1, windows.game, alive, bits, *windows.rows)
    return alive == 0, bits


@pytest.mark.exam
@settings(max_examples=150, deadline=None, derandomize=True)
@given(st.integers(1, 4), st.integers(1, 9), st.integers(0, 2**32 - 1), st.booleans())
def test_both_solvers_agree(n: int, m: int, seed: int, relations: bool) -> None:
    rng = np.random.default_rng(seed)
    counts = tuple(int(v) for v in rng.integers(1, {1: 300, 2: 90, 3: 12, 4: 7}[n], n))
    wraps = tuple(bool(v) for v in rng.random(n) < 0.3)
    windows = drawn(rng, counts, m, wraps, relations)
    order = erosion.order(windows)
    if order is None:
        return
    safe = rng.random(windows.grid.size) < 0.97
    alive, bits, _ = erosion.invariance(windows, safe, order)
    other, kept = looked_at(windows, safe)
    assert np.array_equal(alive, other)
    assert np.array_equal(bits, kept)
    for threads in (1, 2):
        assert np.array_equal(solve(Problem(lambda: windows, safe, threads=threads)).bits, kept)


def test_a_few_agree_and_some_of_them_win() -> None:
    """What is compared is neither empty nor everything."""
    shares = []
    for seed in range(40):
        windows = drawn(np.random.default_rng(seed), (40, 70), 5, (False, False), False)
        if (order := erosion.order(windows)) is not None:
            safe = np.ones(windows.grid.size, dtype=bool)
            alive, bits, _ = erosion.invariance(windows, safe, order)
            other, kept = looked_at(windows, safe)
            assert np.array_equal(alive, other)
            assert np.array_equal(bits, kept)
            shares.append(alive.mean())
    assert sum(0 < s < 1 for s in shares) > 5


@pytest.mark.parametrize("longest", [0, 1])
def test_the_longest_free_axis_lies_along_bits(longest: int) -> None:
    counts = (90, 20) if longest == 0 else (20, 90)
    one = np.zeros((1, 1), dtype=np.int32)
    grid = Grid(Box((StateSpec("a"), StateSpec("b")), (0, 0), (1, 1)), counts)
    windows = Windows(grid, (Along((), True, np.zeros(1, dtype=int), one, one),) * 2)
    order = erosion.order(windows)
    assert order is not None
    assert order[-1] == longest


def test_axes_that_depend_on_each_other_have_no_order() -> None:
    grid = Grid(Box((StateSpec("a"), StateSpec("b"), StateSpec("c")), (0, 0, 0), (1, 1, 1)), (3, 4, 5))
    column = np.zeros(1, dtype=int)

    def axis(on: tuple[int, ...], rows: int) -> Along:
        return Along(on, True, column, np.zeros((rows, 1), dtype=np.int32), np.zeros((rows, 1), dtype=np.int32))

    assert erosion.order(Windows(grid, (axis((1,), 4), axis((0,), 3), axis((), 1)))) is None
    assert erosion.order(Windows(grid, (axis((1,), 4), axis((), 1), axis((0,), 3)))) == (1, 0, 2)
    assert erosion.order(Windows(grid, (axis((1,), 4), axis((2,), 5), axis((0,), 3)))) is None
