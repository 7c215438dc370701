"""Sets of causes with their fits, and by how much one of them is the better explanation."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from gapcert.plugin import Array
from gapcert_diagnosis.fitting.fit import Fit

from .candidates import Causes, Library

NOISE = 1.05
SURE, OFTEN = 3.0, 0.8  # standard errors
TIE = 10.0  # scores closer than this cannot be told apart
COPIED = 6.6  # score of one number that is there by chance in one of a hundred cases
COLOURED = 0.5  # whiteness below which a residual is no white noise

Keys = frozenset[tuple[str, str]]
Found = tuple[Causes, Fit]


def better(new: Fit, old: Fit, cautious: bool = False) -> float:
    """ΔS: how far the score of `new` lies below that of `old`, both as the closer fit has it.

    Cautious: what is left of a rough fit is no noise that samples could be counted by; there it is at most z², the agreement
    of the windows.
    """
    closer = closest([new, old])
    robust = cautious and closer.rough
    fell = old.score(closer, robust) - new.score(closer, robust)
    return math.copysign(min(abs(fell), agreement(new, old) ** 2), fell) if robust else fell


def agreement(new: Fit, old: Fit) -> float:
    """z: the mean fall of the windows' scores over its standard error. Each has one voice, however badly it is fitted."""
    fell = np.sum(new.whiteness * (np.log(old.each) - np.log(new.each)), axis=1)
    error = float(np.std(fell, ddof=1)) / math.sqrt(len(fell)) if len(fell) > 1 else math.inf
    return float(fell.mean()) / max(error, 1e-12)


def noise(fitted: Fit, beyond: float = OFTEN) -> bool:
    """Is no more left than NOISE noise floors, or than chance shows in so few samples of the worst of the channels?

    beyond: standard errors more than that one usually has.
    """
    worst = beyond + math.sqrt(2 * math.log(len(fitted.chi)))
    chance = worst * np.sqrt(2 / np.maximum(np.maximum(fitted.whiteness, COLOURED) * fitted.counts, 1.0))
    return bool((fitted.chi <= np.maximum(NOISE, 1 + chance)).all())


def closest(fits: Sequence[Fit]) -> Fit:
    return min(fits, key=lambda f: float(f.chi.sum()))


def ranked(found: Sequence[Found], cautious: bool = False) -> list[Found]:
    """Best score first, all as the closest fit has it."""
    if not found:
        return []
    best = closest([f for _, f in found])
    return sorted(found, key=lambda f: f[1].score(best, cautious and best.rough))


def rough_charge(library: Library, causes: Causes, before: Causes) -> float:
    """What a larger set must bring where samples cannot be counted; only the same law at one more site may be had so.

    No rivals are charged for it, and a richer one is. The law elsewhere may also be a simpler one: a bristle at one joint and
    Coulomb's at the other are both dry friction.
    """
    contains, known, names = library.contains, {c.effect.name for c in before}, {c.effect.name for c in causes}
    richer = {n: k for n in names - known for k in sorted(known) if contains(n, k)}
    simpler = {n: k for n in names - known for k in sorted(known) if contains(k, n)}
    if {richer.get(n, simpler.get(n, n)) for n in names} != known:
        return math.inf
    return COPIED + (SURE**2 if richer else 0.0)


def values(fitted: Fit) -> dict[str, float]:
    """Fitted numbers by name."""
    return dict(zip(fitted.hypothesis.names, map(float, fitted.theta), strict=True))


def keys(causes: Causes) -> Keys:
    return frozenset(c.key for c in causes)


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


def named(causes: Causes) -> str:
    """`coulomb-friction at q + viscous-friction at q`."""
    return " + ".join(f"{effect} at {site}" for effect, site in (c.key for c in causes)) or "no cause"


def so_far(fits: Mapping[Keys, Found]) -> dict[str, str]:
    """The set with the least error on the fitted windows, and the share of it that is left: what one sees meanwhile."""
    tried = [found for found in fits.values() if found[0]]
    before = float(fits[frozenset()][1].chi.sum()) if frozenset() in fits else 0.0
    if not tried or before <= 0:
        return {}
    causes, least = min(tried, key=lambda found: float(found[1].chi.sum()))
    return {"best": named(causes), "error left": f"{math.sqrt(float(least.chi.sum()) / before):.0%}"}
