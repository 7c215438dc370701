"""The certifier lipsdp: the optimum of known nets, textbook forms of the same problem, units, odd networks and refusals."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import gapcert as gc
import gapcert_networks
from gapcert.cli.main import main
from gapcert_lipsdp.config import LipSDPConfig
from gapcert_lipsdp.lipsdp import LipSDP
from gapcert_networks.network_constant import proved

PENDULUM = Path(__file__).parents[2] / "specs" / "pendulum.yaml"


def network(*sizes, seed=0, activation="relu", output=None):
    rng = np.random.default_rng(seed)
    weights = tuple(rng.standard_normal((o, i)) / np.sqrt(i) for i, o in pairwise(sizes))
    return gapcert_networks.Network(weights, tuple(np.zeros(len(w)) for w in weights), activation, output)


def reduced(first, last):
    """One hidden layer and one output, with 2T eliminated: a matrix of n + 1 rows and second-order cones."""
    import cvxpy as cp

    (h, n), t, rho = first.shape, cp.Variable(len(last)), cp.Variable()
    corner = cp.reshape(1 - cp.sum(cp.multiply(last**2, cp.inv_pos(t))) / 2, (1, 1), order="C")
    side = (first.T @ last).reshape(n, 1) / 2
    spare = cp.Variable((1, 1))
    matrix = cp.bmat([[rho * np.eye(n) - first.T @ cp.diag(t) @ first / 2, -side], [-side.T, spare]])
    cp.Problem(cp.Minimize(rho), [matrix >> 0, spare <= corner]).solve(solver=cp.CLARABEL)
    assert h == len(last)
    return float(np.sqrt(rho.value))


def whole(weights):
    """The matrix of all layers, as it is printed."""
    import cvxpy as cp

    rho, lam = cp.Variable(), [cp.Variable(len(w)) for w in weights[:-1]]
    sizes = [weights[0].shape[1], *(len(w) for w in weights)]
    blocks = [[np.zeros((a, b)) for b in sizes] for a in sizes]
    blocks[0][0] = rho * np.eye(sizes[0])
    for i, w in enumerate(weights):
        last = i == len(weights) - 1
        blocks[i + 1][i] = -w if last else -cp.diag(lam[i]) @ w
        blocks[i][i + 1] = blocks[i + 1][i].T
        blocks[i + 1][i + 1] = np.eye(len(w)) if last else 2 * cp.diag(lam[i])
    matrix = cp.bmat(blocks)
    cp.Problem(cp.Minimize(rho), [(matrix + matrix.T) / 2 >> 0]).solve(solver=cp.CLARABEL)
    return float(np.sqrt(rho.value))


def chordal(weights):
    """The same matrix as a sum of positive semidefinite ones, each of two neighbouring layers (Agler et al. 1988)."""
    import cvxpy as cp

    rho, lam = cp.Variable(), [cp.Variable(len(w)) for w in weights[:-1]]
    sizes = [weights[0].shape[1], *(len(w) for w in weights)]
    diagonal = [rho * np.eye(sizes[0]), *(2 * cp.diag(v) for v in lam), np.eye(sizes[-1])]
    below = [-cp.diag(v) @ w for v, w in zip(lam, weights, strict=False)] + [-weights[-1]]
    parts = [cp.Variable((a + b, a + b), PSD=True) for a, b in pairwise(sizes)]
    held = [part[a:, :a] == block for part, a, block in zip(parts, sizes, below, strict=False)]
    for k, block in enumerate(diagonal):
        ends = [p[: sizes[k], : sizes[k]] for p in parts[k : k + 1]]
        starts = [p[sizes[k - 1] :, sizes[k - 1] :] for p in parts[k - 1 : k] if k]
        held.append(sum([*ends, *starts]) == block)
    cp.Problem(cp.Minimize(rho), held).solve(solver=cp.CLARABEL)
    return float(np.sqrt(rho.value))


@pytest.mark.parametrize("sizes", [(4, 20, 1), (3, 6, 5, 1), (2, 5, 4, 3, 2), (2, 6, 6, 6, 6, 1)], ids=str)
def test_it_is_the_optimum_by_pairs_of_layers(sizes):
    net = network(*sizes, seed=4)
    assert LipSDP().bound(net).value == pytest.approx(chordal(net.weights), rel=1e-5)


@pytest.mark.parametrize("sizes", [(4, 20, 1), (1, 6, 1), (3, 8, 2), (3, 6, 5, 1), (2, 5, 4, 3, 2)], ids=str)
def test_it_is_the_optimum_of_the_matrix_as_it_is_printed(sizes):
    net = network(*sizes, seed=3)
    assert LipSDP().bound(net).value == pytest.approx(whole(net.weights), rel=1e-5)


@pytest.mark.parametrize("width", [10, 100])
def test_it_is_the_optimum_of_the_reduced_form(width):
    net = network(4, width, 1, seed=1)
    assert LipSDP().bound(net).value == pytest.approx(reduced(net.weights[0], net.weights[1][0]), rel=1e-5)


@pytest.mark.parametrize(
    ("sizes", "optimum"),
    [
        ((4, 32, 32, 1), 1.878948),
        ((4, 64, 64, 64, 1), 4.592778),
        pytest.param((4, 128, 128, 128, 128, 128, 1), 9.608713, marks=pytest.mark.exam),
        pytest.param((4, *[100] * 10, 1), 34.461396, marks=pytest.mark.exam),
    ],
    ids=str,
)
def test_known_optima_are_proved(sizes, optimum):
    bound = LipSDP().bound(network(*sizes), axes=False)
    assert bound.value == pytest.approx(optimum, abs=1e-6)
    assert 0 <= bound.gap <= 1e-8
    assert bound.method == "lipsdp"


@pytest.mark.parametrize(
    "sizes", [(4, 400, 1), (6, 30, 1), (4, 40, 3), (4, 4000, 1), (3, 5, 1, 1, 2), (5, 1, 1), (3, 2), (1, 1)], ids=str
)
def test_both_sides_meet(sizes):
    bound = LipSDP().bound(network(*sizes), axes=False)
    assert bound.lower <= bound.value <= bound.lower * (1 + 1e-8)


@pytest.mark.parametrize("width", [400, 4_000, 40_000])
def test_wide_layers_are_solved_to_the_last_digits(width):
    bound = LipSDP().bound(network(4, width, 1), axes=False)
    assert -1e-13 <= bound.gap <= 2e-10


@pytest.mark.parametrize("width", [1, 2, 3, 8, 50, 100])
def test_an_optimum_on_the_boundary_is_found_too(width):
    """The optimal X has rank below 4 there, where Newton's method on definite matrices ends early."""
    assert 0 <= LipSDP().bound(network(4, width, 1), axes=False).gap <= 1e-8


