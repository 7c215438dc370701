"""Where a model is compared: boxes with units, relations that cut them, exact covers, and points that need not be stored."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, final

import numpy as np

from gapcert.contracts.data.inequality import MalformedError, parse
from gapcert.contracts.systems.system import StateSpec, System
from gapcert.numerics import circle
from gapcert.numerics.arrays import Array, Bools, Ints
from gapcert.numerics.constraint_zone import Relation as Relation
from gapcert.numerics.constraint_zone import Zone, centres, grid_at, grid_points, grid_size, lattice
from gapcert.numerics.errors import UsageError
from gapcert.numerics.intervals import Interval, norm

Outside = Literal["raise", "nan"]
"""What an answer is where nothing is known: a UsageError that names the axis and its value, or NaN in that row alone."""


@final
@dataclass(frozen=True)
class Box:
    """A product of closed intervals with named, unit-carrying axes. low, high: one number per axis, low < high."""

    axes: tuple[StateSpec, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]

    def __post_init__(self) -> None:
        for axis, low, high in zip(self.axes, self.low, self.high, strict=True):
            if not (np.isfinite(low) and np.isfinite(high)):
                raise UsageError(f"box: {axis.name} = [{low}, {high}] is not finite; give two numbers")
            if not low < high:
                raise UsageError(
                    f"box: {axis.name} = [{low}, {high}] is {'empty' if low == high else 'inverted'}; expected low < high"
                )

    @classmethod
    def of(cls, axes: tuple[StateSpec, ...], bounds: Mapping[str, Any]) -> Box:
        """From [low, high] of each axis, by name; `bounds` is its inverse."""
        return cls(axes, *(tuple(float(bounds[a.name][k]) for a in axes) for k in (0, 1)))

    @classmethod
    def among(cls, axes: tuple[StateSpec, ...], bounds: Mapping[str, Any]) -> Box | None:
        """The box over those axes that have bounds, by name; None where none has."""
        own = tuple(a for a in axes if a.name in bounds)
        return cls.of(own, bounds) if own else None

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(a.name for a in self.axes)

    @property
    def bounds(self) -> dict[str, list[float]]:
        return {a.name: [low, high] for a, low, high in zip(self.axes, self.low, self.high, strict=True)}

    @property
    def interval(self) -> Interval:
        """The box as one Interval of shape (1, axes)."""
        return Interval(np.asarray(self.low)[None], np.asarray(self.high)[None])

    @property
    def wraps(self) -> tuple[bool, ...]:
        """Axes that close on themselves: angles over a full turn."""
        ends = zip(self.axes, self.low, self.high, strict=True)
        return tuple(axis.kind == "angle" and circle.spans(low, high) for axis, low, high in ends)

    def contains(self, points: Array) -> Bools:
        """(n,) booleans: low ≤ point ≤ high on every axis."""
        return np.asarray(((points >= self.low) & (points <= self.high)).all(axis=-1))

    def leaves(self, point: Array) -> str:
        """Along which axis a point (axes,) lies outside, in words; "" inside."""
        for axis, value, low, high in zip(self.axes, point.tolist(), self.low, self.high, strict=True):
            if not low <= value <= high:
                return f"{axis.name} = {value!r} is outside [{low:g}, {high:g}] {axis.unit}".removesuffix(" 1")
        return ""

    def within(self, other: Box) -> bool:
        return all(a >= b for a, b in zip(self.low, other.low, strict=True)) and all(
            a <= b for a, b in zip(self.high, other.high, strict=True)
        )


def turned(box: Box, x: Array) -> Array:
    """x (…, axes) with every angle on the turn of the box, see `circle.onto`."""
    for j, axis in enumerate(box.axes):
        column = x[..., j]
        if axis.kind == "angle" and (moved := circle.onto(box.low[j], box.high[j], column)) is not column:
            x = x.copy()
            x[..., j] = moved
    return x


@final
@dataclass(frozen=True)
class Domain:
    """Z = X × U, cut by the relations: where the claim is made. Points z = (x, u) have shape (n, nx + nu).

    Z is convex. UsageError where the relations leave less than a thousandth of the box.
    """

    states: Box
    inputs: Box
    relations: tuple[Relation, ...] = ()

    def __post_init__(self) -> None:
        for relation in self.relations:
            given = (*relation.coefficients, relation.bound)
            if len(given) != len(self.axes) + 1 or not np.isfinite(given).all() or not any(relation.coefficients):
                raise UsageError(
                    f"domain.relations: '{relation.text}' has coefficients {relation.coefficients} and bound {relation.bound}; "
                    f"give one finite number per state and input ({len(self.axes)}), not all 0"
                )
        if self.relations:
            self.draw(1, np.random.default_rng(0))

    @classmethod
    def of(cls, system: System, ranges: Mapping[str, tuple[float, float]], relations: Iterable[str | Relation] = ()) -> Domain:
        """From named ranges; every state and input of `system` must have one, and nothing else may. `relations` are texts such
        as `abs(ux - vx) <= 0.5 m/s`, or data.
        """
        known = [a.name for a in (*system.states, *system.inputs)]
        if unknown := [n for n in ranges if n not in known]:
            raise UsageError(f"domain: '{unknown[0]}' is no state or input; there are {', '.join(known)}")
        if missing := [n for n in known if n not in ranges]:
            raise UsageError(f"domain: no range for '{missing[0]}'; add {missing[0]}: [low, high]")
        units = {a.name: a.unit for a in (*system.states, *system.inputs)}
        return cls(Box.of(system.states, ranges), Box.of(system.inputs, ranges), tuple(_relations(relations, units)))

    @functools.cached_property
    def zone(self) -> Zone:
        """Z as numbers alone."""
        return Zone(self.states.low + self.inputs.low, self.states.high + self.inputs.high, self.relations)

    @property
    def axes(self) -> tuple[StateSpec, ...]:
        return self.states.axes + self.inputs.axes

    @property
    def low(self) -> Array:
        return np.asarray(self.states.low + self.inputs.low)

    @property
    def high(self) -> Array:
        return np.asarray(self.states.high + self.inputs.high)

    @property
    def width(self) -> Array:
        return self.high - self.low

    @property
    def volume(self) -> float:
        """Of the box; with relations, times the share that they leave (from 65,536 fixed points)."""
        box = float(np.prod(self.width))
        if not self.relations:
            return box
        z = self.low + self.width * np.random.default_rng(0).random((1 << 16, len(self.low)))
        return box * float(self.zone.related(z).mean())

    @property
    def words(self) -> str:
        """What points are drawn from, as claims state it."""
        return "X × U within its relations" if self.relations else "X × U"

    @property
    def interval(self) -> Interval:
        """The box as one Interval of shape (1, axes); with relations, Z is a part of it."""
        return Interval(self.low[None], self.high[None])

    @property
    def centre(self) -> Array:
        """A point well inside Z (nz,): the middle of the box, unless relations cut that off."""
        return self.zone.centre

    @property
    def nx(self) -> int:
        return len(self.states.axes)

    def split(self, z: Array) -> tuple[Array, Array]:
        """(x, u) of points z, contiguous."""
        return np.ascontiguousarray(z[..., : self.nx]), np.ascontiguousarray(z[..., self.nx :])

    def contains(self, z: Array) -> Bools:
        """(n,) booleans: in the box, and every relation holds; on the circle along axes that close on themselves."""
        return self.zone.contains(self.turned(z))

    def turned(self, z: Array) -> Array:
        """z with the angles that close on themselves on the turn of Z; other angles are numbers here."""
        wraps = np.array([*self.states.wraps, *(False for _ in self.inputs.axes)])
        if not wraps.any():
            return z
        x, u = self.split(z)
        return np.where(wraps, np.concatenate([turned(self.states, x), u], axis=-1), z)

    def asked(self, z: Array, outside: Outside) -> Bools:
        """`contains`, of points at which an answer is wanted; UsageError at the first one outside, unless that is to be NaN."""
        inside = self.contains(z)
        if outside == "raise" and not inside.all():
            row = int(np.argmin(inside))
            x, u = self.split(z[row])
            what = self.states.leaves(x) or self.inputs.leaves(u) or f"'{self.zone.broken(z[row])}' does not hold"
            raise UsageError(
                f"certificate: row {row}: {what}, and outside of its domain nothing is known of f̂ − f; ask inside, or take "
                f"outside='nan'"
            )
        return inside

    def draw(self, n: int, rng: np.random.Generator) -> Array:
        """n independent points, uniform on Z; a pure function of the generator's state."""
        return self.zone.draw(n, rng)

    def outside(self, boxes: Interval) -> Bools:
        """(n,) booleans: the box (n, nz) does not meet Z, for certain."""
        return self.zone.outside(boxes)

    def inside(self, z: Array, boxes: Interval) -> Array:
        """Points z of boxes that may meet Z, those outside Z moved into it: within their box where such a point is found."""
        return self.zone.inside(z, boxes)

    def reach(self, start: Array, target: Array) -> Array:
        """The last point in Z on the straight way from `start`, in Z, to `target`, in the box; (n, nz)."""
        return self.zone.reach(start, target)

    def chord(self, z: Array, j: int) -> tuple[Array, Array]:
        """(low, high), each (n,): where coordinate j of points of Z may move while the others stay."""
        return self.zone.chord(z, j)

    def digest_data(self) -> list[object]:
        box: list[object] = [[a.name, a.unit, a.kind] for a in self.axes] + [self.low.tolist(), self.high.tolist()]
        return [*box, [[*r.coefficients, r.bound] for r in self.relations]] if self.relations else box


