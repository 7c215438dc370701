"""Regions as a picture of the first two states shows them: where its plane cuts them, and their shadow on it."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import final

import numpy as np

from gapcert.plugin import TURN, Array, Box, Ellipsoid, Goal, Polytope, circle, turned

ROUND = 180  # corners that an ellipse is drawn with
_FLAT = 1e-9  # of the box: nearer corners lie on one side
_NOTHING = np.empty((0, 2))
_DRAWN = {
    "stay": ("ink", "to stay in"),
    "avoid": ("bad", "avoid"),
    "target": ("good", "target"),
    "region": ("good", "named region"),
}

Part = Box | Polytope | Ellipsoid


@final
@dataclass(frozen=True)
class Outline:
    """A convex part of a region: its corners in order, points (k, 2).

    role: `stay`, `target`, `avoid` or `region`, whose name is `name`. where: `section`, what the plane, the other states held,
    cuts out of it; `shadow`, its projection along them; `elsewhere`, the shadow of what the plane does not meet; `everywhere`,
    both at once, since the part is the same wherever the others are.
    """

    role: str
    name: str
    where: str
    points: Array

    @property
    def cut(self) -> bool:
        """Is it for a picture at held values, rather than for one of runs?"""
        return self.where != "shadow"

    @property
    def dotted(self) -> bool:
        """Is it there for some values of the other states alone?"""
        return self.where in ("elsewhere", "shadow")


def outlines_of(goal: Goal, at: Array) -> tuple[Outline, ...]:
    """The goal's parts over its first two states, the others held as in `at` (nx,), each as far as it lies in `stay`."""
    names = goal.automaton.propositions if goal.automaton else ()
    parts = [("avoid", "", goal.avoid), ("target", "", goal.target)]
    parts += [("region", name, region) for name, region in zip(names, goal.regions, strict=True)]
    found = [Outline("stay", "", "everywhere", _corners(goal.stay))]
    for role, name, region in parts:
        for part in (*region.boxes, *region.shapes) if region is not None else ():
            found += [Outline(role, name, where, points) for where, points in _drawn(part, goal.stay, at)]
    return tuple(found)


def _drawn(part: Part, stay: Box, at: Array) -> Iterator[tuple[str, Array]]:
    hull = part if isinstance(part, Box) else part.box
    cut, shadow = section(part, at), projection(part)
    if _same(part, hull, stay):
        kinds = [("everywhere", shadow)]
    elif len(cut) < 3:
        kinds = [("elsewhere", shadow)]
    else:
        kinds = [("section", cut), ("shadow", shadow)]
    for (where, points), turns in itertools.product(kinds, _turns(hull, stay)):
        inside = points + turns
        for j in (0, 1):
            for sign, bound in ((-1.0, -stay.low[j]), (1.0, stay.high[j])):
                inside = _clip(inside, sign * np.eye(2)[j], bound)
        if len(inside) > 2:
            yield where, inside


def _same(part: Part, hull: Box, stay: Box) -> bool:
    """Is the part the same wherever in `stay` the states that are not drawn are?"""
    for j in range(2, len(stay.axes)):
        whole = hull.wraps[j]
        if not whole and (hull.low[j] > stay.low[j] or hull.high[j] < stay.high[j]):
            return False
    if isinstance(part, Polytope):
        return not any(any(cut.coefficients[2:]) for cut in part.cuts)
    return isinstance(part, Box) or max(part.on) < 2


def _turns(hull: Box, stay: Box) -> Iterator[Array]:
    """Whole turns of the drawn angles that bring the part to `stay`."""
    ranges = [
        circle.copies(hull.low[j], hull.high[j], stay.low[j], stay.high[j]) if stay.axes[j].kind == "angle" else range(1)
        for j in (0, 1)
    ]
    for turns in itertools.product(*ranges):
        yield TURN * np.array(turns, dtype=np.float64)


