"""A box cut by linear relations: which points belong to it, and how points are drawn in it, moved into it or counted out."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import final

import numpy as np

from gapcert.numerics.arrays import Array, Bools, Ints
from gapcert.numerics.errors import UsageError
from gapcert.numerics.intervals import Interval
from gapcert.thresholds import THRESHOLDS

_DEPTH = 1e-12  # moved points end this far inside (relative), so that rounding cannot push them out
_TINY = float(np.finfo(np.float64).tiny)
_BLOCK = 1 << 18


@final
@dataclass(frozen=True)
class Relation:
    """a·z ≤ b over z = (x, u). `text` is what was written; `coefficients` a has one number per axis of the domain."""

    text: str
    coefficients: tuple[float, ...]
    bound: float


@final
@dataclass(frozen=True)
class Zone:
    """Z = {low ≤ z ≤ high, a·z ≤ b for every relation}: convex, as an intersection of half-spaces. Points are (n, nz)."""

    low: tuple[float, ...]
    high: tuple[float, ...]
    relations: tuple[Relation, ...] = ()

    def dots(self, z: Array) -> Array:
        """a·z (n, relations), summed axis by axis so that a point's bits do not depend on its batch."""
        out = np.zeros((len(z), len(self.relations)))
        for j in self.axes:
            out += z[:, j : j + 1] * self.matrix[:, j]
        return out

    @functools.cached_property
    def ends(self) -> tuple[Array, Array]:
        """(low, high), each (nz,)."""
        return np.array(self.low), np.array(self.high)

    @functools.cached_property
    def matrix(self) -> Array:
        """a, (relations, nz)."""
        return np.array([r.coefficients for r in self.relations], dtype=np.float64).reshape(-1, len(self.low))

    @functools.cached_property
    def bounds(self) -> Array:
        return np.array([r.bound for r in self.relations], dtype=np.float64)

    @functools.cached_property
    def depth(self) -> Array:
        """Bounds for points that are moved: a little smaller than `bounds`."""
        largest = np.maximum(np.abs(self.low), np.abs(self.high))
        size = [abs(r.bound) + float(np.abs(r.coefficients) @ largest) for r in self.relations]
        return np.asarray(self.bounds - _DEPTH * np.array(size, dtype=np.float64))

    def related(self, z: Array) -> Bools:
        """(n,): every relation holds, as computed."""
        return np.asarray((self.dots(z) <= self.bounds).all(axis=1))

    def broken(self, z: Array) -> str:
        """The text of a relation that the point z (nz,) breaks, or ""."""
        over = self.dots(z[None])[0] > self.bounds
        return next((r.text for r, bad in zip(self.relations, over, strict=True) if bad), "")

    def contains(self, z: Array) -> Bools:
        """(n,): in the box, and every relation holds."""
        boxed = ((z >= self.ends[0]) & (z <= self.ends[1])).all(axis=1)
        return np.asarray(boxed & self.related(z) if self.relations else boxed)

    def outside(self, boxes: Interval) -> Bools:
        """(n,): the box does not meet Z for certain, since the least a·z over it lies above some b. (n, nz)."""
        found = np.zeros(len(boxes), dtype=bool)
        for relation in self.relations:
            total = Interval.exact(np.zeros(len(boxes)))
            for j, a in enumerate(relation.coefficients):
                if a:
                    total = total + boxes[:, j] * a
            found |= total.lo > relation.bound
        return found

    def draw(self, n: int, rng: np.random.Generator) -> Array:
        """n independent points, uniform on Z: drawn in the box block by block, those that break a relation left out."""
        low, width = np.asarray(self.low), np.asarray(self.high) - np.asarray(self.low)
        if not self.relations:
            return np.asarray(low + width * rng.random((n, len(low))))
        found: list[Array] = []
        block, drawn, kept = max(n, 1024), 0, 0
        while kept < n:
            z = low + width * rng.random((block, len(low)))
            found.append(z[self.related(z)])
            drawn, kept = drawn + block, kept + len(found[-1])
            if drawn >= 20 / THRESHOLDS.zone_share and kept < THRESHOLDS.zone_share * drawn:
                texts = "; ".join(dict.fromkeys(r.text for r in self.relations))
                raise UsageError(
                    f"domain.relations: {texts}: {kept} of {drawn} points of the box satisfy them; give ranges of which the "
                    f"relations leave more than a thousandth"
                )
        return np.concatenate(found)[:n]

    @functools.cached_property
    def centre(self) -> Array:
        """The middle of the box where that is well inside Z, else the mean of some points of Z, which is too: Z is convex."""
        middle = (np.asarray(self.low) + np.asarray(self.high)) / 2
        if (self.dots(middle[None]) <= self.depth).all():
            return np.asarray(middle)
        return np.asarray(self.draw(1000, np.random.default_rng(0)).mean(axis=0))

    def reach(self, start: Array, target: Array) -> Array:
        """The last point in Z on the way from `start`, in Z, straight to `target` (n, nz), in the box."""
        a, b = self.dots(np.broadcast_to(start, target.shape)), self.dots(target)
        with np.errstate(divide="ignore", invalid="ignore"):
            t = np.where(b > self.depth, (self.depth - a) / (b - a), 1.0)
        share = np.clip(np.nan_to_num(t).min(axis=1, initial=1.0), 0.0, 1.0)[:, None]
        return np.asarray(np.where(share < 1, np.clip(start + share * (target - start), self.low, self.high), target))

    def inside(self, z: Array, boxes: Interval) -> Array:
        """Points z of boxes, moved into Z: within their box where a few steps find such a point, else towards the centre.

        A step goes towards the corner of the box where a·z of the most broken relation is least, as far as that asks.
        """
        z = z.copy()
        for _ in range(THRESHOLDS.zone_steps * len(self.relations)):
            over = self.dots(z) - self.bounds
            rows = np.flatnonzero((over > 0).any(axis=1))
            if not len(rows):
                return z
            p, worst = z[rows], over[rows].argmax(axis=1)
            a, k = self.matrix[worst], np.arange(len(rows))
            corner = np.where(a > 0, boxes.lo[rows], np.where(a < 0, boxes.hi[rows], p))
            dots = self.dots(p)[k, worst]
            share = np.clip((dots - self.depth[worst]) / np.maximum(dots - self.dots(corner)[k, worst], _TINY), 0.0, 1.0)
            z[rows] = np.clip(p + share[:, None] * (corner - p), boxes.lo[rows], boxes.hi[rows])
        lost = ~self.related(z)
        z[lost] = self.reach(self.centre, z[lost])
        return z

    def chord(self, z: Array, j: int) -> tuple[Array, Array]:
        """(low, high), each (n,): where coordinate j of a point of Z may move while the others stay."""
        low, high = np.full(len(z), self.low[j]), np.full(len(z), self.high[j])
        dots = self.dots(z)
        for k, relation in enumerate(self.relations):
            if a := relation.coefficients[j]:
                end = (self.depth[k] - (dots[:, k] - a * z[:, j])) / a
                low, high = (low, np.minimum(high, end)) if a > 0 else (np.maximum(low, end), high)
        return low, high

    def on(self, axes: tuple[int, ...]) -> Zone:
        """The factor of Z on some axes, which are all that its relations involve."""
        relations = tuple(Relation(r.text, tuple(r.coefficients[j] for j in axes), r.bound) for r in self.relations)
        return Zone(tuple(self.low[j] for j in axes), tuple(self.high[j] for j in axes), relations)

    @functools.cached_property
    def axes(self) -> tuple[int, ...]:
        """The axes that the relations involve."""
        return tuple(j for j in range(len(self.low)) if any(r.coefficients[j] for r in self.relations))


