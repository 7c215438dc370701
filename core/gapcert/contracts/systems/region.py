"""Regions of states: boxes, polytopes, ellipsoids and unions of them, and which cells lie wholly inside or touch them."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from gapcert.contracts.systems.domain import Box, turned
from gapcert.contracts.systems.system import StateSpec
from gapcert.contracts.thresholds import THRESHOLDS
from gapcert.numerics import circle
from gapcert.numerics.arrays import Array, Bools
from gapcert.numerics.constraint_zone import Relation, Zone
from gapcert.numerics.errors import UsageError
from gapcert.numerics.intervals import Interval

_ROUND = 1e-12  # relative: an eigenvalue below it may be rounding


@final
@dataclass(frozen=True)
class Polytope:
    """What linear inequalities a·x ≤ b leave of a box; `cuts` have one coefficient per state."""

    box: Box
    cuts: tuple[Relation, ...]

    def __post_init__(self) -> None:
        for cut in self.cuts:
            if len(cut.coefficients) != len(self.box.axes) or not np.isfinite((*cut.coefficients, cut.bound)).all():
                raise UsageError(f"polytope: '{cut.text}' needs one finite coefficient per state and a finite bound")

    @property
    def zone(self) -> Zone:
        return Zone(self.box.low, self.box.high, self.cuts)

    def contains(self, x: Array) -> Bools:
        return _within(self.box, turned(self.box, x), self.zone.related)

    def covers(self, low: Array, high: Array) -> Bools:
        """(n,): every point of the cell lies inside, for certain."""

        def inside(low: Array, high: Array) -> Bools:
            return np.asarray((self._rows(low, high).hi <= self.zone.bounds).all(axis=1))

        return _moved(self.box, low, high, inside, whole=True)

    def touches(self, low: Array, high: Array) -> Bools:
        """(n,): some point of the cell may lie inside; every inequality is looked at alone."""

        def meets(low: Array, high: Array) -> Bools:
            return np.asarray((self._rows(low, high).lo <= self.zone.bounds).all(axis=1))

        return _moved(self.box, low, high, meets, whole=False)

    def _rows(self, low: Array, high: Array) -> Interval:
        return Interval.dot(Interval(low, high).reshape(len(low), 1, low.shape[1]), self.zone.matrix)

    def to_data(self) -> dict[str, Any]:
        return {"box": self.box.bounds, "cuts": [[c.text, list(c.coefficients), c.bound] for c in self.cuts]}


@final
@dataclass(frozen=True)
class Ellipsoid:
    """{x in box: (y − c)ᵀ M (y − c) ≤ 1} with y the states number `on`; M is positive definite, and other states are free."""

    box: Box
    on: tuple[int, ...]
    centre: tuple[float, ...]
    matrix: tuple[tuple[float, ...], ...]

    def __post_init__(self) -> None:
        m = np.asarray(self.matrix, dtype=np.float64)
        k = len(self.on)
        if not 1 <= k <= THRESHOLDS.ellipsoid_states or m.shape != (k, k) or len(self.centre) != k or not np.isfinite(m).all():
            raise UsageError(
                f"ellipsoid: 1 to {THRESHOLDS.ellipsoid_states} states are needed, a finite centre and a "
                "square matrix over them"
            )
        least, most = np.linalg.eigvalsh(m)[[0, -1]]
        if not np.array_equal(m, m.T) or not least > _ROUND * most:
            raise UsageError("ellipsoid: the matrix is not symmetric and positive definite; give radii, or another matrix")

    @classmethod
    def of(cls, frame: Box, centre: Mapping[str, float], radii: Mapping[str, float]) -> Ellipsoid:
        """Along the axes: Σ ((x − c) / r)² ≤ 1 over the states of `centre`; the others are as in `frame`."""
        names = frame.names
        if not centre or set(centre) != set(radii) or not set(centre) <= set(names):
            raise UsageError(f"ellipsoid: centre and radii must name the same states, of {', '.join(names)}")
        if bad := [n for n, r in radii.items() if not 0 < r < np.inf]:
            raise UsageError(f"ellipsoid: the radius of {bad[0]} is {radii[bad[0]]:g}; give a positive number")
        on = tuple(j for j, name in enumerate(names) if name in centre)
        ends = np.array([frame.low, frame.high])
        for j in on:
            c, r = centre[names[j]], radii[names[j]]
            ends[:, j] = np.nextafter(c - r, -np.inf), np.nextafter(c + r, np.inf)
        matrix = np.diag([radii[names[j]] ** -2.0 for j in on])
        box = Box(frame.axes, tuple(ends[0].tolist()), tuple(ends[1].tolist()))
        return cls(box, on, tuple(float(centre[names[j]]) for j in on), tuple(map(tuple, matrix.tolist())))

    def contains(self, x: Array) -> Bools:
        def inside(x: Array) -> Bools:
            d = [x[:, j] - c for j, c in zip(self.on, self.centre, strict=True)]
            return np.asarray(self._form(d, np.zeros(len(x))) <= 1)

        return _within(self.box, turned(self.box, x), inside)

    def covers(self, low: Array, high: Array) -> Bools:
        """(n,): every point of the cell lies inside, for certain: a convex function is largest at a corner."""

        def inside(low: Array, high: Array) -> Bools:
            found = np.ones(len(low), dtype=bool)
            for corner in itertools.product((low, high), repeat=len(self.on)):
                d = [Interval.exact(end[:, j]) - c for end, j, c in zip(corner, self.on, self.centre, strict=True)]
                found &= self._form(d, Interval.exact(np.zeros(len(low)))).hi <= 1
            return found

        return _moved(self.box, low, high, inside, whole=True)

    def touches(self, low: Array, high: Array) -> Bools:
        """(n,): some point of the cell may lie inside.

        At any y a convex function q is at least q(y) + q'(y)·(x − y) elsewhere; y is close to where q is least in the cell.
        """
        m, k = np.asarray(self.matrix), len(self.on)

        def meets(low: Array, high: Array) -> Bools:
            a, b = low[:, self.on], high[:, self.on]
            y = np.clip(self.centre, a, b)
            for i in [*range(k)] * (THRESHOLDS.region_sweeps if k > 1 else 0):
                rest = (y - self.centre) @ m[i] - m[i, i] * (y[:, i] - self.centre[i])
                y[:, i] = np.clip(self.centre[i] - rest / m[i, i], a[:, i], b[:, i])
            zero = Interval.exact(np.zeros(len(y)))
            d = [Interval.exact(y[:, i]) - c for i, c in enumerate(self.centre)]
            least = self._form(d, zero)
            for i in range(k):
                slope = sum((d[j] * m[i, j] for j in range(k)), zero) * 2.0
                least = least + slope * (Interval(a[:, i], b[:, i]) - y[:, i])
            return np.asarray(least.lo <= 1)

        return _moved(self.box, low, high, meets, whole=False)

    def _form(self, d: Sequence[Any], zero: Any) -> Any:
        """dᵀ M d, for arrays or Intervals, summed in one order; squares as such, since an Interval's d · d forgets the sign."""
        total = zero
        for i, j in itertools.combinations_with_replacement(range(len(d)), 2):
            if self.matrix[i][j]:
                total = total + (d[i] ** 2 * self.matrix[i][i] if i == j else d[i] * d[j] * (2 * self.matrix[i][j]))
        return total

    def to_data(self) -> dict[str, Any]:
        rows = [list(row) for row in self.matrix]
        return {"box": self.box.bounds, "on": list(self.on), "centre": list(self.centre), "matrix": rows}


