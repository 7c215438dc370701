"""Which causes, of a model in equations: single steps, several causes at once where these lead nowhere, exchanges and drops.

They are looked for on earlier windows, and a set is kept as far as later ones agree.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import final

import numpy as np

from gapcert.plugin import Array
from gapcert_diagnosis.data.dataset import Windows
from gapcert_diagnosis.fitting.fit import Fit, fit, followed
from gapcert_diagnosis.thresholds import THRESHOLDS

from .candidates import Candidate, Causes, Library
from .criterion import Found, Keys, agrees, beats, fails, keys, margin, noise, outdoes, rank, without
from .fitted_sets import FittedSets, untold
from .moves import additions, idle, merges, remembered, spared, swaps
from .selection import drop, forward


def search_windows(
    library: Library,
    windows: Windows,
    progress: Callable[..., None] = untold,
    plain: Fit | None = None,
    like: FittedSets | None = None,
) -> tuple[FittedSets, Found]:
    """(fitted sets, what was found): on the earlier windows, agreed by the later ones, with the input held as fits best.

    A hold that is not declared is zero, unless the other one makes the final model better: a wrong one looks like half a
    sample of delay, so neither can be chosen before the causes are there. The one that fits plainly better without causes is
    searched first, and is the answer if it plainly is with them. plain: the fit of nothing to the earlier windows; like: a
    search of the same windows, under other noise floors.
    """
    if windows.measured.hold is not None:
        return _guarded(library, windows, progress, plain, like)
    other, earlier, second = windows.with_hold("first"), windows.guard()[0], None
    plain = fit(library.hypothesis(()), earlier) if plain is None else plain
    straight = fit(plain.hypothesis, other.guard()[0], theta=plain.theta, start=plain.start)
    if _plainly(straight, plain):
        second = _guarded(library, other, progress, straight, like)
        if _plainly(second[1][1], fit(second[1][1].hypothesis, earlier, theta=second[1][1].theta)):
            return second
    first = _guarded(library, windows, progress, plain, like)
    causes, fitted = first[1]
    again = fit(fitted.hypothesis, other.guard()[0], theta=fitted.theta)
    if first[0].better(again, fitted) <= THRESHOLDS.tie_score:
        return first
    second = second or _guarded(library, other, progress, like=first[0])
    fewer = len(second[1][0]) < len(causes)
    gained = first[0].better(second[1][1], fitted)
    return second if gained > (-THRESHOLDS.tie_score if fewer else THRESHOLDS.tie_score) else first


def _plainly(new: Fit, old: Fit) -> bool:
    """Does it leave so much less that no other cause could be the reason?"""
    return bool((new.chi < THRESHOLDS.plain_hold * old.chi).all())


def _guarded(
    library: Library,
    windows: Windows,
    progress: Callable[..., None],
    plain: Fit | None = None,
    like: FittedSets | None = None,
) -> tuple[FittedSets, Found]:
    earlier, later = windows.guard()
    sets = FittedSets(library, earlier, progress, plain, like)
    search = EquationSearch(sets)
    found = drop_unconfirmed(sets, search.select(), later)
    if noise(found[1], THRESHOLDS.sure_errors) and not noise(judge(found[1], later), THRESHOLDS.sure_errors):
        # Near the noise of the earlier windows by chance, or by a stand-in.
        search.thorough = True
        found = drop_unconfirmed(sets, search.select(), later)
    if fails(judge(found[1], later), max(1.0, float(found[1].chi.max()))):
        found = _events(sets, found, windows, float(later.t.min()))
    return sets, found


@final
class EquationSearch:
    """Stepwise selection (`Selection`) among fitted sets.

    thorough: several sets are grown at once even where single steps lead to the noise.
    """

    def __init__(self, sets: FittedSets) -> None:
        self.sets, self.thorough = sets, False
        self.nothing: Found = ((), sets.nothing)
        self.piled: Keys | None = None

    def select(self) -> Found:
        """What steps or pairs lead to; cautious steps where something else is missing, unless they miss plainly more."""
        best, sets = self.forward(), self.sets
        if best[1].rough:
            sets.cautious = True
            first, best = self.refine(best), self.forward()
            most = max(1, len(first[0]) - len(best[0])) * sets.library.charge()
            best = first if sets.better(first[1], best[1]) > most and sets.matters(first) else best
        return self.try_split(self.try_pairs(best))

    def forward(self) -> Found:
        """What single steps lead to; where that is no noise yet, or does not last, the best of what several at once lead to."""
        if not self.thorough and (few := self.try_piles()) is not None:
            return few
        best = forward(self)
        if not best[0] or self.enough(best) or (self.settled(best) and not self.sets.cautious):
            return best
        small, large = sorted([best, forward(self, THRESHOLDS.beam, self.enough)], key=lambda f: len(f[0]))
        return large if self.outdoes(large, small) else small

    def key(self, found: Found) -> Keys:
        return keys(found[0])

    def grow(self, parent: Found, width: int) -> list[Found]:
        sets = self.sets
        tried = [self.drop_negligible(f, parent) for f in additions(sets, parent) if sets.pays(f, parent)]
        paying = [f for f in tried if sets.pays(f, parent) and sets.matters(f)]
        return [self.refine(f) for f in paying[:width]]

    def rank(self, found: Sequence[Found]) -> list[Found]:
        return rank(found, self.sets.cautious)

    def outdoes(self, new: Found, best: Found) -> bool:
        return outdoes(new[1], best[1], *self.sets.charges(new, best), larger=len(new[0]) > len(best[0]))

    def settled(self, best: Found) -> bool:
        """Is it a pile of causes, far from noise? Of such, samples say no more."""
        return best[1].chi.max() > THRESHOLDS.lost_search and len(best[0]) >= THRESHOLDS.most_moves

    def enough(self, best: Found) -> bool:
        return noise(best[1]) and not self.thorough

    def without(self, found: Found, cause: Candidate) -> Found:
        rest = without(found[0], (cause,))
        grown, fitted = len(rest) > 1 and self.sets.known(rest) is not None, self.sets.fit(rest, found)
        # What was grown step by step may sit in a valley that only the larger set leads out of.
        return rest, self.sets.fit_again(rest, None, found[1].values) if grown else fitted

    def pays(self, found: Found, rest: Found) -> bool:
        return self.sets.pays(found, rest)

    def try_piles(self) -> Found | None:
        """Of very many candidates a few that screening piles up, if they leave noise, and no single one promises much of it."""
        sets, base = self.sets, self.nothing
        if len(sets.library.candidates) < THRESHOLDS.crowd:
            return None
        for table in sets.screen.tables(sets.fits(base)[::-1]):
            piles = table.pursue(THRESHOLDS.most_moves)
            if piles and piles[0].gain < THRESHOLDS.alone_promise * piles[-1].gain:
                grown = piles[-1].move
                new = self.refine((grown, sets.fit(grown, base, sets.try_move(base, piles[-1]).values)))
                if noise(new[1], THRESHOLDS.sure_errors) and sets.pays(new, base) and sets.matters(new):
                    self.piled = keys(new[0])
                    return new
        return None

    def try_pairs(self, found: Found) -> Found:
        """What was found, or two causes, refined as usual, that explain more, or as much where it names three.

        Where neither of two helps much without the other, steps of one lead elsewhere.
        """
        if keys(found[0]) == self.piled:
            return found  # of all candidates at once, and noise is left
        sets, nothing, now = self.sets, self.nothing, self.sets.brief(found)
        tables, few = sets.screen.tables(sets.fits(nothing)), THRESHOLDS.paired_short_fits
        promised = [s for table in tables for s in (*table.pairs(few), *table.loosened_pairs())]
        most = max((s.gain for s in promised), default=0.0)
        silent = noise(found[1], THRESHOLDS.sure_errors) and bool(found[0])
        if most < (THRESHOLDS.paired_share * self._explained(found[1]) if silent else 2 * sets.library.charge()):
            return found
        now = sets.fit_further(now)
        moves = {keys(s.move): s for s in reversed(promised)}
        tried = rank([(s.move, sets.try_move(nothing, s)) for s in moves.values()])
        best = found
        for causes, first in tried[: THRESHOLDS.paired_full_fits]:
            if beats(first, now, sets.cautious, fewer=len(causes) < len(best[0])):
                new = self.refine((causes, sets.fit(causes, nothing, sets.fit_further(first).values)))
                more = beats(new[1], best[1], sets.cautious, fewer=len(new[0]) < len(best[0]))
                enough = sets.better(new[1], sets.nothing) > len(new[0]) * sets.library.charge()
                if more and enough and sets.pays(new, nothing) and sets.matters(new):
                    best = new
        return best

    def try_split(self, found: Found) -> Found:
        """What was found, or two plain laws in the place of one of many numbers: it can bend to what they are together."""
        sets, library, best = self.sets, self.sets.library, found
        for c in found[0]:
            few = c.effect.site == "input" and not noise(found[1]) and found[1].chi.max() < THRESHOLDS.lost_search
            if len(c.effect.parameters) < (2 if few else THRESHOLDS.table_numbers):
                continue
            rest = without(found[0], (c,))
            plain = [(e, (*rest, e)) for e in library.candidates if library.within(e, c)]
            parts = [(new, sets.fit(new, found, sets.carry(c, e, found))) for e, new in plain]
            for part in rank(parts, sets.cautious)[: THRESHOLDS.split_parts]:
                for grown in additions(sets, part)[: THRESHOLDS.split_parts]:
                    new = self.refine(grown)
                    more = library.simplicity(new[0])[0] - library.simplicity(best[0])[0]
                    least = THRESHOLDS.tie_score if more >= 0 else 0.0
                    if sets.better(new[1], best[1]) > least and sets.matters(new):
                        best = new
        return best

    def _explained(self, fitted: Fit) -> float:
        """What a promise of as much would be: Σ n (1 − χ/χ₀) on the windows of the screen."""
        share = 1 - fitted.chi / np.maximum(self.sets.nothing.chi, 1e-300)
        return float(np.sum(share * fitted.counts)) * len(self.sets.screen.windows) / len(self.sets.windows)

    def drop_negligible(self, found: Found, parent: Found) -> Found:
        """Without what is negligible: members of the move, where others of it are not, and what it took the place of."""
        small = {k for k in self.sets.small(found) if k not in keys(parent[0]) or not self.sets.decides(found, k)}
        rest = tuple(c for c in found[0] if c.key not in small)
        if not small or keys(rest) <= keys(parent[0]):
            return found
        return rest, self.sets.fit(rest, parent, found[1].values)

    def refine(self, found: Found) -> Found:
        """Drops, swaps for simpler and richer laws and merges, until none of them pays."""
        found = self.prune(found)
        seen = {keys(found[0])}
        while keys((new := drop(self, found, found[0]) or self._exchange(found))[0]) not in seen:
            found = new
            seen.add(keys(found[0]))
        return found

    def prune(self, found: Found) -> Found:
        """Without all causes at once that the fit, to second order, loses little without; with half of these, where it does."""
        causes, now = found
        order, lost = lightest(self.sets.library, causes, now)
        small = order[: int(np.searchsorted(lost, THRESHOLDS.small_gain))]
        while len(small) > 1:
            rest = without(causes, small)
            if rest and not self.sets.pays(found, (rest, fitted := self.sets.fit(rest, found))):
                return self.prune((rest, fitted))
            small = small[: len(small) // 2]
        return found

    def _exchange(self, found: Found) -> Found:
        """With the first exchange of laws that pays, those that leave the fewest numbers first."""
        sets, (causes, now) = self.sets, found

        def size(some: Causes) -> int:
            return sets.library.simplicity(some)[0]

        options = [*swaps(sets, found), *merges(sets, found), *remembered(sets, found)]
        for new, start in sorted(options, key=lambda o: size(o[0])):
            if not idle(sets, found, new):
                fitted, more, merged = sets.fit(new, found, start), size(new) - size(causes), len(new) < len(causes)
                least = margin([fitted, now], more, sets.cautious, merged=merged, spared=spared(sets, causes, new))
                if sets.better(fitted, now) > least and sets.matters((new, fitted)):
                    return new, fitted
        return found


def lightest(library: Library, causes: Causes, fitted: Fit) -> tuple[Causes, Array]:
    """(causes, shares): the least needed first, and of the squared residual what these first ones together keep away.

    To second order, from the covariance of what is off: dᵀ Σ⁻¹ d / Σ r².
    """
    names, whole = list(fitted.hypothesis.names), max(float(np.sum(fitted.residual**2)), 1e-300)
    rows, gaps = [], []
    for c in causes:
        k, off = library.amplitude(c), library.off(c)
        own = range(len(off)) if k is None else (k,)
        rows.append([names.index(library.names(c)[i]) for i in own])
        gaps.append([fitted.theta[r] - off[i] for r, i in zip(rows[-1], own, strict=True)])

    def share(some: Sequence[int]) -> float:
        r, d = (np.concatenate([a[i] for i in some]) for a in (rows, gaps))
        return float(d @ np.linalg.pinv(fitted.covariance[np.ix_(r, r)], hermitian=True) @ d) / whole

    order = sorted(range(len(causes)), key=lambda i: share([i]))
    return tuple(causes[i] for i in order), np.array([share(order[: i + 1]) for i in range(len(order))])


def _events(sets: FittedSets, found: Found, windows: Windows, known: float) -> Found:
    """With what only the later windows show: a push that came then, or a level that was not reached before."""
    whole = FittedSets(sets.library, windows, sets.progress)
    base = found[0], whole.fit(found[0], None, found[1].values)
    before = np.maximum(judge(base[1], sets.windows).chi, 1.0)
    for causes, fitted in additions(whole, base):
        silent = all(whole.screen.silent(c, fitted.values, known) for c in without(causes, base[0]))
        calm = silent or (judge(fitted, sets.windows).chi < THRESHOLDS.calm_residual * before).all()
        if calm and whole.pays((causes, fitted), base) and whole.matters((causes, fitted)):
            return causes, sets.fit(causes, found, fitted.values)
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
