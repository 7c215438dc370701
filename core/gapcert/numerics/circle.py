"""Angles as points of the circle: whole turns, and which float lies on which arc.

A float x lies on copy k of an arc [a, b] if a ⊕ kT ≤ x ≤ b ⊕ kT or a ≤ x ⊖ kT ≤ b, end by end, where T is the float nearest to
2π and ⊕ rounds to nearest: an end that is moved by whole turns, up or down, lies in its copy. Rounding is monotone: copies keep
the order of their ends, and between arcs that touch no float is lost.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from gapcert.numerics.arrays import Array, Bools

TURN = 2 * np.pi


def spans(low: float, high: float) -> bool:
    """Is [low, high] a full turn, up to what a person's digits and the sum of an end and a turn round by?"""
    return low + TURN <= high + 8 * math.ulp(max(abs(low), abs(high), TURN))


def turns(x: Array, middle: Any = 0.0) -> Array:
    """The number of whole turns that brings `middle` nearest to x."""
    return np.asarray(np.round((x - middle) / TURN))


def near(x: Array, middle: Any = 0.0, angle: Any = True) -> Array:
    """x moved by whole turns to within half a turn of `middle`, where it is an `angle`; what is so already keeps its bits."""
    return np.asarray(x - TURN * np.where(angle, turns(x, middle), 0.0))


def onto(low: float, high: float, x: Array) -> Array:
    """Angles x on the turn of the arc: the answer is in [low, high] if and only if x lies on the nearest copy of it.

    What lies in the arc keeps its bits. A full turn has no outside: what rounding moves beyond an end is at that end.
    """
    if not (out := np.isfinite(x) & ((x < low) | (x > high))).any():
        return x
    far, y = x[out], x.copy()
    with np.errstate(over="ignore"):
        k = turns(far, (low + high) / 2)
        back = far - TURN * k
        on = spans(low, high) | between(low, high, k, far, far)
    y[out] = np.where(on, np.clip(back, low, high), back)
    return y


def between(low: float, high: float, k: Any, x: Array, y: Array) -> Bools:
    """Is x at the lower end of copy k of the arc or above it, and y at the upper end or below it?"""
    move = TURN * k
    return np.asarray(((x >= low + move) | (x - move >= low)) & ((y <= high + move) | (y - move <= high)))


def copies(low: float, high: float, first: float, last: float) -> range:
    """The numbers of all copies of [low, high] that meet [first, last], and perhaps of some beside it."""
    return range(math.floor((first - high) / TURN), math.ceil((last - low) / TURN) + 1)
