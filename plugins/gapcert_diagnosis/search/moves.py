"""What a set of causes may become next: with a move more, or with something else in the place of one or two of its causes."""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Sequence

import numpy as np

from gapcert_diagnosis.fitting.fit import Fit, followed, promising
from gapcert_diagnosis.thresholds import THRESHOLDS

from .candidates import Candidate, Causes, Library
from .criterion import Found, Keys, keys, noise, rank, scores, without
from .fitted_sets import FittedSets
from .gains import Promise

Tried = tuple[Promise, Fit]
Option = tuple[Causes, dict[str, float]]


def additions(
    sets: FittedSets, base: Found, instead: Candidate | None = None, hope: float = THRESHOLDS.hoped_fall
) -> list[Found]:
    """Fits of a set with one move more, best first; none where screening promises nothing.

    instead: of this cause; where nothing comes near it, the best on short windows.
    """
    causes, library = base[0], sets.library

    def allowed(move: Causes) -> bool:
        """Not twice the same law at one site: a law that contains another takes its place, not a place beside it."""
        c, *more = move
        if instead and (more or c.key == instead.key or library.contains(c.effect.name, instead.effect.name)):
            return False
        return not any(library.related(c, k) for c in move for k in causes)

    if keys(causes) in sets.added:
        return rank([f for f in sets.added[keys(causes)] if allowed(without(f[0], causes))], sets.cautious)
    short, long = (worth([s for s in p if allowed(s.move)], p, instead) for p in sets.promises(base, instead))
    least = hope + 2 * math.log(max(1, len(library.candidates)))
    behind = [s for s in blunted(sets, base) if allowed(s.move)]
    if not behind and max((p[0].gain for p in (short, long) if p), default=-math.inf) < least:
        return []
    few = {keys(s.move): s for s in plain([*long[: THRESHOLDS.long_fits], *short[: THRESHOLDS.short_fits]], library)}
    few |= {keys(s.move): s for s in behind}
    blind = [s for s in (*stuck(sets, causes, few), *slipped(sets, causes)) if allowed(s.move)]
    picks, known = [*few.values(), *blind], None if instead is None else sets.known((*causes, instead))
    if instead is None or known is None:
        tried = [(s, sets.try_move(base, s)) for s in picks]
    else:
        own = sets.brief(((*causes, instead), known))
        tried = near(replacements(sets, picks, base, instead, own), own, sets.cautious)
        if all(keys((*causes, *s.move)) in sets.lost for s, _ in tried):
            return [((*causes, *s.move), f) for s, f in tried]
    if not tried:
        return []
    best = finalists(tried, [keys(s.move) for s in long[: THRESHOLDS.near_ties]], sets.cautious)
    grown = [((*causes, *s.move), sets.fit_further(first).values) for s, first in best]
    full = rank([(new, sets.fit(new, base, start)) for new, start in grown], sets.cautious)
    least = (full[0][1] if known is None else known).chi.sum()
    close = [s for s, f in full if f.chi.sum() < THRESHOLDS.close_residual * least]
    full = rank([(s, sets.fit_shaken(s, (s, f)) if s in close else f) for s, f in full], sets.cautious)
    if instead is None:
        sets.added[keys(causes)] = full
    return full


def finalists(tried: list[Tried], also: Collection[object], cautious: bool) -> list[Tried]:
    """The best of each family, so that one does not crowd out the others; and what is in `also`."""
    families: dict[object, tuple[float, Tried]] = {}
    for score, t in sorted(zip(scores([f for _, f in tried], cautious), tried, strict=True), key=lambda p: p[0]):
        families.setdefault(frozenset((c.effect.family or c.effect.name, c.site) for c in t[0].move), (score, t))
    least, kept = min(score for score, _ in families.values()), list[Tried]()
    for k, (score, t) in enumerate(families.values()):
        close = k < THRESHOLDS.full_fits + THRESHOLDS.near_ties and score < least + THRESHOLDS.tie_score
        if k < THRESHOLDS.full_fits or close or keys(t[0].move) in also:
            kept.append(t)
    return kept


def near(tried: list[Tried], own: Fit, cautious: bool) -> list[Tried]:
    """The best, and those that are not far behind the fit of what they would stand for."""
    mine, *others = scores([own, *(f for _, f in tried)], cautious)
    least = max(min(others, default=0.0), mine + THRESHOLDS.behind_score)
    return [t for t, score in zip(tried, others, strict=True) if score <= least]


