"""A served twin is as its settings and its level say: people, crates, airframes, LiDARs and radios."""

from __future__ import annotations

import math
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from command_line import fly
from numpy.typing import NDArray

from imagine.core.frames import Pose
from imagine.core.lidar import LD19
from imagine.core.lidar_wire import decode_scan
from imagine.fly_sim import FlyOptions, drone_settings
from imagine.sim.drone_edge import Endpoint
from imagine.sim.level import load_level
from imagine.sim.lidar_model import LidarModel
from imagine.sim.server import SitlServer
from imagine.sim.sockets import bind_udp
from imagine.sim.twin import Twin
from imagine.sim.twin_settings import TwinSettings
from imagine.sim_command import ServeOptions, runner_command

pytestmark = pytest.mark.sitl

WALKED = """
extends: "0"
people:
  - {loop: [[1.0, 3.0], [5.0, 3.0]], speed_mps: 1.0, radius: 0.25}
crates:
  - {center: [5.4, 1.2], size: [0.6, 0.6]}
"""


@contextmanager
def served(twin: Twin) -> Iterator[tuple[SitlServer, list[socket.socket]]]:
    """Serve a twin to nobody: its drones stand on the ground, and whoever listens hears their LiDARs."""
    with SitlServer(twin, is_running=lambda _: False) as server:
        sensors = [bind_udp("127.0.0.1", int(e.lidar.rpartition(":")[2]), "LiDAR") for e in server.endpoints]
        try:
            yield server, sensors
        finally:
            for sensor in sensors:
                sensor.close()


def heard(sensor: socket.socket) -> NDArray[np.float32]:
    """Return the ranges of the newest scan that a drone's LiDAR has sent."""
    newest = b""
    while True:
        try:
            newest = sensor.recv(65535)
        except BlockingIOError:
            return decode_scan(newest, LD19).ranges


def test_the_lidar_of_a_served_drone_sees_a_person_walk_by_and_a_crate_stand(tmp_path: Path) -> None:
    path = tmp_path / "walked.yaml"
    path.write_text(WALKED)
    level = load_level(str(path))
    twin = Twin([level], 1, LD19)
    twin.set_level(0, level, [Pose(3.0, 1.2, 0.0)])
    passed_m: list[float] = []
    with served(twin) as (server, sensors):
        for _ in range(80):  # to and fro
            person_x, person_y, _ = twin.mover_discs[0, 0]
            server.tick()
            ranges = heard(sensors[0])
            bearing = math.atan2(person_y - 1.2, person_x - 3.0)
            passed_m.append(person_x - 3.0)
            near = math.hypot(person_x - 3.0, person_y - 1.2) - 0.25
            assert ranges[round(math.degrees(bearing)) % 360] == pytest.approx(near, abs=0.06)
            assert ranges[0] == pytest.approx(5.4 - 0.3 - 3.0, abs=0.06)  # the crate
    assert min(passed_m) < -1.5
    assert max(passed_m) > 1.5


def test_a_flight_in_a_level_with_people_and_crates_goes_on(tmp_path: Path) -> None:
    path = tmp_path / "walked.yaml"
    path.write_text(WALKED)
    found = fly(tmp_path / "out.json", "--level", str(path), "--drones", "2", "--lockstep", "--ticks", "90")
    assert found["coverage"] > 0.8
    assert all(drone["failsafes"] == [] for drone in found["drones"])


def test_a_file_and_single_settings_change_the_twin_that_is_flown_in(tmp_path: Path) -> None:
    twin = tmp_path / "twin.yaml"
    twin.write_text("dynamics: {acceleration_mps2: 0.1}\n")
    flight = ["--level", "0", "--drones", "2", "--lockstep", "--ticks", "70"]
    changed = fly(tmp_path / "a.json", *flight, "--twin", str(twin), "--set", "radio.range_m=0.1")
    usual = fly(tmp_path / "b.json", *flight)
    for slow, quick in zip(changed["drones"], usual["drones"], strict=True):
        assert slow["distance_m"] < 0.5 * quick["distance_m"]
        assert slow["scan_cells"] == 0 < quick["scan_cells"]


def test_drones_of_a_twin_with_skewed_scans_undo_the_skew() -> None:
    skewed = TwinSettings(sensing=LidarModel(skew=True))
    poses = [Pose(1.0, 1.0, 0.0)]
    assert drone_settings(FlyOptions(twin=skewed), poses)[0].odometry.deskew
    assert not drone_settings(FlyOptions(), poses)[0].odometry.deskew
    endpoint = Endpoint(1, "udpin://127.0.0.1:1", "udpin://127.0.0.1:2", None)
    assert "odometry.deskew=true" in runner_command(endpoint, poses[0], ServeOptions(twin=skewed)).split()
    assert "odometry" not in runner_command(endpoint, poses[0], ServeOptions())


def test_skewed_scans_are_tracked_and_mapped(tmp_path: Path) -> None:
    flight = ["--level", "1", "--drones", "2", "--lockstep", "--ticks", "120", "--set", "sensing.skew=true"]
    found = fly(tmp_path / "out.json", *flight)
    assert found["coverage"] > 0.5
    for drone in found["drones"]:
        assert drone["failsafes"] == []
        assert drone["pose_rmse_m"] < 0.1
