"""Order statistics: how many scores, which rank, and what they say; on many repetitions of known distributions."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest
from scipy.stats import binom

import gapcert as gc
from gapcert.numerics import order_statistics as c

EPSILON, BETA = 0.05, 0.05
REPETITIONS = 20_000


@pytest.mark.parametrize(("exceedances", "points"), [(0, 13_809), (1, 16_681), (5, 25_403), (10, 34_416), (50, 92_375)])
def test_the_fewest_points_of_a_rank(exceedances: int, points: int) -> None:
    assert c.points_needed(1e-3, 1e-6, exceedances) == points
    assert c.missed(exceedances, points, 1e-3) <= 1e-6 < c.missed(exceedances, points - 1, 1e-3)
    assert c.most_exceedances(points, 1e-3, 1e-6) == exceedances
    assert c.most_exceedances(points - 1, 1e-3, 1e-6) == (exceedances - 1 if exceedances else None)


@pytest.mark.parametrize("epsilon", [1e-4, 0.01, 0.3, 0.97])
@pytest.mark.parametrize("n", [1, 7, 400])
def test_sums_are_those_of_the_binomial_distribution(epsilon: float, n: int) -> None:
    for m in {0, n // 3, n - 1}:
        assert float(c.missed(m, n, epsilon)) == pytest.approx(binom.cdf(m, n, epsilon), rel=1e-9)
    assert c.missed(n, n, epsilon) == 1  # says nothing
    v = c.surprising(n, epsilon)
    assert v == n + 1 or binom.sf(v - 1, n, epsilon) <= c.THRESHOLDS.surprise * (1 + 1e-9)
    assert binom.sf(v - 2, n, epsilon) > c.THRESHOLDS.surprise * (1 - 1e-9)


def test_sums_are_rounded_against_the_claim() -> None:
    up = [next(iter(c._sums(n, 0.1, c._UP, c._DOWN))) for n in range(1, 60)]
    down = [next(iter(c._sums(n, 0.1, c._DOWN, c._UP))) for n in range(1, 60)]
    exact = [(1 - Fraction(0.1)) ** n for n in range(1, 60)]
    assert all(Fraction(a) <= e <= Fraction(b) for a, e, b in zip(down, exact, up, strict=True))
    assert any(Fraction(a) < e < Fraction(b) for a, e, b in zip(down, exact, up, strict=True))
    share = Fraction(0.1)
    for m, n in ((0, 20), (3, 40), (17, 60)):
        whole = sum(math.comb(n, j) * share**j * (1 - share) ** (n - j) for j in range(m + 1))
        assert whole < Fraction(c.missed(m, n, 0.1)) < whole * (1 + Fraction(1, 10**50))


def failures(points: int, exceedances: int, fitted: bool = False) -> float:
    """The share of repetitions in which the next score exceeds the chosen one with probability > ε; scores uniform on [0, 1].

    fitted: the points are those that a fit of 5 parameters has seen: the 5 worst were made to fit.
    """
    rng = np.random.default_rng([points, exceedances])
    scores = np.sort(rng.random((REPETITIONS, points)), axis=1)
    if fitted:
        scores = np.sort(np.hstack([scores[:, :-5], 0.5 * scores[:, -5:]]), axis=1)
    return float((1 - scores[:, points - exceedances - 1] > EPSILON).mean())


@pytest.mark.parametrize("exceedances", [0, 1, 4])
def test_coverage_fails_as_seldom_as_promised_and_no_seldomer_rank_does(exceedances: int) -> None:
    n = c.points_needed(EPSILON, BETA, exceedances)
    slack = 4 * np.sqrt(BETA / REPETITIONS)
    assert failures(n, exceedances) <= BETA + slack
    assert failures(n, exceedances) >= float(c.missed(exceedances, n, EPSILON)) - slack  # nothing is given away
    assert failures(n, exceedances + 1) > 2 * BETA  # the next rank claims too much
    assert failures(n, exceedances, fitted=True) > 10 * BETA  # and so do points that a fit has seen


def test_ties_and_rounding_do_not_break_coverage() -> None:
    n = c.points_needed(EPSILON, BETA, 2)
    rng = np.random.default_rng(5)
    scores = np.sort(np.floor(rng.random((REPETITIONS, n)) * 30), axis=1)  # 30 values, many ties
    beyond = 1 - (scores[:, n - 3] + 1) / 30
    assert (beyond > EPSILON).mean() <= BETA + 4 * np.sqrt(BETA / REPETITIONS)


def test_exchangeable_units_are_covered_on_average() -> None:
    epsilon, n = 0.1, 19
    rank = c.conformal_rank(n, epsilon)
    rng = np.random.default_rng(6)
    # Exchangeable, and not independent: all units of a repetition share a scale.
    units = rng.exponential(size=(REPETITIONS, 1)) * rng.random((REPETITIONS, n + 1))
    chosen = np.sort(units[:, :n], axis=1)[:, rank - 1]
    missed = float((units[:, n] > chosen).mean())
    slack = 4 * np.sqrt(epsilon / REPETITIONS)
    assert epsilon - slack <= missed <= epsilon + slack  # (n + 1) ε is whole: exactly ε
    lower = np.sort(units[:, :n], axis=1)[:, rank - 2]
    assert float((units[:, n] > lower).mean()) > epsilon + slack


def test_the_exchangeable_rank_is_no_claim_with_confidence() -> None:
    n = 19
    rank = c.conformal_rank(n, 0.1)
    scores = np.sort(np.random.default_rng(7).random((REPETITIONS, n)), axis=1)
    assert float((1 - scores[:, rank - 1] > 0.1).mean()) > 0.3


def test_too_few_units_say_how_many_are_needed() -> None:
    assert c.conformal_points(0.01) == 99
    assert c.conformal_rank(99, 0.01) == 99
    with pytest.raises(gc.UsageError, match=r"98 units, and ε = 0.01 needs 99; with these the smallest ε is 0.010102"):
        c.conformal_rank(98, 0.01)


def test_scores_are_rounded_so_that_the_moved_band_contains() -> None:
    rng = np.random.default_rng(8)
    low, width, scale = rng.normal(size=(5000, 2)), rng.random((5000, 2)), np.array([0.3, 7.0])
    r = low + rng.normal(size=(5000, 2))
    score = c.scores(r, low, low + width, scale)
    w = np.stack([c.widening(float(s), scale) for s in score])
    assert (np.nextafter(low - w, -np.inf) <= r).all()
    assert (r <= np.nextafter(low + width + w, np.inf)).all()
    assert (score < 0).any()
    assert (score > 0).any()


@pytest.mark.parametrize("value", [0.0, 1.0, -0.1, float("nan")])
def test_what_is_no_probability_is_refused(value: float) -> None:
    with pytest.raises(gc.UsageError, match="between 0 and 1"):
        c.points_needed(value, 0.1)
    with pytest.raises(gc.UsageError, match="between 0 and 1"):
        c.points_needed(0.1, value)
