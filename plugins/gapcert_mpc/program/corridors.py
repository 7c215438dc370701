"""Targets and obstacles as bounds on the rows of a program, and the corridor between obstacles that a plan is in."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import final

import numpy as np

from gapcert.plugin import TURN, Array, Bools, Box, Ellipsoid, Goal, Ints, Polytope, Region, circle
from gapcert_mpc.thresholds import THRESHOLDS

from .linearise import Frame
from .program import Program, Rows


@final
@dataclass(frozen=True)
class Part:
    """{low ≤ x ≤ high, cuts x ≤ bounds} of the states, in the frame; a cut's coefficients are at most 1."""

    low: Array
    high: Array
    cuts: Array
    bounds: Array


def parts(region: Region | None, stay: Box, frame: Frame, outer: bool) -> list[Part]:
    """The parts of a region, at every turn of its angles that meets `stay`.

    An ellipsoid becomes the box around it (`outer`), or one inside it.
    """
    if region is None:
        return []
    shapes: list[tuple[Box, Polytope | None]] = [(b, None) for b in region.boxes] + [(p.box, p) for p in region.polytopes]
    shapes += [(e.box if outer else within(e), None) for e in region.ellipsoids]
    return [part for box, polytope in shapes for part in _turned(box, polytope, stay, frame)]


def _turned(box: Box, polytope: Polytope | None, stay: Box, frame: Frame) -> Iterator[Part]:
    low, high = np.asarray(box.low), np.asarray(box.high)
    matrix = polytope.zone.matrix if polytope else np.zeros((0, len(low)))
    right = polytope.zone.bounds if polytope else np.zeros(0)
    middle, half = frame.x
    turns = [
        circle.copies(g, h, a, b) if axis.kind == "angle" else range(1)
        for axis, g, h, a, b in zip(box.axes, low, high, stay.low, stay.high, strict=True)
    ]
    turning = np.array([axis.kind == "angle" for axis in box.axes])
    for turn in itertools.product(*turns):
        move = TURN * np.asarray(turn, dtype=np.float64)
        a, b = (low + move - middle) / half, (high + move - middle) / half
        # A copy that stops short of `stay` is none of its parts; the frame may be wider.
        near = (low + move <= stay.high) & (high + move >= stay.low) | ~turning
        if near.all() and (a <= 1).all() and (b >= -1).all():
            cuts = matrix * half
            size = np.abs(cuts).max(axis=1, initial=1e-300)
            yield Part(a, b, cuts / size[:, None], (right + matrix @ (move - middle)) / size)


def within(shape: Ellipsoid) -> Box:
    """A box inside an ellipsoid, in the proportions of the one around it."""
    m = np.asarray(shape.matrix)
    radii = np.sqrt(np.diag(np.linalg.inv(m)))
    corners = np.array(list(itertools.product((-1.0, 1.0), repeat=len(radii)))) * radii
    radii = radii * (1 - 1e-12) / np.sqrt(np.einsum("ki,ij,kj->k", corners, m, corners).max())
    low, high = list(shape.box.low), list(shape.box.high)
    for j, c, r in zip(shape.on, shape.centre, radii.tolist(), strict=True):
        low[j], high[j] = max(low[j], c - r), min(high[j], c + r)
    return Box(shape.box.axes, tuple(low), tuple(high))


