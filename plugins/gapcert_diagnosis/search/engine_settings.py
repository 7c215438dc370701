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
from gapcert_diagnosis.data.dataset import Windows
from gapcert_diagnosis.fitting.fit import Fit, fit, stepped

from .candidates import Causes, Library
from .criterion import FALL, PLAIN, QUIET, SURE, Found, better, noise, setting_pays, values
from .stepwise import CLOSE, SECOND, Search
from .validation import confirmed, searched

SCREENED = 4_000  # measured values on which all settings are tried
FINALISTS = 2
CONTENDERS = 3  # settings that are fitted, of those that one step shows to be the best
MOST = 2  # settings
HOPELESS = 0.9  # of the squared residual without a setting: what leaves more of it after a step is not fitted
LIKE = 0.2  # of what a cause explains, what a setting in its place has to move: this share, up to its inverse
STILL = 1e-9  # of the squared residual: how friction is solved changes nothing where there is none
TINY = 1e-12  # noise floors squared: data of a simulator are hit exactly

Tried = tuple[Variant, Causes, Fit]


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

    search: Search
    found: Found
    settings: tuple[Setting, ...]


def across(library: Library, effects: Sequence[Effect], windows: Windows, tell: Callable[..., None]) -> Settled:
    """The search of `guard.searched`, and again under settings with which the score is better.

    A setting has no number, but was chosen among as many as there are: it pays as a cause does, unless it takes the place of
    causes, which pay for their numbers already.
    """
    variants = library.model.variants()
    earlier = windows.guard()[0]
    if not variants or (plain := fit(library.hypothesis(()), earlier)).chi.max() < QUIET:
        return Settled(*searched(library, windows, tell, plain if variants else None), ())
    return _Across(effects, windows, earlier, tell).settled(library, variants, plain)