def test_a_bound_can_be_proved_again_from_its_multipliers():
    net = network(4, 10, 8, 1)
    bound = LipSDP().bound(net)
    assert proved(net.weights, bound.multipliers, bound.value**2) == pytest.approx(bound.value, rel=1e-9)


@pytest.mark.parametrize("sizes", [(3, 20, 1), (3, 8, 8, 2)], ids=str)
def test_units_are_a_scaling_of_the_inputs(sizes):
    net, units = network(*sizes), np.array([3.0, 0.1, 20.0])
    scaled = gapcert_networks.Network((net.weights[0] / units, *net.weights[1:]), net.biases)
    a, b = LipSDP().bound(net, units), LipSDP().bound(scaled)
    assert a.value == pytest.approx(b.value, rel=1e-8)
    assert a.axes == pytest.approx(b.axes * units, rel=1e-8)
    assert LipSDP().bound(net, 8 * units).value == pytest.approx(a.value / 8, rel=1e-12)


@pytest.mark.parametrize("sizes", [(3, 20, 1), (3, 8, 8, 2)], ids=str)
def test_an_input_alone_changes_no_more_than_all_together(sizes):
    net, units = network(*sizes), np.array([1.0, 2.0, 0.5])
    bound = LipSDP().bound(net, units)
    assert (bound.axes <= bound.value * units * (1 + 1e-12)).all()
    alone = gapcert_networks.Network((net.weights[0][:, 1:2], *net.weights[1:]), net.biases)
    assert bound.axes[1] == pytest.approx(LipSDP().bound(alone).value, rel=1e-8)


