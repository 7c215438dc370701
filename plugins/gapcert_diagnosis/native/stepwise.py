"""Which native parameters and settings: screened, fitted, added one by one while the trajectories agree that it pays."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, final

import numpy as np
from scipy.stats import norm

from gapcert.plugin import Array, GapcertError
from gapcert_diagnosis.search.criterion import agreement
from gapcert_engines import NativeModel

from .candidates import Nominee
from .response_surface import SMALLEST, Surface, descend
from .rollouts import Motions, Scores, score

MOST = 3  # causes; more than that are stand-ins
LOOK, FEW = 8, 24  # trajectories on which all values are tried, and on which the best of some nominees
SEEN = 4  # nominees that are screened on the larger number
SHIFTS = (-0.2, 0.0, 0.2)  # of the last number, in its coordinate: it may have stood in for a setting
SHORTLIST = 3  # nominees that get a fit after screening
FIRST, FULL = 2, 2  # rounds of a fit to some and to all trajectories
FALL = 0.02  # nats: least mean fall of the score; 2 % of all errors
HOPE = FALL / 4  # before the other numbers have followed: less is not looked into further
EXACT = FALL / 2  # how well a surface has to tell the score at its minimum
SHARE = 0.01  # least fall of the error over the longest horizon, whose square counts wild motions in full
CHANCE = 0.01  # that any of the nominees is named without a reason
NEAR = 10.0  # z²: nearer ones are both fitted to all trajectories
PLAIN = 0.2  # nats: what needs no further trajectories
SAME = 1e-9  # nats: scores that are one and the same
AHEAD = 0.25  # first radius of a fit

Causes = tuple[Nominee, ...]


@final
@dataclass(frozen=True)
class Fitted:
    """A set of causes at its best: `model` has them set, scores (trajectories,) are what that gives; surface: around it."""

    causes: Causes
    model: NativeModel
    scores: Array
    z: Array = field(default_factory=lambda: np.empty(0))
    surface: Surface | None = None

    @property
    def mean(self) -> float:
        return float(self.scores.mean())

    def interval(self, index: int, seed: int) -> tuple[float, float]:
        """95 % of the resampled minima of one free number, in its coordinate."""
        assert self.surface is not None, "a fit of free numbers has a surface"
        low, high = np.quantile(self.surface.bootstrap(seed)[:, index], [0.025, 0.975]).tolist()
        # What the trajectories do not tell, the resolution of the surface does not tell either.
        least = 0.1 * float(self.surface.radius[index])
        return min(low, float(self.z[index]) - least), max(high, float(self.z[index]) + least)


@final
class Contest:
    """Sets of causes on the fitted trajectories. `tell` hears what is tried; every score is kept in `store`."""

    def __init__(
        self,
        model: NativeModel,
        motions: Motions,
        entries: Sequence[Nominee],
        horizons: Sequence[float],
        store: Scores,
        tell: Callable[..., None],
    ) -> None:
        self.model, self.motions, self.entries = model, motions, tuple(entries)
        self.horizons, self.store, self.tell = tuple(horizons), store, tell
        self.few, self.look = motions.some(FEW), motions.some(LOOK)
        self.twins: dict[str, list[str]] = {}
        self.negligible: dict[tuple[str, str], float] = {}
        self.rivals: dict[tuple[str, str], Fitted] = {}
        self.fits: dict[frozenset[str], Fitted] = {}
        self.nothing = self.plain(model, ())
        self.margin = norm.isf(CHANCE / max(1, len(self.entries)))

    def _best(self) -> dict[str, Any]:
        """The set with the least mean score so far: what one sees meanwhile."""
        if not self.fits:
            return {}
        best = min(self.fits.values(), key=lambda f: float(f.scores.mean()))
        return {
            "best": _named(best.causes),
            "score": round(float(best.scores.mean()), 4),
            "of nothing": round(float(self.nothing.scores.mean()), 4),
        }

    def scores(self, model: NativeModel, motions: Motions | None = None) -> Array:
        """(trajectories,)"""
        m = motions or self.motions
        return score(self.store.errors(m, model, self.horizons))

    def errors(self, model: NativeModel) -> Array:
        """(trajectories, horizons, groups, 3), horizons from short to long."""
        return self.store.errors(self.motions, model, self.horizons)

    def plain(self, model: NativeModel, causes: Causes) -> Fitted:
        return Fitted(causes, model, self.scores(model))

    def found(self) -> Fitted:
        """Forward steps; then each cause has to be worth its place beside the others."""
        best = self.nothing
        while len(best.causes) < MOST and (new := self.step(best)) is not None:
            best = new
        return self.dropped(best)

    def step(self, best: Fitted) -> Fitted | None:
        """The best set with one cause more, if the trajectories agree that it pays; the next best becomes its rival."""
        if not (tried := self.shortlist(best)):
            return None
        near = [f for f in tried[:2] if agreement(f.scores - tried[0].scores) ** 2 < NEAR or f is tried[0]]
        hopeful = [f for f in near if best.mean - float(self.scores(f.model).mean()) > HOPE]
        full = sorted((self.fit(f.causes, f, FULL) for f in hopeful), key=lambda f: f.mean)
        if not full or not self.pays(full[0], best):
            return None
        winner, new = full[0], full[0].causes[-1]
        if others := [f for f in (*full[1:], *tried) if f.causes[-1].key != new.key]:
            known = len(others[0].scores) == len(winner.scores)
            self.rivals[new.key] = others[0] if known else replace(others[0], scores=self.scores(others[0].model))
        return winner

    def shortlist(self, best: Fitted) -> list[Fitted]:
        """Fits, to some of the trajectories, of the most promising nominees, best first."""
        before = float(self.scores(best.model, self.few).mean())
        screened: list[tuple[float, Nominee, float]] = []
        for _, n, value in self._looked(best)[:SEEN]:
            for _, model in self._variants(best, n, (value,)):
                screened.append((float(self.scores(model, self.few).mean()), n, value))
                self._closed(n, model)
        screened.sort(key=lambda s: s[0])
        picks = [s for s in screened if s[0] < before - HOPE][:SHORTLIST]
        out = [f for _, n, value in picks if not _tolerated(f := self._first(best, n, value))]
        return sorted(out, key=lambda f: float(self.scores(f.model, self.few).mean()))

    def _looked(self, best: Fitted) -> list[tuple[float, Nominee, float]]:
        """(score of a few trajectories, nominee, its best value), best first; of values of a setting that do the same, one."""
        before = float(self.scores(best.model, self.look).mean())
        found: list[tuple[float, Nominee, float]] = []
        rows: dict[str, tuple[float, ...]] = {}
        for n in self.entries:
            if n.key in {c.key for c in best.causes}:
                continue
            self.tell(f"{n.effect}: {n.label}")
            tried = []
            for value, model in self._variants(best, n, n.values or SHIFTS):
                tried.append((float(self.scores(model, self.look).mean()), value))
                self._closed(n, model)
            rows[n.label] = tuple(s for s, _ in tried)
            if not tried or self._twin(n, rows, before):
                continue
            least, value = min(tried, key=lambda t: t[0])
            alike = any(e.key == n.key and n.option is not None and abs(s - least) < HOPE for s, e, _ in found)
            if least < before - SAME and not alike:
                found.append((least, n, value))
        return sorted(found, key=lambda s: s[0])

    @staticmethod
    def _closed(n: Nominee, model: NativeModel) -> None:
        if n.option is not None:
            model.backend.close()

    @staticmethod
    def _variants(best: Fitted, n: Nominee, values: Sequence[float]) -> list[tuple[float, NativeModel]]:
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

    def _twin(self, n: Nominee, rows: dict[str, tuple[float, ...]], before: float) -> bool:
        """Does a nominee do, value for value, what an earlier one of its effect does?"""
        row = np.array(rows[n.label])
        if not len(row) or np.abs(row - before).max() < SAME:
            return False
        for e in self.entries:
            if e.key == n.key and e.label != n.label and n.option is None and len(known := rows.get(e.label, ())) == len(row):
                same = np.abs(np.array(known) - row) < SAME
                # What only one of them can do (the smaller of two counts) leaves the other where it was.
                if np.all(same) or (np.any(same) and np.all(same | (np.abs(row - before) < SAME))):
                    self.twins.setdefault(e.native, []).append(n.native)
                    return True
        return False

    def _first(self, best: Fitted, n: Nominee, value: float) -> Fitted:
        ((_, start),) = self._variants(best, n, (value,))
        causes = (*best.causes, n)
        return self.fit(causes, Fitted(causes, start, np.empty(0), surface=best.surface), FIRST, self.few)

    def fit(self, causes: Causes, start: Fitted, rounds: int, motions: Motions | None = None) -> Fitted:
        """All free numbers of the causes together, from where `start` has them; to all trajectories or to those given."""
        key = frozenset(c.label for c in causes)
        if motions is None and key in self.fits:
            return self.fits[key]
        m = motions or self.motions
        free = [c for c in causes if c.option is None and c.parameter is not None]
        self.tell(_named(causes), self._best())
        out = self._fitted(causes, free, start, rounds, m) if free else Fitted(causes, start.model, self.scores(start.model, m))
        if motions is None:
            self.fits[key] = out
        return out

    def _fitted(self, causes: Causes, free: Sequence[Nominee], start: Fitted, rounds: int, m: Motions) -> Fitted:
        def at(z: Array) -> NativeModel:
            return start.model.restated({c.native: c.back(v) for c, v in zip(free, z.tolist(), strict=True)})

        now = {p.name: p.value for p in start.model.parameters}
        same = start.causes == causes and len(start.z) == len(free)  # the point that was judged, to the last bit
        first = start.z if same else np.array([c.to(now[c.native]) for c in free])
        bounds = [_bounds(c) for c in free]
        radius = np.full(len(free), AHEAD)
        if (s := start.surface) is not None:  # numbers that were known before come first
            known = s.radius if len(s.radius) <= len(free) else s.radius.max()
            radius[: len(s.radius)] = np.clip(known, 2 * SMALLEST, AHEAD)
        enough = None if start.surface is None else EXACT
        z, surface = descend(lambda p: self.scores(at(p), m), first, bounds, radius, rounds, enough)
        return Fitted(causes, at(z), self.scores(at(z), m), z, surface)

    def pays(self, new: Fitted, old: Fitted) -> bool:
        """Do trajectories that the numbers were not fitted to agree, and is it worth a name?"""
        gained, share = self.gained(new, old)
        seen = agreement(gained) > self.margin
        if seen and gained.mean() > 0 and not (gained.mean() > FALL and share > SHARE):
            self.negligible[new.causes[-1].key] = share
        return bool(seen and gained.mean() > FALL and share > SHARE)

    def gained(self, new: Fitted, old: Fitted) -> tuple[Array, float]:
        """Fall of the score (trajectories,), and share of the error over the longest horizon.

        Each half of the trajectories is judged at the numbers that the other half asks for.
        """
        m, before, after = self.motions, self.errors(old.model), self.errors(new.model)
        free = [c for c in new.causes if c.option is None and c.parameter is not None]
        halves = np.arange(len(after)) % 2
        for half in (0, 1) if new.surface is not None else ():
            assert new.surface is not None
            z = new.surface.minimum((halves != half).astype(np.float64))
            model = new.model.restated({c.native: c.back(v) for c, v in zip(free, z.tolist(), strict=True)})
            judged = np.flatnonzero(halves == half)
            after[judged] = self.store.errors(m.take(judged.tolist()), model, self.horizons)
        size = [math.sqrt(float(np.mean(e[:, -1, :, 0] / m.spread**2))) for e in (before, after)]
        return score(before) - score(after), 1 - size[1] / max(size[0], 1e-300)

    def dropped(self, best: Fitted) -> Fitted:
        """Without causes that a later one made superfluous."""
        for c in best.causes[:-1]:
            rest = self.without(best, c)
            if not self._plain(best, rest) and not self.pays(best, rest):
                self.rivals.pop(c.key, None)
                return self.dropped(replace(rest, scores=self.scores(rest.model)))
        return best

    def _plain(self, new: Fitted, old: Fitted) -> bool:
        """Is it so much better that some of the trajectories say enough?"""
        gained = self.scores(old.model, self.few) - self.scores(new.model, self.few)
        return bool(gained.mean() > PLAIN and agreement(gained) > self.margin)

    def without(self, fitted: Fitted, c: Nominee) -> Fitted:
        """The other causes alone, their numbers fitted again; settings alone are not scored."""
        rest = tuple(k for k in fitted.causes if k is not c)
        stated = {p.name: p.value for p in self.model.parameters}
        if c.option is not None:
            model = self.model.restated(fitted.model.values)
            for k in rest:
                model = model.set(k.option) if k.option is not None else model
        else:
            model = fitted.model.restated({c.native: stated[c.native]})
        start = Fitted(rest, model, np.empty(0), surface=fitted.surface)
        return start if rest and all(k.option is not None for k in rest) else self.fit(rest, start, FIRST)


def _tolerated(fitted: Fitted) -> bool:
    """Is what the last cause changes within the tolerance that was stated?"""
    p = fitted.causes[-1].parameter
    return p is not None and abs(fitted.model.values[p.name] - p.value) <= p.tolerance


def _bounds(c: Nominee) -> tuple[float, float]:
    assert c.parameter is not None
    p = c.parameter
    low = c.to(p.low) if np.isfinite(p.low) and not c.logarithmic else -np.inf
    if c.logarithmic:
        low = math.log(max(p.low / p.value, 1e-4))
    return low, c.to(p.high) if np.isfinite(p.high) else np.inf


def _named(causes: Causes) -> str:
    return " + ".join(f"{c.effect}: {c.label}" for c in causes) or "no cause"
