"""Constants of networks: never below a slope that occurs, and every known way to a false one is planted and caught."""

from __future__ import annotations

from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import gapcert as gc
import gapcert_networks
from gapcert_lipsdp.lipsdp import LipSDP
from gapcert_networks.network_constant import positive_definite, proved, rescaled

HALF = [np.array([[1.0]]), np.array([[0.5]])]  # ½ relu(x)
FLAT = [np.array([[1.0], [1.0]]), np.array([[1.0, -1.0]])]  # relu(x + 1) − relu(x − 1), with its biases


def drawn(sizes, seed, activation):
    rng = np.random.default_rng(seed)
    weights = [rng.standard_normal((o, i)) * rng.uniform(0.1, 3) for i, o in pairwise(sizes)]
    return gapcert_networks.Network(tuple(weights), tuple(rng.normal(size=len(w)) for w in weights), activation)


@pytest.mark.exam
@settings(max_examples=60)
@given(
    st.lists(st.integers(1, 8), min_size=2, max_size=5),
    st.integers(0, 2**32 - 1),
    st.sampled_from(["relu", "leaky-relu", "tanh", "sigmoid", "softplus", "arctan"]),
    st.lists(st.floats(0.01, 100), min_size=8, max_size=8),
)
def test_no_slope_is_steeper(sizes, seed, activation, units):
    net, s = drawn(sizes, seed, activation), np.array(units[: sizes[0]])
    bound = LipSDP().bound(net, s)
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(400, sizes[0])) * rng.choice([0.1, 1, 5], (400, 1))
    for step in (1.0, 1e-3):
        away = rng.normal(size=x.shape) * step / s
        moved = np.linalg.norm(net(x + away) - net(x), axis=1)
        rounding = 1e-12 * (1 + np.abs(net(x)).max() + bound.value)
        assert (moved <= bound.value * np.linalg.norm(s * away, axis=1) * (1 + 1e-12) + rounding).all()
        alone = np.zeros_like(x)
        k = rng.integers(sizes[0])
        alone[:, k] = step
        assert (np.linalg.norm(net(x + alone) - net(x), axis=1) <= bound.axes[k] * step * (1 + 1e-12) + rounding).all()


def test_multipliers_that_couple_neurons_are_refused():
    net = gapcert_networks.Network(tuple(FLAT), (np.array([1.0, -1.0]), np.zeros(1)))
    (rise,) = net(np.array([[0.5]]))[0] - net(np.array([[-0.5]]))[0]
    assert rise == 1
    e = np.array([1.0, -1.0])
    coupled, first, last = np.outer(e, e) / 2, *FLAT
    # The matrix of the network form accepts a constant of 1e-3, a thousandth of the truth.
    planted = np.block(
        [
            [np.full((1, 1), 1e-6), -first.T @ coupled, np.zeros((1, 1))],
            [-coupled @ first, 2 * coupled + 1e-9 * np.eye(2), -last.T],
            [np.zeros((1, 1)), -last, np.eye(1) * (1 + 1e-9)],
        ]
    )
    assert np.linalg.eigvalsh(planted)[0] > -1e-6
    assert proved(FLAT, [coupled], 1e-6) is None
    assert proved(FLAT, [coupled], 100.0) is None
    assert LipSDP().bound(net).value >= 1


def test_the_square_of_the_constant_is_not_the_constant():
    assert proved(HALF, [np.array([0.25])], 0.25) is None or proved(HALF, [np.array([0.25])], 0.25) >= 0.5
    assert all(proved(HALF, [np.array([t])], 0.125) is None for t in np.geomspace(1e-6, 1e6, 200))
    assert 0.5 <= LipSDP().bound(gapcert_networks.Network(tuple(HALF), (np.zeros(1), np.zeros(1)))).value <= 0.5 * (1 + 1e-9)


