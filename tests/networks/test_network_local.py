"""Constants of networks on a box: how tight they are, when the search ends, and what is refused."""

from __future__ import annotations

import itertools
from itertools import pairwise

import numpy as np
import pytest
from scipy.optimize import linprog

import gapcert as gc
import gapcert_networks


def drawn(sizes, seed=0, activation="relu", output=None):
    rng = np.random.default_rng(seed)
    weights = tuple(rng.standard_normal((o, i)) / np.sqrt(i) for i, o in pairwise(sizes))
    return gapcert_networks.Network(weights, tuple(rng.normal(size=len(w)) * 0.3 for w in weights), activation, output)


def cube(n):
    return -np.ones(n), np.ones(n)


@pytest.mark.parametrize(
    ("sizes", "activation"), [((4, 50, 1), "relu"), ((4, 50, 1), "tanh"), ((3, 32, 32, 1), "relu")], ids=str
)
def test_one_percent_is_reached(sizes, activation):
    bound = gapcert_networks.local_bound(drawn(sizes, activation=activation), cube(sizes[0]))
    assert 0 < bound.lower <= bound.value <= 1.01 * bound.lower
    assert bound.gap <= 0.01


def largest(net, low, high, units):
    """Over all patterns of signs that hold with room somewhere in the box, by linear programs."""
    (first, last), (b, _) = net.weights, net.biases
    best = 0.0
    for signs in itertools.product((0.0, 1.0), repeat=len(first)):
        side = 1 - 2 * np.array(signs)
        found = linprog(
            [*np.zeros(net.n_in), -1],
            np.hstack([side[:, None] * first, np.ones((len(first), 1))]),
            -side * b,
            bounds=[*zip(low, high, strict=True), (None, 1)],
        )
        if found.status == 0 and found.x[-1] > 1e-7:
            best = max(best, float(np.linalg.norm((last[0] * signs) @ first / units)))
    return best


@pytest.mark.parametrize("seed", range(3))
def test_it_is_the_largest_gradient_of_any_pattern_that_occurs(seed):
    net, (low, high), units = drawn((2, 6, 1), seed), (np.array([-0.7, -0.2]), np.array([0.4, 1.1])), np.array([1.0, 2.5])
    exact = largest(net, low, high, units)
    bound = gapcert_networks.local_bound(net, (low, high), units, tolerance=1e-4)
    assert bound.lower <= exact * (1 + 1e-9)
    assert exact * (1 - 1e-9) <= bound.value <= exact * (1 + 1.01e-4)


@pytest.mark.parametrize("seed", range(3))
def test_few_gates_of_many_inputs_are_told_apart_themselves(seed):
    net, (low, high), units = drawn((8, 7, 1), seed), (-np.ones(8), np.linspace(0.5, 1.5, 8)), np.linspace(1, 2, 8)
    exact = largest(net, low, high, units)
    bound = gapcert_networks.local_bound(net, (low, high), units, tolerance=1e-6)
    assert bound.gap <= 1e-6
    assert bound.boxes <= 2**8
    assert bound.lower <= exact * (1 + 1e-9)
    assert exact * (1 - 1e-9) <= bound.value


@pytest.mark.parametrize("activation", ["relu", "leaky-relu"])
def test_few_gates_in_two_layers(activation):
    net, box = drawn((8, 6, 6, 1), 1, activation), cube(8)
    bound = gapcert_networks.local_bound(net, box, tolerance=1e-6)
    assert bound.gap <= 1e-6
    # Between points whose gates are the same, the gradient is the difference quotient.
    x = np.random.default_rng(2).uniform(*box, (20_000, 8))
    step = 1e-7
    g = np.stack([(net(x + step * e) - net(x - step * e)) / (2 * step) for e in np.eye(8)], axis=-1)
    norms = np.linalg.norm(g.reshape(len(x), 8), axis=1)
    assert 0.9 * bound.value < norms.max() <= bound.value * (1 + 1e-6)


def test_where_kinks_of_layers_meet_the_gates_are_told_apart():
    assert gapcert_networks.local_bound(drawn((2, 8, 8, 8, 1)), cube(2), tolerance=0.05).gap <= 0.05


@pytest.mark.parametrize("forged", [-1.0, 1.0])
def test_what_a_linear_program_claims_is_not_believed(monkeypatch, forged):
    net, box = drawn((8, 7, 1), 2), cube(8)
    exact = largest(net, *box, np.ones(8))

    def solver(c, A_ub, b_ub, bounds):
        found = linprog(c, A_ub=A_ub, b_ub=b_ub, bounds=bounds)
        found.x[-1] = -1.0
        found.ineqlin.marginals = forged * np.abs(np.random.default_rng(len(b_ub)).normal(size=len(b_ub)))
        return found

    monkeypatch.setattr("scipy.optimize.linprog", solver)
    assert gapcert_networks.local_bound(net, box, tolerance=1e-6, budget=400).value >= exact * (1 - 1e-9)


def test_gates_are_left_when_the_budget_ends_and_told_of_meanwhile():
    seen = []
    net, box = drawn((10, 20, 1)), cube(10)
    bound = gapcert_networks.local_bound(net, box, tolerance=1e-6, budget=20, emit=lambda e: seen.append(e.data))
    whole = gapcert_networks.local_bound(net, box, tolerance=1e-6)
    assert bound.boxes <= 20
    assert bound.gap > whole.gap <= 1e-6
    assert bound.lower <= whole.value <= bound.value
    assert gapcert_networks.local_bound(net, box, tolerance=1e-6, budget=1).boxes == 1
    assert len(seen) > 3
    assert all(b["value"] <= a["value"] and b["lower"] >= a["lower"] for a, b in pairwise(seen))


