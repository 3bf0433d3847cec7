"""Networks of ONNX, made by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from onnx import TensorProto, helper, numpy_helper


def network_file(folder: Path, size: int, actions: int = 2, *, bias: float = 0.0) -> Path:
    """Write a network from ``observation`` to ``action``: the tanh of a linear layer."""
    weights = 0.1 * np.random.default_rng(0).normal(size=(size, actions)).astype(np.float32)
    stored = {"weights": weights, "bias": np.full(actions, bias, np.float32)}
    nodes = [
        helper.make_node("MatMul", ["observation", "weights"], ["product"]),
        helper.make_node("Add", ["product", "bias"], ["sum"]),
        helper.make_node("Tanh", ["sum"], ["action"]),
    ]
    shapes = {"observation": size, "action": actions}
    ends = [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["N", n]) for name, n in shapes.items()]
    initializers = [numpy_helper.from_array(value, name) for name, value in stored.items()]
    graph = helper.make_graph(nodes, "network", ends[:1], ends[1:], initializers)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    (folder / "network.onnx").write_bytes(model.SerializeToString())
    return folder / "network.onnx"
