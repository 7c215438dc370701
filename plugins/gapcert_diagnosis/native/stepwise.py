"""Which native parameters and settings: screened, fitted, added one by one while the trajectories agree that it pays.

Their numbers are fitted without derivatives: by quadratic response surfaces over rollouts, one per trajectory, so that the
minimum can be resampled.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, final

import numpy as np
from scipy.stats import norm

from gapcert.plugin import Array, GapcertError
from gapcert_diagnosis.data.dataset import once
from gapcert_diagnosis.search.criterion import agreement
from gapcert_diagnosis.search.selection import drop, forward
from gapcert_diagnosis.thresholds import THRESHOLDS
from gapcert_engines import NativeModel
from gapcert_figures import spoken

from .candidates import NativeCandidate
from .rollouts import ErrorStore, Motions, score

Causes = tuple[NativeCandidate, ...]


@final
@dataclass(frozen=True)
class NativeFit:
    """A set of causes at its best: `model` has them set, z are their free numbers, with the surface around these."""

    causes: Causes
    model: NativeModel
    z: Array = field(default_factory=lambda: np.empty(0))
    surface: Surface | None = None

    def interval(self, index: int, seed: int) -> tuple[float, float]:
        """95 % of the resampled minima of one free number, in its coordinate."""
        assert self.surface is not None, "a fit of free numbers has a surface"
        low, high = np.quantile(self.surface.bootstrap(seed)[:, index], [0.025, 0.975]).tolist()
        # What the trajectories do not tell, the resolution of the surface does not tell either.
        least = 0.1 * float(self.surface.radius[index])
        return min(low, float(self.z[index]) - least), max(high, float(self.z[index]) + least)


@final
class EngineSearch:
    """Stepwise selection (`Selection`) on the fitted trajectories. `tell` hears what is tried; errors are kept in `store`."""

    def __init__(
        self,
        model: NativeModel,
        motions: Motions,
        entries: Sequence[NativeCandidate],
        horizons: Sequence[float],
        store: ErrorStore,
        tell: Callable[..., None],
    ) -> None:
        self.model, self.motions, self.entries = model, motions, tuple(entries)
        self.horizons, self.store, self.tell = tuple(horizons), store, tell
        self.few, self.look = motions.some(THRESHOLDS.few_trajectories), motions.some(THRESHOLDS.look_trajectories)
        self.twins: dict[str, list[str]] = {}
        self.negligible: dict[tuple[str, str], float] = {}
        self.rivals: dict[tuple[str, str], NativeFit] = {}
        self.fits: dict[frozenset[str], NativeFit] = {}
        self.nothing = NativeFit((), model)
        self.margin = norm.isf(THRESHOLDS.named_by_chance / max(1, len(self.entries)))

    def _best(self) -> dict[str, Any]:
        """The set with the least mean score so far: what one sees meanwhile."""
        if not self.fits:
            return {}
        best = self.rank(list(self.fits.values()))[0]
        least, of_nothing = (round(self.mean(f.model), 4) for f in (best, self.nothing))
        return {"best": _named(best.causes), "score": least, "of nothing": of_nothing}

    def scores(self, model: NativeModel, motions: Motions | None = None) -> Array:
        """(trajectories,): of all of them; or of those given, by an engine that may be coarse."""
        if motions is None:
            return score(self.store.errors(self.motions, model, self.horizons))
        return score(self.store.errors(motions, model.coarse(), self.horizons))

    def mean(self, model: NativeModel, motions: Motions | None = None) -> float:
        return float(self.scores(model, motions).mean())

    def select(self) -> NativeFit:
        """Forward steps; then each cause has to be worth its place beside the others."""
        best = forward(self)
        # The last one has just paid beside the others.
        while (rest := drop(self, best, best.causes[:-1])) is not None:
            best = rest
        return best

    def key(self, found: NativeFit) -> frozenset[str]:
        return frozenset(c.label for c in found.causes)

    def grow(self, parent: NativeFit, width: int) -> list[NativeFit]:
        """The best set with one cause more; the next best becomes its rival."""
        tried = self.shortlist(parent)
        few = [self.scores(f.model, self.few) for f in tried]
        near = [
            f for f, s in zip(tried[:2], few, strict=False) if f is tried[0] or agreement(s - few[0]) ** 2 < THRESHOLDS.near_z2
        ]
        before, full = self.scores(parent.model), list[NativeFit]()
        for f in near:
            # A fit to all is not made for what plainly gains too little, or is plainly behind the fit before.
            scores = self.scores(f.model)
            behind = agreement(scores - self.scores(full[0].model)) if full else 0.0
            if hopeful(before - scores) and behind < math.sqrt(THRESHOLDS.near_z2):
                full.append(self.fit(f.causes, f, THRESHOLDS.full_rounds))
        full = self.rank(full)
        for key in (f.causes[-1].key for f in full[:width]):
            others = [f for f in (*full[1:], *tried) if f.causes[-1].key != key]
            self.rivals |= {key: others[0]} if others else {}
        return full[:width]

    def rank(self, found: Sequence[NativeFit]) -> list[NativeFit]:
        return sorted(found, key=lambda f: self.mean(f.model))

    def shortlist(self, best: NativeFit) -> list[NativeFit]:
        """Fits, to some of the trajectories, of the most promising candidates, best first."""
        before = self.mean(best.model, self.few)
        seen = [(n, self._try(best, n, (value,), self.few)) for _, n, value in self._screen(best)[: THRESHOLDS.seen_candidates]]
        screened = sorted(((s, n, value) for n, tried in seen for s, value in tried), key=lambda s: s[0])
        picks = [s for s in screened if s[0] < before - THRESHOLDS.contact_hope][: THRESHOLDS.fitted_candidates]
        out = [f for _, n, value in picks if not _tolerated(f := self._begin(best, n, value))]
        return sorted(out, key=lambda f: self.mean(f.model, self.few))

    def _screen(self, best: NativeFit) -> list[tuple[float, NativeCandidate, float]]:
        """(score of a few trajectories, candidate, its best value), best first; of values of a setting that are alike, one."""
        before = self.mean(best.model, self.look)
        found: list[tuple[float, NativeCandidate, float]] = []
        rows: dict[str, tuple[float, ...]] = {}
        for n in (n for n in self.entries if n.key not in {c.key for c in best.causes}):
            self.tell(f"screening {_named((n,))}")
            tried = self._try(best, n, n.values or THRESHOLDS.setting_shifts, self.look)
            rows[n.label] = tuple(s for s, _ in tried)
            if not tried or self._twin(n, rows, before):
                continue
            least, value = min(tried, key=lambda t: t[0])
            alike = any(
                e.key == n.key and n.option is not None and abs(s - least) < THRESHOLDS.contact_hope for s, e, _ in found
            )
            if least < before - THRESHOLDS.same_score and not alike:
                found.append((least, n, value))
        return sorted(found, key=lambda s: s[0])

    def _try(self, best: NativeFit, n: NativeCandidate, values: Sequence[float], m: Motions) -> list[tuple[float, float]]:
        """(score, value) of a candidate with some values."""
        out = []
        for value, model in self._variants(best, n, values):
            out.append((self.mean(model, m), value))
            if n.option is not None:
                model.close()
        return out

    @staticmethod
    def _variants(best: NativeFit, n: NativeCandidate, values: Sequence[float]) -> list[tuple[float, NativeModel]]:
        """(value, the model with it); values of a setting: shifts of the last number, if there is one."""
        if n.option is None:
            return [(v, best.model.restated({n.native: v})) for v in values]
        try:
            model = best.model.set(n.option)
        except GapcertError:  # not with the others
            return []
        if (last := next((c for c in reversed(best.causes) if c.parameter is not None), None)) is None:
            return [(0.0, model)]
        now = last.to(best.model.values[last.native])
        return [(v, model.restated({last.native: last.back(now + v)}) if v else model) for v in values]

    def _twin(self, n: NativeCandidate, rows: dict[str, tuple[float, ...]], before: float) -> bool:
        """Does a candidate do, value for value, what an earlier one of its effect does?"""
        row = np.array(rows[n.label])
        if not len(row) or np.abs(row - before).max() < THRESHOLDS.same_score:
            return False
        for e in self.entries:
            if e.key == n.key and e.label != n.label and n.option is None and len(known := rows.get(e.label, ())) == len(row):
                same = np.abs(np.array(known) - row) < THRESHOLDS.same_score
                # What only one of them can do (the smaller of two counts) leaves the other where it was.
                if np.all(same) or (np.any(same) and np.all(same | (np.abs(row - before) < THRESHOLDS.same_score))):
                    self.twins.setdefault(e.native, []).append(n.native)
                    return True
        return False

    def _begin(self, best: NativeFit, n: NativeCandidate, value: float) -> NativeFit:
        ((_, start),) = self._variants(best, n, (value,))
        causes = (*best.causes, n)
        return self.fit(causes, NativeFit(causes, start, surface=best.surface), THRESHOLDS.few_rounds, self.few)

    def fit(self, causes: Causes, start: NativeFit, rounds: int, motions: Motions | None = None) -> NativeFit:
        """All free numbers of the causes together, from where `start` has them; to all trajectories or to those given."""
        known = self.fits if motions is None else dict[frozenset[str], NativeFit]()
        return once(known, frozenset(c.label for c in causes), lambda: self._fitted(causes, start, rounds, motions))

    def _fitted(self, causes: Causes, start: NativeFit, rounds: int, motions: Motions | None) -> NativeFit:
        self.tell(f"trying {_named(causes)}", self._best())
        free, now = _free(causes), {p.name: p.value for p in start.model.parameters}
        if not free:
            return NativeFit(causes, start.model)
        same = start.causes == causes and len(start.z) == len(free)  # the point that was judged, to the last bit
        first = start.z if same else np.array([c.to(now[c.native]) for c in free])
        radius = np.full(len(free), THRESHOLDS.first_radius)
        if (s := start.surface) is not None:  # numbers that were known before come first
            known = s.radius if len(s.radius) <= len(free) else s.radius.max()
            radius[: len(s.radius)] = np.clip(known, 2 * THRESHOLDS.least_radius, THRESHOLDS.first_radius)
        enough = None if start.surface is None else THRESHOLDS.surface_error
        bounds, scores = (
            [c.bounds for c in free],
            lambda p: self.scores(_restated(start.model, free, p), motions or self.motions),
        )
        z, surface = descend(scores, first, bounds, radius, rounds, enough)
        return NativeFit(causes, _restated(start.model, free, z), z, surface)

    def outdoes(self, new: NativeFit, best: NativeFit) -> bool:
        """Do trajectories that the numbers were not fitted to agree, and is it worth a name?"""
        gained, share = self.gained(new, best)
        seen = agreement(gained) > self.margin
        if seen and gained.mean() > 0 and not (gained.mean() > THRESHOLDS.contact_fall and share > THRESHOLDS.contact_share):
            self.negligible[new.causes[-1].key] = share
        return bool(seen and gained.mean() > THRESHOLDS.contact_fall and share > THRESHOLDS.contact_share)

    def gained(self, new: NativeFit, old: NativeFit) -> tuple[Array, float]:
        """Fall of the score (trajectories,), and share of the error over the longest horizon.

        Each half of the trajectories is judged at the numbers that the other half asks for.
        """
        m = self.motions
        before, after = (self.store.errors(m, f.model, self.horizons) for f in (old, new))
        halves = np.arange(len(after)) % 2
        for half in (0, 1) if new.surface is not None else ():
            assert new.surface is not None
            z = new.surface.minimum((halves != half).astype(np.float64))
            model = _restated(new.model, _free(new.causes), z)
            judged = np.flatnonzero(halves == half)
            after[judged] = self.store.errors(m.take(judged.tolist()), model, self.horizons)
        size = [math.sqrt(float(np.mean(e[:, -1, :, 0] / m.spread**2))) for e in (before, after)]
        return score(before) - score(after), 1 - size[1] / max(size[0], 1e-300)

    def pays(self, found: NativeFit, rest: NativeFit) -> bool:
        """Is a set so much better than one that lacks a cause that some of the trajectories say enough, or do all agree?"""
        gained = self.scores(rest.model, self.few) - self.scores(found.model, self.few)
        return bool(gained.mean() > THRESHOLDS.plain_fall and agreement(gained) > self.margin) or self.outdoes(found, rest)

    def without(self, found: NativeFit, cause: NativeCandidate) -> NativeFit:
        """The other causes alone, their numbers fitted again; settings alone have none."""
        rest = tuple(k for k in found.causes if k is not cause)
        if cause.parameter is not None:
            model = found.model.restated({cause.native: cause.parameter.value})
        else:
            model = self.model.restated(found.model.values)
            for k in rest:
                model = model.set(k.option) if k.option is not None else model
        start = NativeFit(rest, model, surface=found.surface)
        return start if rest and all(k.option is not None for k in rest) else self.fit(rest, start, THRESHOLDS.few_rounds)


def hopeful(gained: Array) -> bool:
    """May falls of the score (trajectories,) come to what is worth a name, once numbers are fitted to all of these?"""
    mean, error = float(gained.mean()), float(np.std(gained, ddof=1)) / math.sqrt(len(gained))
    return mean > THRESHOLDS.contact_hope and mean + THRESHOLDS.sure_errors * error > THRESHOLDS.contact_fall


def _free(causes: Causes) -> list[NativeCandidate]:
    """Those with a number."""
    return [c for c in causes if c.parameter is not None]


def _restated(model: NativeModel, free: Sequence[NativeCandidate], z: Array) -> NativeModel:
    """With these numbers, given in the coordinates of their search."""
    return model.restated({c.native: c.back(v) for c, v in zip(free, z.tolist(), strict=True)})


def _tolerated(fitted: NativeFit) -> bool:
    """Is what the last cause changes within the tolerance that was stated?"""
    p = fitted.causes[-1].parameter
    return p is not None and abs(fitted.model.values[p.name] - p.value) <= p.tolerance


def _named(causes: Causes) -> str:
    return " and ".join(f"{spoken(c.effect)} ({c.label})" for c in causes) or "no cause"


@final
@dataclass(frozen=True)
class Surface:
    """c0 + c·d + ½ dᵀC d of d = z − centre per trajectory: coefficients (trajectories, terms), trusted within `radius`."""

    centre: Array
    radius: Array
    coefficients: Array

    @classmethod
    def of(cls, points: Array, scores: Array, centre: Array, radius: Array) -> Surface:
        """Least squares through points (k, p) with scores (k, trajectories)."""
        terms = _terms((points - centre) / radius)
        return cls(centre, radius, np.asarray(np.linalg.lstsq(terms, scores, rcond=None)[0].T, dtype=np.float64))

    def minimum(self, weights: Array | None = None) -> Array:
        """Of the mean surface (weights (trajectories,) or (r, trajectories)), within three radii: (p,) or (r, p)."""
        w = np.ones(len(self.coefficients)) if weights is None else weights
        mean = np.atleast_2d(w @ self.coefficients) / np.atleast_1d(w.sum(axis=-1))[:, None]
        out = np.stack([self._least(c) for c in mean])
        return np.asarray(self.centre + self.radius * (out[0] if w.ndim == 1 else out))

    def mean(self, point: Array) -> float:
        """What it tells of the mean at a point."""
        return float((_terms((point - self.centre)[None] / self.radius) @ self.coefficients.mean(axis=0))[0])

    def _least(self, c: Array) -> Array:
        p = len(self.centre)
        gradient, hessian = c[1 : 1 + p], np.zeros((p, p))
        for k, (i, j) in enumerate(itertools.combinations_with_replacement(range(p), 2)):
            hessian[i, j] += c[1 + p + k]
            hessian[j, i] += c[1 + p + k]
        values, vectors = np.linalg.eigh(hessian)
        slope = vectors.T @ gradient
        # Along a direction without a minimum, the way down is taken to the end of what was tried.
        step = np.where(
            values > THRESHOLDS.flat_curvature * max(np.abs(values).max(), 1e-300),
            -slope / np.where(values > 0, values, 1.0),
            -3.0 * np.sign(slope),
        )
        return np.asarray(np.clip(vectors @ np.clip(step, -3.0, 3.0), -3.0, 3.0))

    def bootstrap(self, seed: int) -> Array:
        """Minima (`resamples`, p) of surfaces whose trajectories are drawn again."""
        n = len(self.coefficients)
        drawn = np.random.default_rng(seed).multinomial(n, np.full(n, 1 / n), THRESHOLDS.resamples)
        return self.minimum(drawn.astype(np.float64))


def _terms(d: Array) -> Array:
    p = d.shape[1]
    squares = [d[:, i] * d[:, j] for i, j in itertools.combinations_with_replacement(range(p), 2)]
    return np.stack([np.ones(len(d)), *d.T, *squares], axis=1)


def design(p: int, *, lean: bool = False) -> Array:
    """Points (k, p) around 0 that fix a quadratic, the ends at ±1: 5, 9 or 15 and more; lean: as many as it has terms."""
    axes = np.concatenate([np.zeros((1, p)), np.eye(p), -np.eye(p)])
    if lean:
        pairs = [0.7 * (a + b) for a, b in itertools.combinations(np.eye(p), 2)]
        return np.concatenate([axes, *(pair[None] for pair in pairs)])
    if p == 1:
        return np.array([[-1.0], [-0.5], [0.0], [0.5], [1.0]])
    corners = np.array(list(itertools.product((-0.7, 0.7), repeat=p)))
    return np.concatenate([axes, corners])


def descend(
    evaluate: Callable[[Array], Array],
    start: Array,
    bounds: Sequence[tuple[float, float]],
    radius: float | Array,
    rounds: int,
    enough: float | None = None,
) -> tuple[Array, Surface]:
    """(the minimum, the last surface around it) of the mean of evaluate(z) (trajectories,), by shrinking surfaces.

    The radius halves while the minimum lies inside, down to about twice what resampling the trajectories moves it by. A surface
    whose minimum is worse than a point that made it (a dip, or chaos) is made again around that point, narrower, as often as
    there are rounds. enough: a start is near; surfaces have no more points than terms, and one that tells the mean at its
    minimum so well is the last.
    """
    low, high = (np.array(side) for side in zip(*bounds, strict=True))
    centre, size = np.clip(start, low, high), np.minimum(np.full(len(start), radius), THRESHOLDS.largest_radius)
    plan = design(len(start), lean=enough is not None)
    best, left = centre, rounds
    for _ in range(2 * rounds):
        points = np.clip(centre + plan * size, low, high)
        scores = np.stack([evaluate(z) for z in points])
        surface = Surface.of(points, scores, centre, size)
        new, tried = np.clip(surface.minimum(), low, high), scores.mean(axis=1)
        mean = float(evaluate(new).mean())
        if mean > tried.min() + THRESHOLDS.worse_centre:
            centre = best = points[tried.argmin()]
            size = np.maximum(size / THRESHOLDS.radius_shrink, THRESHOLDS.least_radius)
            continue
        left -= 1
        inside = (np.abs(new - centre) <= size).all()
        centre, best = (new, new) if inside else (np.clip(new, centre - 2 * size, centre + 2 * size), new)
        if left == 0 or (inside and enough is not None and abs(mean - surface.mean(new)) <= enough):
            break
        if inside:
            width = np.std(surface.bootstrap(0), axis=0)
            size = np.clip(np.maximum(size / THRESHOLDS.radius_shrink, 2 * width), THRESHOLDS.least_radius, size)
    return best, surface
