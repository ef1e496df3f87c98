"""From a checkpoint to an ONNX model with its contract inside, proven equal to the network before it is written."""

from __future__ import annotations

import json
import logging
import math
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import torch
from numpy.typing import NDArray

import imagine.train  # noqa: F401  sets up OpenMP before torch works
from imagine.core.contract import CONTRACT_KEY, STATE, LidarContract, PolicyContract
from imagine.core.errors import InputError, WorkError
from imagine.onboard.onnx_weights import hash_weights
from imagine.onboard.policy import OnnxPolicy
from imagine.train.atomic_file import write_atomically
from imagine.train.checkpoint import Checkpoint, actor_of, load_checkpoint
from imagine.train.networks import LEVEL_CELLS, LEVEL_CHANNELS, Actor
from imagine.train.run_folder import config_hash

logger = logging.getLogger(__name__)

PARITY_TOLERANCE = 1e-5
PARITY_OBSERVATIONS = 256
_OPSET = 18
_FRONTIERS = "frontiers"
_CLEAR = 1e-4  # between scores, far more than they are rounded by


@dataclass(frozen=True)
class Inspection:
    """What `inspect` finds: the contract, whether the weights are those it was written for, and sizes."""

    contract: PolicyContract
    weights_sha256: str
    file_bytes: int
    parameters: int
    inputs: dict[str, tuple[int, ...]]
    outputs: dict[str, tuple[int, ...]]


def export_onnx(checkpoint: Path, out: Path, name: str | None = None) -> Inspection:
    """Write a checkpoint's deterministic policy to `out` and return what `inspect` finds in it.

    `checkpoint` is a `.pt` file or a run folder; `name` goes into the contract (default: the run's name). The model
    takes `views`, `lidar` and `motion` with any batch size and returns `action` `[batch, action size]`; one that
    remembers also takes `state` and returns `next_state`, a centralised one also takes `level`, and its batch is a
    team. Raises InputError for a bad checkpoint, WorkError when the model does not agree with the network or cannot be
    written.
    """
    saved = load_checkpoint(checkpoint)
    actor = actor_of(saved, str(checkpoint))
    model = _to_onnx(actor)
    difference = parity(actor, model)
    if not difference <= PARITY_TOLERANCE:
        raise WorkError(
            f"{checkpoint}: ONNX and torch differ by {difference:.2g}, at most {PARITY_TOLERANCE:g} allowed"
        )
    logger.info("ONNX and torch differ by at most %.2g on %d observations", difference, PARITY_OBSERVATIONS)

    record = {**_training_record(saved, checkpoint), "parity_max_difference": difference}
    contract = _contract(saved, actor, name or saved.settings.run.name, record, hash_weights(model, str(out)))
    content = _with_contract(model, contract)
    write_atomically(out, lambda temporary: temporary.write_bytes(content))
    return inspect(out)


def _to_onnx(actor: Actor) -> bytes:
    """Return the actor as a serialised ONNX model."""
    example = tuple(torch.zeros((3, *shape)) for shape in actor.shapes.values())
    batch = torch.export.Dim("batch")
    quiet = logging.getLogger("torch.onnx")
    level = quiet.level
    quiet.setLevel(logging.ERROR)  # it warns of torchvision's absence
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            program = torch.onnx.export(
                actor,
                example,
                input_names=list(actor.inputs),
                output_names=list(actor.outputs),
                dynamic_shapes=(tuple({0: batch} for _ in example),),
                opset_version=_OPSET,
                dynamo=True,
                verbose=False,
            )
    finally:
        quiet.setLevel(level)
    if program is None:
        raise WorkError("torch.onnx.export returned nothing")
    model = program.model_proto
    graph = model.graph
    for part in (graph, *graph.node, *graph.input, *graph.output, *graph.value_info, *graph.initializer):
        del part.metadata_props[:]  # the exporter's notes, with source lines and paths of this machine
    content: bytes = model.SerializeToString()
    return content


