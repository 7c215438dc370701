"""When is one set of causes the better explanation? Every acceptance test of the search, as a function of what it compares.

ΔS is the fall of the score from the old fit to the new one (`better`), z the agreement of windows (`agreement`), χ the mean
squared residual of a channel over that of noise, G the charge for one more cause, 12 + 2 ln(candidates).

| test           | compares                         | holds where                                           | asked by       |
| -------------- | -------------------------------- | ----------------------------------------------------- | -------------- |
| `noise`        | a fit, the noise floor           | χ ≤ max(`noise_level`, 1 + chance) in all channels    | everyone       |
| `pays`         | a set, one without some causes   | χ falls, ΔS > G; z > `sure_errors` if it falls little | steps, drops   |
| `decides`      | a set, one without one cause     | χ > `plain_residual`² without it, most of that gone   | `matters`      |
| `halves`       | rollouts with and without a cause | error > `loud_channel` without it, most gone with it  | `matters`      |
| `ahead`        | two sets, on held-out data       | noise, beside no noise; or blocks agree by `surely`   | ties, rivals   |
| `outdoes`      | a set, one on another path       | ΔS > 0; if it is larger ΔS > G, and it pays           | steps          |
| `beats`        | two causes at once, single steps | ΔS > `tie_score`; ΔS > 0 if they are fewer            | pairs          |
| `margin`       | a set, one with another law      | ΔS > ±`richer` by its numbers; as many: ±`tie_score`  | exchanges      |
| `richer`       | a law, one that it contains      | ΔS > `richer_score`                                   | ties, `margin` |
| `agrees`       | two fits, on later data          | these see `guard_share` of the excess over noise gone | later data     |
| `fails`        | a fit on later data, its due     | χ > `late_residual` times what is due                 | later data     |
| `setting_pays` | a fit under another setting      | χ falls by `setting_share`, ΔS > charge               | settings       |

Where a search is cautious and the closer of two fits is rough, ΔS is at most z², `rough_charge` stands for G, and
`sure_errors`² or `spared_score` for `richer_score`. `FittedSets.small` says which causes are too small to be named, and
`native.stepwise` what pays for an engine.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np
from scipy.special import ndtr, stdtrit

from gapcert.plugin import Array
from gapcert_diagnosis.fitting.fit import Fit
from gapcert_diagnosis.thresholds import THRESHOLDS
from gapcert_figures import called

from .candidates import Causes, Library

Keys = frozenset[tuple[str, str]]
Found = tuple[Causes, Fit]
T = TypeVar("T")


def better(new: Fit, old: Fit, cautious: bool = False) -> float:
    """ΔS: how far the score of `new` lies below that of `old`, both as the closer fit has it.

    Cautious: what is left of a rough fit is no noise that samples could be counted by; there it is at most z², the agreement
    of the windows.
    """
    closer = closest([new, old])
    robust = cautious and closer.rough
    fell = old.score(closer, robust) - new.score(closer, robust)
    return math.copysign(min(abs(fell), agreement(falls(new, old)) ** 2), fell) if robust else fell


def falls(new: Fit, old: Fit) -> Array:
    """(W,): the falls of the windows' scores."""
    return np.asarray(np.sum(new.whiteness * (np.log(old.each) - np.log(new.each)), axis=1))


def agreement(fell: Array) -> float:
    """z: the mean of falls over its standard error. Each window, or trajectory, has one voice, however badly it is fitted."""
    error = float(np.std(fell, ddof=1)) / math.sqrt(len(fell)) if len(fell) > 1 else math.inf
    return float(fell.mean()) / max(error, 1e-12)


def noise(fitted: Fit, beyond: float = THRESHOLDS.often_errors) -> bool:
    """Is no more left than `noise_level` noise floors, or than chance shows in so few samples of the worst of the channels?

    beyond: standard errors more than that one usually has.
    """
    worst = beyond + math.sqrt(2 * math.log(len(fitted.chi)))
    chance = worst * np.sqrt(2 / np.maximum(np.maximum(fitted.whiteness, THRESHOLDS.white_enough) * fitted.counts, 1.0))
    return bool((fitted.chi <= np.maximum(THRESHOLDS.noise_level, 1 + chance)).all())