@final
@dataclass(frozen=True)
class Region:
    """A union of boxes, polytopes and ellipsoids in the state space."""

    boxes: tuple[Box, ...] = ()
    polytopes: tuple[Polytope, ...] = ()
    ellipsoids: tuple[Ellipsoid, ...] = ()

    @property
    def shapes(self) -> tuple[Polytope | Ellipsoid, ...]:
        """All parts that are no boxes."""
        return (*self.polytopes, *self.ellipsoids)

    @property
    def hulls(self) -> tuple[Box, ...]:
        """One box around each part."""
        return (*self.boxes, *(s.box for s in self.shapes))

    def contains(self, x: Array) -> Bools:
        """(n,) booleans; angles count modulo a turn, NaN is outside."""
        inside = np.zeros(len(x), dtype=bool)
        for box in self.boxes:
            inside |= box.contains(turned(box, x))
        for shape in self.shapes:
            inside |= shape.contains(x)
        return inside

    def to_data(self) -> Any:
        """JSON-able; a list of boxes where there is nothing else."""
        boxes = [b.bounds for b in self.boxes]
        if not self.shapes:
            return boxes
        polytopes, ellipsoids = ([p.to_data() for p in parts] for parts in (self.polytopes, self.ellipsoids))
        return {"boxes": boxes, "polytopes": polytopes, "ellipsoids": ellipsoids}

    @classmethod
    def from_data(cls, axes: tuple[StateSpec, ...], data: Any) -> Region:
        """Inverse of `to_data`, bit for bit."""
        if isinstance(data, list):
            return cls(tuple(Box.of(axes, b) for b in data))
        polytopes = (
            Polytope(Box.of(axes, p["box"]), tuple(Relation(text, tuple(a), b) for text, a, b in p["cuts"]))
            for p in data["polytopes"]
        )
        ellipsoids = (
            Ellipsoid(Box.of(axes, e["box"]), tuple(e["on"]), tuple(e["centre"]), tuple(map(tuple, e["matrix"])))
            for e in data["ellipsoids"]
        )
        return cls(tuple(Box.of(axes, b) for b in data["boxes"]), tuple(polytopes), tuple(ellipsoids))