@pytest.mark.parametrize("sizes", [(3, 12, 1), (3, 6, 6, 2)], ids=str)
@pytest.mark.parametrize("size", [1e-150, 1e-30, 1e40, 1e140])
def test_weights_of_any_size(sizes, size):
    net = network(*sizes)
    weights = (net.weights[0] * size, *net.weights[1:-1], net.weights[-1])
    bound = LipSDP().bound(gapcert_networks.Network(weights, net.biases))
    assert bound.value == pytest.approx(LipSDP().bound(net).value * size, rel=1e-8)
    assert bound.gap <= 1e-8


@pytest.mark.parametrize("sizes", [(3, 4, 4, 1), (2, 5, 2), (4, 10, 1)], ids=str)
def test_weights_of_many_sizes_at_once(sizes):
    rng = np.random.default_rng(5)
    weights = tuple(w * 10 ** rng.uniform(-6, 6, w.shape) for w in network(*sizes).weights)
    bound = LipSDP().bound(gapcert_networks.Network(weights, tuple(np.zeros(len(w)) for w in weights)))
    assert (bound.method, bound.gap <= 1e-8) == ("lipsdp", True)


def test_neurons_without_effect_change_nothing():
    net = network(3, 6, 5, 2)
    first, middle, last = (np.array(w) for w in net.weights)
    first = np.vstack([first, np.zeros((1, 3)), [[1.0, 2.0, 3.0]]])
    middle = np.hstack([middle, np.ones((5, 1)), np.zeros((5, 1))])
    bound = LipSDP().bound(gapcert_networks.Network((first, middle, last), (np.zeros(8), np.zeros(5), np.zeros(2))))
    assert bound.value == pytest.approx(LipSDP().bound(net).value, rel=1e-12)
    assert (bound.multipliers[0] == 0).tolist() == [False] * 6 + [True] * 2


@pytest.mark.parametrize("layer", [0, 1, 2])
def test_a_network_that_never_changes(layer):
    weights = [np.array(w) for w in network(3, 6, 5, 2).weights]
    weights[layer][:] = 0
    bound = LipSDP().bound(gapcert_networks.Network(tuple(weights), (np.ones(6), np.ones(5), np.ones(2))))
    assert (bound.value, bound.lower, bound.gap, bound.axes.tolist()) == (0, 0, 0, [0, 0, 0])


def test_where_multipliers_prove_nothing_spectral_norms_do():
    class Helpless(gapcert_networks.NetworkCertifier):
        name = "helpless"

        def propose(self, weights):
            return [gapcert_networks.Proposal(tuple(np.ones(len(w)) for w in weights[:-1]), 1e-9)], 0.0

    net = network(3, 6, 5, 2)
    bound = Helpless().bound(net)
    product = np.prod([np.linalg.norm(w, 2) for w in net.weights])
    assert (bound.method, bound.lower, bound.gap) == ("spectral", 0, np.inf)
    assert LipSDP().bound(net).value <= bound.value <= 2 * product


def test_a_sigmoid_is_four_times_as_slow_per_layer_and_an_output_counts():
    relu = LipSDP().bound(network(3, 6, 5, 2)).value
    assert LipSDP().bound(network(3, 6, 5, 2, activation="sigmoid")).value == pytest.approx(relu / 16, rel=1e-12)
    assert LipSDP().bound(network(3, 6, 5, 2, output="sigmoid")).value == pytest.approx(relu / 4, rel=1e-12)
    assert LipSDP().bound(network(3, 6, 5, 2, output="softplus")).value == relu