def replacements(sets: FittedSets, picks: list[Promise], base: Found, instead: Candidate, own: Fit) -> list[Tried]:
    """Short fits in the place of a cause, whose own is given; none of what promises plainly less than one far behind that.

    What remembers takes many times as long as what does not: of another family it is not tried either where a law within it is
    far behind, or where others promise much more.
    """
    tried, far, library = list[Tried](), list[Promise](), sets.library
    most = max((s.gain for s in picks), default=0.0)
    for s in sorted(picks, key=lambda s: library.simplicity(s.move)[0]):
        new, grown = s.move[0], keys((*base[0], *s.move))
        if 0 < s.gain < THRESHOLDS.faded_promise * max((t.gain for t in far), default=0.0):
            sets.lost.add(grown)
            continue
        slow = new.effect.family != instead.effect.family and bool(library.extension(new).memory)
        if slow and (s.gain < THRESHOLDS.memory_promise * most or any(library.within(t.move[0], new) for t in far)):
            continue
        first = sets.try_move(base, s, THRESHOLDS.brief_fit)
        behind = sets.better(own, first)
        if behind <= THRESHOLDS.lost_score:
            first = sets.fit_further(first, THRESHOLDS.first_fit - THRESHOLDS.brief_fit)
            behind = sets.better(own, first)
        tried.append((s, first))
        far += [s] if behind > THRESHOLDS.behind_score else []
        sets.lost |= {grown} if behind > THRESHOLDS.lost_score else set()
    return tried


def worth(some: list[Promise], promised: Sequence[Promise], instead: Candidate | None) -> list[Promise]:
    """Of some moves in the place of a cause the best, and those that promise much of what it does; without one, all."""
    if instead is None:
        return some
    own = next((s.gain for s in promised if keys(s.move) == {instead.key}), 0.0)
    least = min(THRESHOLDS.rival_promise * own, max((s.gain for s in some), default=0.0))
    return [s for s in some if s.gain >= least]


def plain(picks: list[Promise], library: Library) -> list[Promise]:
    """Without a law at many sites beside one that it contains: where that one leads, it is swapped in site by site."""
    many = [s.move[0].effect.name for s in picks if len(s.move) > 1]
    return [s for s in picks if len(s.move) == 1 or not any(library.contains(s.move[0].effect.name, n) for n in many)]


def stuck(sets: FittedSets, causes: Causes, but: Collection[Keys]) -> list[Promise]:
    """Dry friction at every coordinate but those tried already: one that sticks shows a screen neither speed nor force."""
    if causes:
        return []
    dry = [c for c in sets.library.candidates if len(sets.library.dry((c,))) == 1 == len(c.effect.parameters)]
    return _unscreened(sets, ((), sets.nothing), [c for c in dry if keys((c,)) not in but])


def blunted(sets: FittedSets, base: Found) -> list[Promise]:
    """What else remembers on the way of an input where something does already: that blunts what a screen expects of it."""
    library, (causes, now) = sets.library, base
    sites = set() if noise(now) else {c.site for c in causes if library.remembers(c)}
    late = [c for c in library.candidates if c.site in sites and library.remembers(c) and c not in causes]
    return _unscreened(sets, base, late)


def _unscreened(sets: FittedSets, base: Found, candidates: Sequence[Candidate]) -> list[Promise]:
    """Each beside a set, from the best of its first values."""
    library, brief, out = sets.library, sets.brief(base), []
    for c in candidates:
        h, names, starts = library.hypothesis((*base[0], c)), library.names(c), library.starts(c)
        thetas = [h.theta(brief.values | dict(zip(names, row, strict=True))) for row in starts.tolist()]
        theta = promising(h, sets.short, np.array(thetas), brief.start)[0]
        out.append(Promise((c,), {n: float(theta[h.names.index(n)]) for n in names}, 0.0))
    return out


def slipped(sets: FittedSets, causes: Causes) -> list[Promise]:
    """Sensors in another unit, where nothing is followed: a start that is a thousandfold off shows a screen no scale."""
    if causes or not sets.nothing.rough:
        return []
    out = []
    for c in (c for c in sets.library.candidates if c.effect.site == "output" and sets.library.is_factor(c)):
        h, (name,) = sets.library.hypothesis((c,)), sets.library.names(c)
        factors = [f for _, one in THRESHOLDS.unit_slips for f in (one, 1 / one)]
        best, f = min(((followed(h, h.theta({name: f}), sets.short), f) for f in factors), key=lambda one: one[0].chi.max())
        if best.chi.max() < sets.brief(((), sets.nothing)).chi.max():
            # States that no channel shows begin elsewhere, too, where the others are read in another unit.
            out.append(Promise((c,), {name: f}, 0.0, best.start))
    return out


def idle(sets: FittedSets, found: Found, new: Causes) -> bool:
    """Is there a law between one and its richer substitute, and none of these leaves less?

    Or is noise left, and the substitute remembers, which takes long to fit, and leaves plainly more wherever it would begin?
    """
    causes, now = found
    gone, come = without(causes, new), without(new, causes)
    if not len(gone) == len(come) == 1:
        return False
    if noise(now) and sets.library.extension(come[0]).memory and _astray(sets, found, gone[0], come[0], new):
        return True
    between = [k for k in sets.library.candidates if sets.library.within(gone[0], k) and sets.library.within(k, come[0])]
    fits = [sets.known(tuple(k if j is gone[0] else j for j in causes)) for k in between]
    least = float(np.sum(now.residual**2)) - THRESHOLDS.richer_fall
    return bool(fits) and all(f is not None and float(np.sum(f.residual**2)) > least for f in fits)


