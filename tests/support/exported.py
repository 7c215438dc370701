"""States that an exported controller is asked about, and its Python file as a module."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np

from gapcert import GridController

POLICIES = ("first", "middle", "last", "least-effort")
ODD = (np.nan, np.inf, -np.inf, 1e300, -1e300, 0.0, -0.0, 5e-324)


def states(c: GridController, n: int = 100_000) -> np.ndarray:
    """Uniform beyond the grid; a third of all numbers on cell edges or next to them, some turned, some odd."""
    rng = np.random.default_rng(1)
    low, high = np.array(c.goal.stay.low), np.array(c.goal.stay.high)
    x = low - 0.1 * (high - low) + 1.2 * (high - low) * rng.random((n, 3))
    for j, edges in zip(c.on, c.edges, strict=True):
        on = rng.random(n) < 0.33
        at = rng.choice(edges, n)
        at = np.where(rng.random(n) < 0.5, at, np.nextafter(at, rng.choice([-9.0, 9.0], n)))
        x[on, j] = at[on]
    turn = rng.random(n) < 0.5
    x[turn, 1] += 2 * np.pi * rng.integers(-3, 4, n)[turn]
    odd = rng.random(n) < 0.01
    x[odd, rng.integers(3)] = rng.choice(ODD, odd.sum())
    return x


def imported(file: Path) -> Any:
    spec = importlib.util.spec_from_file_location("exported", file)
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    assert spec.loader is not None
    spec.loader.exec_module(module)
    return module
