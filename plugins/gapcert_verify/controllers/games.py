"""What a goal asks of a step from a cell: how high the cells that it leads to may be, whatever the disturbance is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
import numpy.typing as npt

from gapcert.plugin import Array, Bools, Ints
from gapcert_cells import AutomatonController, GridController

from .cells import BEYOND, Cells

Small = npt.NDArray[np.int32]
NONE = -1
"""The limit of a cell from which nothing is asked."""


@final
@dataclass(frozen=True)
class Part:
    """One state of an automaton, or all there is: bits (nodes, bytes) of the inputs that are allowed.

    height (nodes,): of cells as what a step leads to; limit (nodes,): the greatest that a step from a cell may lead to, or
    NONE. memory: which state it is, in words.
    """

    bits: npt.NDArray[np.uint8]
    height: Small
    limit: Small
    memory: str = ""


def parts(cells: Cells, controller: GridController | AutomatonController) -> list[Part] | str:
    """What has to be proved of each; or what is wrong with the cells themselves, whatever the steps are.

    In every goal a run's value falls until it may stay, so that it comes where it is to: at a lasting value of `reach_and_stay`
    all cells are in the target; at 0 of `recurrence` another visit begins; an accepting state of an automaton is left anyhow.
    """
    goal, safe = controller.goal, cells.kept(controller.goal)
    if isinstance(controller, AutomatonController):
        return _of_automaton(cells, controller, safe)
    values = np.asarray(controller.values, dtype=np.int64)
    within = cells.related(goal.target, touching=False)
    if goal.kind == "invariance":
        limit = np.where(values == 0, 0, BEYOND)
        ends, wrong = np.zeros(len(values), dtype=bool), values > 0
    elif goal.kind == "reach_avoid":
        limit, ends, wrong = values - 1, values == 0, (values == 0) & ~within
    elif goal.kind == "recurrence":
        limit, ends, wrong = np.where(values == 0, BEYOND - 1, values - 1), values < -1, (values == 0) & ~within
    else:
        lasts = np.isin(values, controller.lasting)
        limit, ends, wrong = np.where(lasts, values, values - 1), values < -1, lasts & (values >= 0) & ~within
    part = _part(cells, controller, safe, wrong, ends, limit)
    return part if isinstance(part, str) else [part]


def _of_automaton(cells: Cells, c: AutomatonController, safe: Bools) -> list[Part] | str:
    automaton, (must, may) = c.automaton, cells.labels(c.goal.regions)
    if c.must.shape != must.shape or c.may.shape != may.shape or len(c.parts) != len(automaton.after):
        return "its labels are not those of its cells, or its automaton has other states"
    if ((c.must & ~must)[cells.whole]).any() or ((may & ~c.may)[cells.whole]).any():
        return "a cell is said to lie in a region, or beside one, and does not"
    height = [_height(np.asarray(p.values, dtype=np.int64)) for p in c.parts]
    out = list[Part]()
    for q, part in enumerate(c.parts):
        values, accepts = np.asarray(part.values, dtype=np.int64), automaton.accepting[q]
        limit = np.where(values >= 0, BEYOND - 1, BEYOND) if accepts else values - 1
        ends = (values >= 0) & bool(automaton.done[q])
        wrong = (values > 0) & accepts
        made = _part(cells, part, safe, wrong, ends, limit, f" with memory {q}")
        if isinstance(made, str):
            return made
        entered = _entered(automaton.after[q], height, c.must, c.may)
        out.append(Part(made.bits, entered, made.limit, made.memory))
    return out


def _entered(after: Sequence[int], height: Sequence[Small], must: Ints, may: Ints) -> Small:
    """The greatest height of the states that a cell's letter may lead to: all letters between `must` and `may` count."""
    out = np.full(len(must), NONE, dtype=np.int32)
    for letter, state in enumerate(after):
        read = ((must & ~letter) == 0) & ((letter & ~may) == 0)
        out[read] = np.maximum(out[read], BEYOND if state < 0 else height[state][read])
    return out


def _height(values: Ints) -> Small:
    return np.where(values < 0, BEYOND, values).astype(np.int32)


def _part(cells: Cells, c: GridController, safe: Bools, wrong: Bools, ends: Bools, limit: Ints, memory: str = "") -> Part | str:
    values, size = np.asarray(c.values, dtype=np.int64), cells.size
    if values.shape != (size,) or c.bits.shape != (size, (len(c.points) + 7) // 8) or c.bits.dtype != np.uint8:
        return f"there are values of shape {values.shape} and inputs of {c.bits.shape} for {size} cells"
    wins, allows = values >= 0, c.bits.any(axis=1)
    for bad, what in (
        ((values < -1) | (wins & ~cells.whole), "has a value that no cell has"),
        (wins & ~safe, "wins, and touches what is avoided, or leaves `stay`"),
        (wrong & wins, "has a value that it cannot have: it is not in the target, or the goal has no such values"),
        (~wins & allows, "loses, and allows inputs"),
        (wins & ~allows & ~ends, "wins without an input"),
    ):
        if bad.any():
            return f"cell {int(np.argmax(bad))}{memory} {what}"
    return Part(c.bits, _height(values), np.where(wins & ~ends, limit, NONE).astype(np.int32), memory)


def figures(cells: Cells, controller: GridController | AutomatonController) -> dict[str, float]:
    """What `evidence` says of cells, counted again: those that win with the memory that a run begins with."""
    if isinstance(controller, AutomatonController):
        wins, a = np.ones(cells.size, dtype=bool), controller.automaton
        won = np.stack([np.asarray(p.values, dtype=np.int64) >= 0 for p in controller.parts])
        for letter, q in enumerate(a.after[a.start]):
            read = ((controller.must & ~letter) == 0) & ((letter & ~controller.may) == 0)
            wins &= ~read | (won[q] if q >= 0 else False)
    else:
        wins = np.asarray(controller.values, dtype=np.int64) >= 0
    splits = controller.parts[0].splits if isinstance(controller, AutomatonController) else controller.splits
    wins &= cells.whole
    share: Array = np.ones(cells.size) / cells.size if splits is None else splits.shares()
    count = int(wins.sum())
    fraction = count / cells.size if splits is None else float(share[wins].sum())
    return {"cells": int(cells.whole.sum()), "winning_cells": count, "winning_fraction": fraction}
