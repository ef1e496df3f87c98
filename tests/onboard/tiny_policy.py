"""Tiny real ONNX policies for the onboard tests."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from imagine.core.contract import CONTRACT_KEY, ActionSpec, LidarContract, PolicyContract
from imagine.core.lidar import LD19
from imagine.core.mapping import MapSettings
from imagine.core.observation_spec import ObservationSpec
from imagine.core.vehicle_limits import VehicleLimits


def make_contract(**changes) -> PolicyContract:
    fields = {
        "name": "tiny",
        "observation": ObservationSpec(view_cells=16),
        "action": ActionSpec(),
        "rate_hz": 10.0,
        "lidar": LidarContract.of(LD19),
        "map": MapSettings(),
        "limits": VehicleLimits(),
    }
    return PolicyContract(**(fields | changes))


def make_model(contract: PolicyContract, action: tuple[float, ...] = (1.0, 0.0)) -> onnx.ModelProto:
    """A model that reads all its inputs and always answers `action`."""
    shapes = contract.observation.shapes
    inputs = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", *shape]) for name, shape in shapes.items()
    ]
    output = helper.make_tensor_value_info("action", TensorProto.FLOAT, ["batch", len(action)])
    weights = {
        "answer": np.array(action, np.float32),
        "zero": np.zeros((*shapes["motion"], len(action)), np.float32),
        "shape": np.array([0, 3], np.int64),
    }
    nodes = [
        helper.make_node("MatMul", ["motion", "zero"], ["nothing"]),
        helper.make_node("ReduceMean", ["views"], ["mean_view"], keepdims=0),
        helper.make_node("ReduceMean", ["lidar"], ["mean_range"], keepdims=0),
        helper.make_node("Sub", ["mean_view", "mean_view"], ["no_view"]),
        helper.make_node("Sub", ["mean_range", "mean_range"], ["no_range"]),
        helper.make_node("Add", ["nothing", "no_view"], ["still_nothing"]),
        helper.make_node("Add", ["still_nothing", "no_range"], ["really_nothing"]),
        helper.make_node("Add", ["really_nothing", "answer"], ["action"]),
    ]
    initializers = [numpy_helper.from_array(array, name) for name, array in weights.items()]
    graph = helper.make_graph(nodes, "tiny", inputs, [output], initializers)
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)


def weights_hash(model: onnx.ModelProto) -> str:
    digest = hashlib.sha256()
    for tensor in sorted(model.graph.initializer, key=lambda tensor: tensor.name):
        digest.update(numpy_helper.to_array(tensor).tobytes())
    return digest.hexdigest()


def write_policy(
    path: Path, contract: PolicyContract | None = None, model: onnx.ModelProto | None = None, text: str | None = None
) -> Path:
    """Write a model with a contract in its metadata; `text` replaces the contract's JSON, '' leaves it out."""
    contract = contract or make_contract()
    model = model or make_model(contract, (1.0, 0.0) if contract.action.size == 2 else (1.0, 0.0, 0.0))
    if text is None:
        text = contract.to_json()
    if text:
        helper.set_model_props(model, {CONTRACT_KEY: text})
    path.write_bytes(model.SerializeToString())
    return path
