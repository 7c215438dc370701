"""Which of many short fits are worth a full one."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from gapcert.diagnosis.fit import Fit
from gapcert.diagnosis.ledger import Screened
from gapcert.diagnosis.library import Candidate, Library
from gapcert.diagnosis.scores import TIE, closest, keys

KEEP, MORE = 4, 2  # candidates that get a full fit; near ties beside them
BEHIND = 100.0  # score on short windows by which a rival may be worse, and still be as good on long ones

LIKELY = 0.3  # of what a cause promises, what a rival of it must promise

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
