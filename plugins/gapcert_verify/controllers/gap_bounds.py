"""[l, u] of a saved certificate over boxes of states and inputs, which a controller's successors are widened by."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np

from gapcert.plugin import Array, Interval, UsageError, cut, joined, ranges, rounding
from gapcert_verify import arithmetic as ar
from gapcert_verify import multilinear
from gapcert_verify.evaluator import Equations, Reader, Tape
from gapcert_verify.evidence import Evidence, Part, bounds, factor, written

BLOCK = 1 << 20  # samples times boxes that are looked at together
_EPS = float(np.finfo(np.float64).eps)
_TINY = float(np.finfo(np.float64).tiny)


@final
@dataclass(frozen=True)
class Gap:
    """The stored gap function over boxes. relative: how (x, u) become the coordinates that it is stored in.

    extended: the model whose step less that of `nominal` is the predictor p, where it is one.
    """

    evidence: Evidence
    relative: Relative | None = None
    extended: Equations | None = None
    nominal: Equations | None = None

    def over(self, low: Array, high: Array) -> Interval:
        """Contains [l(z), u(z)] for all z of boxes (n, nx + nu): (n, nx)."""
        found = self._over(self.boxes(Interval(low, high)), Interval(low, high))
        return found + Interval(-self._spare, self._spare) if self._spare.any() else found

    def beyond(self, y: Interval, z: Interval) -> Interval:
        """Contains what `affine` leaves of r over boxes y of the stored coordinates, in boxes z of (x, u): (n, nx)."""
        spare, size = self._spare, np.zeros(self.nx)
        if self._apart:  # products of the slopes with those of the coordinates round
            size = np.abs(self.affine[0]) @ z.mag.max(axis=0, initial=0.0)
        spare = spare + 1e-14 * size
        return self._over(y, z, known=not self._apart) + Interval(-spare, spare)

    @cached_property
    def affine(self) -> tuple[Array, Array]:
        """(slope (nx, nz), offset (nx,)) over (x, u) of an affine predictor, whose range over wide boxes would hide how little
        is left; 0 of other ones, which are not taken apart.
        """
        nz, arrays, c = len(self.evidence.zone.low), self.evidence.arrays, self.relative
        if not self._apart:
            return np.zeros((self.nx, nz)), np.zeros(self.nx)
        slope = np.asarray(arrays["predictor.slope"])
        if c is not None:
            x, w = slope[:, : self.nx], slope[:, self.nx :]
            slope = np.concatenate([x + w @ c.slope, w * c.scale], axis=1)
        return slope, np.asarray(arrays["predictor.offset"])

    @property
    def _apart(self) -> bool:
        return self.evidence.data.get("predictor") == "affine" and self.evidence.data["form"]["form"] not in _SYMMETRIC

    def stored(self, rows: Array) -> Array:
        """Rows of coefficients of (x, u) as those of the stored coordinates: (n, nz)."""
        if (c := self.relative) is None:
            return rows
        x, u = rows[:, : self.nx], rows[:, self.nx :] / c.scale
        return np.concatenate([x - u @ c.slope, u], axis=1)

    @property
    def nx(self) -> int:
        return int(self.evidence.data["domain"]["states"])

    @property
    def _spare(self) -> Array:
        """What a calibration widens the band by; a narrowing is left out: what is narrower lies in the band."""
        if self.evidence.data["route"] != "calibrate":
            return np.zeros(self.nx)
        own = self.evidence.arrays
        return np.asarray(np.maximum(own["gap.calibrated.widening"], 0.0) + own["gap.calibrated.resolution"])

    def boxes(self, z: Interval) -> Interval:
        """Boxes of the stored coordinates that contain those of (x, u)."""
        return z if self.relative is None else self.relative.over(z)

    def nothing(self, k: int) -> bool:
        """Is there no gap of state k at all, as declared?"""
        own = self.evidence
        return own.data["form"]["form"] == "constant" and own.data["route"] != "calibrate" and not own.arrays["gap.gamma"][k]

    def at(self, z: Array) -> tuple[Interval, Interval]:
        """(l, u) at points (x, u), each as an interval around the exact value."""
        return bounds(self.evidence, z if self.relative is None else self.relative.over(Interval.exact(z)).mid, "")

    @cached_property
    def slopes(self) -> Array | None:
        """(nx, nz): by how much residuals, and so about the ends, move per unit of (x, u); None where no constants tell.
        Nothing but the order in which boxes are cut rests on it.
        """
        if (slope := self.left) is None:
            return None
        if self.evidence.data.get("predictor") == "affine":
            slope = slope + np.abs(self.evidence.arrays["predictor.slope"])
        if (c := self.relative) is None:
            return slope
        x, w = slope[:, : self.nx], slope[:, self.nx :]
        return np.concatenate([x + w @ np.abs(c.slope), w * np.abs(c.scale)], axis=1)

    @cached_property
    def left(self) -> Array | None:
        """The same of what the predictor leaves, per unit of the stored coordinates."""
        e = self.evidence
        form, kind, nz = e.data["form"]["form"], e.data.get("predictor", "none"), len(e.zone.low)
        if form == "constant":
            return np.zeros((len(e.arrays["gap.gamma"]), nz))
        if "lipschitz" not in e.arrays or kind not in ("none", "affine"):
            return None
        return np.asarray(e.arrays["cells.L"].max(axis=0) if "cells.L" in e.arrays else e.arrays["lipschitz"])

    def _over(self, boxes: Interval, asked: Interval, known: bool = True) -> Interval:
        """Of the stored form over boxes in its own coordinates; asked: the same over (x, u). known: with the predictor."""
        e, form = self.evidence, self.evidence.data["form"]["form"]
        if form in _SYMMETRIC:
            gamma = np.broadcast_to(_SYMMETRIC[form](e, boxes), (len(boxes), self.nx))
            return Interval(-gamma, gamma)
        if form not in _BANDS:
            raise UsageError(f"no bound over boxes is known for gap functions of form '{form}'")
        rest = _BANDS[form](e, boxes)
        return self._known(boxes, asked) + rest if known else rest

    def _known(self, boxes: Interval, asked: Interval) -> Interval:
        """Contains the predictor over each box."""
        e, kind = self.evidence, self.evidence.data["predictor"]
        n, nx = len(boxes), len(e.arrays["resolution"])
        if kind == "affine":
            slope = Interval.exact(e.arrays["predictor.slope"])
            return (boxes.reshape(n, 1, -1) * slope).sum(-1) + Interval.exact(e.arrays["predictor.offset"])
        if kind == "multilinear":
            values = e.arrays["predictor.values"]
            low, high = ranges(multilinear.nodes(e.arrays, e.zone, "predictor"), values, boxes.lo, boxes.hi)
            pad = rounding(boxes.shape[1]) * np.abs(values).max()
            return Interval(low - pad, high + pad)
        if kind == "model":
            pair = [q for q in (self.extended, self.nominal) if q is not None]
            parts = [ar.subtract(*(q.over(asked.lo, asked.hi, q.terms[k]) for q in pair)) for k in range(nx)]
            ends = (np.stack(end, axis=1) for end in zip(*map(ar.known, parts), strict=True))
            return Interval(*ends) + Interval.around(0.0, e.arrays["remainder.resolution"] - e.arrays["resolution"])
        return Interval.exact(np.zeros((n, nx)))


def _of_network(e: Evidence, boxes: Interval) -> Array:
    from gapcert_verify.functions import network  # late: networks need SciPy

    return np.asarray((network(e.data["form"], e.arrays).tight_over(boxes) + e.arrays["gap.margin"]).maximum(0.0).hi)


@final
@dataclass(frozen=True)
class Relative:
    """w = scale · u + slope x, one row per input: slope (nu, nx), scale (nu,) without a zero."""

    slope: Array
    scale: Array

    def over(self, z: Interval) -> Interval:
        """Boxes of (x, u) → boxes that contain (x, w), (n, nz)."""
        nx = self.slope.shape[1]
        w = (z[:, None, :nx] * self.slope).sum(-1) + z[:, nx:] * Interval.exact(self.scale)
        return Interval.concatenate([z[:, :nx], w], axis=1)


def coordinates(model: Equations, given: Mapping[str, str] | None) -> Relative | None:
    """Of a spec whose inputs are measured relative to the states: texts such as `{d: u - v}`. ValueError for others."""
    if not given:
        return None
    tape, names = Tape(), (*model.states, *model.inputs)
    read = Reader(tape, {n: tape.column(j) for j, n in enumerate(names)})
    one, wide = ar.point(1.0), frozenset(range(len(names)))
    rows = np.zeros((len(given), len(names)))
    for text, slopes in zip(
        given.values(), tape.run([one] * len(names), [read(t) for t in given.values()], wide)[1], strict=True
    ):
        for j, s in slopes.items():
            own = [r for r in range(len(model.inputs)) if model.nx + r in slopes]
            if len(own) != 1 or s.lo != s.hi:
                raise ValueError(f"'{text}' is no sum of one input and of states")
            rows[own[0], j] = s.lo
    scale = np.diagonal(rows[:, model.nx :])
    if not scale.all():
        raise ValueError("the coordinates do not stand for the inputs")
    return Relative(rows[:, : model.nx], scale)


def _envelope(e: Evidence, boxes: Interval) -> Interval:
    """Of p = 0: the band at a box's centre holds for all of it, widened by Σ_j L_j h_j; of the cells that a box meets, each."""
    nx = len(e.arrays["resolution"])
    low, high = np.full((len(boxes), nx), np.inf), np.full((len(boxes), nx), -np.inf)
    for part in e.parts:
        rows = np.flatnonzero(((boxes.lo <= part.box.hi) & (boxes.hi >= part.box.lo)).all(axis=1))
        if not len(rows) or (not len(part.z) and e.zone.outside(part.box)[0]):
            continue
        own = Interval(np.maximum(boxes.lo[rows], part.box.lo), np.minimum(boxes.hi[rows], part.box.hi))
        ends = _cones(part, own)
        low[rows], high[rows] = np.minimum(low[rows], ends.lo), np.maximum(high[rows], ends.hi)
    outside = low > high  # of boxes beyond Z nothing is known
    return Interval(np.where(outside, -np.inf, low), np.where(outside, np.inf, high))


