"""Networks as functions: enclosures hold on points of their boxes, and computed values err by no more than stated."""

from __future__ import annotations

import itertools
from fractions import Fraction

import numpy as np
import pytest

from gapcert.numerics.intervals import Interval
from gapcert_networks.network import ACTIVATIONS, Network


def network(activation: str, output: str | None = None, sizes: tuple[int, ...] = (3, 12, 9, 2), scale: float = 1.0) -> Network:
    rng = np.random.default_rng(len(activation))
    weights = tuple(scale * rng.standard_normal((b, a)) / np.sqrt(a) for a, b in itertools.pairwise(sizes))
    return Network(weights, tuple(0.3 * rng.standard_normal(len(w)) for w in weights), activation, output)


def boxes(width: float, n: int = 40) -> Interval:
    rng = np.random.default_rng(7)
    low = rng.uniform(-2, 2, (n, 3))
    return Interval(low, low + width * rng.random(low.shape))


@pytest.mark.exam
@pytest.mark.parametrize("activation", sorted(ACTIVATIONS))
@pytest.mark.parametrize("width", [2.0, 0.1, 1e-3, 0.0])
def test_values_and_slopes_stay_in_their_enclosures(activation: str, width: float) -> None:
    for output in (None, activation):
        net, cells = network(activation, output), boxes(width)
        over, tight = net.over(cells), net.tight_over(cells)
        lines = [net.line_over(cells, i) for i in range(net.n_out)]
        slopes = [net.gradient_over(cells, i) for i in range(net.n_out)]
        rng = np.random.default_rng(1)
        error = net.rounding(Interval(np.full((1, 3), -4.0), np.full((1, 3), 4.0)))
        previous, value = None, None
        for share in (0.0, 1.0, *rng.random((40, 1, 3))):
            z = np.clip(cells.lo + share * (cells.hi - cells.lo), cells.lo, cells.hi)
            y = net(z)
            assert ((over.lo <= y + error) & (y - error <= over.hi)).all()
            assert ((tight.lo <= y + error) & (y - error <= tight.hi)).all()
            for i, (a, rest) in enumerate(lines):
                moved = ((Interval.exact(z) - cells.mid) * a).sum(-1)
                left = Interval.around(y[:, i], np.full(len(z), error[i])) - moved
                assert ((rest.lo <= left.hi) & (left.lo <= rest.hi)).all()
            if previous is not None and value is not None:
                for i, slope in enumerate(slopes):
                    reach = (slope * (Interval.exact(z) - previous)).sum(-1)
                    moved = y[:, i] - value[:, i]
                    assert ((reach.lo <= moved + 2 * error[i]) & (moved - 2 * error[i] <= reach.hi)).all()
            previous, value = z, y


def test_small_boxes_are_bounded_tightly() -> None:
    net, cells = network("tanh"), boxes(1e-3)
    assert (net.tight_over(cells).width <= 1e-2).all()
    assert (net.tight_over(cells).width < 0.5 * net.over(cells).width).mean() > 0.9


def test_rounding_is_that_of_rational_arithmetic() -> None:
    net = network("relu", scale=30.0)
    z = np.random.default_rng(3).uniform(-1, 1, (20, 3))
    error = net.rounding(Interval(np.full((1, 3), -1.0), np.ones((1, 3))))
    for point, found in zip(z, net(z), strict=True):
        layer = [Fraction(float(v)) for v in point]
        for k, (w, b) in enumerate(zip(net.weights, net.biases, strict=True)):
            layer = [
                Fraction(float(bias)) + sum((Fraction(float(c)) * v for c, v in zip(row, layer, strict=True)), Fraction(0))
                for row, bias in zip(w, b, strict=True)
            ]
            layer = [max(v, Fraction(0)) for v in layer] if k < len(net.weights) - 1 else layer
        off = [abs(float(Fraction(float(f)) - exact)) for f, exact in zip(found, layer, strict=True)]
        assert (np.array(off) <= error).all()
    assert (error < 1e-8).all()


def test_point_enclosures_hold_the_exact_value_where_the_computed_one_does_not() -> None:
    # 2^53 + 1 is no float: the computed sum is off by 1, and the enclosure holds both.
    net = Network((np.array([[2.0**53, 1.0]]), np.array([[1.0]])), (np.zeros(1), np.array([-(2.0**53)])), "relu")
    at = net.over(Interval.exact(np.array([[1.0, 1.0]])))
    assert float(net(np.array([[1.0, 1.0]]))[0, 0]) == 0.0
    assert at.lo[0, 0] <= 1.0 <= at.hi[0, 0]


def test_a_kink_inside_a_box_has_both_slopes() -> None:
    net = Network((np.eye(1), np.eye(1)), (np.zeros(1), np.zeros(1)), "relu")
    slope = net.gradient_over(Interval(np.array([[-1.0], [0.1], [-1.0]]), np.array([[1.0], [1.0], [-0.1]])), 0)
    assert np.allclose(slope.lo[:, 0], [0, 1, 0])
    assert np.allclose(slope.hi[:, 0], [1, 1, 0])


@pytest.mark.parametrize("name", ["relu", "tanh", "softplus"])
def test_is_stored_and_made_again(name: str) -> None:
    net = network(name, "softplus")
    again = Network.stored(net.data(), net.arrays())
    z = np.random.default_rng(0).uniform(-1, 1, (50, 3))
    assert np.array_equal(net(z), again(z))
