"""Networks for other tools: ONNX files in double precision, and VNN-LIB queries about them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gapcert import MissingDependency, UsageError
from gapcert_networks import Network

OPERATORS = {
    "arctan": "Atan",
    "identity": "Identity",
    "leaky-relu": "LeakyRelu",
    "relu": "Relu",
    "sigmoid": "Sigmoid",
    "softplus": "Softplus",
    "tanh": "Tanh",
}
_NAMES = {operator: name for name, operator in OPERATORS.items()}
_OPSET, _IR = 17, 8


def save_onnx(network: Network, path: Path | str) -> None:
    """The network as a chain of Gemm and activation nodes, from `X` (n, n_in) to `Y` (n, n_out), weights as they are."""
    onnx = _onnx()
    helper, double = onnx.helper, onnx.TensorProto.DOUBLE
    nodes, values, at, last = [], [], "X", len(network.weights) - 1
    for k, (w, b) in enumerate(zip(network.weights, network.biases, strict=True)):
        values += [onnx.numpy_helper.from_array(w, f"W{k}"), onnx.numpy_helper.from_array(b, f"b{k}")]
        name = network.output if k == last else network.activation
        out = "Y" if k == last and name is None else f"v{k}"
        nodes.append(helper.make_node("Gemm", [at, f"W{k}", f"b{k}"], [out], transB=1))
        at = out
        if name is not None:
            after = "Y" if k == last else f"z{k + 1}"
            options = {"alpha": 0.01} if name == "leaky-relu" else {}
            nodes.append(helper.make_node(OPERATORS[name], [at], [after], **options))
            at = after
    ends = [helper.make_tensor_value_info(n, double, ["n", m]) for n, m in (("X", network.n_in), ("Y", network.n_out))]
    graph = helper.make_graph(nodes, "gapcert", ends[:1], ends[1:], values)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", _OPSET)], ir_version=_IR)
    onnx.checker.check_model(model)
    onnx.save(model, str(path))


def load_onnx(path: Path | str) -> Network:
    """What `save_onnx` wrote, or any chain of that kind; UsageError where the file holds something else."""
    try:
        return _network(path)
    except UsageError:
        raise
    except Exception as error:  # protobuf and NumPy raise what they find on bytes that are no network
        what = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise UsageError(f"{path}: cannot be read ({what}); expected an ONNX file of one network; export it again") from None


def _network(path: Path | str) -> Network:
    onnx = _onnx()
    # What a file from elsewhere names as its data is not read: the weights are in it.
    graph = onnx.load(str(path), load_external_data=False).graph
    values = {v.name: np.asarray(onnx.numpy_helper.to_array(v), dtype=np.float64) for v in graph.initializer}
    weights, biases = [], []
    names: list[str | None] = []
    for node in graph.node:
        options = {a.name: onnx.helper.get_attribute_value(a) for a in node.attribute}
        if node.op_type == "Gemm" and set(node.input[1:]) <= set(values) and len(node.input) == 3:
            w = values[node.input[1]]
            if options.get("alpha", 1.0) != 1.0 or options.get("beta", 1.0) != 1.0 or options.get("transA", 0):
                raise UsageError(f"{path}: node Gemm has factors; expected W x + b alone")
            weights.append(w if options.get("transB", 0) else w.T)
            biases.append(values[node.input[2]].reshape(-1))
            names.append(None)
        elif node.op_type in _NAMES and names and names[-1] is None:
            names[-1] = _NAMES[node.op_type]
            # The attribute is a float32: 0.01 is not what it holds.
            if node.op_type == "LeakyRelu" and not np.isclose(options.get("alpha", 0.01), 0.01, rtol=1e-6):
                raise UsageError(f"{path}: LeakyRelu has slope {options['alpha']:g}; expected 0.01")
        else:
            raise UsageError(
                f"{path}: found node {node.op_type}; expected a chain of Gemm and {', '.join(sorted(_NAMES))}; export the "
                f"network as one"
            )
    inner = set(names[:-1]) or {"relu"}
    if not weights or len(inner) > 1 or None in inner:
        raise UsageError(f"{path}: found hidden activations {sorted(map(str, inner))}; expected one for all hidden layers")
    return Network(tuple(weights), tuple(biases), str(inner.pop()), names[-1])


def vnnlib(network: Network, low: Sequence[float], high: Sequence[float], above: Sequence[float]) -> str:
    """The VNN-LIB query that is unsatisfiable if, and only if, Y_i < above_i for every output i on the box [low, high]."""
    if len(low) != network.n_in or len(high) != network.n_in or len(above) != network.n_out:
        raise UsageError(
            f"vnnlib: found {len(low)} and {len(high)} ends and {len(above)} bounds; expected {network.n_in} ends and "
            f"{network.n_out} bounds; give one per input and one per output"
        )
    lines = [f"(declare-const X_{j} Real)" for j in range(network.n_in)]
    lines += [f"(declare-const Y_{i} Real)" for i in range(network.n_out)]
    for j, (a, b) in enumerate(zip(low, high, strict=True)):
        lines += [f"(assert (>= X_{j} {_number(a)}))", f"(assert (<= X_{j} {_number(b)}))"]
    cases = " ".join(f"(and (>= Y_{i} {_number(c)}))" for i, c in enumerate(above))
    return "\n".join([*lines, f"(assert (or {cases}))", ""])


def _number(value: float) -> str:
    """Every digit of the float, without an exponent, which the format does not know."""
    return np.format_float_positional(float(value), unique=True, trim="0")


def _onnx() -> Any:
    try:
        import onnx
        import onnx.numpy_helper
    except ImportError:
        raise MissingDependency("ONNX files need onnx, which is not installed; run: pip install 'gapcert[neural]'") from None
    return onnx
