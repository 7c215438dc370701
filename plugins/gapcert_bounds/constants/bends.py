"""Curvature from second differences: searched for where they are largest, and swept over distances."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from gapcert.plugin import Array, Bools, Ints, LipschitzProblem, UsageError
from gapcert_bounds.thresholds import THRESHOLDS

from .slopes import around


@final
@dataclass(frozen=True)
class Bends:
    """Triples z − δ, z, z + δ along one axis: z (n, nz), δ (n,), and |g(z − δ) − 2 g(z) + g(z + δ)| (n, nx)."""

    centre: Array
    step: Array
    change: Array

    @classmethod
    def ask(cls, problem: LipschitzProblem, name: str, axis: int, centre: Array, step: Array) -> Bends:
        low, high = _beside(centre, step, axis)
        # Rounding z ∓ δ shifts g by up to L ulp(z), which is of the order of its resolution or below.
        before, here, after = np.split(problem.remainder(name, np.concatenate([low, centre, high])), 3)
        return cls(centre, step, np.abs(before - 2 * here + after))

    @property
    def size(self) -> Array:
        """(n, nx): |∂²g| as it looks over the distance."""
        return np.asarray(self.change / self.step[:, None] ** 2)

    def __add__(self, other: Bends) -> Bends:
        both = ((self.centre, other.centre), (self.step, other.step), (self.change, other.change))
        return Bends(*(np.concatenate(pair) for pair in both))


def curvatures(
    problem: LipschitzProblem, names: Mapping[int, str], count: int, distance: float, safety: float, method: str
) -> tuple[Array, list[dict[str, Any]], int]:
    """(H (nx, nz), {"state", "axis", "kind", "inert", "distances", "values"} per state and axis, transitions spent).

    The largest of `count` second differences per axis × safety; ∞ where they do not settle as the distance shrinks (`kink`,
    `noise`) or too few distances tell (`unresolved`). Second differences that the resolution hides at every distance (`inert`)
    are bounded by what it may hide. UsageError where hidden state is drawn, or the triples are too few.
    """
    if problem.paired is not None:
        raise UsageError(
            f"lipschitz {method}: curvature of a residual whose hidden state is drawn is not defined; leave it out"
        )
    if count < THRESHOLDS.least_differences:
        raise UsageError(
            f"lipschitz {method}: {count} second differences per axis are too few; give a budget for "
            f"{THRESHOLDS.least_differences}"
        )
    nx = problem.domain.nx
    value, report, spent = np.zeros((nx, len(problem.domain.axes))), list[dict[str, Any]](), 0
    for j, name in names.items():
        found, calls = _search(problem, j, name, count, distance)
        trails = _Trails.follow(problem, j, name, found)
        spent += 3 * calls + trails.spent
        noise = 4 * problem.change_resolution
        for i in range(nx):
            inert = bool((found.change[:, i] <= noise[i]).all())
            kind, distances, values = trails.judge(i)
            # The shortest steps of a trail may be a quarter noise.
            clear = [v for h, v in zip(distances, values, strict=True) if v * h**2 * THRESHOLDS.bend_faked > noise[i]]
            seen = max([float(_sure(found, noise)[:, i].max()), *clear])
            if inert:
                value[i, j] = 2 * noise[i] / float(found.step.max()) ** 2
            else:
                value[i, j] = seen * safety if kind == "smooth" else np.inf
            entry = {"state": problem.domain.axes[i].name, "axis": name, "kind": kind, "inert": inert}
            report.append({**entry, "distances": distances, "values": values})
    return value, report, spent


def _sure(found: Bends, noise: Array) -> Array:
    """Sizes, 0 where the resolution may fake a large part of them."""
    return np.where(found.change > noise, found.size, 0.0)


def _search(problem: LipschitzProblem, j: int, name: str, count: int, distance: float) -> tuple[Bends, int]:
    """(second differences along axis j, how many were asked for): at random first, then around the largest, ever closer."""
    rng = np.random.default_rng([problem.seed, j, 0xC07E])
    noise, each = 4 * problem.change_resolution, count // (THRESHOLDS.bend_rounds + 1)
    longest = distance * problem.domain.width[j]
    found = Bends.ask(
        problem, f"curvature-{name}-0", j, *_random(problem, j, rng, count - (THRESHOLDS.bend_rounds - 1) * each, longest)
    )
    for k in range(1, THRESHOLDS.bend_rounds):
        z, step = _around(problem, j, rng, found, noise, each - int(THRESHOLDS.bend_fresh * each), longest, k)
        fresh, far = _random(problem, j, rng, each - len(z), longest)
        found = found + Bends.ask(problem, f"curvature-{name}-{k}", j, np.concatenate([fresh, z]), np.append(far, step))
    return found, len(found.step)


def _random(problem: LipschitzProblem, j: int, rng: np.random.Generator, count: int, longest: float) -> tuple[Array, Array]:
    """Centres in Z with room on both sides along axis j, and steps in [½, 1] of the longest."""
    domain, parts, have = problem.domain, list[tuple[Array, Array]](), 0
    for _ in range(100):
        z, step = domain.draw(count, rng), longest * (0.5 + 0.5 * rng.random(count))
        low, high = domain.chord(z, j)
        z[:, j] = low + step + rng.random(count) * np.maximum(high - low - 2 * step, 0)
        rows = _room(problem, z, step, j) & (high - low > 2 * step)
        parts.append((z[rows], step[rows]))
        have += int(rows.sum())
        if have >= count:
            return np.concatenate([z for z, _ in parts])[:count], np.concatenate([s for _, s in parts])[:count]
    raise UsageError(
        f"lipschitz: hardly any point of the domain has room for a second difference along '{domain.axes[j].name}'; "
        f"give a smaller distance"
    )


def _beside(z: Array, step: Array, j: int) -> tuple[Array, Array]:
    low, high = z.copy(), z.copy()
    low[:, j] -= step
    high[:, j] += step
    return low, high


def _room(problem: LipschitzProblem, z: Array, step: Array, j: int) -> Bools:
    low, high = _beside(z, step, j)
    return np.asarray(problem.domain.contains(z) & problem.domain.contains(low) & problem.domain.contains(high))


def _around(
    problem: LipschitzProblem, j: int, rng: np.random.Generator, found: Bends, noise: Array, most: int, longest: float, k: int
) -> tuple[Array, Array]:
    """Up to `most` centres and steps around each state's largest second differences."""
    size = _sure(found, noise)
    state, z = around(problem, rng, found.centre, size, most, k)
    needed = np.sqrt(noise / (THRESHOLDS.bend_faked * np.maximum(size.max(axis=0), np.finfo(float).tiny)))
    step = np.clip(np.maximum(needed[state], longest * 0.5**k), None, longest)
    # At the faces of Z the triple is moved inside, so that what is largest there is met as well.
    low, high = problem.domain.chord(z, j)
    z[:, j] = np.clip(z[:, j], low + step, np.maximum(high - step, low + step))
    rows = _room(problem, z, step, j)
    return z[rows], step[rows]


