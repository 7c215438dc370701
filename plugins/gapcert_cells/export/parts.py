"""What of a controller is exported: one table of inputs and values per state of its memory, and how the memory goes on."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import numpy.typing as npt

from gapcert.plugin import Box, Ellipsoid, Goal, Polytope, circle
from gapcert_cells.automaton_controller import AutomatonController
from gapcert_cells.grid_controller import GridController

Exported = GridController | AutomatonController
Table = npt.NDArray[Any]


def parts_of(controller: Exported) -> tuple[GridController, ...]:
    """One per state of the memory, over the same cells and inputs."""
    return controller.parts if isinstance(controller, AutomatonController) else (controller,)


def cells_of(controller: Exported) -> int:
    one = parts_of(controller)[0]
    return len(one.values) if one.splits is None else int((one.splits.first == 0).sum())


def winning_of(controller: Exported) -> int:
    """Cells of the domain, with some memory."""
    return int(np.any([part.values >= 0 for part in parts_of(controller)], axis=0).sum())


def memory_tables(controller: AutomatonController) -> dict[str, Table]:
    """The automaton, what is known of each cell's regions, and the regions; `start` is the state before anything is read."""
    automaton = controller.automaton
    tables = {"after": automaton.table, "done": automaton.done, "start": np.array(automaton.start)}
    return tables | {"must": controller.must, "may": controller.may} | _shapes(controller.goal)


def _shapes(goal: Goal) -> dict[str, Table]:
    """Convex shapes: in `box` (shapes, states, 4) as `ends_of` has it, all `cuts` a·x ≤ `bounds`, and Σ `factors` d_i d_j ≤ 1.

    d = x − `centres`. Each cut and each term of a sum belongs to one shape; a shape without terms is no ellipsoid.
    """
    shapes = [(p, shape) for p, region in enumerate(goal.regions) for shape in (*region.boxes, *region.shapes)]
    centres, cuts, terms = np.zeros((len(shapes), len(goal.stay.axes))), list[Any](), list[Any]()
    for k, (_, shape) in enumerate(shapes):
        if isinstance(shape, Polytope):
            cuts += [(k, a, b) for a, b in zip(shape.zone.matrix, shape.zone.bounds, strict=True)]
        elif isinstance(shape, Ellipsoid):
            centres[k, shape.on], m = shape.centre, shape.matrix
            pairs = itertools.combinations_with_replacement(range(len(shape.on)), 2)
            terms += [(k, shape.on[i], shape.on[j], m[i][j] * (1 if i == j else 2)) for i, j in pairs if m[i][j]]
    rows = np.array([t[:3] for t in terms], dtype=np.int64).reshape(-1, 3)
    ends = [ends_of(shape if isinstance(shape, Box) else shape.box) for _, shape in shapes]
    return {
        "region": np.array([p for p, _ in shapes], dtype=np.int64),
        "box": np.array(ends, dtype=np.float64).reshape(*centres.shape, 4),
        "centres": centres,
        "cut_of": np.array([c[0] for c in cuts], dtype=np.int64),
        "cuts": np.array([c[1] for c in cuts], dtype=np.float64).reshape(-1, centres.shape[1]),
        "bounds": np.array([c[2] for c in cuts], dtype=np.float64),
        "term_of": rows[:, 0],
        "terms": rows[:, 1:],
        "factors": np.array([t[3] for t in terms], dtype=np.float64),
    }


def ends_of(box: Box) -> list[list[float]]:
    """[low, high, middle, 1 where that is a full turn] per axis."""
    return [[a, b, (a + b) / 2, float(circle.spans(a, b))] for a, b in zip(box.low, box.high, strict=True)]