def _cones(part: Part, boxes: Interval) -> Interval:
    """Computed as it stands: a sum of nz products errs by less than (2 nz + 2) ulp of its size, and Σ L |c − z| is at most
    |u| + |g|.
    """
    nz, nx = boxes.shape[1], len(part.constants)
    if not len(part.z):
        return Interval(np.full((len(boxes), nx), -np.inf), np.full((len(boxes), nx), np.inf))
    centre, reach, size = boxes.mid, boxes.rad, np.maximum(np.abs(part.g.lo), np.abs(part.g.hi)).max(axis=0)
    out, rows = np.empty((2, len(boxes), nx)), max(1, BLOCK // len(part.z))
    for a in range(0, len(boxes), rows):
        c = centre[a : a + rows]
        apart = [np.abs(c[:, j, None] - part.z[None, :, j]) for j in range(nz)]
        for i, constants in enumerate(part.constants):
            d = sum((apart[j] * constants[j] for j in np.flatnonzero(constants)), np.zeros((len(c), len(part.z))))
            out[0, a : a + rows, i] = (part.g.lo[:, i] - d).max(axis=1)
            out[1, a : a + rows, i] = (part.g.hi[:, i] + d).min(axis=1)
    wide = (reach @ part.constants.T) * (1 + (nz + 2) * _EPS) + part.slack.hi
    # Where constants are refuted the ends cross: the hull of both holds then as well.
    pad = (2 * nz + 8) * _EPS * (np.abs(out).max(axis=0) + 2 * size + wide) + _TINY
    return Interval(out.min(axis=0) - wide - pad, out.max(axis=0) + wide + pad)


def _of_basis(e: Evidence, boxes: Interval) -> Array:
    total = Interval.exact(np.broadcast_to(e.arrays["gap.margin"], (len(boxes), len(e.arrays["gap.margin"]))))
    for k, data in enumerate(e.data["form"]["functions"]):
        if (expression := written(data)) is not None:
            value = expression.over(boxes)[:, None]
        else:
            value = Interval.exact(np.ones((len(boxes), 1)))
            for axis, kind, number in data:
                value = value * factor(kind, number, boxes[:, axis : axis + 1])
        total = total + value * Interval.exact(e.arrays["gap.weights"][:, k])
    return total.maximum(0.0).hi


def _dominating(e: Evidence, boxes: Interval) -> Interval:
    """Both sides with their shifts, over the parts of a box that lie in the table's cells; a face is the lower cell's."""
    from gapcert_verify.functions import sides, table

    own, (lower, upper) = table(e.arrays, e.zone), sides(e.data["form"], e.arrays, e.zone)
    starts, parts, first, last = cut(own.edges, boxes, own.at(boxes.lo), own.at(boxes.hi))
    grid = e.arrays["gap.shifts"].reshape(2, -1, *own.counts)
    spans, same = np.unique(np.hstack([first, last]), axis=0, return_inverse=True)
    inner, most = tuple(range(2, grid.ndim)), np.empty((len(spans), 2, grid.shape[1]))
    for row, ends in zip(most, spans.reshape(len(spans), 2, -1), strict=True):
        row[:] = grid[(slice(None), slice(None), *(slice(a, b + 1) for a, b in ends.T))].max(axis=inner)
    shift = most[same.reshape(-1)]
    low, high = lower.tight_over(parts) - shift[:, 0], upper.tight_over(parts) + shift[:, 1]
    return joined(starts, Interval.hull(low, high))


_SYMMETRIC: Mapping[str, Callable[[Evidence, Interval], Array]] = {
    "constant": lambda e, boxes: e.arrays["gap.gamma"],
    "basis": _of_basis,
    "network": _of_network,
}
_BANDS: Mapping[str, Callable[[Evidence, Interval], Interval]] = {
    "envelope": _envelope,
    "dominating": _dominating,
    "multilinear": lambda e, boxes: multilinear.over(e.arrays, e.zone, e.parts[0].g, boxes),
}
"""Forms that have γ alone, and those about a predictor."""