def test_the_last_block_takes_no_multiplier():
    t = 1e-6  # with it in the last block, [[ρ, −t, 0], [−t, 2t, −t/2], [0, −t/2, t]] accepts any ρ as t → 0
    rho = 1e-5
    assert positive_definite(np.array([[rho, -t, 0], [-t, 2 * t, -t / 2], [0, -t / 2, t]]))
    assert proved(HALF, [np.array([t]), np.array([t])], rho) is None
    assert proved(HALF, [np.array([t])], rho) is None


@pytest.mark.parametrize("name", ["softmax", "gelu", "silu"])
@pytest.mark.parametrize("where", ["activation", "output"])
def test_activations_outside_the_theorem_are_refused(name, where):
    with pytest.raises(gc.UsageError, match=name):
        gapcert_networks.Network(tuple(HALF), (np.zeros(1), np.zeros(1)), **{where: name})


NETS = [(4, 20, 1), (3, 8, 2), (3, 6, 6, 1), (2, 5, 4, 4, 2)]


@pytest.mark.parametrize("sizes", NETS, ids=str)
@pytest.mark.parametrize("share", [1 - 1e-7, 0.9])
def test_less_than_the_optimum_is_not_proved(sizes, share):
    net = drawn(sizes, 2, "relu")
    bound = LipSDP().bound(net)
    assert bound.gap < 1e-8
    below = (bound.lower * share) ** 2
    for more in (1 - 1e-6, 1.0, 1 + 1e-6, 1.1):
        assert proved(net.weights, [more * m for m in bound.multipliers], below, most=1e-9) is None


@pytest.mark.parametrize("sizes", NETS, ids=str)
def test_a_certifier_that_promises_too_little_is_not_believed(sizes):
    class Greedy(gapcert_networks.NetworkCertifier):
        name = "greedy"

        def propose(self, weights):
            given, lower = LipSDP().propose(weights)
            return [gapcert_networks.Proposal(p.multipliers, 0.81 * p.square) for p in given], lower

    net = drawn(sizes, 2, "relu")
    assert Greedy().bound(net, axes=False).value >= LipSDP().bound(net, axes=False).lower


@pytest.mark.parametrize("sizes", NETS, ids=str)
@pytest.mark.parametrize("value", [-1.0, np.nan, np.inf, 0.0])
def test_multipliers_that_are_none_are_refused(sizes, value):
    net = drawn(sizes, 2, "relu")
    bound = LipSDP().bound(net)
    for k in range(len(bound.multipliers)):
        spoilt = [m.copy() for m in bound.multipliers]
        spoilt[k][0] = value
        assert proved(net.weights, spoilt, 2 * bound.value**2) is None
    assert proved(net.weights, bound.multipliers, 2 * bound.value**2) is not None


@pytest.mark.parametrize("rho", [0.0, -1.0, np.nan, np.inf])
def test_a_square_that_is_none_is_refused(rho):
    assert proved(HALF, [np.array([0.25])], rho) is None


def test_an_indefinite_matrix_with_a_positive_determinant_is_not_accepted():
    for matrix in (np.diag([-1.0, -1.0, 2.0]), np.array([[1.0, 2, 0, 0], [2, 1, 0, 0], [0, 0, 1, 2], [0, 0, 2, 1]])):
        assert np.linalg.slogdet(matrix) == pytest.approx((1.0, np.log(np.linalg.det(matrix))))
        assert not positive_definite(matrix)


@pytest.mark.parametrize("n", [2, 30, 200])
def test_a_matrix_that_only_rounding_makes_definite_is_not_accepted(n):
    rng = np.random.default_rng(n)
    b = rng.integers(-8, 9, (n, n - 1)).astype(float)
    singular = b @ b.T  # exact in floats, with one eigenvalue that is 0
    assert not positive_definite(singular)
    spare = 1e-12 * n * float(np.trace(singular))
    assert positive_definite(singular + spare * np.eye(n))
    assert not positive_definite(singular + spare * np.eye(n), error=spare)