def _within(box: Box, x: Array, asked: Callable[[Array], Bools]) -> Bools:
    """In the box, and `asked` holds; it is asked only there, where no product is without a value."""
    found = np.asarray(box.contains(x))
    found[found] = asked(x[found])
    return found


def _moved(box: Box, low: Array, high: Array, asked: Callable[[Array, Array], Bools], whole: bool) -> Bools:
    """Does `asked` hold of a cell that lies in the box (`whole`), or of what it has in common with it, in any of its turns?"""
    found = np.zeros(len(low), dtype=bool)
    for a, b in _turns(box, low, high):
        if whole:
            rows = np.flatnonzero(~found & ((a >= box.low) & (b <= box.high)).all(axis=1))
            found[rows] = asked(a[rows], b[rows])
        else:
            rows = np.flatnonzero(~found & ((a <= box.high) & (b >= box.low)).all(axis=1))
            found[rows] = asked(np.maximum(a[rows], box.low), np.minimum(b[rows], box.high))
    return found


def _turns(box: Box, low: Array, high: Array) -> Iterator[tuple[Array, Array]]:
    """The cells moved by every number of turns of every angle that may bring them to the box, widened by what that rounds."""
    a, b, some = low.min(axis=0, initial=np.inf), high.max(axis=0, initial=-np.inf), len(low) > 0
    ends = zip(box.axes, a, b, box.low, box.high, strict=True)
    ranges = [circle.copies(*each) if axis.kind == "angle" and some else range(1) for axis, *each in ends]
    for turns in itertools.product(*ranges):
        t = np.asarray(turns, dtype=np.float64)
        pad = 4 * np.spacing(np.maximum(np.maximum(np.abs(low), np.abs(high)), circle.TURN)) * np.abs(t)
        yield low + t * circle.TURN - pad, high + t * circle.TURN + pad