def pays(new: Fit, old: Fit, charge: float, rough: float | None = None) -> bool:
    """Does the score fall by more than a larger set must bring, and the residual, or the prior, with it?

    rough: what is charged to a cautious search where the closer fit is rough.
    """
    fell, by_prior = 1 - new.chi / old.chi, old.prior - new.prior > THRESHOLDS.prior_fall
    if not ((fell > THRESHOLDS.least_fall).any() or by_prior):
        return False
    if rough is not None and closest([new, old]).rough:
        return better(new, old, cautious=True) > min(rough, charge)
    if better(new, old) <= charge:
        return False
    most = int(np.argmax(fell))
    small = THRESHOLDS.small_gain if new.whiteness[most] > THRESHOLDS.white_enough else THRESHOLDS.small_gain_coloured
    return bool(fell[most] > small or by_prior) or agreement(falls(new, old)) > THRESHOLDS.sure_errors


def decides(whole: Fit, without: Fit) -> bool:
    """Is the residual plainly above the noise without a cause, and most of it gone with it?"""
    most = THRESHOLDS.little_force_share[whole.rough]
    return bool(((without.chi > THRESHOLDS.plain_residual**2) & (whole.chi < (1 - most) ** 2 * without.chi)).any())


def halves(whole: Array, without: Array) -> bool:
    """Is the error (ny,) of long rollouts, in noise floors, above the noise without a cause, and most of it gone with it?"""
    rest, before = (float(np.sum(np.maximum(e**2 - 1, 0.0))) for e in (whole, without))
    most = THRESHOLDS.little_force_share[bool((whole**2 > THRESHOLDS.rough).any())]
    return bool((without > THRESHOLDS.loud_channel).any() and rest < (1 - most) ** 2 * before)


def ahead(floors: Array, others: Array, blocks: Array, other_blocks: Array, due: Callable[[], Sequence[Array]]) -> bool:
    """Does one set foretell held-out data plainly better than another?

    floors (ny,): errors of rollouts in noise floors; blocks (k,): E² of stretches that share no data. It does where its errors
    are noise and the other's twice as much and none, or where the blocks' falls of ln E² are beyond chance (Student's t). due:
    errors that noise would make of either, were it true, which the other's have to exceed by more.
    """
    noise_beside = (floors <= THRESHOLDS.loud_channel).all() and (others > 2 * floors).any()
    beyond = stdtrit(max(1, len(blocks) - 1), ndtr(THRESHOLDS.sure_errors))
    less = blocks.mean() < THRESHOLDS.foretold_share**2 * other_blocks.mean()
    plain = noise_beside or (less and agreement(np.log(other_blocks + 1e-300) - np.log(blocks + 1e-300)) > beyond)
    if not plain or (others <= THRESHOLDS.loud_channel).all():
        return False
    one, two = due()
    return bool((others / two > THRESHOLDS.loud_channel * np.maximum(1.0, floors / one)).any())


def outdoes(new: Fit, best: Fit, charge: float, rough: float | None = None, *, larger: bool) -> bool:
    """Is it better? One that is larger, on whatever path it was found, must pay for that, too."""
    fell = better(new, best, rough is not None)
    return fell > charge and pays(new, best, charge, rough) if larger else fell > 0


def beats(new: Fit, old: Fit, cautious: bool, *, fewer: bool) -> bool:
    """By a plain difference of the score, or with fewer causes."""
    return better(new, old, cautious) > (0.0 if fewer else THRESHOLDS.tie_score)


