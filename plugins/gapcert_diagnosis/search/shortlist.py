"""Which of many short fits are worth a full one."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from gapcert_diagnosis.fitting.fit import Fit, fit, promising

from .candidates import Candidate, Causes, Library
from .criterion import TIE, Found, Keys, closest, keys, values
from .gains import Screened

if TYPE_CHECKING:
    from .stepwise import Search

FIRST, BRIEFLY = 4, 2  # iterations of a short fit; of one that shows whether it is worth the others
KEEP, MORE = 4, 2  # candidates that get a full fit; near ties beside them
BEHIND = 100.0  # score on short windows by which a rival may be worse, and still be as good on long ones
LOST = 10 * BEHIND  # the same, from which a rival is not fitted to long ones, unless it is the best
FADED = 0.7  # of the promise of a rival that is far behind: what promises less is not tried
SLOW = 0.5  # of the best promise, what a law that remembers must promise to be tried in the place of another family's

LIKELY = 0.3  # of what a cause promises, what a rival of it must promise
LOOSELY, FEW = 0.1, 4  # the same, where the fit of nothing is asked; how many are taken in any case

Tried = tuple[Screened, Fit]


def finalists(tried: list[Tried], also: Collection[object], cautious: bool) -> list[Tried]:
    """The best of each family, so that one does not crowd out the others; and what is in `also`."""
    closer = closest([f for _, f in tried])
    robust = cautious and closer.rough
    tried = sorted(tried, key=lambda t: t[1].score(closer, robust))
    families: set[object] = set()
    first = []
    for s, f in tried:
        family = frozenset((c.effect.family or c.effect.name, c.site) for c in s.move)
        if family not in families:
            families.add(family)
            first.append((s, f))
    best = first[0][1].score(closer, robust)
    close = [t for t in first[KEEP : KEEP + MORE] if t[1].score(closer, robust) < best + TIE]
    kept = first[:KEEP] + close
    return kept + [t for t in first[KEEP:] if keys(t[0].move) in also and t not in kept]


def near(tried: list[Tried], own: Fit, cautious: bool) -> list[Tried]:
    """The best, and those that are not far behind the fit of what they would stand for."""
    closer = closest([own, *(f for _, f in tried)])
    robust = cautious and closer.rough
    scores = [f.score(closer, robust) for _, f in tried]
    least = max(min(scores, default=0.0), own.score(closer, robust) + BEHIND)
    return [t for t, score in zip(tried, scores, strict=True) if score <= least]


def replacements(search: Search, picks: list[Screened], base: Found, instead: Candidate, own: Fit) -> list[Tried]:
    """Short fits in the place of a cause, whose own is given; none of what promises plainly less than one far behind that.

    What remembers takes many times as long as what does not: of another family it is not tried either where a law within it is
    far behind, or where others promise much more.
    """
    tried, far, library = list[Tried](), list[Screened](), search.library
    most = max((s.gain for s in picks), default=0.0)
    for s in sorted(picks, key=lambda s: library.simplicity(s.move)[0]):
        new, grown = s.move[0], keys((*base[0], *s.move))
        if 0 < s.gain < FADED * max((t.gain for t in far), default=0.0):
            search.lost.add(grown)
            continue
        slow = new.effect.family != instead.effect.family and bool(library.extension(new).memory)
        if slow and (s.gain < SLOW * most or any(library.within(t.move[0], new) for t in far)):
            continue
        first = search.tried(base[0], base, s, BRIEFLY)
        behind = search.better(own, first)
        if behind <= LOST:
            first = fit(first.hypothesis, search.short, theta=first.theta, start=first.start, iterations=FIRST - BRIEFLY)
            behind = search.better(own, first)
        tried.append((s, first))
        far += [s] if behind > BEHIND else []
        search.lost |= {grown} if behind > LOST else set()
    return tried


def standing_in(moves: Sequence[Causes], gains: Mapping[tuple[str, str], float], cause: tuple[str, str]) -> list[Causes]:
    """Single moves that promise some of what a cause does, the best few in any case, and the cause itself.

    Those without a column, which lift the tolerance of a number that is free already, cost nothing to ask.
    """
    best = sorted(gains, key=lambda k: -gains[k])[:FEW]
    near = {k for k, gain in gains.items() if gain > LOOSELY * gains.get(cause, 0.0)}
    kept = {*near, *best, cause}
    return [m for m in moves if len(m) == 1 and (m[0].key in kept or m[0].key not in gains)]


def worth(some: list[Screened], promised: Sequence[Screened], instead: Candidate | None) -> list[Screened]:
    """Of some moves in the place of a cause the best, and those that promise much of what it does; without one, all."""
    if instead is None:
        return some
    own = next((s.gain for s in promised if keys(s.move) == {instead.key}), 0.0)
    least = min(LIKELY * own, max((s.gain for s in some), default=0.0))
    return [s for s in some if s.gain >= least]


def plain(picks: list[Screened], library: Library) -> list[Screened]:
    """Without a law at many sites beside one that it contains: where that one leads, it is swapped in site by site."""
    many = [s.move[0].effect.name for s in picks if len(s.move) > 1]
    return [s for s in picks if len(s.move) == 1 or not any(library.contains(s.move[0].effect.name, n) for n in many)]


def stuck(search: Search, causes: Causes, but: Collection[Keys]) -> list[Screened]:
    """Dry friction at every coordinate but those tried already: one that sticks shows a screen neither speed nor force."""
    library, nothing = search.library, ((), search.nothing)
    dry = [c for c in library.candidates if len(library.dry((c,))) == 1 == len(c.effect.parameters)]
    out = []
    for c in (c for c in dry if not causes and keys((c,)) not in but):
        h, names, starts = library.hypothesis((c,)), library.names(c), library.starts(c)
        known = values(search.brief(nothing))
        thetas = np.array([[(known | dict(zip(names, row, strict=True)))[n] for n in h.names] for row in starts.tolist()])
        theta = promising(h, search.short, thetas, search.brief(nothing).start)[0]
        out.append(Screened((c,), {n: float(theta[h.names.index(n)]) for n in names}, 0.0))
    return out
