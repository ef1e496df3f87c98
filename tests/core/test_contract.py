"""The policy contract travels as JSON and comes back the same, or is refused by field."""

from __future__ import annotations

import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from imagine.core.contract import ActionSpec, LidarContract, PolicyContract
from imagine.core.errors import InputError
from imagine.core.lidar import LD19, LidarSpec
from imagine.core.mapping import MapSettings
from imagine.core.observation_spec import ObservationSpec
from imagine.core.raster import CELL, HIT, LIMIT, MISS, TILE, UNIT_LOG_ODDS
from imagine.core.vehicle_limits import VehicleLimits


def contract(**changes: Any) -> PolicyContract:
    fields: dict[str, Any] = {
        "name": "explorer",
        "observation": ObservationSpec(),
        "action": ActionSpec(),
        "rate_hz": 10.0,
        "lidar": LidarContract.of(LD19),
        "map": MapSettings(),
        "limits": VehicleLimits(),
        "training": {"run": "a", "coverage": 0.97, "levels": ["0", "1"]},
    }
    return PolicyContract(**(fields | changes))


@given(
    st.text(min_size=1, max_size=100),
    st.sampled_from(["plane", "body", "forward", "waypoint"]),
    st.sampled_from(["map", "heading"]),
    st.integers(1, 720),
    st.floats(0.1, 6.0),
    st.floats(0.1, 5.0),
    st.integers(0, 15),
    st.booleans(),
    st.sampled_from(["off", "self", "team"]),
    st.integers(1, 100),
    st.dictionaries(st.text(max_size=5), st.one_of(st.integers(), st.booleans(), st.none(), st.text(max_size=5))),
)
def test_it_comes_back_the_same(
    name: str,
    mode: Any,
    axes: Any,
    beams: int,
    fov: float,
    speed: float,
    peers: int,
    position: bool,
    visits: Any,
    ticks: int,
    training: dict[str, Any],
) -> None:
    sent = contract(
        name=name,
        action=ActionSpec(mode=mode, speed_mps=speed, decision_ticks=ticks),
        observation=ObservationSpec(axes=axes, peers=peers, position=position, visits=visits),
        lidar=LidarContract.of(LidarSpec(beams=beams, fov=fov, start=-fov / 2)),
        training=training,
    )
    back = PolicyContract.from_json(sent.to_json(), "model.onnx")
    assert back == sent
    assert back.to_json() == sent.to_json()
    assert back.lidar.spec() == LidarSpec(beams=beams, fov=fov, start=-fov / 2)


def test_a_memory_or_a_team_makes_it_version_2_and_names_its_inputs() -> None:
    plain, remembering = contract(paradigm="dtde"), contract(state_size=64)
    team = contract(paradigm="ctce", level_shape=(5, 32, 32))
    assert [each.contract_version for each in (plain, remembering, team)] == [1, 2, 2]
    assert set(plain.inputs) == {"views", "lidar", "motion"}
    assert remembering.inputs["state"] == (64,)
    assert team.inputs["level"] == (5, 32, 32)
    for each in (plain, remembering, team):
        assert PolicyContract.from_json(each.to_json(), "model.onnx") == each


def test_equal_contracts_have_equal_texts() -> None:
    assert contract(training={"a": 1, "b": 2}).to_json() == contract(training={"b": 2, "a": 1}).to_json()


def test_the_map_settings_record_what_the_code_does() -> None:
    settings = MapSettings()
    assert (settings.cell_m, settings.tile_cells, settings.unit_log_odds) == (CELL, TILE, UNIT_LOG_ODDS)
    assert (settings.hit, settings.miss, settings.limit) == (HIT, MISS, LIMIT)


def changed(path: str, value: Any) -> str:
    data = json.loads(contract().to_json())
    target = data
    *parents, last = path.split(".")
    for part in parents:
        target = target[part]
    if value is ...:
        del target[last]
    else:
        target[last] = value
    return json.dumps(data)


@pytest.mark.parametrize(
    ("path", "value", "said"),
    [
        ("contract_version", 3, "contract_version"),
        ("state_size", 8, "version 1 knows neither a state nor ctce"),
        ("state_size", -1, "state_size"),
        ("paradigm", "ctce", "version 1 knows neither a state nor ctce"),
        ("paradigm", "cctv", "paradigm"),
        ("level_shape", [5, 32, 32], "level_shape is for the paradigm ctce"),
        ("name", "", "name"),
        ("rate_hz", 0, "rate_hz"),
        ("rate_hz", ..., "key 'rate_hz' is missing"),
        ("lidar.beams", ..., "key 'lidar.beams' is missing"),
        ("lidar.beams", "many", r"lidar\.beams"),
        ("observation.version", 9, r"observation\.version"),
        ("observation.peers", 2, r"observation: version 1 knows no peers"),
        ("observation.view_scale", 1, r"unknown key 'observation\.view_scale'; did you mean 'view_scales_m'"),
        ("action.mode", "jump", r"action\.mode"),
        ("action.decision_ticks", 0, r"action\.decision_ticks"),
        ("limits.speed_mps", -1, r"limits\.speed_mps"),
        ("map.range_cap_m", None, r"map\.range_cap_m"),
        ("rate_hz", float("nan"), "rate_hz"),
    ],
)
def test_a_contract_that_does_not_fit_is_refused_by_field(path: str, value: Any, said: str) -> None:
    with pytest.raises(InputError, match=r"^m\.onnx: contract: .*" + said):
        PolicyContract.from_json(changed(path, value), "m.onnx")


@pytest.mark.parametrize("text", ["", "{", "[]", "3", '"x"', "null", "{} {}", "[" * 100_000, "9" * 5000])
def test_what_is_no_contract_is_refused(text: str) -> None:
    with pytest.raises(InputError, match=r"m\.onnx: "):
        PolicyContract.from_json(text, "m.onnx")


@pytest.mark.parametrize("field", [("beams", 0), ("fov", 9.0), ("range_min", 20.0)])
def test_an_impossible_lidar_is_refused_when_it_is_built(field: tuple[str, Any]) -> None:
    text = changed(f"lidar.{field[0]}", field[1])
    with pytest.raises(InputError, match=field[0]):
        PolicyContract.from_json(text, "m.onnx").lidar.spec()


def test_a_contract_from_before_the_options_reads_as_without_them() -> None:
    data = json.loads(contract().to_json())
    for name in ("position", "position_extent_m", "heading", "peers", "peers_range_m", "visits", "visits_full_ticks"):
        del data["observation"][name]
    for name in ("waypoint_range_m", "waypoint_braking_mps2", "waypoint_response_s", "decision_ticks"):
        del data["action"][name]
    assert PolicyContract.from_json(json.dumps(data), "m.onnx") == contract()
