"""Inputs whose windows differ along the last axis alone are looked at together, with the same answer as one by one."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from gapcert import Box, StateSpec
from gapcert_symbolic import runs, solvers
from gapcert_symbolic.abstraction import Axis, Windows
from gapcert_symbolic.grid import Grid


@settings(max_examples=80, deadline=None, derandomize=True)
@given(st.integers(1, 3), st.integers(1, 20), st.integers(0, 2**32 - 1))
def test_alike_as_one_by_one(n: int, m: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    counts, axes = tuple(int(v) for v in rng.integers(2, {1: 60, 2: 25, 3: 9}[n], n)), list[Axis]()
    for k, count in enumerate(counts):
        moves = bool(rng.random() < 0.7)
        on = tuple(d for d in range(n) if (d != k and rng.random() < 0.6) or (d == k and not moves))
        size = int(np.prod([counts[d] for d in on])), m if k == n - 1 else 1
        first = rng.integers(-2, 2, size) if moves else rng.integers(-1, count + 1, size)
        last, column = first + rng.integers(0, 3, size), np.arange(m) if k == n - 1 else np.zeros(m, dtype=np.int64)
        axes.append(Axis(on, moves, column, first.astype(np.int32), last.astype(np.int32)))
    grid = Grid(Box(tuple(StateSpec(f"x{k}") for k in range(n)), (0.0,) * n, (1.0,) * n), counts)
    windows, safe, found = Windows(grid, tuple(axes)), rng.random(grid.size) < 0.97, []
    for allowed in (np.empty((0, 0), dtype=bool), np.ones((grid.size, m), dtype=bool)):
        alive, bits = np.where(safe, 0, -1).astype(np.int32), solvers._no_bits(windows)
        runs.invariance(*solvers._given(windows), alive, bits, allowed, *windows.reach)
        found.append((alive, bits))
    assert np.array_equal(found[0][0], found[1][0])
    assert np.array_equal(found[0][1], found[1][1])
