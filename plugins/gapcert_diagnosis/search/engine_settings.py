"""Settings of an engine as causes: a search under each that explains what effects and parameters leave, or that explains more
simply what they make of it."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import final

import numpy as np

from gapcert.plugin import Effect, Model, UsageError, Variant
from gapcert_diagnosis.data.dataset import Windows, once
from gapcert_diagnosis.fitting.fit import Fit, fit, followed, stepped
from gapcert_diagnosis.thresholds import THRESHOLDS

from .candidates import Candidate, Causes, Library
from .criterion import Found, better, noise, setting_pays, without
from .fitted_sets import FittedSets
from .moves import additions
from .stepwise import confirms, search_windows

Tried = tuple[Variant, Causes, Fit]
Numbers = dict[str, float]


@final
@dataclass(frozen=True)
class Setting:
    """A setting that was found: what it changes, the library without it, and what else came next (margin ΔS)."""

    variant: Variant
    before: Library
    runner_up: Variant | None
    margin: float


@final
@dataclass(frozen=True)
class Settled:
    """What a search found under the settings that explain the data best."""

    search: FittedSets
    found: Found
    settings: tuple[Setting, ...]


def across(
    library: Library, effects: Sequence[Effect], windows: Windows, tell: Callable[..., None], like: FittedSets | None = None
) -> Settled:
    """The search of `stepwise.search_windows`, like another one, and again under settings with which the score is better.

    A setting has no number, but was chosen among as many as there are: it pays as a cause does, unless it takes the place of
    causes, which pay for their numbers already.
    """
    under = _Settings(library, effects, windows, tell)
    variants = library.model.variants()
    if not variants or (plain := fit(library.hypothesis(()), under.earlier)).chi.max() < THRESHOLDS.quiet:
        return Settled(*search_windows(library, windows, tell, plain if variants else None, like), ())
    alone = under.rank(variants, ())
    if (at_once := under.at_once(variants, alone, plain)) is not None:
        return at_once
    settled = Settled(*search_windows(library, windows, tell, plain), ())
    while (
        len(settled.settings) < THRESHOLDS.settings_named and (new := under.better(settled, alone, len(variants))) is not None
    ):
        settled, under = new, _Settings(new.search.library, effects, windows, tell)
        done = {s.variant.setting for s in new.settings}
        variants = [v for v in under.library.model.variants() if v.setting not in done]
        alone = under.rank(variants, ())
    return settled


@final
class _Settings:
    """The settings of the model of a library: what causes make of some of the windows under each."""

    def __init__(self, library: Library, effects: Sequence[Effect], windows: Windows, tell: Callable[..., None]) -> None:
        self.library, self.effects, self.windows, self.tell = library, effects, windows, tell
        self.earlier, self.later = windows.guard()
        self._bare: dict[int, Library] = {}
        self._fits: dict[tuple[object, ...], Fit] = {}
        self._near: dict[tuple[object, ...], list[tuple[Variant, tuple[Variant, Fit, Fit] | None]]] = {}
        count = max(1, round(len(self.earlier) * min(1.0, THRESHOLDS.setting_values / self.earlier.y.size)))
        self.few = self.earlier.take(np.unique(np.linspace(0, len(self.earlier) - 1, count).astype(np.intp)))

    def at_once(self, variants: Sequence[Variant], alone: Sequence[Tried], plain: Fit) -> Settled | None:
        """A setting that leaves nothing, alone or, in data of a simulator, beside one of the likeliest causes.

        Where both are missing, a search without the setting piles up stand-ins for it.
        """
        if (setting := self.whole(alone, plain)) is not None:
            return Settled(*self.under(setting.variant), (setting,))
        if not self.library.measured.exact:
            return None
        sets = FittedSets(self.library, self.earlier, self.tell, plain)
        likely = additions(sets, ((), sets.nothing))[: THRESHOLDS.setting_finalists]
        if exact := [f for f in likely if f[1].chi.max() < THRESHOLDS.quiet]:
            # Beside a setting a simpler law may do: two numbers that are one, say.
            likely = [f for e in exact for f in _simpler(sets, e)]
        for causes, now in likely if all(f.chi.max() >= THRESHOLDS.quiet for _, f in likely) else ():
            tried = self.rank(variants, causes, now.values)
            if (setting := self.whole(tried, now)) is not None:
                return Settled(*self.under(setting.variant), (setting,))
        return None

    def whole(self, tried: Sequence[Tried], before: Fit) -> Setting | None:
        """The first of those that were tried, if nothing is left with it."""
        for variant, causes, first in tried[:1]:
            if not self.library.measured.exact and first.chi.max() > THRESHOLDS.plain_residual:
                return None
            found = self.fitted(variant.model, causes, self.earlier, first.values)
            if found.chi.max() < THRESHOLDS.quiet and self.pays(found, before, self.library.charge(len(tried)), fewer=False):
                return _setting(self.library, tried, variant)
        return None

    def under(self, variant: Variant) -> tuple[FittedSets, Found]:
        """The search under a setting."""
        return search_windows(self.library.under(variant.model, self.effects), self.windows, self.tell)

    def groups(self, alone: Sequence[Tried], found: Found) -> list[list[Tried]]:
        """Settings alone, in the place of one of several causes, and beside all where these leave something.

        Without noise any may decide. Else one counts that the windows feel, or that does nothing before a cause is there; in
        the place of a cause, about as much as they feel the cause.
        """
        (causes, now), exact, start = found, self.library.measured.exact, found[1].values
        felt, size = [(v, 0.0) for v, _, _ in alone], 0.0
        if not exact:
            near = self.near([v for v, _ in felt], (), {})
            felt = [(v, float(np.sum((f.residual - own.residual) ** 2))) for v, f, own in near]
            size = float(np.sum(self.fitted(self.library.model, (), self.few, {}).residual ** 2))
        whole = self.fitted(self.library.model, causes, self.few, start) if len(causes) > 1 else now
        # In the place of causes a setting must leave no more than they do.
        out = [[t for t in alone if exact or _near(t[2], whole)]]
        for g in [without(causes, (c,)) for c in causes] if len(causes) > 1 else []:
            gone = 0.0 if exact else float(np.sum(self.fitted(self.library.model, g, self.few, start).residual ** 2))
            own = gone - float(np.sum(whole.residual**2))
            (late,) = without(causes, g)
            if not exact and self.within_step(late, start):
                out.append([t for t in self.as_found([v for v, _ in felt], g, start) if _near(t[2], whole)])
                continue
            alike = [v for v, moved in felt if exact or THRESHOLDS.like_cause * own < moved < own / THRESHOLDS.like_cause]
            out.append(self.rank(alike, g, start, None if exact else whole))
        if causes and now.chi.max() >= THRESHOLDS.quiet and not noise(now, THRESHOLDS.sure_errors):
            some = [v for v, moved in felt if exact or moved > THRESHOLDS.least_fall * size or moved < THRESHOLDS.still * size]
            out.append(self.rank(some, causes, start))
        return out

    def within_step(self, c: Candidate, known: Numbers) -> bool:
        """Is all that a cause does a shift in time, of no more than the step of the engine? Then that may be what is late."""
        step = self.library.model.period / self.library.model.substeps
        times = [n for n, p in self.library.parameters(c).items() if set(p.dimension) in ({"time"}, {"period"})]
        return c.effect.amplitude is None and len(times) == len(c.effect.parameters) and all(known[n] <= step for n in times)

    def as_found(self, variants: Sequence[Variant], causes: Causes, known: Numbers) -> list[Tried]:
        """Fits under the settings that leave least with numbers as they are known, best first.

        What a step shifts in time is many noise floors: from a fit without it no step leads to these numbers.
        """
        left = list[tuple[float, int]]()
        for i, v in enumerate(variants):
            h = self.bare(v.model).hypothesis(causes)
            with contextlib.suppress(UsageError):
                left.append((float(followed(h, h.theta(known), self.few).chi.sum()), i))
        few = [variants[i] for _, i in sorted(left)[: THRESHOLDS.setting_finalists]]
        return _best([t for v in few if (t := self.fit_under(v, causes, known))])

    def rank(
        self, variants: Sequence[Variant], causes: Causes, start: Numbers | None = None, rival: Fit | None = None
    ) -> list[Tried]:
        """The same causes under every setting on some of the windows, best first; without noise, or among the best, fitted.

        One that leaves nearly all of the residual after a step is not fitted: it would have to explain most of it. rival: what
        leaves much less than one of them is none of it.
        """
        self.tell("settings of the engine" + (f" beside {len(causes)} causes" if causes else ""))
        known = start or {}
        if self.library.measured.exact:
            return _best([t for v in variants if (t := self.fit_under(v, causes, known))])
        near = [t for t in self.near(variants, causes, known) if rival is None or _near(t[1], rival)]
        tried = _best([(v, causes, f) for v, f, _ in near])
        left = THRESHOLDS.hopeless_setting * float(self.fitted(self.library.model, causes, self.few, known).chi.sum())
        for i, t in enumerate(tried[: THRESHOLDS.setting_contenders]):
            if t[2].chi.sum() < left:
                tried[i] = self.fit_under(t[0], causes, known) or t
        return _best(tried)

    def near(self, variants: Sequence[Variant], causes: Causes, start: Numbers) -> list[tuple[Variant, Fit, Fit]]:
        """Under each setting, one step from the fit without it: fits of the causes; and what that fit is after such a step."""
        key = tuple(c.key for c in causes), tuple(sorted(start.items()))
        known = self._near.setdefault(key, [])
        new = [v for v in variants if not any(v is k for k, _ in known)]
        found = self._step(new, causes, start) if new else []
        known += [(v, next((t for t in found if t[0] is v), None)) for v in new]
        return [t for v in variants for k, t in known if k is v and t is not None]

    def _step(self, variants: Sequence[Variant], causes: Causes, start: Numbers) -> list[tuple[Variant, Fit, Fit]]:
        base = self.fitted(self.library.model, causes, self.few, start)
        under = [(v, self.bare(v.model).hypothesis(causes)) for v in variants]
        alike = [(v, h) for v, h in under if h.names == base.hypothesis.names]
        own, *fits = stepped(base, [base.hypothesis, *(h for _, h in alike)])
        found = [(v, f, own or base) for (v, _), f in zip(alike, fits, strict=True) if f is not None]
        # A setting that takes numbers away, or brings some, has no slopes in common.
        others = [self.fit_under(v, causes, start) for v, h in under if h.names != base.hypothesis.names]
        return [*found, *((t[0], t[2], base) for t in others if t is not None)]

    def fit_under(self, v: Variant, causes: Causes, start: Numbers) -> Tried | None:
        """The causes fitted under a setting; None where no robot stands: a link without inertia is flung about."""
        with contextlib.suppress(UsageError):
            return v, causes, self.fitted(v.model, causes, self.few, start)
        return None

    def bare(self, model: Model) -> Library:
        """For sets of causes under another model: it has candidates of its own only where it is searched."""
        return once(self._bare, id(model), lambda: self.library.under(model))

    def fitted(self, model: Model, causes: Causes, windows: Windows, start: Numbers) -> Fit:
        key = id(model), id(windows), tuple(c.key for c in causes), tuple(sorted(start.items()))
        h = self.bare(model).hypothesis(causes)
        return once(self._fits, key, lambda: fit(h, windows, theta=h.theta(start), iterations=THRESHOLDS.second_fit))

    def pays(self, new: Fit, old: Fit, charge: float, *, fewer: bool) -> bool:
        """In place of causes only the choice is charged; beside them it pays for itself, on the later windows as well."""
        return setting_pays(new, old, charge, fewer=fewer) and (fewer or confirms(new, old, self.later))

    def better(self, settled: Settled, alone: Sequence[Tried], number: int) -> Settled | None:
        """What is found under another setting that pays, one of so many; None where none does."""
        (causes, now), charge = settled.found, self.library.charge(number)
        best: Settled | None = None
        for tried in self.groups(alone, settled.found):
            for variant, some, first in tried[: THRESHOLDS.setting_finalists]:
                whole = self.fitted(variant.model, some, self.earlier, first.values)
                if not self.pays(whole, now, charge, fewer=len(some) < len(causes)):
                    continue
                search, again = self.under(variant)
                pays = self.pays(again[1], now, charge, fewer=len(again[0]) < len(causes))
                if pays and (best is None or better(again[1], best.found[1]) > 0):
                    best = Settled(search, again, (*settled.settings, _setting(self.library, tried, variant)))
        return best


def _near(fitted: Fit, other: Fit) -> bool:
    """Does a fit that is one step from another simulation's leave as little as the other one, or could, fitted in full?"""
    return bool(fitted.chi.sum() < THRESHOLDS.close_residual**2 * other.chi.sum())


def _best(tried: list[Tried]) -> list[Tried]:
    return sorted(tried, key=lambda t: float(np.sum(np.log(np.maximum(t[2].chi, THRESHOLDS.exact_data)))))


def _simpler(sets: FittedSets, found: Found) -> list[Found]:
    """A law by each of those that it contains."""
    simple = [e for e in sets.library.candidates if sets.library.within(e, found[0][0])]
    return [((e,), sets.fit((e,), None, sets.carry(found[0][0], e, found))) for e in simple]


def _setting(library: Library, tried: Sequence[Tried], chosen: Variant) -> Setting:
    """The chosen one, against the best of another name."""
    own = next(f for v, _, f in tried if v is chosen)
    rival = next(((v, f) for v, _, f in tried if v.setting != chosen.setting), None)
    return Setting(chosen, library, rival[0] if rival else None, better(own, rival[1]) if rival else math.inf)
