"""What no effect in the library explains: is anything left, what does it look like, where is it, did single pushes happen.

Tests of the residual are told as numbers, too: is it white, does it go with an input, a state or the time, does it need a
memory. Correlations are in standard deviations of what independent series of the same colour would show; from about 4 on they
are no accident. `memory` is a share: 0 for a law of the present state and input, 1 where these say nothing about the missing
force.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import final

import numpy as np
from scipy.spatial import KDTree

from gapcert.plugin import Array, Model
from gapcert_diagnosis.data.dataset import scatter
from gapcert_diagnosis.fitting.fit import Fit, fit, lag_one, rescued
from gapcert_diagnosis.fitting.linearised import Tangent
from gapcert_diagnosis.results import Push, Unexplained, Verdict
from gapcert_diagnosis.thresholds import THRESHOLDS
from gapcert_figures import KINDS

from .lack_of_fit import Lack, lack, rare
from .regression import Learnt, correction, learn, learn_shown
from .whiteness import Growth, growth


@final
@dataclass(frozen=True)
class Left:
    """The residual of a final model in long and short windows, and how it was judged.

    learnt: per coordinate; share: of the effort, the force that would leave as much; lack: what it goes with, though it may be
    too little for the other tests; shown: learnt per channel above its noise, of what its output equation may lack; wide: the
    same in windows beyond the longest horizon, where what is slow adds up, if the first say nothing against what was fitted.
    """

    long: Tangent
    short: Tangent
    growth: Growth
    learnt: tuple[Learnt, ...]
    share: float
    lack: Lack | None = None
    shown: tuple[Learnt, ...] = ()
    wide: Left | None = None

    @property
    def best(self) -> Learnt | None:
        """Where most is learnt: of a force, which all channels show, unless a law of one channel alone explains much more."""
        force, own = (max(some, key=lambda k: k.share, default=None) for some in (self.learnt, self.shown))
        alone = own is not None and own.share > THRESHOLDS.shown_alone * (0.0 if force is None else force.share)
        return own if alone else force

    @property
    def coherent(self) -> bool:
        """Is it more than noise, whatever its colour?"""
        # In strongly coloured noise a regression may find a tenth by chance, but then nothing grows.
        learnt = self.best is not None and self.best.share > (
            THRESHOLDS.learnt_share if self.growth.sigmas > 2 else THRESHOLDS.learnt_plenty
        )
        learnt |= any(k.share > THRESHOLDS.learnt_plenty for k in self.shown)
        return self.growth.sigmas > THRESHOLDS.growth_sigmas or self.growth.chi_short > THRESHOLDS.coarse_residual or learnt

    @property
    def remains(self) -> bool:
        """And more than an integrator leaves?"""
        return self.coherent and self.share > THRESHOLDS.slight_force

    @property
    def hides(self) -> bool:
        """Does it go with something, or grow beyond the horizon, and take more than an integrator leaves?"""
        slight = self.share <= THRESHOLDS.slight_force
        return not slight if self.lack is not None else self.wide is not None and (self.wide.remains or self.wide.hides)

    @property
    def doubt(self) -> str | None:
        """Why what was fitted may be a stand-in, in words."""
        best = self.best
        # An integrator leaves a little that the present explains.
        if self.coherent and (self.share > THRESHOLDS.faint_force or (best and best.memory > THRESHOLDS.learnt_share)):
            kind = max(best.kinds, key=lambda k: best.kinds[k]) if best and best.share > THRESHOLDS.learnt_share else None
            looks = f"; it looks like {KINDS.get(kind, kind)}" if kind else ""
            size = (
                f"{100 * self.share:.2g} % of the effort" if self.share < THRESHOLDS.no_effort else "more than any effort here"
            )
            return f"inadequate: a residual of {size} is left that is not noise{looks}"
        if self.lack is not None:
            return f"inadequate: what is left goes with {self.lack.kind} ({self.lack.sigmas:.2g} standard deviations of noise)"
        return None if self.wide is None else self.wide.doubt


def left(model: Model, last: Fit, horizon: float = 0.0, seed: int = 0) -> Left:
    """What the final fit leaves; model: with the causes at their fitted numbers, for slopes and for the force of the effort.

    horizon: the longest in s over which the answer is to hold.
    """
    last, m = rescued(last), last.windows.measured
    long, short = _tangents(model, last)
    found = _judged(long, short, seed)
    if found.remains and m.rough.any():
        smooth = _judged(_smoothed(long), _smoothed(short), seed)
        found = found if smooth.remains else smooth
    windows = None if found.doubt is not None else last.windows.wide(horizon)
    if windows is None:
        return found
    wide = rescued(fit(last.hypothesis, windows, theta=last.theta))
    return replace(found, wide=_judged(*_tangents(model, wide), seed))


def _tangents(model: Model, last: Fit) -> tuple[Tangent, Tangent]:
    """About a fit in its windows, and about the same in short ones."""
    m = last.windows.measured
    brief = m.windows(min(m.brief(THRESHOLDS.short_window), last.windows.length))
    again = rescued(fit(last.hypothesis, brief, theta=last.theta, iterations=5))
    return Tangent.of(model, last), Tangent.of(model, again)


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
    share, shown = _share(long, coordinates, max(excess)), tuple[Learnt, ...]()
    if loud := _loud(long, short):
        shown = tuple(max((learn_shown(m, c) for m in (short, long)), key=lambda k: k.share) for c in loud)
        own = {c: max(k.share * square, float(grown.excess[c])) for (c, square), k in zip(loud.items(), shown, strict=True)}
        own |= {c: square for c, square in loud.items() if square > THRESHOLDS.coarse_residual}
        share = max(share, *(_share(long, coordinates, size, c) for c, size in own.items()))
    found = Left(long, short, grown, learnt, share, shown=shown)
    if found.best in shown and found.coherent:
        found = replace(found, share=math.inf)  # no small force makes it
    if found.coherent and found.share > THRESHOLDS.faint_force:
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


def _loud(long: Tangent, short: Tangent) -> dict[int, float]:
    """Mean squares of the channels that are above their noise in short windows and in long ones.

    Where an input jumps, a channel that shows it at once does so, too, and what is taken for its noise is too much: the noise
    is no more than what varies from sample to sample in the residual, jumps aside.
    """
    rows, rough = [m.residual.reshape(m.windows.y.shape) for m in (short, long)], long.windows.measured.rough
    floor = np.where(
        rough > 0 if rough.size else False, 1.0, np.fmin([scatter(list(c)) for c in rows[1].transpose(2, 0, 1)], 1.0)
    )
    least = np.minimum(*(np.mean(r**2, axis=(0, 1)) for r in rows))
    return {c: float(v) for c, v in enumerate(least) if v > (THRESHOLDS.loud_channel * floor[c]) ** 2}


def _share(motion: Tangent, sites: tuple[str, ...], excess: float, channel: int | None = None) -> float:
    """Force over effort, at the coordinate where least force leaves a mean square `excess`, of one channel or summed over all;
    infinite where no force shows."""
    shares: list[float] = [math.inf]
    for site in sites:
        made = motion.responses(site, motion.effort(site)[..., None]).reshape(motion.windows.y.shape) ** 2
        of_effort = float(np.mean(made) * motion.windows.y.shape[2] if channel is None else np.mean(made[..., channel]))
        shares.append(math.sqrt(excess / max(of_effort, 1e-300)))
    return min(shares)


def verdict(
    causes: int,
    found: Left,
    last: Fit,
    nothing: Fit,
    undecided: bool,
    doubted: bool,
    near: Callable[[float], bool],
    rest: float = 0.0,
) -> Verdict:
    """causes: how many are named; nothing: the fit without them; undecided: are there rivals that an experiment tells apart?

    doubted: has a cause a number that is not plausible, or is nothing of the motion followed, however little force would do so?
    near: are held-out rollouts within noise, or within such a share of the motion? rest: of the excess over noise that these
    have without causes, what these leave. Causes have to leave little, of the excess over noise and of the motion, to be the
    answer where something is left beside them.
    """
    few, quiet = THRESHOLDS.adequate_rest, bool((np.sqrt(last.chi) <= THRESHOLDS.loud_channel).all())
    adequate = causes and (last.chi.mean() - 1 < few * (nothing.chi.mean() - 1) or (quiet and rest < few))
    if doubted or (found.remains and not adequate):
        return "unexplained"
    helped = causes and (adequate or rest < (1 - THRESHOLDS.little_force_share[0]) ** 2)
    if found.coherent and not last.windows.measured.exact and not near(THRESHOLDS.close_motion if helped else 0.0):
        return "unexplained"
    if not causes:
        silent = last.windows.measured.exact or not (found.hides or _astray(last) > THRESHOLDS.lack_sigmas)
        return "nothing" if silent else "unexplained"
    return "ambiguous" if undecided else "causes"


def doubts(causes: int, found: Left, last: Fit, settings: int = 0) -> tuple[str, ...]:
    """Why named causes may be stand-ins, as sentences; settings of an engine, among them, are no part of a composite."""
    out = [found.doubt] if causes and found.doubt is not None else []
    if causes and (far := _astray(last)) > THRESHOLDS.astray_sigmas:
        out.append(
            "inadequate: parameters that are no cause lie further from what is stated than their tolerances make likely "
            f"({far:.2g} standard deviations)"
        )
    if causes - settings >= THRESHOLDS.several_causes:
        out.append(f"composite: {causes - settings} causes together are often stand-ins for one law that the library lacks")
    return tuple(out)


def _astray(last: Fit) -> float:
    """How rare it is that parameters that are no cause lie so far from what is stated, as standard deviations of one number.

    d = θ − θ₀ has the covariance of the prior, and where noise is coloured, what that adds to the uncertainty of white noise.
    """
    h = last.hypothesis
    rows = np.isfinite(h.sd)
    more = max(1.0, float(last.chi.mean())) / float(last.whiteness.min()) - 1
    spread = np.diag(h.sd[rows] ** 2) + more * last.covariance[np.ix_(rows, rows)]
    d = (last.theta - h.value)[rows]
    return rare(float(d @ np.linalg.solve(spread, d)), len(d)) if rows.any() else 0.0


def unexplained(found: Left, events: tuple[Push, ...] = ()) -> Unexplained:
    """The kind of what is left, where it is, pushes that were found, and a formula where a law of the state would do."""
    where, best = _where(found.short), found.best
    if best is None:
        return Unexplained(False, events, where=where)
    # That none of them predicts anything is an answer as well.
    kinds = {n: share for n, share in best.kinds.items() if share > 0} or dict(best.kinds)
    if best.memory > THRESHOLDS.learnt_share:
        return Unexplained(True, events, looks_like=kinds, where=where)
    if best.share > THRESHOLDS.learnt_share and best in found.learnt:
        formulas = (correction(m, best.site) for m in (found.short, found.long))
        formula = max((f for f in formulas if f is not None), key=lambda f: f.explained, default=None)
        return Unexplained(False, events, looks_like=kinds, where=where, correction=formula)
    if best.share > THRESHOLDS.learnt_share:
        return Unexplained(False, events, looks_like=kinds, where=where)
    return Unexplained(False, events, kinds, where)


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


def evidence(found: Left) -> dict[str, dict[str, float]]:
    """Test → channel → number for the residual of the final model; tests of the missing force are by coordinate."""
    long, m = found.long, found.long.windows.measured
    r: Array = long.residual.reshape(long.windows.y.shape)
    brief: Array = found.short.residual.reshape(found.short.windows.y.shape)

    def by(values: Array) -> dict[str, float]:
        return dict(zip((c.name for c in m.channels), map(float, values), strict=True))

    out = {
        "mean square": by(np.mean(r**2, axis=(0, 1))),
        "mean square, short windows": by(np.mean(brief**2, axis=(0, 1))),
        "beyond coloured noise": by(found.growth.beyond),
        "autocorrelation": by(lag_one(r)),
        "size with time": by(_together(r**2, long.windows.t[:, None] + m.period * np.arange(r.shape[1]))),
    }
    for i, spec in enumerate(long.model.inputs):
        out[f"with {spec.name}"] = by(_leading(r, long.windows.u[..., i], m.history, m.samples(THRESHOLDS.leading_input)))
    felt = [s for s in long.model.sites("coordinate") if found.short.felt(found.short.probed(s).reshape(found.short.x.shape))]
    forces = {s: _Missing.of(found.short, s) for s in felt}
    seen = {s: f for s, f in forces.items() if f.seen}
    for i, spec in enumerate((*long.model.states, *long.model.inputs) if seen else ()):
        out[f"force with {spec.name}"] = {s: f.together(i) for s, f in seen.items()}
    memories = {s: v for s, f in seen.items() if (v := f.memory()) is not None}
    return out | ({"memory": memories} if memories else {})


def _leading(r: Array, u: Array, history: int, most: int) -> Array:
    """The largest correlation (ny,) of r (W, L, ny) with an input (W, H + L) that leads by up to `most` samples."""
    length, lags = r.shape[1], range(min(history, most) + 1)
    colour = _colour(r)
    found = [_together(r, u[:, history - k : history - k + length], colour) for k in lags]
    # The best of many lags is larger by chance: about as many of them are independent as fit into one correlation time.
    penalty = np.sqrt(2 * np.log(max(2.0, len(lags) ** 0.5)))
    return np.asarray(np.maximum(np.max(np.abs(found), axis=0) - penalty, 0.0))


def _colour(r: Array) -> Array:
    """Autocovariances (2·L, ny) of r (W, L, ny) about its mean."""
    waves = np.fft.rfft(r - r.mean(axis=(0, 1)), 2 * r.shape[1], axis=1)
    return np.asarray(np.fft.irfft(np.sum(np.abs(waves) ** 2, axis=0), 2 * r.shape[1], axis=0))


def _together(r: Array, z: Array, colour: Array | None = None) -> Array:
    """Correlation (ny,) of r (W, L, ny) with z (W, L), over its standard deviation if they were independent."""
    z = z - z.mean()
    of_z, of_r = _colour(z[..., None])[:, 0], _colour(r) if colour is None else colour
    norm = np.sqrt(of_r[0] * np.sum(z**2)) + 1e-300
    # Bartlett: the variance of the correlation is Σ ρ_r(k) ρ_z(k) / n.
    variance = np.maximum(of_z @ of_r / (of_z[0] * of_r[0] + 1e-300), 0.1) / z.size
    along = np.tensordot(z, r - r.mean(axis=(0, 1)))
    return np.asarray(along / norm / np.sqrt(variance))


@final
@dataclass(frozen=True)
class _Missing:
    """The force (W, P) that the residual asks for at a coordinate, constant over short pieces; noise: its variance from noise.

    z (W, P, nx + nu): state and input there; t (W, P) in s. The first and the last piece of a window can hide in its free
    start and take no part.
    """

    force: Array
    noise: float
    z: Array
    t: Array

    @classmethod
    def of(cls, tangent: Tangent, site: str) -> _Missing:
        steps = tangent.x.shape[1]
        count = min(max(3, round(steps * tangent.model.period / THRESHOLDS.constant_force)), steps)
        member = np.arange(steps) * count // steps
        pieces = np.tile(member[:, None] == np.arange(count), (len(tangent.x), 1, 1)).astype(np.float64)
        columns = tangent.responses(site, pieces)
        gram = np.swapaxes(columns, 1, 2) @ columns
        ridge = THRESHOLDS.force_ridge * np.mean(np.trace(gram, axis1=1, axis2=2)) / count * np.eye(count) + 1e-300
        inverse = np.linalg.inv(gram + ridge)
        force = (inverse @ (np.swapaxes(columns, 1, 2) @ tangent.residual[..., None]))[:, 1:-1, 0]
        noise = np.diagonal(inverse @ gram @ inverse, axis1=1, axis2=2)[:, 1:-1]
        places = np.array([int(np.mean(np.flatnonzero(member == p))) for p in range(1, count - 1)])
        z = np.concatenate([tangent.x[:, places], tangent.u[:, places]], axis=-1)
        return cls(force, float(np.mean(noise)), z, tangent.windows.t[:, None] + places * tangent.model.period)

    @property
    def seen(self) -> bool:
        """Does it vary by more than noise would make it?"""
        return self.force.size >= THRESHOLDS.force_pieces and float(np.var(self.force)) > THRESHOLDS.seen_force * self.noise

    def together(self, column: int) -> float:
        """Its correlation with a state or an input, in standard deviations."""
        return float(_together(self.force[..., None], self.z[..., column])[0])

    def memory(self) -> float | None:
        """How much of it differs between moments of nearly the same state and input; None where no state comes again.

        (½ E(f_i − f_j)² − noise) / (Var f − noise) over nearest neighbours j of i in (x, u) at other times.
        """
        f, t, z = self.force.ravel(), self.t.ravel(), self.z.reshape(self.force.size, -1)
        z = (z - z.mean(axis=0)) / (z.std(axis=0) + 1e-300)
        near: list[list[int]] = np.asarray(KDTree(z).query(z, k=min(len(f), THRESHOLDS.state_neighbours))[1]).tolist()
        nearest = ((i, next((j for j in row if abs(t[i] - t[j]) > THRESHOLDS.recurrence), None)) for i, row in enumerate(near))
        pairs = [(i, j) for i, j in nearest if j is not None]
        if len(pairs) < THRESHOLDS.force_pieces:
            return None
        first, second = (f[list(side)] for side in zip(*pairs, strict=True))
        differ = 0.5 * float(np.mean((first - second) ** 2))
        return float(np.clip((differ - self.noise) / (np.var(f) - self.noise), 0.0, 1.0))
