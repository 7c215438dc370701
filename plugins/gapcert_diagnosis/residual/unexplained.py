"""What no effect in the library explains: is anything left, what does it look like, where is it, did single pushes happen."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import final

import numpy as np

from gapcert.plugin import Array, Model
from gapcert_diagnosis.data.dataset import Windows
from gapcert_diagnosis.fitting.fit import Fit, fit, rescued
from gapcert_diagnosis.fitting.linearised import Tangent
from gapcert_diagnosis.results import Push, Unexplained, Verdict
from gapcert_diagnosis.thresholds import THRESHOLDS
from gapcert_figures import KINDS

from .lack_of_fit import Lack, lack
from .regression import Learnt, correction, learn
from .whiteness import Growth, growth


@final
@dataclass(frozen=True)
class Left:
    """The residual of a final model in long and short windows, and how it was judged.

    learnt: per coordinate; share: of the effort, the force that would leave as much; lack: what it goes with, though it may be
    too little for the other tests, where something was fitted.
    """

    long: Tangent
    short: Tangent
    growth: Growth
    learnt: tuple[Learnt, ...]
    share: float
    lack: Lack | None = None

    @property
    def best(self) -> Learnt | None:
        """Where most is learnt."""
        return max(self.learnt, key=lambda k: k.share, default=None)

    @property
    def coherent(self) -> bool:
        """Is it more than noise, whatever its colour?"""
        # In strongly coloured noise a regression may find a tenth by chance, but then nothing grows.
        learnt = self.best is not None and self.best.share > (
            THRESHOLDS.learnt_share if self.growth.sigmas > 2 else THRESHOLDS.learnt_plenty
        )
        return self.growth.sigmas > THRESHOLDS.growth_sigmas or self.growth.chi_short > THRESHOLDS.coarse_residual or learnt

    @property
    def remains(self) -> bool:
        """And more than an integrator leaves?"""
        return self.coherent and self.share > THRESHOLDS.slight_force


def left(model: Model, last: Fit, windows: Windows, seed: int = 0) -> Left:
    """What the final fit leaves; model: with the causes at their fitted numbers, for slopes and for the force of the effort."""
    last, m = rescued(last, windows), windows.measured
    brief = m.windows(min(m.brief(THRESHOLDS.short_window), windows.length))
    again = rescued(fit(last.hypothesis, brief, theta=last.theta, iterations=5), brief)
    long, short = Tangent.of(model, windows, last), Tangent.of(model, brief, again)
    found = _judged(long, short, seed)
    if found.remains and m.rough.any():
        smooth = _judged(_smoothed(long), _smoothed(short), seed)
        found = found if smooth.remains else smooth
    return found


def _judged(long: Tangent, short: Tangent, seed: int) -> Left:
    grown, coordinates = growth(long, short, seed), long.model.sites("coordinate")
    # What is at the white noise floor holds nothing to learn.
    sites = coordinates if grown.chi_long > THRESHOLDS.located_floor else ()
    # Short windows follow the true path; long ones show what is slow. The one that learns more decides.
    both = [(learn(m, s), m) for m in (short, long) for s in sites]
    learnt = tuple(max((k for k, _ in both if k.site == s), key=lambda k: k.share) for s in sites)
    excess = [float(grown.excess.sum()), *(k.share * _square(m) for k, m in both)]
    if grown.chi_short > THRESHOLDS.coarse_residual:
        excess.append(_square(long))
    found = Left(long, short, grown, learnt, _share(long, coordinates, max(excess)))
    if not long.fitted.hypothesis.charged or (found.coherent and found.share > THRESHOLDS.faint_force):
        return found
    return replace(found, lack=lack(long, short, seed))


def _smoothed(motion: Tangent) -> Tangent:
    """With the residual beyond what a converter may make of the same motion: its steps are a law of the position, and known."""
    m = motion.windows.measured
    r = motion.residual.reshape(motion.windows.y.shape)
    beyond = np.sign(r) * np.maximum(np.abs(r) - m.rough / m.sigma, 0.0)
    return replace(motion, residual=beyond.reshape(motion.residual.shape))


def _square(motion: Tangent) -> float:
    """Mean square of the residual, summed over channels."""
    return float(np.mean(motion.residual**2) * motion.windows.y.shape[2])


def _share(motion: Tangent, sites: tuple[str, ...], excess: float) -> float:
    """Force over effort, at the coordinate where least force leaves a mean square `excess` (summed over channels)."""
    shares: list[float] = [math.inf]
    for site in sites:
        made = motion.responses(site, motion.effort(site)[..., None])
        shares.append(math.sqrt(excess / max(float(np.mean(made**2)) * motion.windows.y.shape[2], 1e-300)))
    return min(shares)


def verdict(causes: int, found: Left, last: Fit, nothing: Fit, experiment: bool, lost: bool = False) -> Verdict:
    """causes: how many are named; nothing: the fit without them; experiment: can one tell the ties apart?

    Causes that leave a tenth of the excess over the noise are an answer even where something small is left beside them.
    lost: nothing of the motion is followed, however little force would do so.
    """
    if found.remains and not (causes and last.chi.mean() - 1 < THRESHOLDS.adequate_rest * (nothing.chi.mean() - 1)):
        return "unexplained"
    if not causes:
        return "unexplained" if lost else "nothing"
    return "ambiguous" if experiment else "causes"


def doubts(causes: int, found: Left) -> tuple[str, ...]:
    """Why named causes may be stand-ins, as sentences."""
    out = []
    if causes and found.coherent and found.share > THRESHOLDS.faint_force:
        best = found.best
        kind = max(best.kinds, key=lambda k: best.kinds[k]) if best and best.share > THRESHOLDS.learnt_share else None
        looks = f"; it looks like {KINDS.get(kind, kind)}" if kind else ""
        size = f"{100 * found.share:.2g} % of the effort" if found.share < THRESHOLDS.no_effort else "more than any effort here"
        out.append(f"inadequate: a residual of {size} is left that is not noise{looks}")
    elif causes and found.lack is not None:
        out.append(
            f"inadequate: what is left goes with {found.lack.kind} ({found.lack.sigmas:.2g} standard deviations of noise)"
        )
    if causes >= THRESHOLDS.several_causes:
        out.append(f"composite: {causes} causes together are often stand-ins for one law that the library lacks")
    return tuple(out)


def unexplained(found: Left) -> Unexplained:
    """The kind of what is left, where it is, single pushes, and a formula where a law of the present state would do."""
    where, best = _where(found.short), found.best
    if best is None:
        return Unexplained(False, where=where)
    kinds = {n: share for n, share in best.kinds.items() if share > 0}
    if best.memory > THRESHOLDS.learnt_share:
        return Unexplained(True, looks_like=kinds, where=where)
    if best.share > THRESHOLDS.learnt_share:
        formulas = (correction(m, best.site) for m in (found.short, found.long))
        formula = max((f for f in formulas if f is not None), key=lambda f: f.explained, default=None)
        return Unexplained(False, looks_like=kinds, where=where, correction=formula)
    # A push at the edge of a window hides in its free start, so these windows overlap by half.
    windows, short = found.short.windows, found.short.fitted
    overlapping = windows.measured.windows(windows.length, max(1, windows.length // 2))
    again = fit(short.hypothesis.holding(short.theta), overlapping)
    motion = Tangent.of(found.short.model, overlapping, again)
    events = _single(_pushes(motion, motion.model.sites("coordinate")))
    return Unexplained(False, events if _quiet(motion, events) else (), kinds, where)


def _where(motion: Tangent) -> tuple[tuple[float, float], ...]:
    """The stretches of time that carry most of the excess over the median window; none where it is all over."""
    energy = np.sum(motion.residual**2, axis=1)
    over = np.where(energy > THRESHOLDS.loud_energy * np.median(energy), energy - np.median(energy), 0.0)
    order = np.argsort(-over, kind="stable")
    count = int(np.searchsorted(np.cumsum(over[order]), THRESHOLDS.located_share * over.sum())) + 1
    if over.sum() <= 0 or count > 0.25 * len(energy):
        return ()
    span = motion.windows.length * motion.windows.measured.period
    stretches: list[tuple[float, float, float]] = []
    for w in sorted(order[:count].tolist(), key=lambda w: float(motion.windows.t[w])):
        t, size = float(motion.windows.t[w]), float(over[w])
        if stretches and t - stretches[-1][1] < span / 2:
            stretches[-1] = (stretches[-1][0], t + span, stretches[-1][2] + size)
        else:
            stretches.append((t, t + span, size))
    largest = sorted(stretches, key=lambda s: -s[2])[: THRESHOLDS.located_stretches]
    return tuple(sorted((round(a, 6), round(b, 6)) for a, b, _ in largest))


def _pushes(motion: Tangent, sites: tuple[str, ...]) -> list[tuple[float, Push]]:
    """(energy, push) of windows that stand out and that one short force explains."""
    energy = np.sum(motion.residual**2, axis=1)
    rows = np.flatnonzero(energy > 8 * np.median(energy))
    if not 0 < len(rows) <= 0.2 * len(energy):
        return []
    steps = motion.x.shape[1]
    edges = np.linspace(0, steps, THRESHOLDS.push_bins + 1).astype(int)
    bins = np.digitize(np.arange(steps), edges[1:-1])[:, None] == np.arange(THRESHOLDS.push_bins)
    found = []
    for site in sites:
        columns = motion.responses(site, np.tile(bins.astype(np.float64), (len(energy), 1, 1)))
        for w in rows.tolist():
            along = columns[w].T @ motion.residual[w]
            size = np.sum(columns[w] ** 2, axis=0) + 1e-300
            j = int(np.argmax(along**2 / size))
            if (share := float(along[j] ** 2 / size[j] / energy[w])) > THRESHOLDS.push_share:
                impulse = float(along[j] / size[j] * (edges[j + 1] - edges[j]) * motion.model.period)
                at = float(motion.windows.t[w] + (edges[j] + edges[j + 1]) / 2 * motion.model.period)
                found.append((share * energy[w], Push(at, site, 1 if impulse > 0 else -1, abs(impulse))))
    return found


def _quiet(motion: Tangent, events: tuple[Push, ...]) -> bool:
    """Is the residual noise where no event is near? What is left all over the recording is a law, not events."""
    span = motion.windows.length * motion.windows.measured.period
    far = np.ones(len(motion.windows), dtype=bool)
    for event in events:
        far &= (event.t < motion.windows.t - THRESHOLDS.push_end) | (event.t > motion.windows.t + span + THRESHOLDS.push_end)
    rest: Array = motion.residual[far]
    return bool(rest.size and np.mean(rest**2) < 1.06 + math.sqrt(2 / rest.size))


def _single(found: list[tuple[float, Push]]) -> tuple[Push, ...]:
    """Each push once, in order of time: of those that overlapping windows show, the one with the most energy."""
    kept: list[Push] = []
    for _, push in sorted(found, key=lambda f: -f[0]):
        if all(abs(push.t - k.t) > THRESHOLDS.short_window for k in kept):
            kept.append(push)
    return tuple(sorted(kept, key=lambda p: p.t))