@final
@dataclass(frozen=True)
class Scene:
    """Over the rows of a program (those of `Program.whole`): targets lie in low ≤ W z ≤ high, (t, rows); a point is outside an
    obstacle if it is beyond one of its faces: above, W_row z ≥ bound (side 1), or below, W_row z ≤ bound (side −1).
    F (f, n+m): what the uncertainty depends on.
    """

    low: Array
    high: Array
    obstacle: Ints
    row: Ints
    side: Ints
    bound: Array
    F: Array

    @property
    def obstacles(self) -> int:
        return int(self.obstacle.max(initial=-1)) + 1

    def margins(self, value: Array, reach: Array) -> Array:
        """(k, faces): how far beyond each face the tubes with W x̄ = value (k, rows) and half-widths reach (k, rows) are."""
        return np.asarray(self.side * (value[:, self.row] - self.bound) - reach[:, self.row])

    def clear(self, value: Array, reach: Array) -> Bools:
        """(k,): the tubes are beyond a face of every obstacle."""
        return np.asarray(self._best(self.margins(value, reach))[1].min(axis=1, initial=np.inf) >= 0)

    def _best(self, margins: Array) -> tuple[Ints, Array]:
        """The face of most margin of each obstacle, and the margin, (k, obstacles) each."""
        face, most = np.zeros((len(margins), self.obstacles), dtype=np.int64), np.zeros((len(margins), self.obstacles))
        for o in range(self.obstacles):
            own = np.flatnonzero(self.obstacle == o)
            face[:, o] = own[margins[:, own].argmax(axis=1)]
            most[:, o] = margins[:, own].max(axis=1)
        return face, most

    def corridor(self, value: Array, reach: Array) -> tuple[Array, Array]:
        """low, high (k, rows): the side of each obstacle on which the tube has most room."""
        low, high = np.full(value.shape, -np.inf), np.full(value.shape, np.inf)
        stages = np.arange(len(value))
        for face in self._best(self.margins(value, reach))[0].T:
            row, bound, above = self.row[face], self.bound[face], self.side[face] > 0
            k = stages[above]
            low[k, row[above]] = np.maximum(low[k, row[above]], bound[above])
            k = stages[~above]
            high[k, row[~above]] = np.minimum(high[k, row[~above]], bound[~above])
        return low, high

    def inside(self, value: Array, reach: Array) -> Array:
        """(k, t): how far inside each target the tubes are; negative where they are not."""
        above, below = value[:, None] + reach[:, None], value[:, None] - reach[:, None]
        return np.asarray(np.minimum(self.high - above, below - self.low).min(axis=2))


def scene(goal: Goal, frame: Frame, rows: Rows, F: Array) -> tuple[Rows, Scene]:
    """The goal's target and obstacles over the rows, with those added that its polytopes need."""
    nx, nz = frame.nx, len(frame.half)
    targets = parts(goal.target, goal.stay, frame, outer=False)
    obstacles = parts(goal.avoid, goal.stay, frame, outer=True)
    cuts = [p.cuts for p in (*targets, *obstacles)]
    C = np.concatenate([c for c in cuts if len(c)] or [np.zeros((0, nx))])
    first = nz + len(rows.C)
    free = np.full(len(C), THRESHOLDS.loose_bound)
    C = np.hstack([C, np.zeros((len(C), nz - nx))])
    more = Rows(np.concatenate([rows.C, C]), np.concatenate([rows.low, -free]), np.concatenate([rows.high, free]))
    low, high = (np.full((len(targets), first + len(C)), s * np.inf) for s in (-1, 1))
    at = first
    for t, p in enumerate(targets):
        low[t, :nx], high[t, :nx] = p.low, p.high
        high[t, at : at + len(p.cuts)] = p.bounds
        at += len(p.cuts)
    faces: list[tuple[int, int, int, float]] = []
    for o, p in enumerate(obstacles):
        found = [(o, j, -1, float(p.low[j]) - THRESHOLDS.outside_margin) for j in range(nx) if p.low[j] > -1]
        found += [(o, j, 1, float(p.high[j]) + THRESHOLDS.outside_margin) for j in range(nx) if p.high[j] < 1]
        found += [(o, at + i, 1, float(b) + THRESHOLDS.outside_margin) for i, b in enumerate(p.bounds)]
        at += len(p.cuts)
        # Nothing is beyond an obstacle that covers all.
        faces += found or [(o, 0, 1, THRESHOLDS.loose_bound)]
    obstacle, row, side = np.array([f[:3] for f in faces], dtype=np.int64).reshape(-1, 3).T
    return more, Scene(low, high, obstacle, row, side, np.array([f[3] for f in faces], dtype=np.float64), F)


def read(program: Program, x: Array, s: Array) -> tuple[Array, Array]:
    """(W x̄, |W P| s) of stages x (k, n), s (k, p): values and half-widths of all rows; those with inputs are not meant."""
    return x @ program.whole[:, : program.n].T, s @ program.grows.T