def _astray(sets: FittedSets, found: Found, old: Candidate, come: Candidate, new: Causes) -> bool:
    """Do all first values of a law leave plainly more than what it would take the place of?"""
    h, names, starts = sets.library.hypothesis(new), sets.library.names(come), sets.library.starts(come)
    known, same = found[1].values, sets.carry(old, come, found, default=False)
    thetas = [h.theta(known | dict(zip(names, row, strict=True)) | same) for row in starts.tolist()]
    return promising(h, sets.windows, np.array(thetas), found[1].start)[2] > THRESHOLDS.astray * float(
        np.sum(found[1].residual ** 2)
    )


def swaps(sets: FittedSets, found: Found) -> list[Option]:
    """Each cause replaced by a law that it contains; by one that contains it, or of its family, where that may pay.

    Where a joint sticks, or remembers, no screen shows what a richer law would change. Where samples cannot be counted, a law
    is also replaced at all its sites at once: windows that agree on all of them may hesitate about each.
    """
    library, (causes, now) = sets.library, found
    n = now.residual.shape[0] * now.residual.shape[1]
    left = float(np.sum(now.whiteness * n * np.log(np.maximum(now.chi, 1.0)))) > 2 * THRESHOLDS.tie_score
    out: dict[Keys, Option] = {}
    for c in causes:
        for e in library.candidates:
            if e.site != c.site or e.key in keys(causes) or any(library.related(e, k) for k in causes if k is not c):
                continue
            certain = library.contains(c.effect.name, e.effect.name) or library.richer(e, c)
            family = bool(c.effect.family) and c.effect.family == e.effect.family
            kin = family or library.contains(e.effect.name, c.effect.name)
            if certain or (kin and (left or ((s := sets.promise(found, e)) is not None and s.gain > THRESHOLDS.tie_score))):
                alike = _alike(sets, causes, c)
                for where in ((c,), alike) if certain and len(alike) > 1 else ((c,),):
                    new, start = _swapped(sets, found, where, e)
                    out.setdefault(keys(new), (new, start))
    return list(out.values())


def spared(sets: FittedSets, causes: Causes, new: Causes) -> bool:
    """Does a simpler law take one of several sites from a law that is judged at all of them at once?"""
    gone, come = without(causes, new), without(new, causes)
    if not len(gone) == len(come) == 1 or len(_alike(sets, causes, gone[0])) == 1:
        return False
    return sets.library.contains(gone[0].effect.name, come[0].effect.name)


def _alike(sets: FittedSets, causes: Causes, c: Candidate) -> Causes:
    """Causes that are judged with c: where samples cannot be counted, the same law at other sites."""
    return tuple(k for k in causes if k is c or (sets.cautious and k.effect.name == c.effect.name))


def _swapped(sets: FittedSets, found: Found, where: Causes, e: Candidate) -> Option:
    """With the law of e in the place of these causes, where it can act there."""
    rest = [k for k in found[0] if k not in where]
    at = {k.site: k for k in sets.library.candidates if k.effect.name == e.effect.name}
    at = {site: new for site, new in at.items() if not any(sets.library.related(new, k) for k in rest)}
    new, start = tuple(at.get(k.site, k) if k in where else k for k in found[0]), dict[str, float]()
    for k in where if sets.known(new) is None else ():
        start |= sets.carry(k, at[k.site], found) if k.site in at else {}
    return new, start


def remembered(sets: FittedSets, found: Found) -> list[Option]:
    """Where no noise is left, a law of an input that remembers in the place of one that does not, which no screen shows.

    Of each cause the one that leaves least at its best first values.
    """
    library, (causes, now), out = sets.library, found, list[Option]()
    for c in () if noise(now) or now.chi.max() > THRESHOLDS.lost_search else causes:
        rest, tried = without(causes, (c,)), list[tuple[float, Option]]()
        for e in library.candidates if c.effect.site == "input" and not library.remembers(c) else ():
            if e.site == c.site and library.remembers(e) and not any(library.related(e, k) for k in rest):
                h, names, starts = library.hypothesis((*rest, e)), library.names(e), library.starts(e)
                thetas = [h.theta(now.values | dict(zip(names, row, strict=True))) for row in starts.tolist()]
                theta, _, left = promising(h, sets.windows, np.array(thetas), now.start)
                tried.append((left, ((*rest, e), {n: float(theta[h.names.index(n)]) for n in names})))
        out += [option for _, option in sorted(tried, key=lambda t: t[0])[:1]]
    return out


def merges(sets: FittedSets, found: Found) -> list[Option]:
    """Two causes at one site as one law that contains the first of them."""
    causes, out = found[0], []
    for a, b in itertools.permutations(causes, 2):
        for e in sets.library.candidates if a.site == b.site else ():
            if e.site == a.site and a.effect.name in e.effect.contains and e.key not in keys(causes):
                start = sets.carry(a, e, found) | sets.carry(b, e, found, default=False)
                out.append(((*without(causes, (a, b)), e), start))
    return out
