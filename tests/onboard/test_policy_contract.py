"""A policy is refused, in one line that names the field, wherever model, contract and drone do not fit."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from tiny_policy import make_contract, make_model, weights_hash, write_policy

from imagine.core.contract import ActionSpec, LidarContract
from imagine.core.errors import InputError
from imagine.core.lidar import LD19, LidarSpec
from imagine.core.mapping import MapSettings
from imagine.core.observation_spec import ObservationSpec
from imagine.core.vehicle_limits import VehicleLimits
from imagine.onboard.onnx_weights import hash_weights
from imagine.onboard.policy import OnnxPolicy, check_fit

NOTHING = np.zeros(0, np.float32)


def zeros(contract):
    return {name: np.zeros(shape, np.float32) for name, shape in contract.observation.shapes.items()}


def refusal(call, *args) -> str:
    with pytest.raises(InputError) as caught:
        call(*args)
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_a_model_that_keeps_its_contract_loads_and_answers(tmp_path):
    policy = OnnxPolicy.load(write_policy(tmp_path / "p.onnx"))
    action, state = policy.infer(zeros(policy.contract), NOTHING)
    assert state.shape == (0,)
    assert action.dtype == np.float32
    assert action.tolist() == [1.0, 0.0]


def test_the_same_observation_gives_the_same_bits(tmp_path):
    policy = OnnxPolicy.load(write_policy(tmp_path / "p.onnx"))
    rng = np.random.default_rng(3)
    observation = {name: rng.random(shape, np.float32) for name, shape in policy.contract.observation.shapes.items()}
    assert policy.infer(observation, NOTHING)[0].tobytes() == policy.infer(observation, NOTHING)[0].tobytes()


def test_a_missing_file_is_named(tmp_path):
    assert "nowhere.onnx" in refusal(OnnxPolicy.load, tmp_path / "nowhere.onnx")


@pytest.mark.parametrize("damage", ["empty", "noise", "truncated"])
def test_a_corrupt_file_is_refused(tmp_path, damage):
    whole = write_policy(tmp_path / "p.onnx").read_bytes()
    data = {"empty": b"", "noise": bytes(range(256)) * 8, "truncated": whole[: len(whole) // 2]}[damage]
    path = tmp_path / "corrupt.onnx"
    path.write_bytes(data)
    assert "corrupt.onnx" in refusal(OnnxPolicy.load, path)


def test_a_model_without_contract_is_refused_with_the_remedy(tmp_path):
    message = refusal(OnnxPolicy.load, write_policy(tmp_path / "p.onnx", text=""))
    assert "no policy contract" in message
    assert "imagine export onnx" in message


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("{not json", "not valid JSON"),
        ("[1, 2]", "not a JSON object"),
        (json.dumps({"contract_version": 1}), "is missing"),
        (json.dumps(json.loads(make_contract().to_json()) | {"contract_version": 9}), "contract_version"),
        (json.dumps(json.loads(make_contract().to_json()) | {"rate_hz": "fast"}), "rate_hz"),
        (json.dumps(json.loads(make_contract().to_json()) | {"colour": "red"}), "colour"),
    ],
)
def test_a_broken_contract_is_refused_by_its_field(tmp_path, text, named):
    assert named in refusal(OnnxPolicy.load, write_policy(tmp_path / "p.onnx", text=text))


def test_a_graph_whose_view_differs_from_its_contract_is_refused(tmp_path):
    promised = make_contract(observation=ObservationSpec(view_cells=32))
    message = refusal(OnnxPolicy.load, write_policy(tmp_path / "p.onnx", promised, make_model(make_contract())))
    assert "'views'" in message
    assert "32" in message


def test_a_graph_with_too_few_actions_is_refused(tmp_path):
    promised = make_contract(action=ActionSpec(mode="body"))
    message = refusal(OnnxPolicy.load, write_policy(tmp_path / "p.onnx", promised, make_model(promised, (1.0, 0.0))))
    assert "action" in message


def test_changed_weights_are_noticed(tmp_path):
    model = make_model(make_contract())
    contract = make_contract(weights_sha256=weights_hash(model))
    OnnxPolicy.load(write_policy(tmp_path / "good.onnx", contract, model))
    changed = make_model(contract, (0.5, 0.0))
    assert "weights" in refusal(OnnxPolicy.load, write_policy(tmp_path / "bad.onnx", contract, changed))


def test_the_weights_hash_is_the_one_of_the_onnx_package(tmp_path):
    model = make_model(make_contract())
    path = write_policy(tmp_path / "p.onnx", model=model)
    assert hash_weights(path.read_bytes(), "p.onnx") == weights_hash(model)


@pytest.mark.parametrize("cut", [1, 7, 40])
def test_the_weights_walk_ends_on_truncated_files(tmp_path, cut):
    data = write_policy(tmp_path / "p.onnx").read_bytes()
    assert "p.onnx" in refusal(hash_weights, data[:-cut], "p.onnx")


DRONE = (LD19, MapSettings(), VehicleLimits())


def test_a_model_for_this_drone_fits():
    check_fit(make_contract(), *DRONE, "p.onnx")


@pytest.mark.parametrize("mode", ["plane", "waypoint"])
def test_a_model_that_never_turns_asks_for_no_yaw_rate(mode):
    slow = VehicleLimits(yaw_rate_rps=0.5)
    check_fit(make_contract(action=ActionSpec(mode=mode)), LD19, MapSettings(), slow, "p.onnx")


@pytest.mark.parametrize(
    ("contract", "drone", "field", "wanted", "has"),
    [
        ({"lidar": LidarContract.of(LidarSpec(beams=180))}, DRONE, "lidar.beams", "180", "360"),
        ({"lidar": LidarContract.of(LidarSpec(360, fov=math.pi))}, DRONE, "lidar.fov", "3.14159", "6.28319"),
        ({"lidar": LidarContract.of(LidarSpec(360, range_max=8.0))}, DRONE, "lidar.range_max", "8", "12"),
        ({"lidar": LidarContract.of(LidarSpec(360, rate_hz=5.0))}, DRONE, "lidar.rate_hz", "5", "10"),
        ({"rate_hz": 20.0}, DRONE, "rate_hz", "20", "10"),
        ({"map": MapSettings(range_cap_m=2.0)}, DRONE, "map.range_cap_m", "2", "4"),
        ({"map": MapSettings(cell_m=0.05)}, DRONE, "map.cell_m", "0.05", "0.1"),
        ({}, (LD19, MapSettings(), VehicleLimits(speed_mps=0.5)), "action.speed_mps", "0.8", "0.5"),
        (
            {"action": ActionSpec(mode="body")},
            (LD19, MapSettings(), VehicleLimits(yaw_rate_rps=1.0)),
            "action.yaw_rate_rps",
            "3",
            "1",
        ),
        (
            {"action": ActionSpec(mode="forward")},
            (LD19, MapSettings(), VehicleLimits(yaw_rate_rps=1.0)),
            "action.yaw_rate_rps",
            "3",
            "1",
        ),
        (
            {"action": ActionSpec(mode="waypoint")},
            (LD19, MapSettings(), VehicleLimits(acceleration_mps2=0.5)),
            "action.waypoint_braking_mps2",
            "1",
            "0.5",
        ),
        ({}, (LD19, MapSettings(), VehicleLimits(radius_m=0.25)), "limits.radius_m", "0.08", "0.25"),
    ],
)
def test_a_drone_the_model_was_not_trained_for_is_refused(contract, drone, field, wanted, has):
    with pytest.raises(InputError) as caught:
        check_fit(make_contract(**contract), *drone, "p.onnx")
    message = str(caught.value)
    assert f"{field}: the model wants {wanted}, this drone has {has}" in message