def section(part: Part, at: Array) -> Array:
    """Corners (k, 2) of what is left of a part over the first two states with the others as in `at` (nx,)."""
    hull = part if isinstance(part, Box) else part.box
    at = turned(hull, np.asarray(at, dtype=np.float64)[None])[0]
    if any(not low <= v <= high for v, low, high in zip(at[2:], hull.low[2:], hull.high[2:], strict=True)):
        return _NOTHING
    points = _corners(hull)
    if isinstance(part, Polytope):
        for a, b in zip(part.zone.matrix, part.zone.bounds, strict=True):
            points = _clip(points, a[:2], b - a[2:] @ at[2:])
    elif isinstance(part, Ellipsoid):
        points = _ellipse(part, at)
    return points


def projection(part: Part) -> Array:
    """Corners (k, 2) of a part's projection onto the first two states; none where it is empty."""
    if isinstance(part, Box):
        return _corners(part)
    if isinstance(part, Polytope):
        return _projected(part)
    return _ellipse(part, None)


def _corners(box: Box) -> Array:
    (x0, y0), (x1, y1) = box.low[:2], box.high[:2]
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]], dtype=np.float64)


def _clip(points: Array, a: Array, bound: float) -> Array:
    """The corners of a convex polygon's part with a·p ≤ bound."""
    if not len(points):
        return _NOTHING
    over = points @ a - bound
    kept: list[Array] = []
    for p, q, v, w in zip(points, np.roll(points, -1, axis=0), over, np.roll(over, -1), strict=True):
        if v <= 0:
            kept.append(p)
        if (v < 0 < w) or (w < 0 < v):
            kept.append(p + (q - p) * (v / (v - w)))
    return np.array(kept).reshape(-1, 2)


def _ellipse(e: Ellipsoid, at: Array | None) -> Array:
    """The section at `at`, or the projection: with M = [[A, B], [Bᵀ, C]] the first has the form A, the second A − B C⁻¹ Bᵀ."""
    m, centre = np.asarray(e.matrix), np.asarray(e.centre)
    drawn, rest = ([i for i, j in enumerate(e.on) if (j < 2) == first] for first in (True, False))
    a, b, c = m[np.ix_(drawn, drawn)], m[np.ix_(drawn, rest)], m[np.ix_(rest, rest)]
    middle, level = centre[drawn], 1.0
    if at is None:
        a = a - b @ np.linalg.solve(c, b.T)
    else:
        r = at[[e.on[i] for i in rest]] - centre[rest]
        shift = np.linalg.solve(a, b @ r)
        middle, level = middle - shift, float(1 - r @ c @ r + (b @ r) @ shift)
    if level < 0:
        return _NOTHING
    if len(drawn) == 2:
        t = TURN * np.arange(ROUND) / ROUND
        return np.asarray(middle + np.sqrt(level) * np.linalg.solve(np.linalg.cholesky(a).T, [np.cos(t), np.sin(t)]).T)
    points = _corners(e.box)
    for i, j in enumerate(e.on[k] for k in drawn):
        reach = np.sqrt(level / a[i, i])
        points[:, j] = np.clip(points[:, j], middle[i] - reach, middle[i] + reach)
    return points


def _projected(p: Polytope) -> Array:
    """Corner by corner: beyond each side found so far, what lies farthest is the next corner, until nothing does."""
    from scipy.optimize import linprog

    low, width = np.asarray(p.box.low), np.asarray(p.box.high) - np.asarray(p.box.low)
    matrix, bounds = p.zone.matrix * width, p.zone.bounds - p.zone.matrix @ low

    def farthest(direction: Array) -> Array:
        cost = np.append(-direction, np.zeros(len(low) - 2))
        found = linprog(cost, A_ub=matrix, b_ub=bounds, bounds=(0.0, 1.0))
        return np.full(2, np.nan) if found.x is None else np.asarray(found.x[:2], dtype=np.float64)

    def beyond(a: Array, b: Array) -> list[Array]:
        normal = np.array([b[1] - a[1], a[0] - b[0]])
        if np.abs(normal).max() <= _FLAT:
            return []
        c = farthest(normal)
        return [*beyond(a, c), c, *beyond(c, b)] if normal @ (c - a) > _FLAT * np.abs(normal).max() else []

    left, right = farthest(np.array([-1.0, 0.0])), farthest(np.array([1.0, 0.0]))
    if np.isnan(left).any():
        return _NOTHING
    around = np.array([left, *beyond(left, right), right, *beyond(right, left)])
    return np.asarray(around * width[:2] + low[:2])
