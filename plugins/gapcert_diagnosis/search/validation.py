"""What later data say: a set of causes that earlier ones suggest is kept as far as they agree."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gapcert.plugin import Array
from gapcert_diagnosis.data.dataset import Windows
from gapcert_diagnosis.fitting.fit import Fit, fit, followed
from gapcert_diagnosis.thresholds import THRESHOLDS

from .candidates import Library
from .criterion import Found, agrees, better, fails, noise, values, without
from .fitted_sets import FittedSets, untold
from .moves import additions
from .stepwise import EquationSearch


def search_windows(
    library: Library, windows: Windows, progress: Callable[..., None] = untold, plain: Fit | None = None
) -> tuple[FittedSets, Found]:
    """(fitted sets, what was found): on the earlier windows, agreed by the later ones, with the input held as fits best.

    A hold that is not declared is zero, unless the other one makes the final model better: a wrong one looks like half a
    sample of delay, so neither can be chosen before the causes are there. plain: the fit of nothing to the earlier windows.
    """
    first = _guarded(library, windows, progress, plain)
    if windows.measured.hold is not None:
        return first
    causes, fitted = first[1]
    other = windows.with_hold("first")
    again = fit(fitted.hypothesis, other.guard()[0], theta=fitted.theta)
    if better(again, fitted) <= THRESHOLDS.tie_score:
        return first
    second = _guarded(library, other, progress)
    fewer = len(second[1][0]) < len(causes)
    return second if better(second[1][1], fitted) > (-THRESHOLDS.tie_score if fewer else THRESHOLDS.tie_score) else first


def _guarded(
    library: Library, windows: Windows, progress: Callable[..., None], plain: Fit | None = None
) -> tuple[FittedSets, Found]:
    earlier, later = windows.guard()
    sets = FittedSets(library, earlier, progress, plain)
    search = EquationSearch(sets)
    found = drop_unconfirmed(sets, search.select(), later)
    if noise(found[1], THRESHOLDS.sure_errors) and not noise(judge(found[1], later), THRESHOLDS.sure_errors):
        # Near the noise of the earlier windows by chance, or by a stand-in.
        search.thorough = True
        found = drop_unconfirmed(sets, search.select(), later)
    if fails(judge(found[1], later), max(1.0, float(found[1].chi.max()))):
        found = _events(sets, found, windows, float(later.t.min()))
    return sets, found


def _events(sets: FittedSets, found: Found, windows: Windows, known: float) -> Found:
    """With what only the later windows show: a push that came then, or a level that was not reached before."""
    whole = FittedSets(sets.library, windows, sets.progress)
    base = found[0], whole.fit(found[0], None, values(found[1]))
    before = np.maximum(judge(base[1], sets.windows).chi, 1.0)
    for causes, fitted in additions(whole, base):
        silent = all(whole.screen.silent(c, values(fitted), known) for c in without(causes, base[0]))
        calm = silent or (judge(fitted, sets.windows).chi < THRESHOLDS.calm_residual * before).all()
        if calm and whole.pays((causes, fitted), base) and whole.matters((causes, fitted)):
            return causes, sets.fit(causes, found, values(fitted))
    return found


def drop_unconfirmed(sets: FittedSets, found: Found, guard: Windows) -> Found:
    """What is left of a set once later data are asked: first about the whole, then about each cause without it."""
    causes, now = found
    if not causes:
        return (), sets.nothing
    own = judge(now, guard)
    if not confirms(now, sets.nothing, guard, own):
        left = [(rest, sets.fit(rest, found)) for rest in (without(causes, (c,)) for c in causes)]
        return drop_unconfirmed(sets, min(left, key=lambda f: float(judge(f[1], guard).chi.sum())), guard)
    adequate = own.chi.max() < THRESHOLDS.adequate_residual
    for c in reversed(causes):
        rest = without(causes, (c,))
        fitted = sets.fit(rest, found)
        if rest and not confirms(now, fitted, guard, own):
            return drop_unconfirmed(sets, (rest, fitted), guard)
        # A law that contains a simpler one has to earn its place beside it as well.
        for e in sets.library.candidates:
            if not adequate and sets.library.within(e, c):
                new = tuple(e if k is c else k for k in causes)
                simple = sets.fit(new, found, sets.carry(c, e, found))
                if not confirms(now, simple, guard, own):
                    return drop_unconfirmed(sets, (new, simple), guard)
    return causes, now


def judge(fitted: Fit, windows: Windows, start: Array | None = None) -> Fit:
    """The same numbers on other windows; only the starts are free."""
    return followed(fitted.hypothesis, fitted.theta, windows, start)


def confirms(new: Fit, old: Fit, later: Windows, own: Fit | None = None) -> bool:
    """Does the new fit agree with later data beside the old one? own: its numbers on these, where that is known."""
    one = own or judge(new, later)
    return agrees(new, old, one, judge(old, later, one.start))
