"""The smallest change after which something wins, found by trying: a smaller gap, or more cells."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from gapcert_symbolic.cells.grid import Grid
from gapcert_symbolic.thresholds import THRESHOLDS


def tried(wins: Callable[[float, int], bool], grid: Grid, inputs: int, gap: bool) -> dict[str, Any]:
    """`gap_scale`: γ scaled by it lets something win, and by 1/256 more does not. `cells`: so many do, with γ as it is.

    `both`: these two at once, where neither helps alone, or no gap at all is all that would. wins(scale, factor): does
    anything, with γ scaled and the cells of each axis multiplied? What no trial shows is absent.
    """
    out: dict[str, Any] = {}
    pairs, names = grid.size * inputs, [a.name for a in grid.box.axes]
    if gap and pairs <= THRESHOLDS.change_pairs and (scale := _scale(wins, 1)) is not None:
        out["gap_scale"] = scale
    factors = [f for f in THRESHOLDS.factors if grid.nodes is None and pairs * f ** len(grid.counts) <= THRESHOLDS.change_pairs]
    cells = {f: {name: n * f for name, n in zip(names, grid.counts, strict=True)} for f in factors}
    if enough := next((f for f in factors if wins(1.0, f)), None):
        out["cells"] = cells[enough]
    elif gap and not out.get("gap_scale"):
        both = ({"gap_scale": s, "cells": cells[f]} for f in factors if (s := _scale(wins, f)))
        out |= {"both": found} if (found := next(both, None)) else {}
    return out


def _scale(wins: Callable[[float, int], bool], factor: int) -> float | None:
    """The largest of the multiples of 1/256 below 1 with which something wins, by bisection; None if nothing does."""
    if not wins(0.0, factor):
        return None
    low, high = 0, 2**THRESHOLDS.change_halvings
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if wins(middle / 2**THRESHOLDS.change_halvings, factor) else (low, middle)
    return float(low / 2**THRESHOLDS.change_halvings)


def in_words(change: dict[str, Any]) -> str:
    """As the end of a sentence; "" where nothing is known to help."""
    parts = [*_parts(change), *([" and ".join(_parts(change["both"]))] if "both" in change else [])]
    return f"; with {', or with '.join(parts)}, some cell wins" if parts else ""


def _parts(change: dict[str, Any]) -> list[str]:
    parts = []
    if (scale := change.get("gap_scale")) is not None:
        parts.append(f"γ scaled by {scale:.3g}" if scale else "no gap at all")
    if cells := change.get("cells"):
        parts.append("cells {" + ", ".join(f"{name}: {n}" for name, n in cells.items()) + "}")
    return parts
