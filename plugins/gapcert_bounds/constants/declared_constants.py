"""Lipschitz constants and curvature that the user states."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import TypeVar, final

import numpy as np

from gapcert.plugin import Array, LipschitzBound, LipschitzEstimator, LipschitzProblem, UsageError

Bend = float | Sequence[Sequence[float]]
T = TypeVar("T")


@final
class Declared(LipschitzEstimator):
    """Constants taken on trust: values[state][axis] bounds |∂g_state/∂axis|, in the units of state per axis, and
    curvature[state][axis] |∂²g_state/∂axis²|, in those per square of the axis: a number, or [low, high, number] for each part
    of the axis.
    """

    provenance = "declared"

    def __init__(
        self, values: Mapping[str, Mapping[str, float]], curvature: Mapping[str, Mapping[str, Bend]] | None = None
    ) -> None:
        self.values, self.curvature = values, curvature

    def bound(self, problem: LipschitzProblem) -> LipschitzBound:
        axes = [a.name for a in problem.domain.axes]
        states = axes[: problem.domain.nx]
        value = np.array(_table(self.values, states, axes, "lipschitz.values"), dtype=np.float64)
        if self.curvature is None:
            return LipschitzBound(value, np.zeros_like(value), "declared", "declared")
        rows = _table(self.curvature, states, axes, "lipschitz.curvature")
        ends = zip(problem.domain.low, problem.domain.high, axes, strict=True)
        slabs = tuple(_slabs([row[j] for row in rows], *end) for j, end in enumerate(ends))
        bent = np.stack([h.max(axis=1) for _, h in slabs], axis=1)
        several = tuple(slab if len(slab[0]) > 2 else None for slab in slabs)
        return LipschitzBound(value, np.zeros_like(value), "declared", "declared", curvature=bent, slabs=several)


def _slabs(given: list[Bend], low: float, high: float, axis: str) -> tuple[Array, Array]:
    """(cuts, H (nx, slabs)) of one axis; UsageError unless the parts of each state leave no gap between the ends."""
    parts = [sorted([[low, high, g]] if isinstance(g, int | float) else [list(p) for p in g]) for g in given]
    for part in parts:
        joined = all(a[1] == b[0] for a, b in pairwise(part))
        if not joined or part[0][0] > low or part[-1][1] < high or any(a >= b for a, b, _ in part):
            raise UsageError(
                f"lipschitz.curvature: the parts {part} do not tile {axis} = [{low:g}, {high:g}]; give [low, high, bound] for "
                f"each, the next one beginning where one ends"
            )
    cuts = np.unique([low, high, *(c for part in parts for a, b, _ in part for c in (a, b) if low < c < high)])
    middle = (cuts[1:] + cuts[:-1]) / 2
    return cuts, np.array([[next(h for a, b, h in part if a <= m <= b) for m in middle] for part in parts])


def _table(given: Mapping[str, Mapping[str, T]], states: list[str], axes: list[str], where: str) -> list[list[T]]:
    rows = named(given, states, where, "state")
    return [list(named(row, axes, f"{where}.{s}", "axis").values()) for s, row in rows.items()]


def named(given: Mapping[str, T], names: list[str], where: str, what: str) -> dict[str, T]:
    """`given` in the order of `names`; UsageError unless it holds these names and no others."""
    for name in given:
        if name not in names:
            near = difflib.get_close_matches(name, names, 1)
            hint = f"did you mean '{near[0]}'?" if near else f"there are {', '.join(names)}"
            raise UsageError(f"{where}: '{name}' is no {what} of the problem; {hint}")
    if missing := [n for n in names if n not in given]:
        raise UsageError(
            f"{where}: no entry for {what} '{missing[0]}'; every {what} needs one: {', '.join(names)} (0 where inert)"
        )
    return {n: given[n] for n in names}
