"""Random windows on grids of halving cells."""

from __future__ import annotations

import numpy as np

from gapcert import Box, StateSpec
from gapcert_cells import Along
from gapcert_symbolic.cells.abstraction import Windows
from gapcert_symbolic.cells.grid import Grid

TURN = 2 * np.pi


def nested(n: int, m: int, levels: int, rng: np.random.Generator) -> list[Windows]:
    """Windows on grids of halving cells, random but that a cell's windows lie in those of the cell that it is part of."""
    counts = tuple(int(v) for v in rng.integers(2, {1: 9, 2: 5, 3: 3}[n], n))
    angles = rng.random(n) < 0.4
    axes = tuple(StateSpec(f"x{k}", "rad" if a else "", "angle" if a else "real") for k, a in enumerate(angles))
    grid, made = Grid(Box(axes, (0.0,) * n, tuple(TURN if a else 1.0 for a in angles)), counts), list[Windows]()
    first = [rng.integers(0 if w else -1, c + (not w), (grid.size, m)) for c, w in zip(counts, grid.wraps, strict=True)]
    last = [a + rng.integers(0, min(counts[k], 3), a.shape) for k, a in enumerate(first)]
    for level in range(levels + 1):
        tables = []
        for k in range(n):
            c, wraps = grid.counts[k], grid.wraps[k]
            a, b = (first[k], last[k]) if wraps else (np.clip(first[k], -1, c), np.clip(last[k], -1, c))
            a, b = (a % c, a % c + np.minimum(b - a, c - 1)) if wraps else (a, b)
            tables.append(Along(tuple(range(n)), False, np.arange(m), a.astype(np.int32), b.astype(np.int32)))
        made.append(Windows(grid, tuple(tables)))
        if level < levels:
            grid = grid.halved
            index = np.stack(np.unravel_index(np.arange(grid.size), grid.counts))
            parent = np.ravel_multi_index(tuple(index >> 1), tuple(c // 2 for c in grid.counts))
            for k in range(n):
                low, high = 2 * first[k][parent], 2 * last[k][parent] + 1
                first[k] = low + (rng.random(low.shape) * np.minimum(high - low + 1, 2)).astype(np.int64)
                last[k] = np.maximum(first[k], high - (rng.random(low.shape) * 3).astype(np.int64))
    return made
