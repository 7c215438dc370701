"""Why nothing wins: the first of the known causes, with its figures."""

from __future__ import annotations

import numpy as np

from gapcert import Box, Interval, SynthesisProblem

from .abstraction import Disturbance, Windows
from .grid import Array, Bools, Grid


def why_empty(
    problem: SynthesisProblem,
    added: Disturbance | None,
    paths: Windows,
    safe: Bools,
    target: Bools,
    inputs: Box,
) -> str:
    """One sentence: what stands in the way, its size, and what to change."""
    goal, grid = problem.goal, paths.grid
    if not safe.any():
        return "every cell touches an obstacle; use smaller cells or a smaller `avoid`"
    if paths.allowed is not None and not paths.allowed.any():
        texts = ", ".join(dict.fromkeys(r.text for r in problem.domain.relations))
        return f"no input keeps the relations ({texts}) for all states of any cell; use smaller cells or more inputs"
    if goal.target is not None and not (target & safe).any():
        return _no_target(problem, grid, bool((target & ~safe).any()))
    axes, widths = grid.box.axes, grid.widths
    gamma = np.zeros(len(axes)) if added is None else np.asarray(added.r.mag).max(axis=(0, 1))[list(grid.states)]
    by_input, total = authority(problem, grid, inputs)
    driven = by_input > 0
    move = np.where(driven, by_input, total)
    for a, g, d, steered in zip(axes, gamma, move, driven, strict=True):
        if g >= d:
            who = "the inputs move" if steered else "one step moves"
            return (
                f"{a.name}: the gap is up to {g:.3g} {a.unit} per step, but {who} {a.name} by at most {d:.3g}, so nothing "
                f"counteracts it; certify a smaller gap, or use a longer period"
            )
    for k, a in enumerate(axes):
        if _leaves(paths, k):
            return (
                f"{a.name}: each cell may leave [{grid.box.low[k]:g}, {grid.box.high[k]:g}] {a.unit} in one step under every "
                f"input (cell width {widths[k]:.3g}, gap up to {gamma[k]:.3g}); use smaller cells or a wider goal"
            )
    for a, w, g, d, steered in zip(axes, widths, gamma, move, driven, strict=True):
        if steered and w + g >= d:
            return (
                f"{a.name}: cells are {w:.3g} {a.unit} wide and the gap is up to {g:.3g}, but the inputs move {a.name} by at "
                f"most {d:.3g} per step, so no cell can be left for certain; use more cells"
            )
    figures = "; ".join(
        f"{a.name}: cell {w:.3g}, gap up to {g:.3g}, one step moves at most {d:.3g} {a.unit}"
        for a, w, g, d in zip(axes, widths, gamma, total, strict=True)
    )
    if goal.automaton is not None:
        return f"no cell wins against '{goal.automaton.text}' ({figures}); use more cells, a smaller gap or wider regions"
    what = "cells" if goal.target is None else "target cells"
    verb = "visited again and again" if goal.kind == "recurrence" else "kept for ever"
    return f"no set of {what} can be {verb} ({figures}); use more cells, a smaller gap or a wider goal"


def _leaves(paths: Windows, k: int) -> bool:
    """May every cell, under every input, leave the grid along axis k?"""
    n, axis = paths.grid.counts[k], paths.axes[k]
    # Own indices from −first to n − 1 − last stay inside; where nothing moves, any does if 0 does.
    least, most = np.maximum(0, -axis.first), np.minimum(n - 1, n - 1 - axis.last) if axis.moves else n - 1 - axis.last
    inside = least <= most if axis.moves else (least == 0) & (most >= 0)
    return not paths.grid.wraps[k] and not bool(inside.any())


def authority(problem: SynthesisProblem, grid: Grid, inputs: Box) -> tuple[Array, Array]:
    """Upper bounds over the goal's box and all inputs, per state with cells, of what one step can do.

    By the inputs: |f_i(x, u) − f_i(x, v)| ≤ |∂f/∂u| ρ with v the middle. In total: |f_i(x, u) − x_i| ≤
    |f(c, v) − c| + |∂f/∂x − 1| r + |∂f/∂u| ρ, cell by cell.
    """
    nx, step = problem.domain.nx, 20_000
    by_input, total = np.zeros(nx), np.zeros(nx)
    u = inputs.interval
    for start in range(0, grid.size, step):
        low, high = grid.cells(start, start + step)
        z = Interval.concatenate([Interval(low, high), Interval(u.lo.repeat(len(low), 0), u.hi.repeat(len(low), 0))], axis=1)
        centre = z.mid
        slope = problem.model.jacobian_enclosure(z) - np.eye(nx, z.shape[1])
        spread = slope * (z - centre).reshape(len(low), 1, z.shape[1])
        moved = problem.model.enclosure(Interval.exact(centre)) - centre[:, :nx] + spread.sum(-1)
        by_input = np.maximum(by_input, spread[:, :, nx:].mag.sum(-1).max(axis=0))
        total = np.maximum(total, moved.mag.max(axis=0))
    # Outward rounding leaves a residue of 1e-300 where an input has no effect.
    states = list(grid.states)
    return np.where(by_input > 1e-250, by_input, 0.0)[states], total[states]


def _no_target(problem: SynthesisProblem, grid: Grid, blocked: bool) -> str:
    if blocked:
        return "every cell inside the target touches an obstacle; move the target or the obstacle"
    boxes = problem.goal.target.hulls if problem.goal.target else ()
    for j, axis, width in zip(grid.states, grid.box.axes, grid.widths, strict=True):
        widest = max(box.high[j] - box.low[j] for box in boxes)
        if widest < width:
            return f"{axis.name}: the target is {widest:.3g} {axis.unit} wide and a cell {width:.3g}; use smaller cells"
    return "no cell lies wholly inside the target; use smaller cells, or align the target with their edges"