@pytest.mark.parametrize("activation", ["relu", "leaky-relu", "tanh", "sigmoid", "softplus", "arctan", "identity"])
def test_a_row_has_the_same_bits_in_any_batch(activation):
    net, z = network(5, 33, 17, 3, activation=activation, output="tanh"), np.random.default_rng(0).normal(size=(257, 5))
    together = net(z)
    assert together.tobytes() == np.concatenate([net(row[None]) for row in z]).tobytes()
    assert together == pytest.approx(np.concatenate([net(z[:100]), net(z[100:])]), abs=0)


def test_a_network_is_what_its_formula_says():
    net = gapcert_networks.Network(([[1.0, -2.0], [0.5, 1.0]], [[2.0, -1.0]]), ([0.25, 0.0], [1.0]))
    z = np.array([[1.0, 2.0], [3.0, -1.0]])
    assert net(z).tolist() == [[2 * 0.0 - 2.5 + 1], [2 * 5.25 - 0.5 + 1]]
    assert (net.n_in, net.n_out) == (2, 1)


GOOD = {"weights": ([[1.0, 2.0]], [[1.0]]), "biases": ([0.0], [0.0])}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"weights": ([[1.0, 2.0]],)}, r"found 1 weights and 2 biases; expected one bias per weight"),
        ({"weights": ([1.0], [[1.0]])}, r"weights\[0\]: found shape \(1,\); expected \(h, n\)"),
        ({"weights": ([[1.0, 2.0]], [[1.0, 1.0]])}, r"weights\[1\]: found shape \(1, 2\); expected \(h, 1\)"),
        ({"biases": ([0.0], [0.0, 0.0])}, r"biases\[1\]: found shape \(2,\); expected \(1,\)"),
        ({"weights": ([[1.0, np.nan]], [[1.0]])}, r"weights\[0\]: found nan at \[0, 1\]; expected finite numbers"),
        ({"biases": ([np.inf], [0.0])}, r"biases\[0\]: found inf at \[0\]"),
        ({"activation": "gelu"}, r"activation: found 'gelu', and its slopes reach from -0.129 to 1.129"),
        ({"activation": "silu"}, r"slopes reach from -0.0999"),
        ({"output": "softmax"}, r"output: found 'softmax', and it is not elementwise"),
        ({"activation": "absolute"}, r"its slopes are -1 and 1"),
        (
            {"activation": "magic"},
            r"found 'magic', and nothing is known of its slopes; expected elementwise slopes in \[0, 1\]",
        ),
    ],
)
def test_a_network_that_cannot_be_bounded_is_refused(change, message):
    with pytest.raises(gc.UsageError, match=message):
        gapcert_networks.Network(**GOOD | change)


@pytest.mark.parametrize("units", [[1.0], [1.0, 0.0], [1.0, -1.0], [1.0, np.nan], [1e-60, 1e60]])
def test_units_that_make_no_norm_are_refused(units):
    with pytest.raises(gc.UsageError, match="network units: found"):
        LipSDP().bound(gapcert_networks.Network(**GOOD), units)


def test_what_floats_do_not_hold_is_refused():
    with pytest.raises(gc.UsageError, match="beyond floats; rescale"):
        LipSDP().bound(gapcert_networks.Network(([[1e200]], [[1e200]]), ([0.0], [0.0])))
    with pytest.raises(gc.UsageError, match="too far apart for floats"):
        LipSDP().bound(gapcert_networks.Network(([[1e300, 1e-310]],), ([0.0],)))


def test_points_of_another_shape_are_refused():
    with pytest.raises(gc.UsageError, match=r"network input: found shape \(3,\); expected \(n, 2\)"):
        gapcert_networks.Network(**GOOD)(np.zeros(3))


def test_it_is_declared_and_no_estimator_of_residuals(capsys, tmp_path):
    certifier = gc.registry().build("lipschitz", "lipsdp", LipSDPConfig(kind="lipsdp"))
    assert isinstance(certifier, LipSDP)
    change = "lipschitz.residual={kind: lipsdp}"
    assert main(["run", str(PENDULUM), "--set", change, "--out", str(tmp_path), "--quiet"]) == 2
    assert "lipsdp bounds networks, not residuals" in capsys.readouterr().err
    assert LipSDPConfig(kind="lipsdp").tolerance == LipSDP().tolerance
