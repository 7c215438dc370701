"""What later data say: a set of causes that earlier ones suggest is kept as far as they agree."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gapcert.plugin import Array
from gapcert_diagnosis.data.dataset import Windows
from gapcert_diagnosis.fitting.fit import Fit, fit, followed

from .candidates import Library
from .criterion import SURE, TIE, Found, agrees, better, fails, keys, noise, values
from .pairs import leapt
from .stepwise import Search

CALM = 1.02  # times the residual of the earlier windows that a law of the later ones may make of it
ADEQUATE = 1.2  # residual per noise floor of later data that no simpler law has to improve


def searched(
    library: Library,
    windows: Windows,
    progress: Callable[..., None] = lambda text, best=None, fitted=True: None,
    plain: Fit | None = None,
) -> tuple[Search, Found]:
    """(search, what it found): on the earlier windows, agreed by the later ones, with the input held as fits best.

    A hold that is not declared is zero, unless the other one makes the final model better: a wrong one looks like half a
    sample of delay, so neither can be chosen before the causes are there. plain: the fit of nothing to the earlier windows.
    """
    first = _guarded(library, windows, progress, plain)
    if windows.measured.hold is not None:
        return first
    causes, fitted = first[1]
    other = windows.with_hold("first")
    again = fit(fitted.hypothesis, other.guard()[0], theta=fitted.theta)
    if better(again, fitted) <= TIE:
        return first
    second = _guarded(library, other, progress)
    fewer = len(second[1][0]) < len(causes)
    return second if better(second[1][1], fitted) > (-TIE if fewer else TIE) else first


def _guarded(
    library: Library, windows: Windows, progress: Callable[..., None], plain: Fit | None = None
) -> tuple[Search, Found]:
    earlier, later = windows.guard()
    search = Search(library, earlier, progress, plain)
    found = agreed(search, leapt(search, search.found()), later)
    if noise(found[1], SURE) and not noise(judged(found[1], later), SURE):
        # Near the noise of the earlier windows by chance, or by a stand-in.
        search.thorough = True
        found = agreed(search, leapt(search, search.found()), later)
    if fails(judged(found[1], later), max(1.0, float(found[1].chi.max()))):
        found = _events(search, found, windows, float(later.t.min()))
    return search, found


def _events(search: Search, found: Found, windows: Windows, known: float) -> Found:
    """With what only the later windows show: a push that came then, or a level that was not reached before."""
    whole = Search(search.library, windows, search.progress)
    base = found[0], whole.fit(found[0], None, values(found[1]))
    before = np.maximum(judged(base[1], search.windows).chi, 1.0)
    for causes, fitted in whole.additions(base[0], base):
        new = tuple(c for c in causes if c.key not in keys(base[0]))
        silent = all(whole.screen.silent(c, values(fitted), known) for c in new)
        calm = silent or (judged(fitted, search.windows).chi < CALM * before).all()
        if calm and whole.pays((causes, fitted), base) and whole.matters((causes, fitted)):
            return causes, search.fit(causes, found, values(fitted))
    return found


def agreed(search: Search, found: Found, guard: Windows) -> Found:
    """What is left of a set once later data are asked: first about the whole, then about each cause without it."""
    causes, now = found
    if not causes:
        return (), search.nothing
    own = judged(now, guard)
    if not confirmed(now, search.nothing, guard, own):
        fewer = [tuple(k for k in causes if k is not c) for c in causes]
        left = [(rest, search.fit(rest, (causes, now))) for rest in fewer]
        return agreed(search, min(left, key=lambda f: float(judged(f[1], guard).chi.sum())), guard)
    adequate = own.chi.max() < ADEQUATE
    for c in reversed(causes):
        rest = tuple(k for k in causes if k is not c)
        without = search.fit(rest, (causes, now))
        if rest and not confirmed(now, without, guard, own):
            return agreed(search, (rest, without), guard)
        # A law that contains a simpler one has to earn its place beside it as well.
        for e in search.library.candidates:
            if not adequate and e.site == c.site and search.library.contains(c.effect.name, e.effect.name):
                new = tuple(e if k is c else k for k in causes)
                simple = search.fit(new, (causes, now), search.carried(c, e, (causes, now)))
                if not confirmed(now, simple, guard, own):
                    return agreed(search, (new, simple), guard)
    return causes, now


def judged(fitted: Fit, windows: Windows, start: Array | None = None) -> Fit:
    """The same numbers on other windows; only the starts are free."""
    return followed(fitted.hypothesis, fitted.theta, windows, start)


def confirmed(new: Fit, old: Fit, later: Windows, own: Fit | None = None) -> bool:
    """Does the new fit agree with later data beside the old one? own: its numbers on these, where that is known."""
    one = own or judged(new, later)
    return agrees(new, old, one, judged(old, later, one.start))
