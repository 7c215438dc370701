"""Arcs of the circle: which float is on which, at every seam, some hundred floats and twenty turns around."""

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gapcert import Box, Region, StateSpec
from gapcert.numerics import circle
from gapcert.numerics.circle import TURN

ANGLE = (StateSpec("a", "rad", "angle"),)
FLOATS = 400
TURNS = range(-20, 21)


def around(x: float, n: int = FLOATS) -> np.ndarray:
    """x and the n floats on either side of it."""
    up, down = [x], [x]
    for _ in range(n):
        up.append(math.nextafter(up[-1], math.inf))
        down.append(math.nextafter(down[-1], -math.inf))
    return np.array(down[:0:-1] + up)


def seam(end: float) -> np.ndarray:
    return np.concatenate([around(end + TURN * k) for k in TURNS])


def beyond(x: np.ndarray, low: float, high: float, k: int) -> np.ndarray:
    """How far floats are outside of the k-th copy of [low, high], by fractions; negative inside."""
    first, last = (Fraction(end) + k * Fraction(TURN) for end in (low, high))
    return np.array([float(max(first - Fraction(v), Fraction(v) - last)) for v in x.tolist()])


def apart(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """How far they are on the circle, by fractions."""
    d = [Fraction(a) - Fraction(b) for a, b in zip(x.tolist(), y.tolist(), strict=True)]
    return np.array([float(abs(v - Fraction(TURN) * round(v / Fraction(TURN)))) for v in d])


@pytest.mark.parametrize("low", [0.0, -np.pi, -0.3, 2.5, 40.0, -63.1])
def test_a_full_turn_has_no_outside(low: float) -> None:
    high = low + TURN
    assert circle.spans(low, high)
    x = seam(low)
    y = circle.onto(low, high, x)
    assert ((y >= low) & (y <= high)).all()
    # Two roundings, each in units of the larger of the two numbers.
    assert (apart(x[::37], y[::37]) <= 2 * np.spacing(np.abs(x[::37]) + abs(low) + TURN)).all()
    kept = (x >= low) & (x <= high)
    assert np.array_equal(y[kept], x[kept])


@given(st.floats(-130, 130))
def test_an_end_and_a_turn_are_a_turn_from_either_end(end: float) -> None:
    assert circle.spans(end, end + TURN)
    assert circle.spans(end - TURN, end)
    assert not circle.spans(end, end + TURN - 1e-12)
    assert circle.spans(-3.14159265358979, 3.14159265358979), "as many digits as people write"


@settings(max_examples=40)
@given(st.floats(-70, 70), st.floats(1e-3, 6.2), st.integers(-20, 20))
def test_an_arc_is_closed_and_no_larger_than_it_is(low: float, width: float, k: int) -> None:
    high = low + width
    for end in (low, high):
        x = around(end + TURN * k, 20)
        y = circle.onto(low, high, x)
        inside, far = (y >= low) & (y <= high), beyond(x, low, high, k)
        assert inside[20], "an end that was moved by whole turns is inside"
        # k turns are rounded, and the sum is.
        rounding = np.spacing(np.maximum(np.abs(x), abs(end))) + np.spacing(abs(TURN * k))
        assert inside[far < -rounding].all(), "no point is lost"
        assert not inside[far > rounding].any(), "none is won"
        assert k or np.array_equal(inside, far <= 0)


@settings(max_examples=30)
@given(st.floats(-40, 40), st.floats(0.01, 3), st.floats(0.01, 3), st.integers(-20, 20))
def test_between_arcs_that_touch_no_float_is_lost(low: float, first: float, second: float, k: int) -> None:
    middle = low + first
    x = around(middle + TURN * k, 50)
    one, other = circle.onto(low, middle, x), circle.onto(middle, middle + second, x)
    assert (((one >= low) & (one <= middle)) | ((other >= middle) & (other <= middle + second))).all()


@pytest.mark.parametrize("turns", range(-10, 11))
def test_edges_of_boxes_turns_away_lose_and_gain_no_point(turns: int) -> None:
    rng = np.random.default_rng(turns + 10)
    for low in rng.uniform(-3, 3, 20):
        high = low + rng.uniform(0.01, 5)
        box = Region((Box(ANGLE, (low + TURN * turns,), (high + TURN * turns,)),))
        assert box.contains(np.array([[low], [high], [(low + high) / 2]])).all()
        assert not box.contains(np.array([[low - 1e-13], [high + 1e-13]])).any()


def test_numbers_that_are_no_angles_stay_outside() -> None:
    x = np.array([np.nan, np.inf, -np.inf, 1.7e308, -1e300, -0.0])
    y = circle.onto(-np.pi, np.pi, x)
    assert np.isnan(y[0])
    assert np.isinf(y[1:3]).all()
    assert (np.abs(y[3:]) <= np.pi).all()


def test_differences_keep_the_bits_of_what_is_near() -> None:
    d = np.array([1e-300, -3.0, 3.1, 1e-9])
    assert np.array_equal(circle.near(d), d)
    assert circle.near(np.array([TURN + 0.25, -2 * TURN - 0.5])) == pytest.approx([0.25, -0.5], abs=1e-14)
    assert np.array_equal(circle.near(np.array([9.0, 9.0]), 0.0, [True, False]), [9.0 - TURN, 9.0])


def test_copies_are_all_that_meet() -> None:
    rng = np.random.default_rng(3)
    for _ in range(2000):
        low, first = rng.uniform(-40, 40, 2)
        high, last = low + rng.uniform(0, 8), first + rng.uniform(0, 8)
        meet = [k for k in range(-40, 41) if low + TURN * k <= last and high + TURN * k >= first]
        assert set(meet) <= set(found := circle.copies(low, high, first, last))
        assert len(found) <= len(meet) + 2
