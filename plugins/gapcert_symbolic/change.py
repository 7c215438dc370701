"""The smallest change after which something wins, found by trying: a smaller gap, or more cells."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from .grid import Grid

PAIRS = 10_000_000
"""Pairs of a cell and an input up to which a change is tried."""
HALVINGS, FACTORS = 8, (2, 4)


def tried(wins: Callable[[float, int], bool], grid: Grid, inputs: int, gap: bool) -> dict[str, Any]:
    """`gap_scale`: γ scaled by it lets something win, and by 1/256 more does not. `cells`: so many do, with γ as it is.

    wins(scale, factor): does anything, with γ scaled and the cells of each axis multiplied? What no trial shows is absent.
    """
    out: dict[str, Any] = {}
    pairs = grid.size * inputs
    if gap and pairs <= PAIRS and wins(0.0, 1):
        low, high = 0, 2**HALVINGS
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (middle, high) if wins(middle / 2**HALVINGS, 1) else (low, middle)
        out["gap_scale"] = low / 2**HALVINGS
    for factor in FACTORS if grid.nodes is None else ():
        if pairs * factor ** len(grid.counts) <= PAIRS and wins(1.0, factor):
            names = [a.name for a in grid.box.axes]
            out["cells"] = {name: n * factor for name, n in zip(names, grid.counts, strict=True)}
            break
    return out


def in_words(change: dict[str, Any]) -> str:
    """As the end of a sentence; "" where nothing is known to help."""
    parts = []
    if (scale := change.get("gap_scale")) is not None:
        parts.append(f"γ scaled by {scale:.3g}" if scale else "no gap at all")
    if cells := change.get("cells"):
        parts.append("cells {" + ", ".join(f"{name}: {n}" for name, n in cells.items()) + "}")
    return f"; with {', or with '.join(parts)}, some cell wins" if parts else ""
