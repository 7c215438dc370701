"""Lipschitz constants that need no sampling: declared by the user, or proved from equations."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import TypeVar, final

import numpy as np

from gapcert import Array, Interval, Model, UsageError
from gapcert.plugin import LipschitzBound, LipschitzEstimator, LipschitzProblem, ModelPredictor
from gapcert_bounds.thresholds import THRESHOLDS

from .interval_cells import Slopes, cells
from .interval_curvature import proved

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


@final
class IntervalJacobian(LipschitzEstimator):
    """sup_Z |∂(f̂ − f − p)_i/∂z_j| by interval Jacobians over boxes that are bisected where the bound is loosest.

    Needs equations of both systems. `boxes` limits the bisection, which stops earlier when every bound is within a thousandth
    of a slope that occurs. With `cells` > 1 the domain is cut into up to so many cells where the bounds differ most, and each
    has constants of its own, proved in as many boxes once more. With `curvature`, second derivatives along each axis are
    bounded alike, on the whole domain and in up to `slabs` parts of the axis, ∞ where there may be a kink; in as many boxes per
    axis.
    """

    provenance = "interval"

    def __init__(self, boxes: int = 4096, cells: int = 1, curvature: bool = False, slabs: int = 8) -> None:
        if curvature and cells > 1:
            raise UsageError("lipschitz interval: curvature is that of the whole domain; use cells: 1, or leave it out")
        self.boxes, self.cells, self.curvature, self.slabs = boxes, cells, curvature, slabs

    def bound(self, problem: LipschitzProblem) -> LipschitzBound:
        whole, fhat = self._whole(problem), problem.white_box
        if self.curvature and fhat is not None:
            return proved(problem, fhat, whole, self.slabs, self.boxes)
        return whole if self.cells == 1 else self._cut(problem, whole)

    def _cut(self, problem: LipschitzProblem, whole: LipschitzBound) -> LipschitzBound:
        fhat, axes = problem.white_box, tuple(j for j in range(len(problem.domain.low)) if j not in problem.held)
        if fhat is None or len(axes) > THRESHOLDS.cell_axes:
            raise UsageError(
                f"lipschitz interval: cells are cut along at most {THRESHOLDS.cell_axes} axes, found {len(axes)}; use cells: 1"
            )
        parts = self.boxes // self.cells
        made = cells(Slopes(problem.domain, lambda b: _slopes(fhat, problem, b).mag, whole.value, axes, parts), self.cells)
        if len(made) == 1:
            return whole
        return replace(whole, value=made.worst, method=f"interval ({len(made)} cells)", cells=made)

    def _whole(self, problem: LipschitzProblem) -> LipschitzBound:
        fhat = problem.white_box
        if fhat is None:
            raise UsageError(
                "lipschitz interval: the backend is a black box, and interval bounds need its equations; "
                "use wood-zhang or declared constants"
            )
        _refuse_wrap(fhat, problem)
        boxes = problem.domain.interval
        bound, lower = _slopes(fhat, problem, boxes).mag, _reached(fhat, problem, boxes)
        while len(boxes) < self.boxes:
            loose = np.where(bound > lower * (1 + 1e-3) + np.finfo(float).tiny, bound, 0.0)
            # A box is urgent where it holds an entry's largest bound, or nearly does.
            urgency = (loose / np.maximum(loose.max(axis=0), np.finfo(float).tiny)).max(axis=(1, 2))
            if urgency.max() == 0:
                break
            count = min(self.boxes - len(boxes), max(1, len(boxes) // 2))
            order = np.argsort(-urgency, kind="stable")
            first, rest = order[:count], order[count:]
            urgent = boxes[first]
            parts = urgent.cut(((urgent.hi - urgent.lo) / problem.domain.width).argmax(axis=1))
            tighter = np.minimum(_slopes(fhat, problem, parts).mag, np.tile(bound[first], (2, 1, 1)))
            lower = np.maximum(lower, _reached(fhat, problem, parts))
            boxes, bound = Interval.concatenate([boxes[rest], parts]), np.concatenate([bound[rest], tighter])
        value = bound.max(axis=0)
        if not np.isfinite(value).all():
            i, j = np.argwhere(~np.isfinite(value))[0]
            names = [a.name for a in problem.domain.axes]
            raise UsageError(f"lipschitz interval: ∂{names[i]}/∂{names[j]} is unbounded on the domain; make the domain smaller")
        return LipschitzBound(value, lower, "interval", "interval", diagnostics={"boxes": len(boxes)})


def _refuse_wrap(fhat: Model, problem: LipschitzProblem) -> None:
    """A residual or predictor of angles that can reach ±π jumps there, whatever its derivative is."""
    parts = [ModelPredictor(fhat, problem.model)]
    if isinstance(problem.predictor, ModelPredictor):
        parts.append(problem.predictor)
    difference = np.max([p.over(problem.domain.interval).mag[0] for p in parts], axis=0)
    for state, size in zip(problem.model.states, difference, strict=True):
        if state.kind == "angle" and size >= np.pi:
            raise UsageError(
                f"lipschitz interval: the residual of angle '{state.name}' may reach {size:.3g} ≥ π, where it jumps; "
                f"make the domain smaller"
            )


def _slopes(fhat: Model, problem: LipschitzProblem, boxes: Interval) -> Interval:
    """∂(f̂ − f − p)/∂z over boxes, (n, nx, nz)."""
    return fhat.jacobian_enclosure(boxes) - problem.model.jacobian_enclosure(boxes) - problem.predictor.jacobian_over(boxes)


def _reached(fhat: Model, problem: LipschitzProblem, boxes: Interval) -> Array:
    """A slope that is proved to occur: the smallest |∂| that each centre's own enclosure allows, maximised over boxes."""
    return np.asarray(abs(_slopes(fhat, problem, Interval.exact(boxes.mid))).lo.max(axis=0))
