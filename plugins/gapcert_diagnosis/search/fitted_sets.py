"""Sets of causes on some windows: each fitted once, and what screening promises beside it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import final

import numpy as np

from gapcert_diagnosis.data.dataset import Windows, once
from gapcert_diagnosis.fitting.fit import Fit, carried, fit, promising, rescued
from gapcert_diagnosis.fitting.rollout_error import Stretches
from gapcert_diagnosis.thresholds import THRESHOLDS

from .candidates import Candidate, Causes, Library
from .criterion import Found, Keys, better, decides, halves, keys, named, noise, pays, rough_charge, without
from .gains import Promise
from .screening import Screen, standing_in

Promised = tuple[list[Promise], list[Promise]]


def untold(text: str, best: Mapping[str, str] | None = None, fitted: bool = True) -> None:
    """Progress that nobody follows."""


@final
class FittedSets:
    """Sets of causes on some windows, each fitted once to long windows and once to short ones, into which these are cut.

    cautious: rough fits are judged by what the windows agree on, not by how many samples they have. added: sets → fits of these
    with one move more. lost: sets that are so far behind on short windows that long ones do not matter; negligible: (effect,
    site) → share of the effort of what was met and found too small.
    """

    def __init__(
        self,
        library: Library,
        windows: Windows,
        progress: Callable[..., None] = untold,
        plain: Fit | None = None,
        like: FittedSets | None = None,
    ) -> None:
        """plain: the fit of nothing, where it is known; like: the same on the same windows, with inputs held another way."""
        self.library, self.windows, self.progress, self.like = library, windows, progress, like
        self.parts = max(1, windows.length // windows.measured.brief(THRESHOLDS.short_fit_window))
        self._fits: dict[Keys, Found] = {}
        self._brief: dict[Keys, Fit] = {}
        self._promised: dict[tuple[Keys, tuple[str, str] | None], Promised] = {}
        self.added: dict[Keys, list[Found]] = {}
        self.cautious = False
        self.lost: set[Keys] = set()
        self.negligible: dict[tuple[str, str], float] = {}
        self.nothing = self.fit((), None) if plain is None else self._keep((), plain)

    @cached_property
    def screen(self) -> Screen:
        return Screen(self.library, self.windows, self.nothing, lambda text: self.progress(text, self._so_far(), fitted=False))

    @cached_property
    def far(self) -> Stretches | None:
        """Rollouts of all fitted data over the longest horizon, where that is longer than usual windows."""
        measured, horizon = self.windows.measured, self.library.horizon
        if horizon <= THRESHOLDS.window or not Stretches.fits(measured, horizon):
            return None
        return Stretches.of(measured, horizon)

    @cached_property
    def short(self) -> Windows:
        return self.windows.cut(self.parts)

    def _so_far(self) -> dict[str, str]:
        """The set with the least error on the fitted windows, and the share of it that is left: what one sees meanwhile."""
        tried = [found for found in self._fits.values() if found[0]]
        if not tried or (before := float(self.nothing.chi.sum())) <= 0:
            return {}
        causes, least = min(tried, key=lambda found: float(found[1].chi.sum()))
        return {"best": named(causes), "error left": f"{math.sqrt(float(least.chi.sum()) / before):.0%}"}

    def fit(self, causes: Causes, base: Found | None, start: Mapping[str, float] | None = None) -> Fit:
        """On long windows, kept; from `start`, or from `base`, the fit of a set that differs little, and from screening."""
        if keys(causes) not in self._fits:
            self.progress(f"trying {named(causes)}", self._so_far())
            if (near := self._alike(causes)) is not None:
                self._keep(causes, fit(near.hypothesis, self.windows, theta=near.theta, start=near.start))
            else:
                self.fit_again(causes, base, start)
        return self._fits[keys(causes)][1]

    def _alike(self, causes: Causes) -> Fit | None:
        """The fit of the same set where inputs are held another way: half a sample of them moves it little."""
        return None if self.like is None else self.like.known(causes)

    def known(self, causes: Causes) -> Fit | None:
        """The fit of a set, if it was ever made."""
        return self._fits[keys(causes)][1] if keys(causes) in self._fits else None

    def fit_again(self, causes: Causes, base: Found | None, start: Mapping[str, float] | None = None) -> Fit:
        """A fit from other first values; the better one is kept."""
        h, known = self.library.hypothesis(causes), {} if base is None else base[1].values
        if base is not None and start is None:
            start = self._first(causes, base)
        fewer = base is not None and keys(causes) < keys(base[0]) and len(base[1].start) == len(self.windows)
        theta = h.theta({**known, **(start or {})})
        return self._keep(causes, fit(h, self.windows, theta=theta, start=base[1].start if base and fewer else None))

    def fit_from(self, causes: Causes, other: Fit) -> Fit:
        """The fit of a set from its numbers on other windows; starts that are not known from there follow these first."""
        if keys(causes) not in self._fits:
            h = self.library.hypothesis(causes)
            theta = h.theta(other.values)
            closest = min((f for _, f in self._fits.values()), key=lambda f: float(f.chi.sum()))
            start = carried(h, theta, other, self.windows, closest.start)
            self._keep(causes, fit(h, self.windows, theta=theta, start=start))
        return self._fits[keys(causes)][1]

    def _keep(self, causes: Causes, made: Fit) -> Fit:
        """The better one of what was known, and of this once its lost windows are led back, and its edges moved."""
        new, old = self._further(causes, rescued(made)), self.known(causes)
        if old is None or self.better(new, old) > 0:
            self._fits[keys(causes)] = causes, new
        return self._fits[keys(causes)][1]

    def _further(self, causes: Causes, made: Fit) -> Fit:
        """Fitted again while a level or a force ends at the edge of what is tried, with that edge further out."""
        for _ in range(THRESHOLDS.moved_edges):
            h = self.library.further(causes, made)
            if h is None:
                break
            made = fit(h, self.windows, theta=made.theta, start=made.start)
        return made

    def fit_shaken(self, causes: Causes, base: Found) -> Fit:
        """The best of a fit and of fresh ones from nearby: sticking puts kinks into the cost, and a fit may catch on one."""
        best, dry = self.fit(causes, base), self.library.dry(causes)
        for factor in THRESHOLDS.shakes if dry and not noise(best) and self._alike(causes) is None else ():
            shaken = {n: v * factor if n in dry else v for n, v in best.values.items()}
            self.fit_again(causes, None, shaken)
        for c in causes:
            tried = [best.values]
            while (
                not noise(best) and len(tried) < THRESHOLDS.needles and (start := self._elsewhere(c, best, tried)) is not None
            ):
                tried.append(start)
                best = self.fit_again(causes, None, start)
        return self._fits[keys(causes)][1]

    def _elsewhere(self, c: Candidate, best: Fit, tried: Sequence[Mapping[str, float]]) -> dict[str, float] | None:
        """The numbers of a fit with the most promising of those that data suggest for a cause, away from all that were tried.

        Each optimum is narrow, and has others near it.
        """
        names, h, known = self.library.names(c), best.hypothesis, best.values
        rows = [dict(zip(names, row, strict=True)) for row in self.library.suggested(c)]
        apart = {n: 12 * h.step[h.names.index(n)] for n in self.library.needles(c)}
        rows = [r for r in rows if all(any(abs(r[n] - t[n]) > d for n, d in apart.items()) for t in tried)]
        if not rows:
            return None
        turned = [r | {n: sign * r[n] for n in [names[self.library.amplitude(c) or 0]]} for r in rows for sign in (1, -1)]
        theta = promising(h, self.windows, np.array([h.theta(known | r) for r in turned]), best.start)[0]
        return dict(zip(h.names, theta.tolist(), strict=True))

    def brief(self, base: Found) -> Fit:
        """The set of a long fit, fitted to the short windows."""
        h, theta = base[1].hypothesis, base[1].theta
        return once(self._brief, keys(base[0]), lambda: fit(h, self.short, theta=theta, iterations=THRESHOLDS.first_fit))

    def fits(self, base: Found) -> list[tuple[Fit, int]]:
        """Of a set to long and to short windows, and how many of these a long one has."""
        return [(base[1], 1), (self.brief(base), self.parts)]

    def try_move(self, base: Found, s: Promise, iterations: int = THRESHOLDS.first_fit) -> Fit:
        """A set with a move more, fitted to the short windows from what is promised."""
        h, brief = self.library.hypothesis((*base[0], *s.move)), self.brief(base)
        theta = h.theta(brief.values | dict(s.values))
        start = h.guessed(self.short, theta, brief.start) if s.start is None else s.start
        return fit(h, self.short, theta=theta, start=start, iterations=iterations)

    def fit_further(self, first: Fit, iterations: int = THRESHOLDS.second_fit) -> Fit:
        """A fit to the short windows, gone on with."""
        return fit(first.hypothesis, self.short, theta=first.theta, start=first.start, iterations=iterations)

    def promises(self, base: Found, instead: Candidate | None = None) -> Promised:
        """All moves by their promise on short and on long windows; of very many those that could stand for `instead`."""
        key = keys(base[0]), None if instead is None or len(self.library.candidates) < THRESHOLDS.crowd else instead.key
        if key not in self._promised:
            moves = [m for m in self.library.moves if not keys(m) & key[0]]
            if key[1] is not None:
                (table,) = self.screen.tables(self.fits(((), self.nothing))[1:])
                moves = standing_in(moves, table.beside(base[0]), key[1])
            long, short = self.screen.rank(self.fits(base), moves)
            self._promised[key] = short, long
        return self._promised[key]

    def promise(self, base: Found, c: Candidate) -> Promise | None:
        """Of one candidate beside a set."""
        known = [p for (k, instead), p in self._promised.items() if k == keys(base[0]) and instead]
        if (found := _first_of(known, c)) is not None:
            return found
        if not base[0] and len(self.library.candidates) >= THRESHOLDS.crowd:
            # The pile has entered all of them.
            (table,) = self.screen.tables(self.fits(base)[1:], (c,))
            return table.promise((c,))
        return _first_of([self.promises(base)], c)

    def _first(self, causes: Causes, base: Found) -> dict[str, float]:
        """What screening promises for the causes that the base lacks."""
        out: dict[str, float] = {}
        for c in causes:
            if c.key not in keys(base[0]):
                found = self.promise(base, c) or self.promise(((), self.nothing), c)
                names = self.library.names(c)
                out |= found.values if found else dict(zip(names, self.library.starts(c)[0].tolist(), strict=True))
        return out

    def carry(self, old: Candidate, new: Candidate, found: Found, default: bool = True) -> dict[str, float]:
        """First values of one law from those of another that it contains, or that contains it."""
        fitted = found[1].values
        if old.effect.contains.get(new.told[0]) == {}:
            return self._best_start(new, (*without(found[0], (old,)), new), found[1])
        mine, theirs = ({p.name: n for n, p in self.library.parameters(c).items()} for c in (new, old))
        out: dict[str, float] = self._first((new,), ((), self.nothing)) if default else {}
        for m, t in new.effect.contains.get(old.effect.name, {}).items():
            out[mine[m]] = fitted[theirs[t]]
        for t, m in old.effect.contains.get(new.effect.name, {}).items():
            out[mine[m]] = fitted[theirs[t]]
        return out

    def _best_start(self, c: Candidate, causes: Causes, near: Fit) -> dict[str, float]:
        """Of a law in the place of one that only comes near it: the best of its first values, beside the other causes."""
        h, names = self.library.hypothesis(causes), self.library.names(c)
        rows = [dict(zip(names, row, strict=True)) for row in self.library.starts(c).tolist()]
        theta = promising(h, self.windows, np.array([h.theta(near.values | row) for row in rows]), near.start)[0]
        return {n: float(theta[h.names.index(n)]) for n in names}

    def better(self, new: Fit, old: Fit) -> float:
        return better(new, old, self.cautious)

    def pays(self, found: Found, before: Found) -> bool:
        return pays(found[1], before[1], *self.charges(found, before))

    def charges(self, found: Found, before: Found) -> tuple[float, float | None]:
        """What a larger set must bring: where samples are counted, and where a cautious search finds both fits rough."""
        return self.library.charge(), rough_charge(self.library, found[0], before[0]) if self.cautious else None

    def small(self, found: Found) -> dict[tuple[str, str], float]:
        """(effect, site) → share of the effort of causes that are too small to be named."""
        known = found[1].values
        shares = {c.key: self.screen.share(c, known) for c in found[0]}
        least = {c.key: THRESHOLDS.least_output if c.effect.site == "output" else THRESHOLDS.least_effort for c in found[0]}
        return {key: share for key, share in shares.items() if share < least[key]}

    def matters(self, found: Found) -> bool:
        """Is every cause larger than what an integrator may leave, or than a stated tolerance? What is not, is noted. Nor does
        a form of a law matter that does what a simpler one does.

        Where almost nothing rubs, a thousandth of the effort may be all that is wrong: then it decides what windows look like,
        or rollouts over the longest horizon.
        """
        small = {key: share for key, share in self.small(found).items() if not self.decides(found, key)}
        self.negligible |= small
        return not small and not any(self._plainer(c, found[1].values) for c in found[0])

    def _plainer(self, c: Candidate, values: Mapping[str, float]) -> bool:
        forms = (e for e in self.library.candidates if e.site == c.site and c.effect.contains.get(e.effect.name))
        return any(self.screen.adds(c, values, e) < THRESHOLDS.least_added for e in forms)

    def decides(self, found: Found, key: tuple[str, str]) -> bool:
        rest = self.fit(tuple(c for c in found[0] if c.key != key), found)
        return decides(found[1], rest) or (self.far is not None and halves(*(self.far.floors(f) for f in (found[1], rest))))


def _first_of(promised: Sequence[Promised], c: Candidate) -> Promise | None:
    """What is promised of one candidate alone, on long windows if it is known there."""
    return next((s for short, long in promised for s in (*long, *short) if keys(s.move) == {c.key}), None)