def centres(low: float, high: float, n: int) -> Array:
    """Of n equal cells: low + (2k + 1)·width / (2n)."""
    return np.asarray(low + (high - low) * (2 * np.arange(n) + 1) / (2 * n))


def edges(low: float, high: float, n: int) -> Array:
    """The n + 1 ends of equal cells, the first and last exact."""
    out = low + (high - low) * np.arange(n + 1) / n
    out[-1] = high
    return np.asarray(out)


@final
@dataclass(frozen=True, eq=False)
class Lattice:
    """One point of Z for each grid cell that may meet Z, on the axes that relations involve.

    points (K, axes) in the C order of the cells; half (axes,): no point of a kept cell is farther from the cell's point than
    that, axis by axis. Cells that are left out do not meet Z, so every z in Z has a point within `half`, wherever it was moved
    to: max |z_j − p_j| over a cell is taken at its ends. Both ends of that step lie in Z, and so does the segment between.
    """

    points: Array
    half: Array


@functools.lru_cache(maxsize=16)
def lattice(zone: Zone, counts: tuple[int, ...]) -> Lattice:
    """The lattice of `counts` cells per axis over zone.on(zone.axes)."""
    factor, number = zone.on(zone.axes), tuple(counts[j] for j in zone.axes)
    middle = [centres(lo, hi, n) for lo, hi, n in zip(factor.low, factor.high, number, strict=True)]
    ends = [edges(lo, hi, n) for lo, hi, n in zip(factor.low, factor.high, number, strict=True)]
    points, half = [np.empty((0, len(number)))], np.zeros(len(number))
    for index in _blocks(number):
        low, high = (np.stack([e[k + up] for e, k in zip(ends, index, strict=True)], axis=1) for up in (0, 1))
        kept = ~factor.outside(Interval(low, high))
        z = np.stack([c[k] for c, k in zip(middle, index, strict=True)], axis=1)[kept]
        cells = Interval(low[kept], high[kept])
        points.append(factor.inside(z, cells))
        far = np.nextafter(np.maximum(points[-1] - cells.lo, cells.hi - points[-1]), np.inf)
        half = np.maximum(half, far.max(axis=0, initial=0.0))
    return Lattice(np.concatenate(points), half)


