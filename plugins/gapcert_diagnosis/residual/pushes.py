"""Pushes from outside: short forces that no law makes, as a list with time, place, size and interval.

A push is looked for in overlapping windows, short and long ones, whose starts are free: of all forces that are constant between
two places of a window, the one that takes most of the residual, by the linearised motion. It counts where it takes more than
chance finds in as many places, and far more than in other windows: what a missing law leaves all along a recording is no push.
Where a command was repeated, what the repetitions left at the same time is taken off first.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import final

import numpy as np
from scipy.stats import binom

from gapcert.plugin import Bools, Effect, Model, position, site_units
from gapcert_diagnosis.data.dataset import Dataset
from gapcert_diagnosis.fitting.fit import Fit, fit, followed, lag_one, rescued
from gapcert_diagnosis.fitting.hypothesis import Hypothesis
from gapcert_diagnosis.fitting.linearised import Tangent
from gapcert_diagnosis.results import Push
from gapcert_diagnosis.thresholds import THRESHOLDS


@final
@dataclass(frozen=True)
class _Found:
    """Forces (site → from, until in s, size), each of which takes most of a window (from, until) of a piece, the best first.

    gain: what that takes of the sum of squares; chance: what the best of all windows might take of noise; plain: does it take
    nearly all that the window has more than others?
    """

    piece: int
    forces: Mapping[str, tuple[float, float, float]]
    window: tuple[float, float]
    gain: float
    chance: float
    plain: bool

    @property
    def stretch(self) -> tuple[float, float]:
        return next(iter(self.forces.values()))[:2]

    def away(self, push: _Found) -> bool:
        """Does my window not see a push?"""
        (t, end), (begin, until) = push.stretch, self.window
        return self.piece != push.piece or begin > end or until < t


def pushes(
    extended: Callable[[Mapping[str, float]], Model], last: Fit, measured: Dataset, names: Sequence[str], law: Effect
) -> tuple[Push, ...]:
    """In order of trajectory and time.

    extended: the model with the causes, at the numbers of a fit; last: their fit; names: of the trajectories; law: of one push.
    """
    lengths = sorted({measured.brief(THRESHOLDS.short_window), last.windows.length})
    found = list[_Found]()
    for sure in (False, True):
        model = extended(last.values)
        found = _standing_out([f for length in lengths for f in _strongest(model, last, measured, length)], sure)
        if not found:
            return ()
        # Numbers that were fitted with the pushes in the data are off by what these do.
        w = last.windows
        span = w.length * measured.period
        free = np.array([all(t > f.stretch[1] or t + span < f.stretch[0] for f in found) for t in w.t.tolist()])
        if free.sum() >= THRESHOLDS.guard_windows:
            last = fit(last.hypothesis, w.take(free), theta=last.theta, start=last.start[free])
    if _commanded(found, measured):
        return ()
    about = _About(extended(last.values), last, measured, law, found)
    told = [about.fits(f) for f in sorted(found, key=lambda f: (f.piece, f.stretch))]
    left = {s: sum(float(np.sum(fits[s].residual ** 2)) for fits in told if s in fits) for s in about.model.sites("coordinate")}
    usual = sorted(left, key=lambda s: (position(about.model, s) is None, left[s]))
    listed = (about.push(fits, usual, names) for fits in told)
    return tuple(p for p in listed if p is not None)


def _commanded(found: Sequence[_Found], measured: Dataset) -> bool:
    """Do they come where an input has just changed more often than chance has it? Then a law makes them."""
    size, lag, after = np.std(np.concatenate(measured.inputs), axis=0), measured.samples(THRESHOLDS.short_window), list[Bools]()
    for u in measured.inputs:
        moved = u - np.concatenate([np.repeat(u[:1], lag, axis=0), u])[: len(u)]
        after.append(np.any(np.abs(moved) > THRESHOLDS.jump * size, axis=1))
    starts = [(after[f.piece], int(np.searchsorted(measured.times[f.piece], f.stretch[0]))) for f in found]
    begun, share = [bool(near[min(k, len(near) - 1)]) for near, k in starts], float(np.mean(np.concatenate(after)))
    return bool(binom.sf(sum(begun) - 1, len(begun), share) < THRESHOLDS.by_command)


def elsewhere(model: Model, measured: Dataset, names: Sequence[str], pushed: Sequence[Push]) -> bool:
    """Do most of them come at places and inputs that the rest of the recording knows? Else they may be a law, as of a stop."""
    places = {position(model, site) for site in model.sites("coordinate")}
    shown = [i for i, s in enumerate(model.states) if s.name in places]
    rows = [np.hstack([x[:, shown], u]) for x, u in zip(measured.states, measured.inputs, strict=True)]
    during = [
        [(names[k] == p.trajectory) & (t >= p.t) & (t <= p.t + p.duration) for p in pushed]
        for t, k in zip(measured.times, measured.source, strict=True)
    ]
    calm = np.concatenate([z[~np.any(hit, axis=0)] for z, hit in zip(rows, during, strict=True)])
    low, high = np.quantile(calm, [THRESHOLDS.push_rest, 1 - THRESHOLDS.push_rest], axis=0)
    at = [np.concatenate([z[hit[k]] for z, hit in zip(rows, during, strict=True)]) for k in range(len(pushed))]
    known = [bool(((np.median(z, axis=0) >= low) & (np.median(z, axis=0) <= high)).all()) for z in at if len(z)]
    return 2 * sum(known) > len(known)


def _standing_out(found: Sequence[_Found], sure: bool) -> list[_Found]:
    """Of the strongest forces in all windows those that stand out from what the windows hold that see none of them.

    sure: as many as hold several times as much, or more than chance where the others hold no more; else those with the
    widest gap below them.
    """
    rest, kept, best, widest = sorted(found, key=lambda f: -f.gain), list[_Found](), list[_Found](), THRESHOLDS.push_gap
    while (push := next((f for f in rest if f.plain and f.gain > f.chance), None)) is not None:
        kept.append(push)
        rest = [f for f in rest if f.away(push)]
        if len(rest) < THRESHOLDS.push_calm * len(found):
            break
        gap = push.gain / max(1.0, *(f.gain for f in rest))
        if sure and (gap > THRESHOLDS.push_rare or all(f.gain < f.chance for f in rest)):
            best = [*kept]
        elif not sure and gap > widest:
            widest, best = gap, [*kept]
    return best


def _strongest(model: Model, last: Fit, measured: Dataset, length: int) -> Iterator[_Found]:
    """The best force of every window."""
    if max(map(len, measured.outputs)) < measured.history + length:
        return
    windows = measured.windows(length, max(1, length // THRESHOLDS.push_overlap))
    motion = Tangent.of(model, _unlike_others(rescued(followed(last.hypothesis, last.theta, windows))))
    steps = motion.x.shape[1]
    count = min(THRESHOLDS.push_bins, steps)
    edges = np.linspace(0, steps, count + 1).astype(int)
    bins = np.digitize(np.arange(steps), edges[1:-1])[:, None] == np.arange(count)
    first, until = np.triu_indices(count)
    boxes = (np.arange(count)[:, None] >= first) & (np.arange(count)[:, None] <= until)
    force, gain = [], []
    sites = [s for s in model.sites("coordinate") if motion.felt(motion.probed(s).reshape(motion.x.shape))]
    for site in sites:
        columns = motion.responses(site, np.tile(bins.astype(np.float64), (len(windows), 1, 1)))
        along = np.einsum("wnk,wn->wk", columns, motion.residual) @ boxes
        own = np.sum((np.swapaxes(columns, 1, 2) @ columns @ boxes) * boxes, axis=1)
        force.append(along / np.maximum(own, 1e-300))
        gain.append(along * force[-1])
    if not sites:
        return
    energy, row = np.sum(motion.residual**2, axis=1), np.arange(len(windows))
    best = [g.argmax(axis=1) for g in gain]
    most = np.stack([g[row, k] for g, k in zip(gain, best, strict=True)], axis=-1)
    gains = most.max(axis=1)
    rest = max(1.0, float(np.median((energy - gains) / np.maximum(np.sum(windows.weight**2, axis=(1, 2)), 1))))
    chance = THRESHOLDS.push_beyond * rest * charge(len(sites) * len(first) * len(row))
    plain = gains > THRESHOLDS.push_share * (energy - np.median(energy))
    # Neighbours that are alike count for fewer, and their sum is larger by chance.
    rho = max(0.0, float(np.median([lag_one(r[None]).max() for r in motion.residual.reshape(windows.y.shape)])))
    plain &= gains > chance * (1 + rho) / (1 - rho)
    # What moves outputs by less than 1.5 noise floors from its beginning on, or is little force, may be an integrator's.
    best_site = most.argmax(axis=1)
    begun = edges[first[np.stack(best, axis=-1)[row, best_site]]]
    plain &= gains > THRESHOLDS.loud_channel**2 * rest * (1 - begun / steps) * length
    effort = np.array([np.sqrt(np.mean(motion.effort(site) ** 2)) for site in sites])
    size = np.abs(np.stack([f[row, i] for f, i in zip(force, best, strict=True)], axis=-1))[row, best_site]
    plain &= size > THRESHOLDS.least_effort * effort[best_site]
    for w, t in enumerate(windows.t.tolist()):
        forces = {}
        for i in np.argsort(-most[w], kind="stable").tolist():
            k = int(best[i][w])
            ends = (t + float(edges[e]) * model.period for e in (first[k], until[k] + 1))
            forces[sites[i]] = (*ends, float(force[i][w, k]))
        window = t, t + length * measured.period
        yield _Found(int(windows.place[w, 0]), forces, window, float(gains[w]), chance, bool(plain[w]))


def charge(tried: int) -> float:
    """What the best of so many forces must lower the sum of squares by, in squares of the noise."""
    return 12 + 2 * math.log(max(1, tried))


def _unlike_others(fitted: Fit) -> Fit:
    """Without what the nearest of several repetitions of the same command left at that time, where that leaves less."""
    windows, m = fitted.windows, fitted.windows.measured
    begun = {k: min(t[0] for t, s in zip(m.times, m.source, strict=True) if s == k) for k in set(m.source)}
    since = np.round((windows.t - [begun[k] for k in windows.trajectory.tolist()]) / m.period)
    level = THRESHOLDS.same_command * np.std(np.concatenate(m.inputs), axis=0) + 1e-300
    near = THRESHOLDS.same_way * np.std(np.concatenate(m.states), axis=0) + 1e-300
    left = fitted.residual.copy()
    for w in range(len(windows)):
        rows = np.flatnonzero((since == since[w]) & (windows.trajectory != windows.trajectory[w]))
        same = rows[(np.abs(windows.u[rows] - windows.u[w]) <= level).all(axis=(1, 2))]
        # Of two runs nobody knows which one was pushed.
        if len(same) > 1:
            apart = fitted.residual[w] - fitted.residual[same]
            # After a push a run goes its own way, where the same law leaves something else.
            apart *= (np.abs(windows.start[same] - windows.start[w]) <= near).all(axis=1)[:, None, None]
            left[w] = apart[np.argmin(np.sum(apart**2, axis=(1, 2)))]
    now, before = (float(np.median(np.sum(r**2, axis=(1, 2)))) for r in (left, fitted.residual))
    return replace(fitted, residual=left) if now < THRESHOLDS.push_repeated * before else fitted


@final
@dataclass(frozen=True)
class _About:
    """Stretches about pushes that were found, each of which holds no other, and fits of the law of a push to them."""

    model: Model
    last: Fit
    measured: Dataset
    law: Effect
    found: Sequence[_Found]

    def fits(self, f: _Found) -> dict[str, Fit]:
        """Site → fit of force, time and duration; none where the stretch is too short."""
        m, (t, end) = self.measured, f.stretch
        times, span = m.times[f.piece], max(THRESHOLDS.short_window, self.last.windows.length * m.period / 2)
        near = [k.stretch for k in self.found if k.piece == f.piece and k is not f]
        low = max([t - span, *((t + b) / 2 for _, b in near if b <= t)])
        high = min([end + span, *((end + a) / 2 for a, _ in near if a >= end)])
        first, last = max(m.history, int(np.searchsorted(times, low))), int(np.searchsorted(times, high))
        if last - first < THRESHOLDS.window_samples:
            return {}
        windows = m.at(np.array([[i, first] for i, own in enumerate(m.times) if len(own) >= last]), last - first)
        row = windows.place[:, 0] == f.piece
        if len(windows) > 1:
            plain = followed(self.last.hypothesis, self.last.theta, windows)
            windows = replace(windows, y=windows.y + (plain.residual - _unlike_others(plain).residual) * m.sigma)
        own = windows.take(row)
        return {s: fit(self._pushed(s, f.forces[s], low, high), own) for s in f.forces}

    def _pushed(self, site: str, force: tuple[float, float, float], low: float, high: float) -> Hypothesis:
        extension, (t, end, size) = self.law.extension(site, self.model), force
        names, start = tuple(p.name for p in extension.parameters), np.array([size, t, end - t])
        least, most = np.array([-np.inf, low, self.measured.period / 10]), np.array([np.inf, high, high - low])
        step = THRESHOLDS.difference_step * np.abs(start[[0, 2, 2]])
        return Hypothesis(self.model.extend([extension]), names, start, least, most, step, np.full(3, np.inf))

    def push(self, fits: Mapping[str, Fit], usual: Sequence[str], names: Sequence[str]) -> Push | None:
        """At the site that leaves least, or at a usual one that leaves about as much; None where a fit of its own denies it."""
        left = {s: float(np.sum(fit.residual**2) / max(1.0, fit.chi.mean())) for s, fit in fits.items()}
        site = next((s for s in usual if s in left and left[s] < min(left.values()) + THRESHOLDS.tie_score), None)
        if site is None:
            return None
        fitted = fits[site]
        force, t, duration = fitted.theta.tolist()
        slope = np.array([duration, 0.0, force])
        variance = float(slope @ fitted.covariance @ slope) * max(1.0, float(fitted.chi.mean()))
        size, half = abs(force * duration), 1.959964 * math.sqrt(max(variance, 0.0) / float(fitted.whiteness.min()))
        if not half < THRESHOLDS.push_sure * size:
            return None
        units, name = site_units(self.model, "coordinate", site), names[int(fitted.windows.trajectory[0])]
        unit = f"{units['force']}*s" if f"{site}_dot" in {s.name for s in self.model.states} else units["velocity"]
        sign = 1 if force > 0 else -1
        return Push(name, t, duration, site, sign, size, unit, size - half, size + half, abs(force), units["force"])
