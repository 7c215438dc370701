"""Networks that keep to a Lipschitz constant by construction."""

from __future__ import annotations

import numpy as np
import pytest

import gapcert
import gapcert_networks
from gapcert.contracts.gaps.gap import GapFamily
from gapcert_bounds.testing.contracts import GapFamilyContract
from gapcert_bounds.testing.fields import Waves, gap_problem
from gapcert_neural.covered import SHAPES, Covered
from gapcert_neural.family import Neural
from gapcert_neural.training import Plan


class _Shaped(GapFamilyContract):
    shape = "lbdn"

    def family(self) -> GapFamily:
        family = Neural(hidden=(8, 8), steps=40, shape=self.shape)
        family.routes = ("theorem1",)
        return family


class TestSandwich(_Shaped):
    pass


class TestResidual(_Shaped):
    shape = "sll"


def drawn(shape: str, seed: int, hidden: tuple[int, ...]) -> tuple[gapcert_networks.Network, float]:
    """A network of random parameters in units of z as measured, and the constant that it is said to have."""
    rng = np.random.default_rng(seed)
    half = np.array([0.5, 2.0, 1.0])
    points = Covered(rng.uniform(-1, 1, (50, 3)), rng.random((50, 2)), half, 0.1, np.ones(3))
    training = SHAPES[shape](Plan(hidden, "relu", 1, seed, "auto"), points, None, lambda done, total: None)
    theta = rng.standard_normal(sum(int(np.prod(s)) for s in training.shapes))
    (w, b), *rest = training.layers(theta)
    weights, biases = zip((w / half, b), *rest, strict=True)
    return gapcert_networks.Network(tuple(weights), tuple(biases), "relu"), float(np.exp(theta[0]))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("hidden", [(12,), (10, 6), (5, 7, 4)])
def test_sandwich_is_proved_to_keep_its_constant(seed: int, hidden: tuple[int, ...]) -> None:
    network, constant = drawn("lbdn", seed, hidden)
    bound = gapcert.registry().build("lipschitz", "lipsdp").bound(network, axes=False)
    # Weights are float32 numbers.
    assert bound.value <= constant * (1 + 1e-4)
    assert bound.value > 0.2 * constant


@pytest.mark.parametrize("shape", sorted(SHAPES))
@pytest.mark.parametrize("seed", range(3))
def test_no_slope_exceeds_the_constant(shape: str, seed: int) -> None:
    network, constant = drawn(shape, seed, (8, 8))
    rng = np.random.default_rng(seed)
    a = rng.uniform(-3, 3, (20_000, 3))
    b = a + 10.0 ** rng.uniform(-4, 0, (len(a), 1)) * rng.standard_normal(a.shape)
    change = np.linalg.norm(network(a) - network(b), axis=1)
    assert (change <= constant * np.linalg.norm(a - b, axis=1) * (1 + 1e-4)).all()


@pytest.mark.exam
def test_layers_in_a_row_pay_on_route_theorem1() -> None:
    field = Waves.smooth()
    asked = gap_problem(field, (24, 24, 24), route="theorem1")
    z = asked.domain.draw(5_000, np.random.default_rng(1))
    gap = Neural(hidden=(24, 24), steps=400, shape="lbdn").fit(asked)
    constant = np.abs(asked.samples.r).max(axis=0) + asked.margin
    assert (np.abs(field(z)) <= gap.gamma(z)).all()
    assert (gap.gamma(z).mean(axis=0) < 0.9 * constant).all()


def test_shapes_are_for_route_theorem1() -> None:
    with pytest.raises(gapcert.UsageError, match="shape: lbdn is for route theorem1"):
        Neural(shape="lbdn").fit(gap_problem(Waves.smooth(), (6, 6, 6)))
    with pytest.raises(gapcert.UsageError, match="through relu"):
        Neural(shape="sll", activation="tanh").fit(gap_problem(Waves.smooth(), (6, 6, 6), route="theorem1"))