def richer(fits: Sequence[Fit], cautious: bool, spared: bool = False) -> float:
    """The score by which a law must beat one that it contains; spared: at one of several sites that are judged at once."""
    rough = THRESHOLDS.spared_score if spared else THRESHOLDS.sure_errors**2
    return rough if cautious and closest(fits).rough else THRESHOLDS.richer_score


def margin(fits: Sequence[Fit], more: int, cautious: bool, *, merged: bool, spared: bool) -> float:
    """The score by which a set must beat one with another law in a law's place, if it has so many numbers more.

    merged: it has one law instead of two; with as many numbers, that need not even fit as well.
    """
    if more == 0:
        return -THRESHOLDS.tie_score if merged else THRESHOLDS.tie_score
    return math.copysign(richer(fits, cautious, spared), more)


def agrees(new: Fit, old: Fit, one: Fit, two: Fit) -> bool:
    """Do later data see a share of the excess over the noise explained, or no harm done where the prior alone spoke?

    one, two: the numbers of the new and of the old fit on the later data.
    """
    after, before = one.chi, two.chi
    # A push that is over, a joint at rest, a channel that is not moved here: these data contradict nothing.
    if (
        max(after.max(), before.max()) < THRESHOLDS.quiet
        or np.mean((one.residual - two.residual) ** 2) < THRESHOLDS.same_motion**2
    ):
        return True
    concerned = new.chi < (1 - THRESHOLDS.least_fall) * old.chi
    if (
        before[concerned].max(initial=0.0) < THRESHOLDS.quiet
        and agreement(falls(one, two)) > -THRESHOLDS.sure_errors
        and after.max() < THRESHOLDS.creep_residual
    ):
        return True
    if one.rough:
        fell = (two.typical - one.typical) / np.maximum(two.typical - 1, 1e-9)
        return bool(fell.max() >= THRESHOLDS.guard_share and agreement(falls(one, two)) > THRESHOLDS.leaning_errors)
    worst = int(np.argmax(before))
    if old.prior - new.prior > THRESHOLDS.prior_fall and (after < 1.05 * np.maximum(before, 1.0)).all():
        return True
    return bool(before[worst] - after[worst] >= max(THRESHOLDS.guard_share * (before[worst] - 1), 1e-9))


def fails(later: Fit, chi: float) -> bool:
    """Is a fit, judged on later data, plainly further off there than it should be?"""
    return float(later.chi.max()) > THRESHOLDS.late_residual * chi


def setting_pays(new: Fit, old: Fit, charge: float, *, fewer: bool) -> bool:
    """In place of causes only the choice of a setting is charged; beside them it pays for itself."""
    if fewer:
        return better(new, old) > charge - 12
    much = bool((new.chi < (1 - THRESHOLDS.setting_share) * old.chi).any() and new.chi.sum() < old.chi.sum())
    return much and better(new, old) > charge


def closest(fits: Sequence[Fit]) -> Fit:
    return min(fits, key=lambda f: float(f.chi.sum()))


def scores(fits: Sequence[Fit], cautious: bool) -> list[float]:
    """All as the closest of them has it."""
    best = closest(fits) if fits else None
    return [f.score(best, cautious and best.rough) for f in fits] if best else []


def rank(found: Sequence[tuple[T, Fit]], cautious: bool = False) -> list[tuple[T, Fit]]:
    """Best score first."""
    marks = scores([f for _, f in found], cautious)
    return [f for _, f in sorted(zip(marks, found, strict=True), key=lambda p: p[0])]


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
    return THRESHOLDS.number_score + (THRESHOLDS.sure_errors**2 if richer else 0.0)


def keys(causes: Causes) -> Keys:
    return frozenset(c.key for c in causes)


def without(causes: Causes, others: Causes) -> Causes:
    """Those that are not among the others."""
    return tuple(c for c in causes if c.key not in keys(others))


def named(causes: Causes) -> str:
    """`Coulomb friction at q and viscous friction at q`."""
    return " and ".join(called(*c.told) for c in causes) or "no cause"