def _relations(given: Iterable[str | Relation], units: Mapping[str, str]) -> Iterable[Relation]:
    for item in given:
        if isinstance(item, Relation):
            yield item
            continue
        try:
            yield from parse(item, units)
        except MalformedError as error:
            what = f"domain.relations: '{item}', character {error.offset + 1}: {error}"
            raise UsageError(f"{what}; {error.hint or 'write a linear relation'}") from None


@final
@dataclass(frozen=True)
class Points:
    """An explicit list of points z (n, nz)."""

    z: Array

    def __len__(self) -> int:
        return len(self.z)

    def chunk(self, start: int, stop: int) -> Array:
        return self.z[start:stop]

    def at(self, index: Ints) -> Array:
        """The points of given numbers, (n, nz)."""
        return np.asarray(self.z[index])

    def digest(self) -> str:
        return hashlib.sha256(np.ascontiguousarray(self.z).tobytes() + str(self.z.shape).encode()).hexdigest()


@final
@dataclass(frozen=True)
class Cover:
    """One point per cell of a uniform grid over Z, computed on demand, and the exact radius that they cover.

    counts: cells per axis. The points are cell centres, low + (2k + 1)·width / (2·count) on each axis. With relations, cells
    that do not meet Z are left out, and centres outside Z are moved into it (see `relation.Lattice`).
    """

    domain: Domain
    counts: tuple[int, ...]

    def __len__(self) -> int:
        return grid_size(self.domain.zone, self.counts)

    def axis(self, j: int) -> Array:
        return centres(self.domain.low[j], self.domain.high[j], self.counts[j])

    def chunk(self, start: int, stop: int) -> Array:
        return grid_points(self.domain.zone, self.counts, start, stop)

    def at(self, index: Ints) -> Array:
        """The points of given numbers (n,), as `chunk` has them: (n, nz)."""
        return grid_at(self.domain.zone, self.counts, index)

    def digest(self) -> str:
        data = repr((self.domain.digest_data(), self.counts))
        return hashlib.sha256(data.encode()).hexdigest()

    def half_widths(self) -> Array:
        """h (nz,): every z in Z has a grid point with |z_j − p_j| ≤ h_j. From the floating-point grid itself, rounded up."""
        zone, h = self.domain.zone, np.empty(len(self.counts))
        for j in range(len(h)):
            p = self.axis(j)
            gaps = [p[0] - self.domain.low[j], self.domain.high[j] - p[-1]]
            if len(p) > 1:
                gaps.append(float(np.nextafter(np.diff(p).max(), np.inf)) / 2)
            h[j] = np.nextafter(max(gaps), np.inf)
        if zone.relations:
            # No relation involves the other axes: Z is a product, and both factors are covered each on its own.
            h[list(zone.axes)] = lattice(zone, self.counts).half
        return h

    def radii(self, axes: Bools | None = None) -> tuple[float, float]:
        """(εx, εu): Euclidean cover radii of the state and the input block, rounded up; over some axes (nz booleans) alone,
        where a function does not change along the others.
        """
        h = self.half_widths() if axes is None else np.where(axes, self.half_widths(), 0.0)
        return float(norm(h[: self.domain.nx])), float(norm(h[self.domain.nx :]))
