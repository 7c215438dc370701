"""Answers of the remainder that were asked for once, and close pairs of points along the axes with their slopes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import final

import numpy as np
import numpy.typing as npt

from gapcert import Array
from gapcert.plugin import Bools, LipschitzProblem, Trails, follow

Index = npt.NDArray[np.intp]


@final
class Answers:
    """g at every point that was asked about: z (n, nz), g (n, nx). Each is asked once, each round under a name of its own."""

    def __init__(self, problem: LipschitzProblem) -> None:
        self.problem = problem
        self.z, self.g = np.empty((0, len(problem.domain.low))), np.empty((0, problem.domain.nx))
        self._row: dict[bytes, int] = {}
        self._rounds = 0

    def __len__(self) -> int:
        return len(self.z)

    def __call__(self, z: Array) -> Array:
        """g at points z (n, nz)."""
        keys = [row.tobytes() for row in np.ascontiguousarray(z) + 0.0]
        fresh: dict[bytes, int] = {}
        for k, key in enumerate(keys):
            if key not in self._row:
                fresh.setdefault(key, k)
        if fresh:
            new = z[list(fresh.values())]
            g = self.problem.remainder(f"lipschitz-{self._rounds:03d}", new)
            self._rounds += 1
            self._row |= {key: len(self.z) + k for k, key in enumerate(fresh)}
            self.z, self.g = np.concatenate([self.z, new]), np.concatenate([self.g, g])
        return np.asarray(self.g[[self._row[key] for key in keys]])

    def follow(self, z: Array, state: Index, noise: Array, steps: Index, enough: Array | None) -> Trails:
        """Segments z (n, 2, nz) of known ends, each followed for its state."""
        ends = self(z.reshape(-1, z.shape[2])).reshape(len(z), 2, -1)
        return follow(lambda _, points: self(points), z, ends, state, noise, steps, enough)


@final
class Pairs:
    """Segments along single axes across which nothing jumps: ends (n, 2, nz), axis (n,), change (n, nx) = |Δg|."""

    def __init__(self, nz: int, nx: int) -> None:
        self._keep(np.empty((0, 2, nz)), np.empty(0, dtype=np.intp), np.empty((0, nx)))

    def _keep(self, ends: Array, axis: Index, change: Array) -> None:
        self.ends, self.axis, self.change = ends, axis, change
        rows = np.arange(len(axis))
        self.length = ends[rows, 1, axis] - ends[rows, 0, axis]
        self.middle = (ends[:, 0] + ends[:, 1]) / 2

    def add(self, ends: Array, axis: Index, change: Array) -> None:
        axes = np.concatenate([self.axis, axis])
        self._keep(np.concatenate([self.ends, ends]), axes, np.concatenate([self.change, change]))

    def drop(self, rows: Bools) -> None:
        self._keep(self.ends[~rows], self.axis[~rows], self.change[~rows])

    def within(self, low: Array, high: Array) -> Bools:
        """(n,): the middle lies in the box."""
        inside = np.ones(len(self.axis), dtype=bool)
        for j in range(len(low)):
            inside &= (self.middle[:, j] >= low[j]) & (self.middle[:, j] <= high[j])
        return inside

    def slopes(self, noise: Array, rows: Bools | slice = slice(None)) -> Array:
        """(n, nx), 0 where the change is no more than the arithmetic's noise."""
        return np.asarray(np.where(self.change[rows] > noise, self.change[rows], 0.0) / self.length[rows, None])

    def steepest(self, rows: Bools, noise: Array) -> Array:
        """(nx, nz): the largest slope of each state along each axis among some of the pairs."""
        slopes, axis = self.slopes(noise, rows), self.axis[rows]
        parts = [slopes[axis == j].max(axis=0, initial=0.0) for j in range(self.ends.shape[2])]
        return np.stack(parts, axis=1)

    def count(self, rows: Bools, axes: Sequence[int]) -> int:
        """How many of them that one of the axes has which has the fewest."""
        return int(np.bincount(self.axis[rows], minlength=self.ends.shape[2])[list(axes)].min())
