"""Gap functions by route dominate: any lower and upper function, lifted until they contain the envelope everywhere."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, final

import numpy as np
import numpy.typing as npt

from gapcert.plugin import (
    Array,
    Domain,
    Event,
    GapFunction,
    GapProblem,
    Interval,
    Predictor,
    cut,
    joined,
    on_curvature,
    registry,
)

from .bounded_function import Function
from .lifting import Band, Cones, Part, Side, Table, lift

Index = npt.NDArray[np.intp]

_EPS = float(np.finfo(np.float64).eps)
_TINY = float(np.finfo(np.float64).tiny)
_SLACK = 1e-12  # of the sizes involved, on every shift: a proof that is repeated elsewhere may round otherwise


@final
class DominatingGap(GapFunction):
    """l_i = p_i + lower_i − δ_i and u_i = p_i + upper_i + δ′_i with shifts δ that are constant per cell of a table.

    shifts (2, nx, m): δ of the lower and of the upper side; rounding (2, nx): bounds on the errors of both computed functions
    on the domain; boxes (2, nx): how many the proof took. target: the band that is contained.
    """

    predictor: Predictor

    def __init__(
        self,
        family: str,
        sides: tuple[Function, Function],
        table: Table,
        shifts: Array,
        predictor: Predictor,
        rounding: Array,
        boxes: Array,
        target: GapFunction,
    ) -> None:
        self.family, self.sides, self.table, self.shifts = family, sides, table, shifts
        self.predictor, self.rounding, self.boxes, self.target = predictor, rounding, boxes, target

    def interval(self, z: Array) -> tuple[Array, Array]:
        low, high = self.ends(z)
        return np.minimum(low, high), np.maximum(low, high)

    def ends(self, z: Array) -> tuple[Array, Array]:
        """(l, u) as they are: u < l is possible where constants are refuted."""
        cell, p = self.table.locate(z), self.predictor(z)
        low, high = (self._ended(k, p, self.sides[k](z), self.shifts[k][:, cell].T) for k in (0, 1))
        return low, high

    def _ended(self, k: int, p: Array, q: Array, shift: Array) -> Array:
        pad = self.rounding[k] + 8 * _EPS * (np.abs(p) + np.abs(q) + np.abs(shift)) + _TINY
        return np.asarray(p + q + shift + pad if k else p + q - shift - pad)

    def interval_over(self, boxes: Interval) -> Interval:
        # Of both ends: where constants are refuted they may cross.
        return Interval.hull(*self.ends_over(boxes))

    def ends_over(self, boxes: Interval) -> tuple[Interval, Interval]:
        return self._ends(boxes, self.predictor)

    def remainder_ends_over(self, boxes: Interval) -> tuple[Interval, Interval]:
        (low, high), pad = self._ends(boxes, None), self.predictor.error_over(boxes)
        return Interval(low.lo - pad, low.hi + pad), Interval(high.lo - pad, high.hi + pad)

    def _ends(self, boxes: Interval, plus: Predictor | None) -> tuple[Interval, Interval]:
        """Of the sides with the shifts, and with p where `plus` is it."""
        starts, parts, first, last = cut(self.table.edges, boxes, self.table.at(boxes.lo), self.table.at(boxes.hi))
        ends, size, (least, most) = [], self.predictor.over(parts).mag, self._shifts_over(first, last)
        for k, sign in enumerate((-1, 1)):
            q = self.sides[k].tight_over(parts, plus)
            shift = Interval.hull(sign * least[k], sign * most[k])
            # Twice what `interval` adds at a point of the box, for the rounding here; |q| ≤ |p + q| + |p|.
            pad = 2 * (self.rounding[k] + 8 * _EPS * (2 * size + q.mag + shift.mag) + _TINY)
            end = q + shift
            ends.append(joined(starts, Interval(end.lo - pad, end.hi + pad)))
        return ends[0], ends[1]

    def _shifts_over(self, first: Index, last: Index) -> tuple[Array, Array]:
        """The least and the largest shifts of cells first … last, each (2, n, nx)."""
        found = np.repeat(self.shifts[:, :, np.ravel_multi_index(tuple(first.T), self.table.counts)][None], 2, axis=0)
        found = np.moveaxis(found, 3, 2)
        several = np.flatnonzero((first != last).any(axis=1))
        ranges, same = np.unique(np.hstack([first, last])[several], axis=0, return_inverse=True)
        grid = self.shifts.reshape(*self.shifts.shape[:2], *self.table.counts)
        for row, ends in enumerate(ranges.reshape(len(ranges), 2, first.shape[1])):
            part = grid[(slice(None), slice(None), *(slice(a, b + 1) for a, b in ends.T))]
            inner, own = tuple(range(2, grid.ndim)), several[same.reshape(-1) == row]
            found[0][:, own], found[1][:, own] = part.min(axis=inner)[:, None], part.max(axis=inner)[:, None]
        return found[0], found[1]

    def lipschitz(self, boxes: Interval) -> Array:
        slope, p = np.zeros((len(boxes), self.shifts.shape[1], boxes.shape[1])), self.predictor.jacobian_over(boxes)
        for q in self.sides:
            for i in range(slope.shape[1]):
                own = q.gradient_over(boxes, i)
                # The pad follows |p| and |q|, whose slopes need not cancel where those of p + q do.
                slope[:, i] = np.maximum(slope[:, i], (p[:, i] + own).mag + 1e-12 * (p[:, i].mag + own.mag))
        crossed = self.table.at(boxes.lo) != self.table.at(boxes.hi)
        return np.where(crossed[:, None, :], np.inf, slope * (1 + 1e-12))

    def pieces(self, domain: Domain) -> Iterator[tuple[Interval, GapFunction]]:
        boxes = self.table.boxes
        for c in range(len(self.table)):
            one = Table(tuple(np.array([a, b]) for a, b in zip(boxes.lo[c], boxes.hi[c], strict=True)))
            shifts = np.ascontiguousarray(self.shifts[:, :, c : c + 1])
            yield (
                boxes[c : c + 1],
                DominatingGap(self.family, self.sides, one, shifts, self.predictor, self.rounding, self.boxes, self.target),
            )

    def arrays(self) -> dict[str, Array]:
        named = {"shifts": self.shifts, "boxes": self.boxes, **{f"edges{j}": e for j, e in enumerate(self.table.edges)}}
        for side, q in zip(("lower", "upper"), self.sides, strict=True):
            named |= {f"{side}.{k}": v for k, v in q.arrays().items()}
        return named | (self.target.arrays() if on_curvature(self.target.form) else {})

    @property
    def form(self) -> Mapping[str, Any]:
        """`lower` and `upper` as `Function.data`, each with its kind; the numbers of both are arrays."""
        lower, upper = ({"kind": q.kind, **q.data()} for q in self.sides)
        kind = {"form": "dominating", "target": self.target.form["form"], "predictor": self.predictor.kind}
        return {**kind, "lower": lower, "upper": upper}


def dominate(
    problem: GapProblem,
    family: str,
    lower: Function,
    upper: Function,
    counts: Sequence[int],
    tolerance: float = 0.01,
    budget: int = 200_000,
) -> DominatingGap:
    """The tightest shifts of `lower` and `upper` (both of g = r − p, n_out = nx) for which they contain the problem's envelope,
    per cell of a table with `counts` cells per axis.

    Each shift is about `tolerance` (of the mean |r_i| over the samples) above the smallest, or as good as `budget` boxes per
    state and side prove.
    """
    domain, nx = problem.domain, problem.domain.nx
    table = Table.uniform(domain.low.tolist(), domain.high.tolist(), counts)
    sides, shifts, boxes, open_ = (lower, upper), np.empty((2, nx, len(table))), np.empty((2, nx)), 0.0
    scale, largest = np.abs(problem.samples.r).mean(axis=0) + problem.resolution, np.abs(problem.remainder).max(axis=0)
    for k, q in enumerate(sides):
        for i in range(nx):
            parts = _side(problem, i, 1 if k else -1)

            def progress(done: int, total: int, step: int = k * nx + i) -> None:
                told = {"done": step * total + done, "total": 2 * nx * total, "unit": "cells"}
                problem.emit(Event("progress", "fit", {**told, "best": {"sides proved": step}}))

            found = lift(Side(parts, q, i, 1 if k else -1), table, domain.zone, tolerance * scale[i], budget, None, progress)
            size = largest[i] + problem.lipschitz.value[i] @ domain.width + np.abs(found.shift).max()
            shifts[k, i], boxes[k, i] = found.shift + _SLACK * size, found.boxes
            open_ = max(open_, found.open)
    if open_:
        message = (
            f"the proofs ended at {budget} boxes each, and left up to {open_:.0%} of the table's cells looser than asked for"
        )
        problem.emit(Event("warning", "fit", {"message": message}))
    rounding = np.array([q.rounding(domain.interval) for q in sides])
    return DominatingGap(family, sides, table, shifts, problem.predictor, rounding, boxes, band(problem))


def band(problem: GapProblem) -> GapFunction:
    """The band that `dominate` lifts functions above: the family `multilinear` where samples on a lattice and bounds of
    curvature allow it, else the `envelope`."""
    family = "envelope" if _nodes(problem) is None else "multilinear"
    found: GapFunction = registry().build("gap_family", family).fit(problem)
    return found


def _nodes(problem: GapProblem) -> Sequence[Array] | None:
    """Per axis, the nodes between which `band` is multilinear; None where it is the envelope."""
    bound = problem.lipschitz
    usable = bound.curvature is not None and bound.cells is None and not problem.domain.relations
    return problem.samples.lattice if usable and problem.predictor.kind != "multilinear" and not problem.spread else None


def _side(problem: GapProblem, i: int, sign: int) -> Sequence[Part]:
    """The upper side of `band` for state i; with sign −1, the mirror image of its lower side."""
    z, g, bound, whole = problem.samples.z, sign * problem.remainder[:, i], problem.lipschitz, problem.domain.interval
    slack = float(np.nextafter(2 * problem.remainder_resolution[i], np.inf))
    if (axes := _nodes(problem)) is not None:
        counts, bends = [len(a) for a in axes], [bound.bend(j, a)[i] for j, a in enumerate(axes)]
        nodes = Interval.exact(g[-int(np.prod(counts)) :].reshape(counts))
        return [Band.of(whole, axes, nodes, bends, bound.value[i], slack)]
    if bound.cells is None:
        return [Cones(whole, z, g, bound.value[i], slack)]
    members, boxes = bound.cells.closures(z), bound.cells.boxes
    made = [Cones(boxes[c : c + 1], z[rows], g[rows], bound.cells.constants[c, i], slack) for c, rows in enumerate(members)]
    jumps = bound.cells.jumps[:, i]
    return [replace(part, slack=float(np.nextafter(slack + j, np.inf))) for part, j in zip(made, jumps, strict=True)]