@final
@dataclass(frozen=True)
class _Trails:
    """Some second differences followed to shorter and shorter distances, towards where they are largest.

    step, size (trails, steps + 1), NaN where the change is not clear of the resolution; state: whose they are, −1 − i for one
    of state i that began at random.
    """

    state: Ints
    step: Array
    size: Array
    spent: int

    @classmethod
    def follow(cls, problem: LipschitzProblem, j: int, name: str, found: Bends) -> _Trails:
        nx, clear = problem.domain.nx, THRESHOLDS.bend_clear * problem.change_resolution
        top = np.argsort(-_sure(found, clear / 4), axis=0, kind="stable")[: THRESHOLDS.bend_trails]
        pick = np.concatenate([np.concatenate([top[:, i], np.arange(THRESHOLDS.bend_trails)]) for i in range(nx)])
        state = np.concatenate([np.repeat([i, -1 - i], [len(top), THRESHOLDS.bend_trails]) for i in range(nx)])
        own = np.where(state < 0, -1 - state, state)
        z, h, change = found.centre[pick], found.step[pick], found.change[pick, own]
        step, size = np.full((2, len(pick), THRESHOLDS.bend_steps + 1), np.nan)
        rows, spent, beside = np.arange(len(pick)), 0, np.arange(-4, 5)
        for k in range(THRESHOLDS.bend_steps + 1):
            if k:
                # Nine points, a quarter of the last distance apart: seven second differences, the largest of which goes on.
                quarter = h[rows] / 4
                points = np.repeat(z[rows, None], len(beside), axis=1)
                points[:, :, j] += quarter[:, None] * beside
                points[:, :, j] = np.clip(points[:, :, j], problem.domain.low[j], problem.domain.high[j])
                g = problem.remainder(f"curvature-{name}-sweep-{k}", points.reshape(-1, points.shape[2]))
                spent += len(g)
                g = g.reshape(len(rows), len(beside), nx)[np.arange(len(rows)), :, own[rows]]
                bend = np.abs(g[:, :-2] - 2 * g[:, 1:-1] + g[:, 2:])
                best = np.where(state[rows] < 0, 3, bend.argmax(axis=1))
                z[rows], h[rows] = points[np.arange(len(rows)), best + 1], quarter
                change[rows] = bend[np.arange(len(rows)), best]
            seen = change[rows] > clear[own[rows]]
            rows = rows[seen]
            step[rows, k], size[rows, k] = h[rows], change[rows] / h[rows] ** 2
            if not len(rows):
                break
        return cls(state, step, size, spent)

    def judge(self, i: int) -> tuple[str, list[float], list[float]]:
        """(kind, distances, sizes) of state i: of the trail that grew most, or of the largest where none grew."""
        mine, random = (np.flatnonzero(self.state == s) for s in (i, -1 - i))
        length = np.isfinite(self.size).sum(axis=1)
        growth = np.array([self._growth(row, int(n)) for row, n in enumerate(length)])
        row = int(mine[np.argmax(np.nan_to_num(growth[mine], nan=0.0))])
        if not growth[row] > THRESHOLDS.bend_growth:
            last = [self.size[m, max(0, length[m] - 1)] for m in mine]
            row = int(mine[np.argmax(np.nan_to_num(last))])
        n = int(length[row])
        own = self.step[row, :n].tolist(), self.size[row, :n].tolist()
        if n < 3:
            return "unresolved", *own
        if growth[row] > THRESHOLDS.bend_growth:
            return "noise" if (growth[random] > THRESHOLDS.bend_growth).sum() * 2 > len(random) else "kink", *own
        return "smooth" if own[1][-1] <= THRESHOLDS.bend_settled * own[1][-2] else "unresolved", *own

    def _growth(self, row: int, n: int) -> float:
        """By what factor a trail grew in each of its last two steps, on the mean; less than that if one of them was flat."""
        if n < 3:
            return float("nan")
        a, b, c = self.size[row, n - 3 : n]
        # A kink may lie anywhere between the points, which makes single factors of 2 to 8 out of its 4.
        return float(np.sqrt(c / a) if min(b / a, c / b) > THRESHOLDS.bend_settled else min(b / a, c / b))
