"""Bounds of gap functions over cells: what is left of them as cells shrink, and what they must not be."""

from __future__ import annotations

import itertools
from functools import cache
from typing import Any

import numpy as np
import pytest
import scipy.optimize

import gapcert as gc
import gapcert_networks
from gapcert_bounds.families import cone
from gapcert_bounds.testing.excess import excess, reached
from gapcert_bounds.testing.fields import Waves, gap_problem
from gapcert_calibrate.route import CalibratedGap
from gapcert_functions.bounded_function import Function
from gapcert_functions.dominating import dominate
from gapcert_networks.theorem1_network import raised

FIELD = Waves.smooth()


def network(activation: str, nz: int = 3, nx: int = 2, hidden: int = 40) -> gapcert_networks.Network:
    rng = np.random.default_rng(0)
    first, last = rng.standard_normal((hidden, nz)), rng.standard_normal((nx, hidden)) / hidden
    b = rng.uniform(-0.7, 0.7, hidden) * np.abs(first).sum(axis=1)
    return gapcert_networks.Network((first, last), (b, np.full(nx, 0.3)), activation)


def build(name: str, **options: object) -> gc.plugin.GapFamily:
    family: gc.GapFamily = gc.registry().get("gap_family", name).load()(**options)
    return family


def envelope(affine: bool = False) -> gc.GapFunction:
    return build("envelope", predictor="affine" if affine else "none").fit(gap_problem(FIELD, (5, 5, 5), affine=affine))


def dominating(activation: str, affine: bool) -> gc.GapFunction:
    q = network(activation)
    negative = gapcert_networks.Network((*q.weights[:-1], -q.weights[-1]), (*q.biases[:-1], -q.biases[-1]), activation)
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


class Wide(gc.GapFunction):
    """[−1, 1] everywhere, with bounds over cells that are too wide by this much below and above."""

    family = "wide"

    def __init__(self, below: float, above: float) -> None:
        self.below, self.above = below, above

    def interval(self, z: Any) -> tuple[Any, Any]:
        return np.full((len(z), 1), -1.0), np.full((len(z), 1), 1.0)

    def interval_over(self, boxes: gc.Interval) -> gc.Interval:
        low, high = self.interval(boxes.lo)
        return gc.Interval(low - self.below, high + self.above)

    def lipschitz(self, boxes: gc.Interval) -> Any:
        return np.zeros((len(boxes), 1, boxes.shape[1]))

    def arrays(self) -> dict[str, Any]:
        return {}

    @property
    def form(self) -> dict[str, Any]:
        return {"form": "constant"}


@pytest.mark.parametrize(("below", "above"), [(0.5, 0.0), (0.0, 0.25)])
def test_an_excess_is_that_of_the_side_where_it_is_larger(below: float, above: float) -> None:
    assert (excess(Wide(below, above), cells(3, 0.1), steps=1) == max(below, above)).all()


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


def highest(gap: Any, boxes: gc.Interval) -> np.ndarray:
    """The largest u_0 in each box, by linear programs over the parts of it in which all cones are affine."""
    slope, g, found = gap.lipschitz_values[0], gap.g[:, 0], []
    for low, high in zip(boxes.lo, boxes.hi, strict=True):
        ends = zip(low, gap.z.T, high, strict=True)
        edges = [[a, *np.unique(z[(a < z) & (z < b)]), b] for a, z, b in ends]
        best = -np.inf
        for part in itertools.product(*(itertools.pairwise(e) for e in edges)):
            half = np.array([(b - a) / 2 for a, b in part])
            away = np.array([(a + b) / 2 for a, b in part]) - gap.z
            at = g + np.abs(away) @ slope
            near = at <= at.min() + 2 * slope @ half
            rows = np.hstack([-np.sign(away[near]) * slope, np.ones((near.sum(), 1))])
            limits = [*((-h, h) for h in half), (None, None)]
            best = max(best, -scipy.optimize.linprog([0, 0, 0, -1], A_ub=rows, b_ub=at[near], bounds=limits).fun)
        found.append(best)
    return np.array(found) + 2 * gap.resolution[0]


def test_envelopes_are_exact_on_ridges(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where cones meet and, too, where they bend along one axis; cut nowhere, the latter are bounded too high."""
    gap, boxes = envelope(), cells(400, 0.1)
    crossed = ((boxes.lo[:, None] < gap.z) & (gap.z < boxes.hi[:, None])).any(axis=1).sum(axis=1)
    inner = [
        gap._cones.lowest(0, 1, boxes.lo + t * (boxes.hi - boxes.lo)) for t in np.random.default_rng(3).random((8, 400, 3))
    ]
    ridge = np.ptp(inner, axis=0) > 0
    few, bent = (boxes[np.flatnonzero(ridge & (crossed == k))[:25]] for k in (0, 1))
    for some in (few, bent):
        beyond = gap.interval_over(some).hi[:, 0] - highest(gap, some)
        assert len(some) == 25
        assert (beyond >= -1e-13).all()
        assert (beyond <= 1e-11).all()
    whole = cone.Cones.crest
    monkeypatch.setattr(cone.Cones, "crest", lambda *given: whole(*given[:6]))
    assert (gap.interval_over(bent).hi[:, 0] - highest(gap, bent) > 1e-4).any()


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
    q = gapcert_networks.Network((slope,), (np.zeros(1),), "identity")
    p = gc.plugin.AffinePredictor(np.array([0.25]), -slope)
    boxes = cells(50, 0.2)
    for found in (q.tight_over(boxes, p), Function.tight_over(q, boxes, p)):
        assert found.contains(0.25).all()
        assert found.width.max() < 1e-12
