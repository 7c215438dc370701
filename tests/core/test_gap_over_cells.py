"""Bounds of gap functions over cells: what is left of them as cells shrink, and what they must not be."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

import gapcert as gc
from gapcert.calibrated import CalibratedGap
from gapcert.covered import raised
from gapcert.dominating import dominate
from gapcert.functions import Function
from gapcert.testing.excess import excess, reached
from gapcert.testing.fields import Waves, gap_problem

FIELD = Waves.smooth()


def network(activation: str, nz: int = 3, nx: int = 2, hidden: int = 40) -> gc.Network:
    rng = np.random.default_rng(0)
    first, last = rng.standard_normal((hidden, nz)), rng.standard_normal((nx, hidden)) / hidden
    b = rng.uniform(-0.7, 0.7, hidden) * np.abs(first).sum(axis=1)
    return gc.Network((first, last), (b, np.full(nx, 0.3)), activation)


def build(name: str, **options: object) -> gc.GapFamily:
    family: gc.GapFamily = gc.registry().get("gap_family", name).load()(**options)
    return family


def envelope(affine: bool = False) -> gc.GapFunction:
    return build("envelope", predictor="affine" if affine else "none").fit(gap_problem(FIELD, (5, 5, 5), affine=affine))


def dominating(activation: str, affine: bool) -> gc.GapFunction:
    q = network(activation)
    negative = gc.Network((*q.weights[:-1], -q.weights[-1]), (*q.biases[:-1], -q.biases[-1]), activation)
    return dominate(gap_problem(FIELD, (5, 5, 5), affine=affine), "drawn", negative, q, (2, 2, 2), 0.05, 2000)


GAPS = {
    "envelope": envelope,
    "envelope-affine": lambda: envelope(affine=True),
    "calibrated": lambda: CalibratedGap(envelope(), np.array([0.01, -0.005]), np.zeros(2)),
    "dominating-relu": lambda: dominating("relu", affine=False),
    "dominating-tanh-affine": lambda: dominating("tanh", affine=True),
    "raised": lambda: raised(gap_problem(FIELD, (12,) * 3, route="theorem1"), "drawn", network("tanh")),
}


@cache
def made(name: str) -> gc.GapFunction:
    return GAPS[name]()


def cells(n: int, eta: float) -> gc.Interval:
    low = np.random.default_rng(1).random((n, 3)) * (2 - eta) - 1
    return gc.Interval(low, low + eta)


@pytest.mark.parametrize("name", GAPS)
def test_bounds_close_in_with_the_square_of_the_cell(name: str) -> None:
    gap = made(name)
    found = [excess(gap, cells(60, eta)) for eta in (0.1, 0.0125)]
    assert min(f.min() for f in found) >= -1e-12
    assert found[1].mean() <= max(found[0].mean() / 16, 1e-7)
    # A constant times the radius, which closes in with the cell, is far above both.
    for boxes, f in zip((cells(60, 0.1), cells(60, 0.0125)), found, strict=True):
        reach = (gap.lipschitz(boxes) * boxes.rad[:, None, :]).sum(axis=2)
        assert f.mean() < 0.2 * reach.mean()


@pytest.mark.parametrize("name", GAPS)
def test_ends_lie_within_their_own_bounds(name: str) -> None:
    gap, boxes = made(name), cells(60, 0.1)
    low, high = gap.ends_over(boxes)
    rng = np.random.default_rng(2)
    for _ in range(20):
        at = gap.interval(boxes.lo + rng.random(boxes.shape) * (boxes.hi - boxes.lo))
        assert ((low.lo <= at[0]) & (at[0] <= low.hi) & (high.lo <= at[1]) & (at[1] <= high.hi)).all()


def test_the_value_at_the_centre_is_caught() -> None:
    """It lies below what is reached in nearly every cell."""
    gap, boxes = envelope(), cells(200, 0.05)
    least, most = reached(gap, boxes)
    low, high = gap.interval(boxes.mid)
    assert ((most > high) | (least < low)).all(axis=1).mean() > 0.9


@pytest.mark.parametrize("activation", ["relu", "tanh"])
def test_networks_are_far_below_the_ranges_of_their_layers(activation: str) -> None:
    q = network(activation, nz=4, nx=1, hidden=100)
    low = np.random.default_rng(3).uniform(-1, 0.95, (200, 4))
    boxes = gc.Interval(low, low + np.array([0.05, 0.05, 0.0, 0.0]))
    rng = np.random.default_rng(4)
    found = np.max([q(boxes.lo + rng.random(low.shape) * (boxes.hi - boxes.lo)) for _ in range(300)], axis=0)
    tight, plain = (f(boxes).hi - found for f in (q.tight_over, q.over))
    assert tight.min() >= 0
    assert tight.mean() < 0.06 * plain.mean()


def test_what_predictor_and_function_share_cancels() -> None:
    """q + p with opposite slopes is nearly constant, and so is its bound."""
    slope = np.array([[1.5, -2.0, 0.5]])
    q = gc.Network((slope,), (np.zeros(1),), "identity")
    p = gc.AffinePredictor(np.array([0.25]), -slope)
    boxes = cells(50, 0.2)
    for found in (q.tight_over(boxes, p), Function.tight_over(q, boxes, p)):
        assert found.contains(0.25).all()
        assert found.width.max() < 1e-12
