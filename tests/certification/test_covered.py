"""Networks on route theorem1: the constant that the margin rests on is proved whatever the units are, and proved again."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

import gapcert
import gapcert_networks
from gapcert_bounds.testing.fields import Waves, gap_problem
from gapcert_networks.network_constant import proved_balanced

GRID = (6, 6, 6)


def network(
    unit: float, scale: float, activation: str, hidden: tuple[int, ...] = (9, 5), seed: int = 0
) -> gapcert_networks.Network:
    """Inputs in `unit`s, outputs in `scale`s, and one neuron each without an input and without an effect."""
    rng, sizes = np.random.default_rng(seed), (3, *hidden, 2)
    weights = [rng.standard_normal((b, a)) / np.sqrt(a) for a, b in itertools.pairwise(sizes)]
    weights[0] = weights[0] / unit
    weights[-1] = weights[-1] * scale
    weights[0][0], weights[1][:, 1] = 0.0, 0.0
    biases = [0.3 * rng.standard_normal(len(w)) for w in weights]
    biases[-1] *= scale
    return gapcert_networks.Network(tuple(weights), tuple(biases), activation, "relu")


@pytest.mark.exam
@pytest.mark.parametrize("activation", ["relu", "sigmoid", "tanh"])
@pytest.mark.parametrize(("unit", "scale"), [(1.0, 1.0), (1e-6, 1e6), (1e9, 1e-9), (1e-3, 1e-12)])
@pytest.mark.parametrize("hidden", [(9,), (9, 5)])
def test_constants_are_proved_in_any_units(unit: float, scale: float, activation: str, hidden: tuple[int, ...]) -> None:
    q, asked = network(unit, scale, activation, hidden), gap_problem(Waves.smooth(), GRID, route="theorem1")
    gap = gapcert_networks.raised(asked, "drawn", q)
    best = gapcert.registry().build("lipschitz", "lipsdp")
    rng = np.random.default_rng(1)
    a = asked.domain.draw(4_000, rng) * unit
    b = a + 1e-3 * unit * rng.standard_normal(a.shape)
    for i, square in enumerate(gap.squares):
        weights = [*q.weights[:-1], q.weights[-1][i : i + 1]]
        constant = proved_balanced(weights, gap.multipliers[i], float(square), q.exponent)
        one = gapcert_networks.Network(tuple(weights), (*q.biases[:-1], q.biases[-1][i : i + 1]), activation, "relu")
        assert constant is not None
        assert constant == pytest.approx(best.bound(one, axes=False).value, rel=1e-6)
        change = np.abs(one(a) - one(b))[:, 0]
        assert (change <= constant * np.linalg.norm(a - b, axis=1) * (1 + 1e-6) + 1e-9 * scale).all()


def test_less_than_the_constant_is_not_proved() -> None:
    q = network(1.0, 1.0, "relu")
    gap = gapcert_networks.raised(gap_problem(Waves.smooth(), GRID, route="theorem1"), "drawn", q)
    weights = [*q.weights[:-1], q.weights[-1][:1]]
    assert proved_balanced(weights, gap.multipliers[0], float(gap.squares[0]) * 0.99, q.exponent) is None


def test_a_network_that_never_changes_has_the_constant_0() -> None:
    dead = gapcert_networks.Network((np.zeros((4, 3)), np.ones((2, 4))), (np.ones(4), np.ones(2)), "relu", "relu")
    gap = gapcert_networks.raised(gap_problem(Waves.smooth(), GRID, route="theorem1"), "drawn", dead)
    assert (gap.squares == 0).all()
    z = np.random.default_rng(0).uniform(-1, 1, (5_000, 3))
    assert (np.abs(Waves.smooth()(z)) <= gap.gamma(z)).all()