@pytest.mark.parametrize("blocks", [2, 10])
def test_a_matrix_by_blocks_needs_a_smaller_margin_and_still_one(blocks):
    width, rng = 40, np.random.default_rng(blocks)
    n = blocks * width
    b = np.zeros((n, n - 1))
    for k in range(blocks):
        part = b[k * width : (k + 1) * width, max(0, (k - 1) * width) : (k + 1) * width]
        part[:] = rng.integers(-8, 9, part.shape)
    singular = b @ b.T  # exact in floats, block tridiagonal, with an eigenvalue that is 0
    assert not positive_definite(singular)
    largest = max(float(np.trace(singular[k : k + 3 * width, k : k + 3 * width])) for k in range(0, n, width))
    enough = 6 * (2 * width + 2) * 2.0**-53 * largest
    assert positive_definite(singular + enough * np.eye(n))
    full = singular + 1e-300  # the same matrix to the last bit that counts, but no entry is 0
    assert positive_definite(full + enough * np.eye(n)) == (blocks == 2)


@pytest.mark.parametrize("power", [-480, -130, 0, 130, 480])
@pytest.mark.parametrize("hidden", [1, 7, 60])
def test_one_hidden_layer_is_proved_as_exact_arithmetic_proves_it(hidden, power):
    rng = np.random.default_rng(hidden)
    first = np.ldexp(rng.standard_normal((hidden, 3)), rng.integers(-3, 4, (hidden, 1)))
    last = rng.standard_normal(hidden)
    t = 2 * hidden * last**2 * rng.uniform(0.5, 2, hidden)
    smallest = exact_square(first, last, t)
    first, t = np.ldexp(first, -power), np.ldexp(t, 2 * power)  # the same network in other units of its neurons
    last = np.ldexp(last, power)
    found = proved([first, last[None]], [t], float(smallest) * (1 + 1e-15))
    assert found is not None
    assert Fraction(found) ** 2 >= smallest
    assert found**2 <= float(smallest) * (1 + 1e-11)
    assert proved([first, last[None]], [t], float(smallest) * (1 - 1e-9), most=1e-12) is None


def exact_square(first, last, t):
    """The smallest ρ, to 1e-18 of it from above, with ρ·I − ½W₀ᵀTW₀ − ggᵀ/(4q) ⪰ 0, in rational arithmetic."""
    rows, weight, own = [[Fraction(v) for v in r] for r in first], [Fraction(v) for v in last], [Fraction(v) for v in t]
    n = len(rows[0])
    g = [sum(w * r[i] for w, r in zip(weight, rows, strict=True)) for i in range(n)]
    q = 1 - sum(w * w / m for w, m in zip(weight, own, strict=True)) / 2
    both = [[sum(m * r[i] * r[j] for m, r in zip(own, rows, strict=True)) for j in range(n)] for i in range(n)]
    inner = [[both[i][j] / 2 + g[i] * g[j] / (4 * q) for j in range(n)] for i in range(n)]
    assert q > 0
    low, high = Fraction(0), sum(inner[i][i] for i in range(n))
    while high - low > high / 10**18:
        middle = (low + high) / 2
        low, high = (low, middle) if definite(inner, middle) else (middle, high)
    return high


def definite(inner, rho):
    a = [[(rho if i == j else 0) - v for j, v in enumerate(row)] for i, row in enumerate(inner)]
    for k in range(len(a)):
        if a[k][k] <= 0:
            return False
        for i in range(k + 1, len(a)):
            share = a[i][k] / a[k][k]
            a[i] = [x - share * y for x, y in zip(a[i], a[k], strict=True)]
    return True


def test_weights_that_floats_do_not_hold_once_scaled_are_not_scaled():
    """A third of the least float is 0, and a network without that weight has a smaller constant."""
    odd, none = np.array([[3 * np.nextafter(0.0, 1.0), 1.0]]), np.zeros(2, dtype=np.int64)
    assert rescaled(odd, np.array([1]), none).tolist() == (2 * odd).tolist()
    assert rescaled(odd, np.array([-1]), none) is None
    assert rescaled(odd, np.array([-1]), np.array([1, 0])).tolist() == [[odd[0, 0], 0.5]]