def test_a_box_tells_more_than_all_of_space():
    net = drawn((4, 50, 1))
    everywhere = gc.registry().build("lipschitz", "lipsdp").bound(net, axes=False)
    whole, part = (gapcert_networks.local_bound(net, (-w * np.ones(4), w * np.ones(4)), tolerance=0.05) for w in (1.0, 0.3))
    assert part.value < whole.value < 0.7 * everywhere.value


def test_the_budget_ends_it_and_what_is_proved_stays_proved():
    net = drawn((4, 50, 1))
    tight = gapcert_networks.local_bound(net, cube(4))
    budgets = 1, 400, 2000
    values = [gapcert_networks.local_bound(net, cube(4), budget=k) for k in budgets]
    assert all(b.boxes <= k for b, k in zip(values, budgets, strict=True))
    assert values[0].value >= values[1].value > values[2].value > tight.value * 0.99
    assert all(b.value >= tight.lower for b in values)


def test_progress_is_told_and_never_gets_worse():
    events = []
    bound = gapcert_networks.local_bound(drawn((4, 50, 1)), cube(4), emit=events.append)
    told = [e.data["value"] for e in events]
    assert all(a >= b for a, b in pairwise(told))
    assert told[-1] == bound.value
    assert events[-1].data["done"] == bound.boxes


def test_an_observer_can_interrupt_it():
    def emit(event):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        gapcert_networks.local_bound(drawn((4, 50, 1)), cube(4), emit=emit)


def test_the_same_twice():
    a, b = (gapcert_networks.local_bound(drawn((3, 20, 20, 1)), cube(3), cells=2) for _ in range(2))
    assert (a.value, a.lower, a.boxes) == (b.value, b.lower, b.boxes)
    assert np.array_equal(a.constants, b.constants)


def test_constants_of_cells_are_not_above_that_of_the_box():
    net = drawn((2, 30, 1))
    bound = gapcert_networks.local_bound(net, cube(2), cells=(8, 3))
    assert bound.constants.shape == (8, 3)
    assert [len(e) for e in bound.edges] == [9, 4]
    assert (bound.constants <= bound.value).all()
    assert bound.constants.mean() < 0.9 * bound.value
    part = gapcert_networks.local_bound(net, ([e[i] for e, i in zip(bound.edges, (5, 1), strict=True)],
                                [e[i + 1] for e, i in zip(bound.edges, (5, 1), strict=True)]), tolerance=1e-3)  # fmt: skip
    assert part.lower <= bound.constants[5, 1] <= 1.5 * part.value


def test_a_linear_network_and_one_that_is_constant():
    w = np.array([[3.0, 4.0]])
    linear = gapcert_networks.local_bound(gapcert_networks.Network((w,), (np.ones(1),)), cube(2))
    assert 5 <= linear.value <= 5 * (1 + 1e-9)
    assert linear.lower >= 5 * (1 - 1e-9)
    flat = gapcert_networks.local_bound(
        gapcert_networks.Network((w, np.zeros((1, 1))), (np.ones(1), np.ones(1))), cube(2), cells=2
    )
    assert flat.value == flat.gap == 0
    assert not flat.constants.any()


def test_an_output_activation_counts():
    net = drawn((2, 10, 1), output="sigmoid")
    plain = gapcert_networks.Network(net.weights, net.biases)
    assert gapcert_networks.local_bound(net, cube(2)).value < 0.26 * gapcert_networks.local_bound(plain, cube(2)).value


NET = gapcert_networks.Network((np.ones((3, 2)), np.ones((1, 3))), (np.zeros(3), np.zeros(1)))


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"box": ([0, 0], [1, 0])}, "low < high"),
        ({"box": ([0, 0, 0], [1, 1, 1])}, r"\(3,\)"),
        ({"box": ([0, 0],)}, "low, high"),
        ({"box": ([0, np.nan], [1, 1])}, "finite"),
        ({"box": "ab"}, "low, high"),
        ({"units": [1, 0]}, "positive"),
        ({"tolerance": -1}, "tolerance"),
        ({"tolerance": np.nan}, "tolerance"),
        ({"budget": 0}, "budget"),
        ({"seconds": 0}, "seconds"),
        ({"cells": 0}, "whole number"),
        ({"cells": (2, 2, 2)}, "whole number"),
        ({"cells": 1.5}, "whole number"),
        ({"network": drawn((2, 3, 2))}, "2 outputs"),
        ({"network": gapcert_networks.Network((np.full((3, 2), 1e80), np.ones((1, 3))), NET.biases)}, "too far apart"),
        (
            {"network": gapcert_networks.Network((np.full((3, 2), 1e308), np.ones((1, 3))), NET.biases), "units": [0.1, 1]},
            "too far apart",
        ),
        (
            {"network": gapcert_networks.Network((np.full((3, 2), 1e-200), np.full((1, 3), 1e-200)), NET.biases)},
            "too far apart",
        ),
    ],
    ids=str,
)
def test_what_cannot_be_bounded_is_refused(arguments, says):
    with pytest.raises(gc.UsageError, match=says):
        gapcert_networks.local_bound(**{"network": NET, "box": ([0, 0], [1, 1])} | arguments)
