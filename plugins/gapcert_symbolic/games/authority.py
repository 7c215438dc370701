"""What inputs can do in a goal: how far they move the states, where that is too little even for γ = 0, and what suffices."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple, final

import numpy as np

from gapcert import Array, Box, Interval, StateSpec, SynthesisProblem
from gapcert_cells import sufficient
from gapcert_symbolic.cells.grid import Grid
from gapcert_symbolic.thresholds import THRESHOLDS

_BLOCK = 20_000  # cells at a time


def moves(problem: SynthesisProblem, grid: Grid, inputs: Box) -> Iterator[tuple[Interval, Interval]]:
    """By blocks of cells, over each cell and all inputs: f(x, u) − f(x, v), and f(x, u) − x, (n, nx) each.

    With v the middle, the first is in ∂f/∂u [−ρ, ρ], and the second in f(c, v) − c + (∂f/∂x − 1) [−r, r] + ∂f/∂u [−ρ, ρ].
    """
    nx, u = problem.domain.nx, inputs.interval
    for start in range(0, grid.size, _BLOCK):
        low, high = grid.cells(start, start + _BLOCK)
        z = Interval.concatenate([Interval(low, high), Interval(u.lo.repeat(len(low), 0), u.hi.repeat(len(low), 0))], axis=1)
        centre = z.mid
        slope = problem.model.jacobian_enclosure(z) - np.eye(nx, z.shape[1])
        spread = slope * (z - centre).reshape(len(low), 1, z.shape[1])
        moved = problem.model.enclosure(Interval.exact(centre)) - centre[:, :nx] + spread.sum(-1)
        yield spread[:, :, nx:], moved


def authority(problem: SynthesisProblem, grid: Grid, inputs: Box) -> tuple[Array, Array]:
    """Upper bounds over the goal's box and all inputs, per state with cells, of what one step does: by inputs, and in total."""
    by_input, total = np.zeros(problem.domain.nx), np.zeros(problem.domain.nx)
    for spread, moved in moves(problem, grid, inputs):
        by_input = np.maximum(by_input, spread.mag.sum(-1).max(axis=0))
        total = np.maximum(total, moved.mag.max(axis=0))
    # Outward rounding leaves a residue of 1e-300 where an input has no effect.
    states = list(grid.states)
    return np.where(by_input > 1e-250, by_input, 0.0)[states], total[states]


@final
class Drift(NamedTuple):
    """A state that every step moves to one side, by [low, high], wherever it has to stay and whatever the inputs, for γ = 0.

    needed: the smallest ranges of the inputs, widened to one side or both, that are not proved to be too weak in all of it;
    None where no wider ones are known to help.
    """

    axis: StateSpec
    low: float
    high: float
    needed: Box | None


def drift(problem: SynthesisProblem, grid: Grid, inputs: Box) -> Drift | None:
    """The first such state: no set in the goal can be kept then, with cells of any size."""
    goal = problem.goal
    if goal.kind not in ("invariance", "recurrence", "reach_and_stay"):
        return None
    most = max(1, int(THRESHOLDS.drift_cells ** (1 / len(grid.counts))))
    coarse = Grid(grid.box, tuple(min(n, most) for n in grid.counts), grid.on, grid.frame)
    kept = ~coarse.inside(goal.avoid) & (coarse.touching(goal.target) if goal.kind == "reach_and_stay" else True)

    def ranges(used: Box) -> Interval:
        parts = [moved for _, moved in moves(problem, coarse, used)]
        return Interval.concatenate(parts, axis=0)[kept]

    if not kept.any():
        return None
    each = ranges(inputs)
    low, high = each.lo.min(axis=0), each.hi.max(axis=0)
    for k, j in enumerate(grid.states):
        if not grid.wraps[k] and (low[j] > 0 or high[j] < 0):

            def held(used: Box, j: int = j) -> bool:
                found = ranges(used)
                return bool(found.lo[:, j].min() <= 0 <= found.hi[:, j].max())

            needed = sufficient(held, inputs, halvings=THRESHOLDS.needed_halvings)
            return Drift(grid.box.axes[k], float(low[j]), float(high[j]), needed)
    return None
