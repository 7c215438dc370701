"""Constants on boxes: never below a gradient that occurs there, and flaws that make them smaller are planted and caught."""

from __future__ import annotations

from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import expit

import gapcert as gc
import gapcert_networks
from gapcert_networks.network import ACTIVATIONS
from gapcert_networks.network_cells import Cells, largest
from gapcert_networks.network_slopes import gates, lines

SLOPES = {
    "arctan": lambda v: 1 / (1 + v * v),
    "identity": np.ones_like,
    "leaky-relu": lambda v: np.where(v > 0, 1.0, 0.01),
    "relu": lambda v: np.where(v > 0, 1.0, 0.0),
    "sigmoid": lambda v: expit(v) * expit(-v),
    "softplus": expit,
    "tanh": lambda v: 1 / np.cosh(v) ** 2,
}


def drawn(sizes, seed, activation, output=None):
    rng = np.random.default_rng(seed)
    weights = [rng.standard_normal((o, i)) * rng.uniform(0.1, 2) for i, o in pairwise(sizes)]
    return gapcert_networks.Network(tuple(weights), tuple(rng.normal(size=len(w)) for w in weights), activation, output)


def norms(net, x, units):
    z, slope = x, np.broadcast_to(np.eye(net.n_in) / units, (len(x), net.n_in, net.n_in))
    for i, (w, b) in enumerate(zip(net.weights, net.biases, strict=True)):
        v = z @ w.T + b
        name = net.activation if i < len(net.weights) - 1 else net.output or "identity"
        slope = SLOPES[name](v)[:, :, None] * (w @ slope)
        z = ACTIVATIONS[name][0](v)
    return np.linalg.norm(slope[:, 0], axis=1)


