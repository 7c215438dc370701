"""Two causes at once: where neither helps much without the other, steps of one lead elsewhere."""

from __future__ import annotations

import numpy as np

from gapcert_diagnosis.fitting.fit import Fit, fit

from .criterion import SURE, Found, beats, keys, noise, ranked, values
from .stepwise import SECOND, Search

PAIRS = 6  # of the largest promise on long and on short windows, that get a short fit
FULL = 2  # that get a full one
SHARE = 0.6  # of what was found, below which no pair promises to explain as much


def leapt(search: Search, found: Found) -> Found:
    """What a search found, or two causes, dropped and swapped as usual, that explain more, or as much where it names three."""
    if keys(found[0]) == search.piled:
        return found  # of all candidates at once, and noise is left
    nothing, now = ((), search.nothing), search.brief(found)
    promised = search.screen.pairs([(search.nothing, 1), (search.brief(nothing), search.parts)], PAIRS)
    most = max((s.gain for s in promised), default=0.0)
    if most < (SHARE * _explained(search, found[1]) if noise(found[1], SURE) and found[0] else 2 * search.library.threshold):
        return found
    now = fit(now.hypothesis, search.short, theta=now.theta, start=now.start, iterations=SECOND)
    moves = {keys(s.move): s for s in reversed(promised)}
    tried = ranked([(s.move, search.tried((), nothing, s)) for s in moves.values()])
    best = found
    for causes, first in tried[:FULL]:
        if beats(first, now, search.cautious, fewer=len(causes) < len(best[0])):
            second = fit(first.hypothesis, search.short, theta=first.theta, start=first.start, iterations=SECOND)
            new = search.refined((causes, search.fit(causes, nothing, values(second))))
            more = beats(new[1], best[1], search.cautious, fewer=len(new[0]) < len(best[0]))
            enough = search.better(new[1], search.nothing) > len(new[0]) * search.library.threshold
            if more and enough and search.pays(new, nothing) and search.matters(new):
                best = new
    return best


def _explained(search: Search, fitted: Fit) -> float:
    """What a promise of as much would be: Σ n (1 − χ/χ₀) on the windows of the screen."""
    share = 1 - fitted.chi / np.maximum(search.nothing.chi, 1e-300)
    return float(np.sum(share * fitted.counts)) * len(search.screen.windows) / len(search.windows)
