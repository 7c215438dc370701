"""Networks as ONNX files and VNN-LIB queries: written, read again, and evaluated by another program."""

from __future__ import annotations

import itertools
import re
from pathlib import Path

import numpy as np
import pytest

import gapcert
import gapcert_networks
from gapcert_neural.exchange import OPERATORS, load_onnx, save_onnx, vnnlib

pytestmark = pytest.mark.contract


def network(activation: str, output: str | None, sizes: tuple[int, ...] = (3, 7, 5, 2)) -> gapcert_networks.Network:
    rng = np.random.default_rng(3)
    weights = tuple(rng.standard_normal((b, a)) for a, b in itertools.pairwise(sizes))
    return gapcert_networks.Network(weights, tuple(rng.standard_normal(len(w)) for w in weights), activation, output)


@pytest.mark.parametrize("activation", sorted(OPERATORS))
@pytest.mark.parametrize("output", [None, "relu", "softplus"])
def test_comes_back_as_it_was(tmp_path: Path, activation: str, output: str | None) -> None:
    net, path = network(activation, output), tmp_path / "net.onnx"
    save_onnx(net, path)
    again = load_onnx(path)
    assert (again.activation, again.output) == (activation, output)
    for name in ("weights", "biases"):
        assert all(np.array_equal(a, b) for a, b in zip(getattr(net, name), getattr(again, name), strict=True))


@pytest.mark.parametrize("activation", sorted(set(OPERATORS) - {"leaky-relu"}))
def test_another_program_evaluates_it_alike(tmp_path: Path, activation: str) -> None:
    from onnx.reference import ReferenceEvaluator

    net, path = network(activation, "softplus"), tmp_path / "net.onnx"
    save_onnx(net, path)
    z = np.random.default_rng(0).uniform(-2, 2, (100, 3))
    (found,) = ReferenceEvaluator(str(path)).run(None, {"X": z})
    assert np.abs(found - net(z)).max() < 1e-12 * (1 + np.abs(found).max())


def test_a_query_says_what_is_asked() -> None:
    text = vnnlib(network("relu", None), [-1, -0.5, 1e-7], [1, 0.5, 2], [3.25, -1])
    for line in (
        "(declare-const X_2 Real)",
        "(declare-const Y_1 Real)",
        "(assert (>= X_2 0.0000001))",
        "(assert (<= X_1 0.5))",
    ):
        assert line in text.splitlines()
    assert "(assert (or (and (>= Y_0 3.25)) (and (>= Y_1 -1.0))))" in text
    assert text.count("(") == text.count(")")
    assert not re.search(r"\de[+-]?\d", text)


def test_other_files_and_queries_are_refused(tmp_path: Path) -> None:
    import onnx

    helper, path = onnx.helper, tmp_path / "other.onnx"
    ends = [helper.make_tensor_value_info(n, onnx.TensorProto.DOUBLE, [2, 2]) for n in "XY"]
    graph = helper.make_graph([helper.make_node("Softmax", ["X"], ["Y"])], "other", ends[:1], ends[1:])
    onnx.save(helper.make_model(graph), str(path))
    with pytest.raises(gapcert.UsageError, match="found node Softmax"):
        load_onnx(path)
    with pytest.raises(gapcert.UsageError, match="one per input"):
        vnnlib(network("relu", None), [0], [1], [1, 1])
