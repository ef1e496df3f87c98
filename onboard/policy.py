"""The learned policy on board: an ONNX model with a contract that says what it needs, refused where that differs.

`read_contract` checks that the model keeps its own word, `check_fit` that this drone is what it was trained for.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from imagine.core.contract import CONTRACT_KEY, NEXT_STATE, STATE, PolicyContract
from imagine.core.errors import InputError, WorkError
from imagine.core.lidar import LidarSpec
from imagine.core.mapping import MapSettings
from imagine.core.vehicle_limits import VehicleLimits
from imagine.onboard.onnx_weights import hash_weights

_log = logging.getLogger(__name__)

LARGEST_MODEL_BYTES = 64 * 2**20
OUTPUT = "action"
_TOLERANCE = 1e-6


class Policy(Protocol):
    """What the runner needs of a policy: its contract, and an action for an observation and what it remembers."""

    contract: PolicyContract

    def infer(
        self, observation: dict[str, NDArray[np.float32]], state: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return the action, float32 `[contract.action.size]`, and the next state, `[contract.state_size]`.

        `state` is what it returned for the decision before, zeros where a flight begins. Raises WorkError where the
        model fails.
        """


class OnnxPolicy:
    """A policy in onnxruntime, on one CPU thread: the same numbers at every run."""

    def __init__(self, contract: PolicyContract, session: Any) -> None:
        """Wrap a session whose contract was checked; use `load`."""
        self.contract = contract
        self._session = session

    @staticmethod
    def load(path: Path) -> OnnxPolicy:
        """Read a model and its contract. Raises InputError if the file is unreadable or breaks its own contract."""
        data = _read(path)
        session = _open_session(data, path)
        contract = read_contract(session, str(path))
        if contract.weights_sha256:
            found = hash_weights(data, str(path))
            if found != contract.weights_sha256:
                raise InputError(
                    f"{path}: its weights hash to {found[:12]}…, its contract says {contract.weights_sha256[:12]}…: "
                    "the file was damaged or changed; export it again"
                )
        return OnnxPolicy(contract, session)

    def infer(
        self, observation: dict[str, NDArray[np.float32]], state: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return action and next state of one observation (arrays without batch axis), see `Policy.infer`."""
        from onnxruntime.capi import onnxruntime_pybind11_state as ort_state

        batch = {name: array[np.newaxis] for name, array in observation.items()}
        outputs = [OUTPUT]
        if self.contract.state_size:
            batch[STATE] = state[np.newaxis]
            outputs.append(NEXT_STATE)
        try:
            action, *rest = self._session.run(outputs, batch)
        except (ort_state.Fail, ort_state.RuntimeException, ort_state.InvalidArgument, ort_state.EPFail) as error:
            raise WorkError(f"policy inference failed: {_first_line(error)}") from error
        following = rest[0][0] if rest else state
        return np.asarray(action[0], dtype=np.float32), np.asarray(following, dtype=np.float32)


def read_contract(session: Any, where: str) -> PolicyContract:
    """Return the contract an onnxruntime session carries. Raises InputError where the graph does not keep it."""
    text = session.get_modelmeta().custom_metadata_map.get(CONTRACT_KEY)
    if text is None:
        raise InputError(
            f"{where}: has no policy contract (metadata '{CONTRACT_KEY}'); write it with `imagine export onnx`"
        )
    contract = PolicyContract.from_json(text, where)
    inputs = {node.name: node for node in session.get_inputs()}
    shapes = contract.inputs
    if set(inputs) != set(shapes):
        raise InputError(f"{where}: contract: observation has inputs {sorted(shapes)}, the graph has {sorted(inputs)}")
    for name, shape in shapes.items():
        _check_node(inputs[name], shape, f"{where}: contract: observation '{name}'")
    outputs = {node.name: node for node in session.get_outputs()}
    if OUTPUT not in outputs:
        raise InputError(f"{where}: contract: the graph has no output '{OUTPUT}', only {sorted(outputs)}")
    _check_node(outputs[OUTPUT], (contract.action.size,), f"{where}: contract: action ({contract.action.mode})")
    if contract.state_size:
        if NEXT_STATE not in outputs:
            raise InputError(f"{where}: contract: the graph has no output '{NEXT_STATE}', only {sorted(outputs)}")
        _check_node(outputs[NEXT_STATE], (contract.state_size,), f"{where}: contract: state_size: '{NEXT_STATE}'")
    return contract


def check_fit(
    contract: PolicyContract, lidar: LidarSpec, map_settings: MapSettings, limits: VehicleLimits, where: str
) -> None:
    """Raise InputError naming the field, what the model wants and what this drone has, unless they fit."""
    if contract.paradigm == "ctce":
        raise InputError(
            f"{where}: contract: paradigm: the model (ctce) wants what the whole team sees and the whole level, this "
            "drone has its own observation; fly one trained with ctde or dtde, and this one in `imagine evaluate`"
        )
    for name, wanted, has in _misfits(contract, lidar, map_settings, limits):
        raise InputError(
            f"{where}: contract: {name}: the model wants {_shown(wanted)}, this drone has {_shown(has)}; "
            "use a model trained for this drone, or correct the drone's settings"
        )


def _misfits(
    contract: PolicyContract, lidar: LidarSpec, map_settings: MapSettings, limits: VehicleLimits
) -> Iterator[tuple[str, float, float]]:
    """Yield every (field, wanted, present) that the drone cannot honour."""
    for name in ("beams", "fov", "range_min", "range_max", "rate_hz", "start"):
        wanted, has = getattr(contract.lidar, name), getattr(lidar, name)
        if abs(wanted - has) > _TOLERANCE:
            yield f"lidar.{name}", wanted, has
    if abs(contract.rate_hz - lidar.rate_hz) > _TOLERANCE:  # one decision a scan
        yield "rate_hz", contract.rate_hz, lidar.rate_hz
    for name in MapSettings.model_fields:
        wanted, has = getattr(contract.map, name), getattr(map_settings, name)
        if abs(wanted - has) > _TOLERANCE:
            yield f"map.{name}", wanted, has
    if contract.action.speed_mps > limits.speed_mps + _TOLERANCE:
        yield "action.speed_mps", contract.action.speed_mps, limits.speed_mps
    if contract.action.turns and contract.action.yaw_rate_rps > limits.yaw_rate_rps + _TOLERANCE:
        yield "action.yaw_rate_rps", contract.action.yaw_rate_rps, limits.yaw_rate_rps
    if contract.action.mode == "waypoint":  # a drone that cannot brake so hard would fly past its points
        braking, has = contract.action.waypoint_braking_mps2, limits.acceleration_mps2
        if braking > has + _TOLERANCE:
            yield "action.waypoint_braking_mps2", braking, has
    if limits.radius_m > contract.limits.radius_m + _TOLERANCE:  # a wider drone was never trained in these passages
        yield "limits.radius_m", contract.limits.radius_m, limits.radius_m


def _check_node(node: Any, shape: tuple[int, ...], where: str) -> None:
    if node.type != "tensor(float)":
        raise InputError(f"{where} is {node.type} in the graph, needs tensor(float)")
    batch, *rest = node.shape if node.shape else (None,)
    if tuple(rest) != shape or (isinstance(batch, int) and batch != 1):
        raise InputError(f"{where} has shape {list(shape)} after the batch axis, the graph has {list(node.shape)}")


def _read(path: Path) -> bytes:
    try:
        if path.stat().st_size > LARGEST_MODEL_BYTES:
            raise InputError(f"{path}: is larger than {LARGEST_MODEL_BYTES // 2**20} MB, no policy for a drone")
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: the policy cannot be read: {error.strerror}") from error


def _open_session(data: bytes, path: Path) -> Any:
    import onnxruntime as ort  # here, not above: 0.15 s that replay and tools without a policy need not pay
    from onnxruntime.capi import onnxruntime_pybind11_state as ort_state

    ort.disable_telemetry_events()  # a drone reports to its pilot alone

    options = ort.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.execution_mode = ort.ExecutionMode.ORT_SEQUENTIAL
    options.log_severity_level = 4
    refusals = (
        ort_state.Fail, ort_state.InvalidArgument, ort_state.InvalidGraph, ort_state.InvalidProtobuf,
        ort_state.NoModel, ort_state.NotImplemented, ort_state.RuntimeException,
    )  # fmt: skip
    try:
        return ort.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    except refusals as error:
        raise InputError(f"{path}: is not a usable ONNX model: {_first_line(error)}") from error


def _first_line(error: Exception) -> str:
    return str(error).strip().splitlines()[0][:160] if str(error).strip() else type(error).__name__


def _shown(value: float) -> str:
    return f"{value:.6g}"
