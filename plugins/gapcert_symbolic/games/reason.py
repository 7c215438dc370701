"""Why nothing wins: the first cause, in the order goal, inputs, gap, cells, with its figures; and the smallest change after
which something does, found by trying: a smaller gap, more cells, or wider inputs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, Literal, NamedTuple, final

import numpy as np

from gapcert import Array, Box, Goal, SynthesisProblem
from gapcert.plugin import Bools
from gapcert_cells import FAR, ranges
from gapcert_symbolic.cells.abstraction import Windows
from gapcert_symbolic.cells.gaps import Disturbance
from gapcert_symbolic.cells.grid import Grid
from gapcert_symbolic.thresholds import THRESHOLDS

from .authority import Drift, authority, drift
from .games import Labels


@final
class Cause(NamedTuple):
    """A sentence, and what must change before anything else can help: `gap_below`, `cells_above`, each by state.

    of: which part of the question is to blame for certain, so that changes of later parts need not be tried. `needed`: inputs
    that are not proved to be too weak.
    """

    text: str
    change: Mapping[str, Any] = MappingProxyType({})
    of: Literal["goal", "inputs", ""] = ""
    needed: Box | None = None


def why_empty(
    problem: SynthesisProblem,
    labels: Labels | None,
    added: Disturbance | None,
    tables: Callable[[], Windows],
    safe: Bools,
    target: Bools,
    inputs: Box,
) -> Cause:
    """What stands in the way, its size, and what to change."""
    goal = problem.goal
    if text := _unlabelled(goal, labels):
        return Cause(text, of="goal")
    paths = tables()
    grid = paths.grid
    if text := _nothing_to_win(problem, paths, safe):
        return Cause(text, of="goal")
    if goal.target is not None and not (target & safe).any():
        return _no_target(problem, grid, bool((target & ~safe).any()))
    if (moved := drift(problem, grid, inputs)) is not None:
        return _too_weak(moved, inputs)
    axes, widths, gamma = grid.box.axes, grid.widths, _gamma(added, grid)
    by_input, total = authority(problem, grid, inputs)
    driven = by_input > 0
    move = np.where(driven, by_input, total)
    if goal.kind == "reach_avoid" and (cause := _too_narrow(goal, grid, gamma)) is not None:
        return cause
    for a, g, d, steered in zip(axes, gamma, move, driven, strict=True):
        if g >= d:
            who = "the inputs move" if steered else "one step moves"
            return Cause(
                f"{a.name}: the gap is up to {g:.3g} {a.unit} per step, but {who} {a.name} by at most {d:.3g}, so nothing "
                f"counteracts it; certify a smaller gap, or use a longer period",
                {"gap_below": {a.name: float(d)}},
            )
    for k, a in enumerate(axes):
        if _leaves(paths, k):
            return Cause(
                f"{a.name}: each cell may leave [{grid.box.low[k]:g}, {grid.box.high[k]:g}] {a.unit} in one step under every "
                f"input (cell width {widths[k]:.3g}, gap up to {gamma[k]:.3g}); use smaller cells or a wider goal"
            )
    for k, (a, w, g, d, steered) in enumerate(zip(axes, widths, gamma, move, driven, strict=True)):
        if steered and w + g >= d:
            least = math.floor((grid.box.high[k] - grid.box.low[k]) / (d - g))
            return Cause(
                f"{a.name}: cells are {w:.3g} {a.unit} wide and the gap is up to {g:.3g}, but the inputs move {a.name} by at "
                f"most {d:.3g} per step, so no cell can be left for certain; use more cells, above {least}",
                {"cells_above": {a.name: least}},
            )
    return Cause(f"{_figures(problem, grid, gamma, total)}; use more cells, a smaller gap or a wider goal")


def _unlabelled(goal: Goal, labels: Labels | None) -> str:
    """Which region no cell lies wholly inside, or nothing."""
    if goal.automaton is None or labels is None:
        return ""
    lost = [n for p, n in enumerate(goal.automaton.propositions) if not (labels.must >> p & 1).any()]
    return f"no cell lies wholly inside region {lost[0]}; use smaller cells, or align it with their edges" if lost else ""


def _nothing_to_win(problem: SynthesisProblem, paths: Windows, safe: Bools) -> str:
    if not safe.any():
        return "every cell touches an obstacle; use smaller cells or a smaller `avoid`"
    if paths.allowed is not None and not paths.allowed.any():
        texts = ", ".join(dict.fromkeys(r.text for r in problem.domain.relations))
        return f"no input keeps the relations ({texts}) for all states of any cell; use smaller cells or more inputs"
    return ""


def _too_weak(moved: Drift, inputs: Box) -> Cause:
    a, needed = moved.axis, moved.needed
    by = f"moves {a.name} by {moved.low:.3g} to {moved.high:.3g} {a.unit} wherever the goal has it stay, for γ = 0 too"
    if needed is None:
        wide = f"even with inputs {FAR} times as wide"
        return Cause(f"{a.name}: each step {by}, {wide}, so the goal cannot be kept; choose another goal", of="goal")
    own, wider = ranges(inputs, needed), ranges(needed, inputs)
    return Cause(
        f"{a.name}: the inputs are too weak: with {own} each step {by}, so the goal cannot be kept, by cells of any size; "
        f"about {wider} is needed at the least",
        of="inputs",
        needed=needed,
    )


def _gamma(added: Disturbance | None, grid: Grid) -> Array:
    """The largest magnitude per axis of the grid."""
    if added is None:
        return np.zeros(len(grid.counts))
    return np.asarray(np.asarray(added.r.mag).max(axis=(0, 1))[list(grid.states)])


def _too_narrow(goal: Goal, grid: Grid, gamma: Array) -> Cause | None:
    """A target that the successors of a cell, about a cell and twice the gap wide, do not fit into."""
    boxes = goal.target.hulls if goal.target else ()
    for j, a, w, g in zip(grid.states, grid.box.axes, grid.widths, gamma, strict=True):
        widest = max((box.high[j] - box.low[j] for box in boxes), default=math.inf)
        if widest < w + 2 * g:
            return Cause(
                f"{a.name}: the target is {widest:.3g} {a.unit} wide, less than a cell ({w:.3g}) and twice the gap (up to "
                f"{g:.3g}), so no step ends in it for certain; use smaller cells, a smaller gap or a wider target",
                {"gap_below": {a.name: float((widest - w) / 2)}} if widest > w else {},
            )
    return None


def _figures(problem: SynthesisProblem, grid: Grid, gamma: Array, total: Array) -> str:
    goal = problem.goal
    figures = "; ".join(
        f"{a.name}: cell {w:.3g}, gap up to {g:.3g}, one step moves at most {d:.3g} {a.unit}"
        for a, w, g, d in zip(grid.box.axes, grid.widths, gamma, total, strict=True)
    )
    if goal.automaton is not None:
        return f"no cell wins against '{goal.automaton.text}' ({figures})"
    if goal.kind == "reach_avoid":
        return f"no cell is led into the target for certain ({figures})"
    what = "cells" if goal.target is None else "target cells"
    verb = "visited again and again" if goal.kind == "recurrence" else "kept for ever"
    return f"no set of {what} can be {verb} ({figures})"


def _leaves(paths: Windows, k: int) -> bool:
    """May every cell, under every input, leave the grid along axis k?"""
    n, axis = paths.grid.counts[k], paths.axes[k]
    # Own indices from −first to n − 1 − last stay inside; where nothing moves, any does if 0 does.
    least, most = np.maximum(0, -axis.first), np.minimum(n - 1, n - 1 - axis.last) if axis.moves else n - 1 - axis.last
    inside = least <= most if axis.moves else (least == 0) & (most >= 0)
    return not paths.grid.wraps[k] and not bool(inside.any())


def _no_target(problem: SynthesisProblem, grid: Grid, blocked: bool) -> Cause:
    if blocked:
        return Cause("every cell inside the target touches an obstacle; move the target or the obstacle")
    boxes = problem.goal.target.hulls if problem.goal.target else ()
    for j, axis, width in zip(grid.states, grid.box.axes, grid.widths, strict=True):
        widest = max(box.high[j] - box.low[j] for box in boxes)
        if widest < width:
            least = math.ceil(width * grid.counts[grid.states.index(j)] / widest) - 1
            return Cause(
                f"{axis.name}: the target is {widest:.3g} {axis.unit} wide and a cell {width:.3g}; use smaller cells",
                {"cells_above": {axis.name: least}},
            )
    return Cause("no cell lies wholly inside the target; use smaller cells, or align the target with their edges")


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


def in_words(change: dict[str, Any], inputs: Box, without: bool, all_tried: bool) -> str:
    """As the end of a sentence; "" where nothing is known. without: was γ = 0 tried, where no `gap_scale` came of it?"""
    parts = [*_parts(change), *([" and ".join(_parts(change["both"]))] if "both" in change else [])]
    told = f"; with {', or with '.join(parts)}, some cell wins" if parts else ""
    if (wider := change.get("inputs")) is not None:
        told += f"; for γ = 0, {ranges(Box.of(inputs.axes, wider), inputs)} suffices"
    elif not parts and all_tried:
        told = f"; neither do more cells help, nor inputs {FAR} times as wide"
    return f"; for γ = 0 nothing wins either, with these cells and inputs{told}" if without else told


def _parts(change: dict[str, Any]) -> list[str]:
    parts = []
    if (scale := change.get("gap_scale")) is not None:
        parts.append(f"γ scaled by {scale:.3g}" if scale else "no gap at all")
    if cells := change.get("cells"):
        parts.append("cells {" + ", ".join(f"{name}: {n}" for name, n in cells.items()) + "}")
    return parts
