"""Policies of a few nodes as ONNX files, in place of trained ones."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

Axes = Sequence[int | str]


def write_policy(
    path: Path,
    steps: Sequence[str],
    inputs: Mapping[str, Axes],
    outputs: Mapping[str, Axes],
    constants: Mapping[str, np.ndarray] | None = None,
    kind: int = TensorProto.FLOAT,
) -> Path:
    """Write a graph of steps such as `action = MatMul(observation, weights)`."""
    nodes = []
    for step in steps:
        made, _, call = step.partition(" = ")
        operator, _, given = call.removesuffix(")").partition("(")
        along = {"axis": 1} if operator in ("Concat", "Gather") else {}
        nodes.append(helper.make_node(operator, given.split(", "), [made], **along))
    ports = [
        [helper.make_tensor_value_info(name, kind, list(axes)) for name, axes in each.items()]
        for each in (inputs, outputs)
    ]
    kept = [numpy_helper.from_array(value, name) for name, value in (constants or {}).items()]
    graph = helper.make_graph(nodes, "policy", *ports, kept)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.checker.check_model(model)
    onnx.save(model, path)
    return path


def write_linear(path: Path, weights: np.ndarray, batch: int | str = 1) -> Path:
    """Write a = s W, (k,) → (n,)."""
    k, n = weights.shape
    return write_policy(
        path,
        ["action = MatMul(observation, weights)"],
        {"observation": [batch, k]},
        {"action": [batch, n]},
        {"weights": weights.astype(np.float32)},
    )


def write_sum(path: Path, weights: np.ndarray, memory: Axes | None = None) -> Path:
    """Write h′ = h + s, a = h′ W: the memory is the sum of all observations."""
    k, n = weights.shape
    return write_policy(
        path,
        ["state_next = Add(state, observation)", "action = MatMul(state_next, weights)"],
        {"observation": [1, k], "state": memory or [1, k]},
        {"action": [1, n], "state_next": [1, k]},
        {"weights": weights.astype(np.float32)},
    )