@final
class _Across:
    def __init__(self, effects: Sequence[Effect], windows: Windows, earlier: Windows, tell: Callable[..., None]) -> None:
        self.effects, self.windows, self.earlier, self.tell = effects, windows, earlier, tell
        self.later = windows.guard()[1]
        self._bare: dict[tuple[int, int], Library] = {}
        self._fits: dict[tuple[object, ...], Fit] = {}
        self._near: dict[tuple[object, ...], list[tuple[Variant, tuple[Variant, Fit, Fit] | None]]] = {}
        count = max(1, round(len(earlier) * min(1.0, SCREENED / earlier.y.size)))
        self.few = earlier.take(np.unique(np.linspace(0, len(earlier) - 1, count).astype(np.intp)))

    def settled(self, library: Library, variants: Sequence[Variant], plain: Fit) -> Settled:
        alone = self.ranked(library, variants, ())
        if (at_once := self.at_once(library, variants, alone, plain)) is not None:
            return at_once
        search, found = searched(library, self.windows, self.tell, plain)
        settings: tuple[Setting, ...] = ()
        while len(settings) < MOST:
            new = self.better(library, found, self.groups(library, alone, found), len(variants))
            if new is None:
                break
            search, found, setting = new
            settings, library = (*settings, setting), search.library
            done = {s.variant.setting for s in settings}
            variants = [v for v in library.model.variants() if v.setting not in done]
            alone = self.ranked(library, variants, ())
        return Settled(search, found, settings)

    def at_once(self, library: Library, variants: Sequence[Variant], alone: Sequence[Tried], plain: Fit) -> Settled | None:
        """A setting that leaves nothing, alone or, in data of a simulator, beside one of the likeliest causes.

        Where both are missing, a search without the setting piles up stand-ins for it.
        """
        if (setting := self.whole(library, alone, plain)) is not None:
            return Settled(*self.under(library, setting.variant.model), (setting,))
        if not library.measured.exact:
            return None
        search = Search(library, self.earlier, self.tell, plain)
        likely = search.additions((), ((), search.nothing))[:FINALISTS]
        if exact := [f for f in likely if f[1].chi.max() < QUIET]:
            # Beside a setting a simpler law may do: two numbers that are one, say.
            likely = [f for e in exact for f in _simpler(search, e)]
        for causes, now in likely if all(f.chi.max() >= QUIET for _, f in likely) else ():
            tried = self.ranked(library, variants, causes, values(now))
            if (setting := self.whole(library, tried, now)) is not None:
                return Settled(*self.under(library, setting.variant.model), (setting,))
        return None

    def whole(self, library: Library, tried: Sequence[Tried], before: Fit) -> Setting | None:
        """The first of those that were tried, if nothing is left with it."""
        for variant, causes, first in tried[:1]:
            if not library.measured.exact and first.chi.max() > PLAIN:
                return None
            found = self.fitted(library, variant.model, causes, self.earlier, values(first))
            if found.chi.max() < QUIET and self.pays(found, before, self.charge(library, len(tried)), fewer=False):
                return _setting(library, tried)
        return None

    def under(self, library: Library, model: Model) -> tuple[Search, Found]:
        return searched(Library(model, library.measured, self.effects), self.windows, self.tell)

    def groups(self, library: Library, alone: Sequence[Tried], found: Found) -> list[list[Tried]]:
        """Settings alone, in the place of one of several causes, and beside all where these leave something.

        Without noise any may decide. Else one counts that the windows feel, or that does nothing before a cause is there; in
        the place of a cause, about as much as they feel the cause.
        """
        causes, now = found
        exact, start = library.measured.exact, values(now)
        felt, size = [(v, 0.0) for v, _, _ in alone], 0.0
        if not exact:
            felt = [
                (v, float(np.sum((f.residual - own.residual) ** 2)))
                for v, f, own in self.near(library, [v for v, _ in felt], (), {})
            ]
            size = float(np.sum(self.fitted(library, library.model, (), self.few, {}).residual ** 2))
        whole = self.fitted(library, library.model, causes, self.few, start) if len(causes) > 1 else now
        # In the place of causes a setting must leave no more than they do.
        out = [[t for t in alone if exact or _near(t[2], whole)]]
        for g in [tuple(c for c in causes if c is not gone) for gone in causes] if len(causes) > 1 else []:
            gone = 0.0 if exact else float(np.sum(self.fitted(library, library.model, g, self.few, start).residual ** 2))
            own = gone - float(np.sum(whole.residual**2))
            alike = [v for v, moved in felt if exact or LIKE * own < moved < own / LIKE]
            out.append(self.ranked(library, alike, g, start, None if exact else whole))
        if causes and now.chi.max() >= QUIET and not noise(now, SURE):
            some = [v for v, moved in felt if exact or moved > FALL * size or moved < STILL * size]
            out.append(self.ranked(library, some, causes, start))
        return out

    def ranked(
        self,
        library: Library,
        variants: Sequence[Variant],
        causes: Causes,
        start: dict[str, float] | None = None,
        rival: Fit | None = None,
    ) -> list[Tried]:
        """The same causes under every setting on some of the windows, best first; without noise, or among the best, fitted.

        One that leaves nearly all of the residual after a step is not fitted: it would have to explain most of it.

        rival: what leaves much less than one of them is none of it.
        """
        self.tell("settings of the engine" + (f" beside {len(causes)} causes" if causes else ""))
        known = start or {}
        if library.measured.exact:
            return _best([t for v in variants if (t := self.under_one(library, v, causes, known))])
        near = [t for t in self.near(library, variants, causes, known) if rival is None or _near(t[1], rival)]
        tried = _best([(v, causes, f) for v, f, _ in near])
        left = HOPELESS * float(self.fitted(library, library.model, causes, self.few, known).chi.sum())
        for i, t in enumerate(tried[:CONTENDERS]):
            if t[2].chi.sum() < left:
                tried[i] = self.under_one(library, t[0], causes, known) or t
        return _best(tried)

    def near(
        self, library: Library, variants: Sequence[Variant], causes: Causes, start: dict[str, float]
    ) -> list[tuple[Variant, Fit, Fit]]:
        """Under each setting, one step from the fit without it: fits of the causes; and what that fit is after such a step."""
        key = id(library), tuple(c.key for c in causes), tuple(sorted(start.items()))
        known = self._near.setdefault(key, [])
        new = [v for v in variants if not any(v is k for k, _ in known)]
        found = self._stepped(library, new, causes, start) if new else []
        known += [(v, next((t for t in found if t[0] is v), None)) for v in new]
        return [t for v in variants for k, t in known if k is v and t is not None]

    def _stepped(
        self, library: Library, variants: Sequence[Variant], causes: Causes, start: dict[str, float]
    ) -> list[tuple[Variant, Fit, Fit]]:
        base = self.fitted(library, library.model, causes, self.few, start)
        under = [(v, self.bare(library, v.model).hypothesis(causes)) for v in variants]
        alike = [(v, h) for v, h in under if h.names == base.hypothesis.names]
        own, *fits = stepped(base, self.few, [base.hypothesis, *(h for _, h in alike)])
        found = [(v, f, own or base) for (v, _), f in zip(alike, fits, strict=True) if f is not None]
        # A setting that takes numbers away, or brings some, has no slopes in common.
        others = [self.under_one(library, v, causes, start) for v, h in under if h.names != base.hypothesis.names]
        return [*found, *((t[0], t[2], base) for t in others if t is not None)]

    def under_one(self, library: Library, v: Variant, causes: Causes, start: dict[str, float]) -> Tried | None:
        """The causes fitted under a setting; None where no robot stands: a link without inertia is flung about."""
        with contextlib.suppress(UsageError):
            return v, causes, self.fitted(library, v.model, causes, self.few, start)
        return None

    def bare(self, library: Library, model: Model) -> Library:
        """For sets of causes under another model: it has candidates of its own only where it is searched."""
        key = id(model), id(library.measured)
        if key not in self._bare:
            self._bare[key] = Library(model, library.measured, [])
        return self._bare[key]

    def fitted(self, library: Library, model: Model, causes: Causes, windows: Windows, start: dict[str, float]) -> Fit:
        key = id(model), id(windows), tuple(c.key for c in causes), tuple(sorted(start.items()))
        if key not in self._fits:
            self._fits[key] = self._fitted(library, model, causes, windows, start)
        return self._fits[key]

    def _fitted(self, library: Library, model: Model, causes: Causes, windows: Windows, start: dict[str, float]) -> Fit:
        h = self.bare(library, model).hypothesis(causes)
        known = {n: start.get(n, v) for n, v in zip(h.names, h.value.tolist(), strict=True)}
        return fit(h, windows, theta=np.array([known[n] for n in h.names]), iterations=SECOND)

    def charge(self, library: Library, count: int) -> float:
        return 12 + 2 * math.log(len(library.candidates) + count)

    def pays(self, new: Fit, old: Fit, charge: float, *, fewer: bool) -> bool:
        """In place of causes only the choice is charged; beside them it pays for itself, on the later windows as well."""
        return setting_pays(new, old, charge, fewer=fewer) and (fewer or confirmed(new, old, self.later))

    def better(
        self, library: Library, found: Found, groups: Sequence[Sequence[Tried]], number: int
    ) -> tuple[Search, Found, Setting] | None:
        """Another setting, and what is found under it; None where none pays."""
        count, now = len(found[0]), found[1]
        charge = self.charge(library, number)
        best: tuple[Search, Found, Setting] | None = None
        for tried in groups:
            for variant, causes, first in tried[:FINALISTS]:
                whole = self.fitted(library, variant.model, causes, self.earlier, values(first))
                if not self.pays(whole, now, charge, fewer=len(causes) < count):
                    continue
                search, again = self.under(library, variant.model)
                pays = self.pays(again[1], now, charge, fewer=len(again[0]) < count)
                if pays and (best is None or better(again[1], best[1][1]) > 0):
                    best = search, again, _setting(library, tried, variant)
        return best


def _near(fitted: Fit, other: Fit) -> bool:
    """Does a fit that is one step from another simulation's leave as little as the other one, or could, fitted in full?"""
    return bool(fitted.chi.sum() < CLOSE**2 * other.chi.sum())


def _best(tried: list[Tried]) -> list[Tried]:
    return sorted(tried, key=lambda t: float(np.sum(np.log(np.maximum(t[2].chi, TINY)))))


def _simpler(search: Search, found: Found) -> list[Found]:
    """A law by each of those that it contains."""
    (c, *_), contains = found[0], search.library.contains
    simple = [e for e in search.library.candidates if e.site == c.site and contains(c.effect.name, e.effect.name)]
    return [((e,), search.fit((e,), None, search.carried(c, e, found))) for e in simple]


def _setting(library: Library, tried: Sequence[Tried], chosen: Variant | None = None) -> Setting:
    """The chosen one, by default the first, against the best of another name."""
    chosen = chosen or tried[0][0]
    own = next(f for v, _, f in tried if v is chosen)
    rival = next(((v, f) for v, _, f in tried if v.setting != chosen.setting), None)
    return Setting(chosen, library, rival[0] if rival else None, better(own, rival[1]) if rival else math.inf)
