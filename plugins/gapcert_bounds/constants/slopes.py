"""Close pairs along one axis, inside the domain, and what their slopes tell as they get closer: the distance sweep.

The resolution hides some states from any pair (`inert`). Where slopes settle the residual is smooth; jumps and noise grow on.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from gapcert.plugin import Array, Bools, Ints, LipschitzBound, LipschitzProblem, Trails, UsageError
from gapcert_bounds.thresholds import THRESHOLDS

Curvature = tuple[Array, list[dict[str, Any]], int]


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
) -> tuple[Ints, Array]:
    """(states (n,), points of Z (n, nz)) around the middles (m, nz) where a state's size (m, nx) is largest, in round k."""
    domain = problem.domain
    state = np.arange(most) % domain.nx
    order = np.argsort(-size, axis=0, kind="stable")[: THRESHOLDS.elites]
    middle = middles[order[rng.integers(len(order), size=most), state]]
    wide = THRESHOLDS.elite_reach * 0.5 ** (k - 1) * domain.width
    return state, domain.reach(middle, np.clip(middle + wide * rng.standard_normal(middle.shape), domain.low, domain.high))


def inert(problem: LipschitzProblem, j: int, pairs: Close, seen: Array, noise: Array, method: str) -> Bools:
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


def estimate(
    problem: LipschitzProblem,
    pairs: Mapping[int, Close],
    values: Mapping[int, tuple[Array, Array]],
    diagnostics: Mapping[str, Any],
    method: str,
    safety: float,
    curvature: Callable[[], Curvature] | None,
) -> LipschitzBound:
    """What close pairs along each axis say; values: estimates and proved lower bounds, (nx,) each, of the axes asked along."""
    kinds, spent = _sweep(problem, pairs)
    samples = 2 * sum(len(close.start) for close in pairs.values()) + spent
    told, bent = {**diagnostics, "sweep": kinds}, None
    if curvature is not None:
        bent, told["curvature"], more = curvature()
        samples += more
    value, lower = np.zeros((2, problem.domain.nx, len(problem.domain.axes)))
    for j, (most, least) in values.items():
        value[:, j], lower[:, j] = most, least
    steep = np.concatenate([close.steepest(1) for close in pairs.values()], axis=1)
    return LipschitzBound(value, lower, "estimated", method, safety, samples, steep=steep, curvature=bent, diagnostics=told)


def _sweep(problem: LipschitzProblem, pairs: Mapping[int, Close]) -> tuple[list[dict[str, Any]], int]:
    """({"state", "axis", "distances", "slopes", "kind"} per state and axis, transitions spent); pairs: those of each axis.

    The steepest pairs are cut in four again and again, towards their steepest quarter: slopes that settle are `smooth`; where
    they grow to the end, but not at other pairs, something jumps (`jump`). Some random pairs are shortened as well: where most
    of these grow, it is `noise`. `unresolved`: too few distances at which the change is clear of the resolution.
    `distances` and `slopes` are those of the steepest pair, and for noise the medians of the random ones.
    """
    names = [a.name for a in problem.domain.axes]
    trails, axes, lengths, spent = _steep(problem, pairs)
    random, other = _random(problem, pairs)
    out = []
    for j in pairs:
        for i in range(problem.domain.nx):
            rows = np.flatnonzero((axes == j) & (trails.state == i))
            kind, distances, slopes = _judge(trails, lengths, rows, random[j][0], random[j][1][:, :, i])
            out.append({"state": names[i], "axis": names[j], "distances": distances, "slopes": slopes, "kind": kind})
    return out, spent + other