def check(net, box, units, bound, n=100_000, seed=0):
    """Random points against the constants of the box and of their cells."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(*box, (n, net.n_in))
    g = norms(net, x, units) * (1 - 1e-12)
    if (g > bound.value).any():
        return False
    cell = tuple(np.clip(np.searchsorted(e, x[:, k], "right") - 1, 0, len(e) - 2) for k, e in enumerate(bound.edges))
    return bool((g <= bound.constants[cell]).all())


@settings(max_examples=40, deadline=None)
@given(
    st.lists(st.integers(1, 7), min_size=1, max_size=4),
    st.integers(0, 2**32 - 1),
    st.sampled_from(sorted(SLOPES)),
    st.sampled_from([None, "sigmoid", "relu"]),
    st.floats(0.01, 3),
)
def test_no_gradient_is_larger(sizes, seed, activation, output, width):
    net, rng = drawn([*sizes, 1], seed, activation, output), np.random.default_rng(seed)
    units, low = rng.uniform(0.1, 5, net.n_in), rng.normal(size=net.n_in)
    box = low, low + width * rng.uniform(0.1, 1, net.n_in)
    bound = gapcert_networks.local_bound(net, box, units, budget=300, cells=2)
    assert bound.lower <= bound.value
    assert check(net, box, units, bound, 5_000, seed)


NETS = [
    ((4, 30, 1), "relu"),
    ((3, 12, 12, 1), "relu"),
    ((2, 20, 1), "tanh"),
    ((2, 8, 8, 8, 1), "softplus"),
    ((3, 9, 9, 1), "arctan"),
]


@pytest.mark.exam
@pytest.mark.parametrize(("sizes", "activation"), NETS, ids=str)
def test_many_points_of_the_box_and_of_its_cells(sizes, activation):
    net, units, box = drawn(sizes, 1, activation), np.ones(sizes[0]), (-np.ones(sizes[0]), np.ones(sizes[0]))
    bound = gapcert_networks.local_bound(net, box, budget=5_000, cells=3)
    assert check(net, box, units, bound)
    everywhere = gc.registry().build("lipschitz", "lipsdp").bound(net, axes=False)
    assert bound.lower <= everywhere.value
    small = type(bound)(bound.value, 0, 0, *box, units, bound.edges, 0.9 * bound.constants.clip(max=bound.lower))
    assert not check(net, box, units, small)


def test_the_centre_of_a_box_does_not_stand_for_it():
    net, rng = drawn((2, 20, 1), 3, "relu"), np.random.default_rng(0)
    cells = Cells(net.weights, net.biases, ["relu"], np.ones(2))
    low = rng.uniform(-1, 1, (50, 2))
    high = low + 0.3
    centre, whole = cells.bounds((low + high) / 2, (low + high) / 2)[0], cells.bounds(low, high)[0]
    most = np.array([norms(net, rng.uniform(a, b, (500, 2)), 1.0).max() for a, b in zip(low, high, strict=True)])
    assert (most <= whole).all()
    assert (most > centre * (1 + 1e-9)).any()


def test_kinks_on_the_edges_of_cells_belong_to_neither_or_both():
    # relu(x) − relu(x − ½): the slope is 0, 1, 0, and its kinks lie at two edges of the grid.
    net = gapcert_networks.Network((np.ones((2, 1)), np.array([[1.0, -1.0]])), (np.array([0.0, -0.5]), np.zeros(1)))
    bound = gapcert_networks.local_bound(net, ([-1.0], [1.5]), cells=5)
    assert 1 <= bound.value <= 1 + 1e-9
    assert bound.constants[2] >= 1
    assert (bound.constants <= 1 + 1e-9).all()
    assert bound.constants[[0, 4]] == pytest.approx(0, abs=1e-9)
    assert (np.abs(net(np.array([[0.5]])) - net(np.array([[0.0]]))) <= bound.value * 0.5).all()


def test_rounding_is_paid_for():
    # The slope 1e8 + 1e-9 − 1e8 is 0 in floating point.
    weights, biases = (np.array([[1e8], [1e-9], [1e8]]), np.array([[1.0, 1.0, -1.0]])), (np.full(3, 1e9), np.zeros(1))
    exact = sum(Fraction(float(a)) * Fraction(float(w)) for a, w in zip(weights[0][:, 0], weights[1][0], strict=True))
    cells = Cells(weights, biases, ["relu"], np.ones(1))
    one = np.ones((1, 1))
    assert Fraction(float(cells.bounds(0 * one, one)[0][0])) >= exact
    assert Fraction(float(cells.attained(one)[0])) <= exact
    cells.margin = 0.0
    assert Fraction(float(cells.bounds(0 * one, one)[0][0])) < exact


def test_a_kink_that_rounding_hides_is_seen():
    # a·x + b is 0 in floating point at the corner of the box, and positive.
    a, x = 1 + 2.0**-30, 1 + 2.0**-31
    b = -(a * x)
    assert Fraction(a) * Fraction(x) + Fraction(b) != 0
    sign = 1.0 if Fraction(a) * Fraction(x) + Fraction(b) > 0 else -1.0
    net = gapcert_networks.Network((np.array([[sign * a]]), np.ones((1, 1))), (np.array([sign * b]), np.zeros(1)))
    low, high = (x - 1e-3, x) if sign > 0 else (x, x + 1e-3)
    assert gapcert_networks.local_bound(net, ([low], [high]), budget=1000).value >= 1


@settings(max_examples=200, deadline=None)
@given(st.sampled_from(sorted(SLOPES)), st.floats(-30, 30), st.floats(0, 10), st.floats(-1, 1))
def test_slopes_and_values_lie_where_they_are_said_to(name, z, r, share):
    centre, radius = np.array([[z]]), np.array([[r]])
    v = centre + share * radius
    alpha, beta, rho = gates(name, centre, radius * (1 + 1e-15) + 1e-15)
    if not (name in ("relu", "leaky-relu") and abs(v[0, 0]) < 1e-9):
        bend = 0.0 if beta is None else beta
        assert abs(SLOPES[name](v) - alpha - bend * (v - centre)) <= rho + 1e-15
    alpha, mu, delta = lines(name, centre, radius * (1 + 1e-15) + 1e-15)
    assert abs(ACTIVATIONS[name][0](v) - alpha * v - mu) <= delta + 1e-14


@pytest.mark.parametrize("n", [1, 2, 5, 12])
def test_the_largest_eigenvalue_is_not_underestimated(n):
    rng = np.random.default_rng(n)
    a = rng.standard_normal((200, n, n)) * np.exp(rng.normal(size=(200, 1, n)))
    a[:50] = np.eye(n) * rng.uniform(0.1, 9, (50, 1, 1))  # all equal
    m = a @ a.transpose(0, 2, 1)
    found, exact = largest(m, np.einsum("kii->k", m)), np.linalg.eigvalsh(m)[:, -1]
    assert (found >= exact * (1 - 1e-14)).all()
    assert (found <= exact * (1 + 1e-4)).all()
    assert (largest(0 * m, np.zeros(200)) == 0).all()
