"""On which cells and inputs the successors along an axis depend, from the Jacobian over all of them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import final

import numpy as np

from gapcert import Interval, Model

from .grid import Array, Grid

LEAK = 1e-9  # of a cell: what an axis may shift another by and still not count


@final
@dataclass(frozen=True)
class Part:
    """f_k(x, u) = [x_k] + g(x_on, u_used), up to `leak`: with x_k where it `moves`, and k not in `on` then.

    on: axes of the grid. inputs: which ones matter.
    """

    on: tuple[int, ...]
    moves: bool
    inputs: tuple[bool, ...]
    leak: float

    def rows(self, grid: Grid) -> int:
        return math.prod(grid.counts[d] for d in self.on)


def structure(model: Model, grid: Grid, axes: tuple[Array, ...]) -> list[Part]:
    """One part per axis of the grid.

    With J over the hull of all cells and inputs, replacing x_j by another value of the grid changes f_k by |J_kj| w_j at most
    (mean-value theorem), w_j the width of the grid, and moving x_k by d changes f_k by d ± |J_kk − 1| w_k. Where that is below
    LEAK cells, the sum of it over all such axes is the leak.
    """
    (low, high), nx = grid.hull, len(model.states)
    z = Interval(np.concatenate([low, [a.min() for a in axes]])[None], np.concatenate([high, [a.max() for a in axes]])[None])
    slope, widths = model.jacobian_enclosure(z)[0], z.width[0]
    found = []
    for k, state in enumerate(grid.states):
        with np.errstate(invalid="ignore"):
            still = slope[state].mag * widths
            along = float((slope[state, state] - 1.0).mag * widths[state])
        limit = LEAK * float(grid.widths[k])
        on = tuple(d for d, j in enumerate(grid.states) if d != k and not still[j] <= limit)
        moves = along <= limit
        if not moves and not still[state] <= limit:
            on = tuple(sorted((*on, k)))
        uses = tuple(not v <= limit for v in still[nx:])
        small = [still[j] for d, j in enumerate(grid.states) if d != k and d not in on]
        small += [along if moves else still[state]] if k not in on else []
        small += [v for v, used in zip(still[nx:], uses, strict=True) if not used]
        found.append(Part(on, moves, uses, 2 * float(sum(small))))
    return found
