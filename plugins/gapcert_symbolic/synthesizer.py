"""The synthesizer `symbolic`: from a model, a gap and a goal to a controller that keeps its promise."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, final

import numpy as np

from gapcert import Domain, Event, Goal, GridController, Model, Policy, SynthesisProblem, Synthesizer, UsageError

from .abstraction import Nominal, check_size, disturbance, enclose, windows
from .grid import Array, Grid, corners
from .reason import why_empty
from .solvers import Solution, invariance, reach_avoid


@final
class Symbolic(Synthesizer):
    """A cell wins under an input if f over the whole cell, plus [l, u] over the whole cell, lies in winning cells.

    cells: number per state; inputs: number of values per input, both ends included. `policy` is the default for closed loops.
    """

    name = "symbolic"

    def __init__(self, cells: Mapping[str, int], inputs: Mapping[str, int], policy: Policy = "first") -> None:
        self.cells, self.inputs, self.policy = dict(cells), dict(inputs), policy

    def check(self, model: Model, domain: Domain, goal: Goal) -> None:
        grid, axes = self._grids(domain, goal)
        # A model that knows no range over boxes says so at the first cell.
        enclose(model, *grid.cells(0, 1), np.asarray([[a[0] for a in axes]]))

    def _grids(self, domain: Domain, goal: Goal) -> tuple[Grid, tuple[Array, ...]]:
        """Cells of the states, and values of each input."""
        goal.check(domain)
        grid = Grid(goal.stay, _counts("cells", self.cells, domain.states.names))
        counts = _counts("inputs", self.inputs, domain.inputs.names)
        check_size(grid, math.prod(counts))
        ends = zip(domain.inputs.low, domain.inputs.high, counts, strict=True)
        return grid, tuple(np.linspace(low, high, n) for low, high, n in ends)

    def synthesize(self, problem: SynthesisProblem) -> GridController:
        goal = problem.goal
        grid, axes = self._grids(problem.domain, goal)

        def tick(part: str) -> Any:
            return lambda done, total: problem.emit(
                Event("progress", "controller", {"done": done, "total": total, "part": part})
            )

        added = None if problem.gap is None else disturbance(problem.gap, grid, axes, tick=tick("gap over cells"))
        base = Nominal.coarsest(problem.model, grid, axes)
        paths = windows(base, added, grid, tick=tick("successors of cells"))
        safe = np.ones(grid.size, dtype=bool)
        for box in goal.avoid.boxes if goal.avoid else ():
            safe &= ~grid.touching(box)
        target = np.zeros(grid.size, dtype=bool)
        for box in goal.target.boxes if goal.target else ():
            target |= grid.inside(box)
        solution = invariance(paths, safe) if goal.kind == "invariance" else reach_avoid(paths, safe, target)
        evidence = _counted(grid, axes, solution)
        if not evidence["winning_cells"]:
            evidence["reason"] = why_empty(problem, base, added, paths, safe, target)
        points = corners(list(axes), list(axes))[0]
        return GridController(goal, grid.edges, points, solution.bits, solution.values, evidence)


def _counted(grid: Grid, axes: tuple[Array, ...], solution: Solution) -> dict[str, Any]:
    winning = int((solution.values >= 0).sum())
    return {
        "cells": grid.size,
        "inputs": math.prod(len(a) for a in axes),
        "winning_cells": winning,
        "winning_fraction": winning / grid.size,
        "rounds": solution.rounds,
    }


def _counts(field: str, given: Mapping[str, int], names: tuple[str, ...]) -> tuple[int, ...]:
    least = 1 if field == "cells" else 2
    for name, number in given.items():
        if name not in names:
            raise UsageError(f"controller.{field}: '{name}' is unknown; expected {', '.join(names)}")
        if number < least:
            raise UsageError(f"controller.{field}: {name} is {number}; give at least {least}")
    if missing := [n for n in names if n not in given]:
        raise UsageError(f"controller.{field}: nothing for '{missing[0]}'; add {missing[0]}: a number")
    return tuple(int(given[n]) for n in names)
