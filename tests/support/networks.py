"""Networks of ONNX, made by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from onnx import TensorProto, helper, numpy_helper


def network_file(
    folder: Path, size: int, actions: int = 2, *, memory: bool = False, bias: float = 0.0, mixing: bool = False
) -> Path:
    """Write a network from ``observation`` to ``action``, the tanh of a sum, to which a memory ``hidden`` is added."""
    weights = 0.1 * np.random.default_rng(0).normal(size=(size, actions)).astype(np.float32)
    stored = {"weights": weights, "bias": np.full(actions, bias, np.float32)}
    nodes = [
        helper.make_node("MatMul", ["observation", "weights"], ["whole" if mixing else "product"]),
        helper.make_node("Add", ["product", "hidden" if memory else "bias"], ["sum"]),
        helper.make_node("Tanh", ["sum"], ["action"]),
        helper.make_node("Add", ["action", "bias"], ["next_hidden"]),
    ]
    if mixing:  # subtract the mean over the batch
        stored["rows"] = np.array([0])
        nodes.insert(1, helper.make_node("ReduceMean", ["whole", "rows"], ["mean"]))
        nodes.insert(2, helper.make_node("Sub", ["whole", "mean"], ["product"]))
    shapes = {"observation": size, "hidden": actions, "action": actions, "next_hidden": actions}
    values = {name: helper.make_tensor_value_info(name, TensorProto.FLOAT, ["N", n]) for name, n in shapes.items()}
    ends = [values["observation"], values["hidden"]], [values["action"], values["next_hidden"]]
    inputs, outputs = (end[: 1 + memory] for end in ends)
    initializers = [numpy_helper.from_array(value, name) for name, value in stored.items()]
    graph = helper.make_graph(nodes, "network", inputs, outputs, initializers)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    (folder / "network.onnx").write_bytes(model.SerializeToString())
    return folder / "network.onnx"