def _blocks(counts: tuple[int, ...]) -> Iterator[tuple[Ints, ...]]:
    size = int(np.prod(counts, dtype=np.int64))
    for start in range(0, size, _BLOCK):
        yield np.unravel_index(np.arange(start, min(start + _BLOCK, size)), counts)


def grid_size(zone: Zone, counts: tuple[int, ...]) -> int:
    """How many points `grid_points` has."""
    if not zone.relations:
        return int(np.prod(counts, dtype=np.int64))
    return len(lattice(zone, counts).points) * int(np.prod([counts[j] for j in _free(zone)], dtype=np.int64))


def grid_points(zone: Zone, counts: tuple[int, ...], start: int, stop: int) -> Array:
    """Points start … stop − 1 of the grid: cell centres in C order; with relations, the lattice's points times the centres of
    the other axes, which vary fastest.
    """
    stop, free = min(stop, grid_size(zone, counts)), _free(zone)
    if not free:
        return grid_at(zone, counts, np.arange(start, stop))
    # By whole lines of the fastest axis, of which all other coordinates are looked up once.
    axis, n = free[-1], counts[free[-1]]
    lines = np.arange(start // n, max(-(-stop // n), start // n))
    out, starts = np.empty((len(lines), n, len(counts))), grid_at(zone, counts, lines * n)
    for j in range(len(counts)):
        out[:, :, j] = centres(zone.low[axis], zone.high[axis], n) if j == axis else starts[:, j : j + 1]
    first = start - start // n * n
    return out.reshape(-1, len(counts))[first : first + max(stop - start, 0)]


def grid_at(zone: Zone, counts: tuple[int, ...], index: Ints) -> Array:
    """The points of the grid with given numbers (n,): what `grid_points` has there, bit for bit."""
    free, out = _free(zone), np.empty((len(index), len(counts)))
    if zone.relations:
        index, rest = np.divmod(index, int(np.prod([counts[j] for j in free], dtype=np.int64)))
        out[:, list(zone.axes)] = lattice(zone, counts).points[index]
        index = rest
    for j, k in zip(free, np.unravel_index(index, [counts[j] for j in free]) if free else (), strict=True):
        out[:, j] = centres(zone.low[j], zone.high[j], counts[j])[k]
    return out


def _free(zone: Zone) -> tuple[int, ...]:
    return tuple(j for j in range(len(zone.low)) if j not in zone.axes)
