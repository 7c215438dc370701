"""Close pairs along one axis, drawn inside the domain, and which states the resolution lets them tell anything about."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
import numpy.typing as npt

from gapcert import Array, UsageError
from gapcert.plugin import LipschitzProblem
from gapcert_bounds.thresholds import THRESHOLDS


@final
@dataclass(frozen=True)
class Close:
    """Pairs along one axis: both ends (n, nz), |Δg| (n, nx), and the realised length (n,) that slopes are divided by."""

    start: Array
    end: Array
    change: Array
    length: Array

    @classmethod
    def ask(cls, problem: LipschitzProblem, name: str, axis: int, start: Array, end: Array) -> Close:
        return cls(start, end, np.abs(problem.change(name, start, end)[0]), end[:, axis] - start[:, axis])

    @property
    def slope(self) -> Array:
        """(n, nx)"""
        return np.asarray(self.change / self.length[:, None])

    def steepest(self, most: int) -> Array:
        """(nx, most, 2, nz): each state's steepest pairs, the steepest first."""
        rows = np.argsort(-self.slope, axis=0, kind="stable")[:most].T
        return np.stack([self.start[rows], self.end[rows]], axis=2)

    def lower(self, noise: Array) -> Array:
        """(nx,): slopes that occur for certain."""
        return np.asarray((np.maximum(self.change - noise, 0) / self.length[:, None]).max(axis=0) * (1 - 1e-12))

    def hidden(self, noise: Array) -> Array:
        """(nx,) what an inert state may hide: the noise itself, and whatever change was seen above it."""
        most = self.change.max(axis=0)
        return np.asarray((noise + np.where(most > noise, most, 0.0)) / self.length.min())

    def __add__(self, other: Close) -> Close:
        both = ((self.start, other.start), (self.end, other.end), (self.change, other.change), (self.length, other.length))
        return Close(*(np.concatenate(pair) for pair in both))


def uniform(
    problem: LipschitzProblem, j: int, rng: np.random.Generator, count: int, distance: float, method: str
) -> tuple[Array, Array]:
    """Both ends (count, nz) of random pairs inside Z, [½, 1] · distance · (width of axis j) apart along axis j."""
    domain = problem.domain
    if domain.relations:
        return _chords(problem, j, rng, count, distance, method)
    delta = domain.width[j] * distance * (0.5 + 0.5 * rng.random(count))
    start = domain.draw(count, rng)
    start[:, j] = domain.low[j] + rng.random(count) * (domain.width[j] - delta)
    end = start.copy()
    end[:, j] = np.minimum(start[:, j] + delta, domain.high[j])
    return start, end


def _chords(
    problem: LipschitzProblem, j: int, rng: np.random.Generator, count: int, distance: float, method: str
) -> tuple[Array, Array]:
    """Pairs on chords of Z along axis j, those of points drawn from Z that are long enough."""
    domain, starts, ends, found = problem.domain, list[Array](), list[Array](), 0
    for _ in range(100):
        z = domain.draw(count, rng)
        delta = domain.width[j] * distance * (0.5 + 0.5 * rng.random(count))
        low, high = domain.chord(z, j)
        start = z.copy()
        start[:, j] = low + rng.random(count) * (high - low - delta)
        end = start.copy()
        end[:, j] = start[:, j] + delta
        both = (high - low > delta) & domain.contains(start) & domain.contains(end)
        starts.append(start[both])
        ends.append(end[both])
        found += int(both.sum())
        if found >= count:
            return np.concatenate(starts)[:count], np.concatenate(ends)[:count]
    raise UsageError(
        f"lipschitz {method}: {found} of {100 * count} points of the domain have room for a pair along "
        f"'{domain.axes[j].name}' within the relations; give a smaller distance"
    )


def around(
    problem: LipschitzProblem, rng: np.random.Generator, middles: Array, size: Array, most: int, k: int
) -> tuple[npt.NDArray[np.intp], Array]:
    """(states (n,), points of Z (n, nz)) around the middles (m, nz) where a state's size (m, nx) is largest, in round k."""
    domain = problem.domain
    state = np.arange(most) % domain.nx
    order = np.argsort(-size, axis=0, kind="stable")[: THRESHOLDS.elites]
    middle = middles[order[rng.integers(len(order), size=most), state]]
    wide = THRESHOLDS.elite_reach * 0.5 ** (k - 1) * domain.width
    return state, domain.reach(middle, np.clip(middle + wide * rng.standard_normal(middle.shape), domain.low, domain.high))


def inert(problem: LipschitzProblem, j: int, pairs: Close, seen: Array, noise: Array, method: str) -> npt.NDArray[np.bool_]:
    """Which states do not change along axis j beyond the resolution; UsageError where longer pairs would tell."""
    length = float(pairs.length.min())
    drowned = noise / length > THRESHOLDS.noise_share * seen
    hidden = drowned & (pairs.change.max(axis=0) > noise)
    for i in np.flatnonzero(hidden):
        needed = 2 * noise[i] / (THRESHOLDS.noise_share * seen[i] * problem.domain.width[j])
        if needed <= 1:
            name, state = problem.domain.axes[j].name, problem.domain.axes[i].name
            raise UsageError(
                f"lipschitz {method}: pairs along '{name}' are too close for '{state}': the largest "
                f"slope seen is {seen[i]:.3g}, and rounding alone can fake {noise[i] / length:.3g}; "
                f"set distance: {_round_up(needed):g}"
            )
    return np.asarray(drowned)


def _round_up(x: float) -> float:
    """x to two digits, not smaller."""
    unit = 10.0 ** (np.floor(np.log10(x)) - 1)
    return float(min(1.0, np.ceil(x / unit) * unit))
