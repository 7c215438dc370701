"""Where a model is compared: boxes with units, exact covers, and point sets that need not be stored."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import final

import numpy as np

from gapcert.errors import UsageError
from gapcert.intervals import Interval
from gapcert.system import Array, StateSpec, System


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

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(a.name for a in self.axes)

    @property
    def interval(self) -> Interval:
        """The box as one Interval of shape (1, axes)."""
        return Interval(np.asarray(self.low)[None], np.asarray(self.high)[None])

    def contains(self, points: Array) -> np.ndarray:
        """(n,) booleans: low ≤ point ≤ high on every axis."""
        return np.asarray(((points >= self.low) & (points <= self.high)).all(axis=-1))

    def within(self, other: Box) -> bool:
        return all(a >= b for a, b in zip(self.low, other.low, strict=True)) and all(
            a <= b for a, b in zip(self.high, other.high, strict=True)
        )


@final
@dataclass(frozen=True)
class Domain:
    """Z = X × U: where the claim is made. Points z = (x, u) have shape (n, nx + nu)."""

    states: Box
    inputs: Box

    @classmethod
    def of(cls, system: System, ranges: Mapping[str, tuple[float, float]]) -> Domain:
        """From named ranges; every state and input of `system` must have one, and nothing else may."""
        known = [a.name for a in (*system.states, *system.inputs)]
        if unknown := [n for n in ranges if n not in known]:
            raise UsageError(f"domain: '{unknown[0]}' is no state or input; there are {', '.join(known)}")
        if missing := [n for n in known if n not in ranges]:
            raise UsageError(f"domain: no range for '{missing[0]}'; add {missing[0]}: [low, high]")

        def box(axes: tuple[StateSpec, ...]) -> Box:
            return Box(axes, tuple(float(ranges[a.name][0]) for a in axes), tuple(float(ranges[a.name][1]) for a in axes))

        return cls(box(system.states), box(system.inputs))

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
        return float(np.prod(self.width))

    @property
    def interval(self) -> Interval:
        return Interval(self.low[None], self.high[None])

    @property
    def nx(self) -> int:
        return len(self.states.axes)

    def split(self, z: Array) -> tuple[Array, Array]:
        """(x, u) of points z."""
        return z[..., : self.nx], z[..., self.nx :]

    def contains(self, z: Array) -> np.ndarray:
        return np.asarray(((z >= self.low) & (z <= self.high)).all(axis=-1))

    def draw(self, n: int, rng: np.random.Generator) -> Array:
        """n independent points, uniform on Z."""
        return np.asarray(self.low + self.width * rng.random((n, len(self.low))))

    def digest_data(self) -> list[object]:
        return [[a.name, a.unit, a.kind] for a in self.axes] + [self.low.tolist(), self.high.tolist()]


@final
@dataclass(frozen=True)
class Points:
    """An explicit list of points z (n, nz)."""

    z: Array

    def __len__(self) -> int:
        return len(self.z)

    def chunk(self, start: int, stop: int) -> Array:
        return self.z[start:stop]

    def digest(self) -> str:
        return hashlib.sha256(np.ascontiguousarray(self.z).tobytes() + str(self.z.shape).encode()).hexdigest()


@final
@dataclass(frozen=True)
class Cover:
    """Cell centres of a uniform grid over Z, computed on demand, and the exact radius that they cover.

    counts: cells per axis. Point i has axis coordinates low + (2k + 1)·width / (2·count).
    """

    domain: Domain
    counts: tuple[int, ...]

    def __len__(self) -> int:
        return int(np.prod(self.counts, dtype=np.int64))

    def axis(self, j: int) -> Array:
        n = self.counts[j]
        return np.asarray(self.domain.low[j] + self.domain.width[j] * (2 * np.arange(n) + 1) / (2 * n))

    def chunk(self, start: int, stop: int) -> Array:
        index = np.unravel_index(np.arange(start, min(stop, len(self))), self.counts)
        return np.stack([self.axis(j)[k] for j, k in enumerate(index)], axis=-1)

    def digest(self) -> str:
        data = repr((self.domain.digest_data(), self.counts))
        return hashlib.sha256(data.encode()).hexdigest()

    def half_widths(self) -> Array:
        """h (nz,): every z in Z has a grid point with |z_j − p_j| ≤ h_j. From the floating-point grid itself, rounded up."""
        h = []
        for j in range(len(self.counts)):
            p = self.axis(j)
            gaps = [p[0] - self.domain.low[j], self.domain.high[j] - p[-1]]
            if len(p) > 1:
                gaps.append(float(np.nextafter(np.diff(p).max(), np.inf)) / 2)
            h.append(np.nextafter(max(gaps), np.inf))
        return np.asarray(h)

    def radii(self) -> tuple[float, float]:
        """(εx, εu): Euclidean cover radii of the state and the input block, rounded up."""
        h = Interval.exact(self.half_widths())
        square = (h * h).hi
        nx = self.domain.nx

        def root(block: Array) -> float:
            total = 0.0
            for s in block:
                total = float(np.nextafter(total + s, np.inf))
            return float(np.nextafter(np.sqrt(total), np.inf))

        return root(square[:nx]), root(square[nx:])