def _steep(problem: LipschitzProblem, pairs: Mapping[int, Close]) -> tuple[Trails, Ints, Array, int]:
    """(trails of the steepest pairs of each state and axis, their axes, their lengths at each step, transitions spent)."""
    nx, segments, states, axes = problem.domain.nx, [], [], []
    for j, close in pairs.items():
        few = close.steepest(max(1, min(4, len(close.start) // 250)))
        segments.append(few.reshape(-1, 2, few.shape[3]))
        states.append(np.repeat(np.arange(nx), few.shape[1]))
        axes.append(np.full(len(segments[-1]), j))
    z, state, axis = np.concatenate(segments), np.concatenate(states), np.concatenate(axes)
    rows, spent = np.arange(len(z)), 0
    slope, lengths = np.full((2, len(z), THRESHOLDS.sweep_steps + 1), np.nan)
    g, settled = np.zeros((len(z), 2, nx)), np.zeros(len(z), dtype=bool)
    t, clear_of = np.linspace(0, 1, THRESHOLDS.sweep_parts + 1)[:, None], THRESHOLDS.sweep_clear * problem.change_resolution
    for k in range(THRESHOLDS.sweep_steps + 1):
        a, b = z[rows, :1], z[rows, 1:]
        # The first round looks at the pairs themselves, which a resolution may already hide.
        points = np.concatenate([a, b], axis=1) if k == 0 else np.clip(a * (1 - t) + b * t, np.minimum(a, b), np.maximum(a, b))
        moved, cost = _parts(problem, f"sweep-steep-{k}", points)
        spent += cost
        each, own = np.arange(len(rows)), state[rows]
        change = np.abs(moved[each, :, own])
        best = change.argmax(axis=1)
        length = np.abs(points[each, best + 1, axis[rows]] - points[each, best, axis[rows]])
        clear = (change[each, best] > clear_of[own]) & (length > 0)
        rows, each, best = rows[clear], each[clear], best[clear]
        z[rows] = np.stack([points[each, best], points[each, best + 1]], axis=1)
        g[rows, 1] = moved[each, best]
        lengths[rows, k], slope[rows, k] = length[clear], change[each, best] / length[clear]
        if k > 1:
            settled[rows] = slope[rows, k] <= THRESHOLDS.slope_settled * slope[rows, 0]
            rows = rows[~settled[rows]]
        if not len(rows):
            break
    return Trails(z, g, state, slope, settled, spent), axis, lengths, spent


def _parts(problem: LipschitzProblem, name: str, points: Array) -> tuple[Array, int]:
    """(g's change from each of the points (n, m, nz) to the next, (n, m − 1, nx), and transitions spent)."""
    n, m, nz = points.shape
    if problem.paired is None:
        return np.diff(problem.remainder(name, points.reshape(-1, nz)).reshape(n, m, -1), axis=1), n * m
    moved, _ = problem.change(name, points[:, :-1].reshape(-1, nz), points[:, 1:].reshape(-1, nz))
    return moved.reshape(n, m - 1, -1), 2 * n * (m - 1)


def _random(problem: LipschitzProblem, pairs: Mapping[int, Close]) -> tuple[dict[int, tuple[Array, Array]], int]:
    """{axis: (lengths (steps, pairs), slopes (steps, pairs, nx), NaN where the change is not clear)}, and transitions."""
    few = {j: max(2, min(4, len(close.start) // 50)) for j, close in pairs.items()}
    start, end = (np.concatenate([getattr(c, side)[: few[j]] for j, c in pairs.items()]) for side in ("start", "end"))
    owner = np.concatenate([np.full(few[j], j) for j in pairs])
    rows, spent = np.arange(len(start)), 0
    lengths = np.full((THRESHOLDS.sweep_steps + 1, len(start)), np.nan)
    slopes = np.full((THRESHOLDS.sweep_steps + 1, len(start), problem.domain.nx), np.nan)
    for k in range(THRESHOLDS.sweep_steps + 1):
        part = float(THRESHOLDS.sweep_parts) ** -k
        a = start[rows]
        b = a * (1 - part) + end[rows] * part
        length = b[np.arange(len(rows)), owner[rows]] - a[np.arange(len(rows)), owner[rows]]
        moved, resolution = problem.change(f"sweep-random-{k}", a, b)
        spent += 2 * len(rows)
        change = np.abs(moved)
        clear = (change > THRESHOLDS.sweep_clear * resolution) & (length > 0)[:, None]
        lengths[k, rows] = length
        slopes[k, rows] = np.where(clear, change / np.where(length > 0, length, 1.0)[:, None], np.nan)
        rows = rows[clear.any(axis=1)]
        if not len(rows):
            break
    return {j: (lengths[:, owner == j], slopes[:, owner == j]) for j in pairs}, spent


def _judge(trails: Trails, lengths: Array, rows: Ints, distance: Array, random: Array) -> tuple[str, list[float], list[float]]:
    """(kind, distances, slopes) of one state along one axis: its trails, and the random pairs' slopes (steps, pairs)."""
    last, growing = np.maximum(trails.steps[rows], 0), trails.growing[rows]
    final = np.nan_to_num(trails.slope[rows, last])
    pick = int(np.where(growing.any() & ~growing, -1.0, final).argmax())
    row, steps = rows[pick], int(trails.steps[rows[pick]])
    own = lengths[row, : steps + 1].tolist(), trails.slope[row, : steps + 1].tolist()
    many = np.isfinite(random).sum(axis=1) * 2 > random.shape[1]
    levels = int(many.sum()) if many.all() else int(many.argmin())
    typical, apart = np.array([np.nanmedian(random[k]) for k in range(levels)]), np.nanmedian(distance[:levels], axis=1)
    noisy = levels > 2 and typical[-1] > THRESHOLDS.slope_growth * max(typical[0], typical[-3])
    # Of several steps, as single changes of noise differ much.
    usual = np.nanmax((random * distance)[max(0, levels - 3) : levels], initial=0.0)
    if noisy and not (growing.any() and final[pick] * own[0][-1] > THRESHOLDS.jump_alone * usual):
        return "noise", apart.tolist(), typical.tolist()
    if growing.any():
        return "jump", *own
    if steps < 1 or own[1][-1] > THRESHOLDS.slope_settled * own[1][-2]:
        return "unresolved", *own
    return "smooth", *own