def parity(actor: Actor, model: bytes, observations: int = PARITY_OBSERVATIONS) -> float:
    """Return the largest difference between ONNX and torch over random observations, one batch and in small ones.

    States are random too, so that what is remembered counts; they are in [-1, 1], as a memory's are. Frontiers are
    shown or not at random, as they are to drones: what lies between would decide alone which one is chosen. Where two
    are as good as each other, rounding decides, and neither choice is wrong: such actions do not count.
    """
    rng = np.random.default_rng(0)
    session = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])
    inputs: dict[str, NDArray[np.float32]] = {
        key: rng.uniform(-1.0, 1.0, (observations, *shape)).astype(np.float32) for key, shape in actor.shapes.items()
    }
    inputs["lidar"] = np.abs(inputs["lidar"])
    if _FRONTIERS in inputs:
        shown = (inputs[_FRONTIERS][..., :1] > 0.0).astype(np.float32)
        inputs[_FRONTIERS] = shown * np.concatenate([shown, inputs[_FRONTIERS][..., 1:]], axis=2)
    worst = 0.0
    for rows in (slice(0, observations), *(slice(i, i + 1) for i in range(16)), slice(16, 19)):
        part = {key: value[rows] for key, value in inputs.items()}
        with torch.no_grad():
            given = actor(*(torch.from_numpy(part[key]) for key in actor.inputs))
        expected = given if isinstance(given, tuple) else (given,)
        found = session.run(list(actor.outputs), part)
        decided = [_decided(actor, part)] + [np.ones(len(other), bool) for other in expected[1:]]
        for one, other, counts in zip(found, expected, decided, strict=True):
            if one.shape != tuple(other.shape) or not np.isfinite(one).all():
                return math.inf
            worst = max(worst, float(np.abs(one - other.numpy())[counts].max(initial=0.0)))
    return worst


def _decided(actor: Actor, inputs: dict[str, NDArray[np.float32]]) -> NDArray[np.bool_]:
    """Tell in which rows one frontier is clearly the best, bool `[rows]`; in all where none is chosen from."""
    seen = {key: torch.from_numpy(inputs[key]) for key in actor.inputs}
    rows = len(inputs["motion"])
    with torch.no_grad():
        scores = actor.decide(seen, seen.pop(STATE, None), drones=rows if actor.is_central else 1).scores
    if scores is None or scores.shape[1] < 2:
        return np.ones(rows, bool)
    best = scores.topk(2, dim=1).values
    clear: NDArray[np.bool_] = (best[:, 0] - best[:, 1] > _CLEAR).numpy()
    return clear


def _contract(
    saved: Checkpoint, actor: Actor, name: str, record: dict[str, Any], weights_sha256: str
) -> PolicyContract:
    env = saved.settings.env
    lidar = env.lidar_spec
    return PolicyContract(
        name=name,
        observation=env.observation,
        action=env.action,
        rate_hz=lidar.rate_hz,
        lidar=LidarContract.of(lidar),
        map=env.map,
        limits=env.limits,
        paradigm=actor.paradigm,
        state_size=actor.state_size,
        level_shape=(LEVEL_CHANNELS, LEVEL_CELLS, LEVEL_CELLS) if actor.is_central else None,
        training=record,
        weights_sha256=weights_sha256,
    )


def _training_record(saved: Checkpoint, checkpoint: Path) -> dict[str, Any]:
    """Return how the policy was made: run, configuration, steps, commit, and how it fared where that was measured."""
    run = checkpoint if checkpoint.is_dir() else checkpoint.parent.parent
    record = {
        **saved.record,
        "config_sha256": config_hash(saved.settings),
        "phase": saved.phase,
        "agent_steps": saved.agent_steps,
        "wall_s": round(saved.wall_s, 1),
        "env": {
            key: value
            for key, value in saved.settings.env.model_dump(mode="json").items()
            if key not in ("observation", "action", "map", "limits")
        },
    }
    evaluation = run / "evaluation.json"
    if evaluation.exists():
        try:
            record["evaluation"] = json.loads(evaluation.read_text("utf-8"))
        except (OSError, ValueError) as error:
            raise InputError(f"{evaluation}: cannot be read as JSON; delete it or evaluate again") from error
    return record


def _with_contract(model: bytes, contract: PolicyContract) -> bytes:
    proto = onnx.load_from_string(model)
    onnx.helper.set_model_props(proto, {CONTRACT_KEY: contract.to_json()})
    proto.producer_name = "imagine"
    content: bytes = proto.SerializeToString()
    return content


def inspect(path: Path) -> Inspection:
    """Read a model as a drone would, and describe it. Raises InputError where a drone would refuse the file."""
    contract = OnnxPolicy.load(path).contract
    content = path.read_bytes()
    graph = onnx.load_from_string(content).graph
    return Inspection(
        contract=contract,
        weights_sha256=hash_weights(content, str(path)),
        file_bytes=len(content),
        parameters=sum(math.prod(t.dims) for t in graph.initializer if t.data_type == onnx.TensorProto.FLOAT),
        inputs={node.name: _shape(node) for node in graph.input},
        outputs={node.name: _shape(node) for node in graph.output},
    )


def _shape(node: onnx.ValueInfoProto) -> tuple[int, ...]:
    """Return a tensor's shape without the batch axis."""
    return tuple(dim.dim_value for dim in node.type.tensor_type.shape.dim[1:])
