"""Which of many short fits are worth a full one."""

from __future__ import annotations

from collections.abc import Collection

from gapcert.diagnosis.fit import Fit
from gapcert.diagnosis.ledger import Screened
from gapcert.diagnosis.scores import TIE, closest, keys

KEEP, MORE = 4, 2  # candidates that get a full fit; near ties beside them
BEHIND = 100.0  # score on short windows by which a rival may be worse, and still be as good on long ones

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
