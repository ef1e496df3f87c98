"""`imagine fly --sim --lockstep` as a user runs it: it repeats exactly, on every protocol, and tells all."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from command_line import SHIPPED_POLICY, fly

pytestmark = pytest.mark.sitl
DRONE_KEYS = {
    "id", "distance_m", "own_cells", "scan_cells", "map_cells", "bytes_sent", "setpoints", "pose_rmse_m", "failsafes",
}  # fmt: skip
WALL_CLOCK = {"wall_s", "first_motion_s", "tick_ms"}


@pytest.fixture(scope="module")
def flights(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Any]]:
    """The same command, twice."""
    folder = tmp_path_factory.mktemp("flights")
    command = ["--level", "1", "--drones", "3", "--lockstep", "--seed", "1", "--ticks", "120"]
    return [fly(folder / f"{number}.json", *command) for number in (1, 2)]


def test_the_same_command_gives_the_same_flight_exactly(flights: list[dict[str, Any]]) -> None:
    first, second = flights
    assert first["coverage_curve"] == second["coverage_curve"]
    for a, b in zip(first["drones"], second["drones"], strict=True):
        assert {k: v for k, v in a.items() if k not in WALL_CLOCK} == {
            k: v for k, v in b.items() if k not in WALL_CLOCK
        }
    assert {k: v for k, v in first.items() if k not in WALL_CLOCK | {"drones"}} == {
        k: v for k, v in second.items() if k not in WALL_CLOCK | {"drones"}
    }


def test_the_flight_explores_without_failsafe_and_knows_where_it_is(flights: list[dict[str, Any]]) -> None:
    found = flights[0]
    assert found["ticks"] == len(found["coverage_curve"]) == 120
    assert found["coverage"] > 0.5
    assert found["coverage_curve"][-1] > found["coverage_curve"][0] + 0.1
    for drone in found["drones"]:
        assert drone["failsafes"] == []
        assert drone["error"] == ""
        assert drone["distance_m"] > 1.0
        assert drone["pose_rmse_m"] < 0.15
        assert drone["setpoints"] >= 110  # from the first tracked scan on, in every tick
        assert drone["scan_cells"] > 0  # the mesh works: it saw some through its teammates


def test_the_json_has_the_keys_that_scripts_rely_on(flights: list[dict[str, Any]]) -> None:
    found = flights[0]
    assert {"coverage", "ticks", "t90", "t95", "collisions", "wall_s", "tick_ms", "decided_by", "drones"} <= set(found)
    assert set(found["tick_ms"]) == {"p50", "p99", "max"}
    assert 0 < found["tick_ms"]["p50"] <= found["tick_ms"]["p99"] <= found["tick_ms"]["max"]
    assert set(found["decided_by"]) == {"policy", "frontier", "hold", "land"}
    assert sum(found["decided_by"].values()) > 200
    assert (found["decided_by"]["policy"] > 0) is SHIPPED_POLICY
    assert [drone["id"] for drone in found["drones"]] == [1, 2, 3]
    for drone in found["drones"]:
        assert set(drone) >= DRONE_KEYS
        assert set(drone["bytes_sent"]) == {"scan", "tile", "digest", "status"}
        assert min(drone["bytes_sent"].values()) > 0


@pytest.mark.parametrize(("protocol", "shares"), [("off", False), ("multi-hop", True)])
def test_every_protocol_flies(protocol: str, shares: bool, tmp_path: Path) -> None:
    command = ["--level", "0", "--drones", "2", "--lockstep", "--ticks", "70", "--protocol", protocol]
    found = fly(tmp_path / "out.json", *command)
    for drone in found["drones"]:
        assert drone["failsafes"] == []
        assert drone["distance_m"] > 0.3
        assert (drone["scan_cells"] > 0) is shares
        assert (drone["bytes_sent"]["scan"] > 0) is shares
        assert drone["bytes_sent"]["status"] > 0  # the ground is served either way
