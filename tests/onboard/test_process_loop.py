"""The edge loop: virtual ports for its rules, and a real process over real sockets for its promises."""

from __future__ import annotations

import json
import select
import signal
import socket
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from flat_world import TWO_ROOMS, FlatFlight, make_runner, ray_ranges
from pymavlink.dialects.v20 import common as mavlink
from tiny_policy import make_contract, write_policy

from imagine.core.errors import InputError, WorkError
from imagine.core.lidar import LD19, Scan
from imagine.core.lidar_wire import encode_scan
from imagine.onboard.autopilot import VirtualAutopilot
from imagine.onboard.build import build_runner, mesh_sealer, square_room, warm_up
from imagine.onboard.process import Loop, ScanClock, run_drone
from imagine.onboard.report import FlightRecord, write_report
from imagine.onboard.settings import DroneSettings, LaunchPose

SETTINGS = DroneSettings(policy=None, launch=LaunchPose(x=1.5, y=1.5), lockstep=True, silence_s=0.3)


class WorldLidar:
    """A LiDAR in the flat world whose every read is one tick of it; it falls silent after `ticks`."""

    spec = LD19

    def __init__(self, vehicle: VirtualAutopilot, ticks: int) -> None:
        self.vehicle, self.left = vehicle, ticks
        self.on_read = lambda: None

    def read(self, timeout_s: float) -> Scan | None:
        self.on_read()
        if self.left <= 0:
            time.sleep(min(timeout_s, 0.01))  # as a silent sensor does
            return None
        self.left -= 1
        self.vehicle.advance(0.1)
        v = self.vehicle
        return Scan(v.now, ray_ranges(TWO_ROOMS, v.x, v.y, v.yaw))

    def close(self) -> None:
        pass


def make_loop(settings: DroneSettings, ticks: int) -> tuple[Loop, VirtualAutopilot, WorldLidar]:
    vehicle = VirtualAutopilot(settings.launch.x, settings.launch.y)
    lidar = WorldLidar(vehicle, ticks)
    return Loop(settings, make_runner(settings), lidar, vehicle, None, ScanClock()), vehicle, lidar


def test_a_whole_flight_through_the_loop_leaves_a_report(tmp_path):
    loop, vehicle, _ = make_loop(SETTINGS, ticks=600)
    loop.run(threading.Event())
    assert not vehicle.state.armed
    loop.leave_behind(tmp_path / "report.json", tmp_path / "map.npz")
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["phase"] == "done"
    assert report["reason"] == "area explored"
    assert report["setpoints"] == report["ticks"] == len(report["trajectory"])
    assert report["decided_by"]["frontier"] > 20
    assert report["decided_by"]["policy"] == 0
    assert report["distance_m"] > 2.0
    assert report["failsafes"] == []
    assert report["own_cells"] > 2000
    assert report["tick_ms"]["p50"] <= report["tick_ms"]["p99"] <= report["tick_ms"]["max"]
    with np.load(tmp_path / "map.npz") as data:
        assert np.array_equal(data["belief"], loop.runner.evidence.belief())


def test_scans_that_stay_away_end_the_process():
    loop, vehicle, _ = make_loop(SETTINGS, ticks=20)
    loop.run(threading.Event())
    assert loop.gave_up is not None
    assert "no LiDAR scan" in loop.gave_up
    assert len(vehicle.setpoints) == 20  # not one more than there were scans


def test_asked_to_end_in_the_air_it_lands_first():
    loop, vehicle, lidar = make_loop(SETTINGS, ticks=600)
    ending = threading.Event()

    def end_in_the_air() -> None:
        if vehicle.height > 0.5:
            ending.set()

    lidar.on_read = end_in_the_air
    loop.run(ending)
    assert vehicle.height == 0.0
    assert not vehicle.state.armed
    assert loop.record.reason == "the runner was asked to end"
    assert lidar.left > 0


def test_with_stay_it_runs_on_after_landing_until_it_is_asked_to_end():
    loop, vehicle, lidar = make_loop(SETTINGS.model_copy(update={"stay": True}), ticks=400)
    ending = threading.Event()
    lidar.on_read = lambda: ending.set() if lidar.left == 0 else None
    loop.run(ending)
    assert lidar.left == 0
    assert loop.gave_up is None
    assert vehicle.setpoints[-1][0] == pytest.approx(40.0)  # on the ground it keeps a lockstep twin going


def test_the_loop_ticks_the_same_flight_as_the_tests_do():
    """What flies through the loop is what `tick` alone gives: the loop decides nothing."""
    loop, vehicle, _ = make_loop(SETTINGS, ticks=120)
    loop.run(threading.Event())
    flight = FlatFlight(SETTINGS)
    flight.scan = lambda: Scan(
        flight.vehicle.now, ray_ranges(TWO_ROOMS, flight.vehicle.x, flight.vehicle.y, flight.vehicle.yaw)
    )
    for _ in range(120):
        flight.tick()
    assert vehicle.setpoints == flight.vehicle.setpoints


def test_the_scan_clock_goes_on_between_scans_and_never_back():
    wall = [10.0]
    clock = ScanClock(lambda: wall[0])
    clock.set(500.0)
    wall[0] += 0.25
    assert clock.now() == pytest.approx(500.25)
    clock.set(500.1)
    assert clock.now() == pytest.approx(500.25)
    wall[0] += 0.5
    assert clock.now() == pytest.approx(500.6)


def test_the_clock_stands_before_the_first_scan_so_that_no_stamp_is_in_its_past():
    wall = [10.0]
    clock = ScanClock(lambda: wall[0])
    wall[0] += 60.0
    assert clock.now() == 0.0
    clock.set(0.1)
    assert clock.now() == pytest.approx(0.1)


def test_a_mesh_without_a_key_is_refused():
    with pytest.raises(InputError, match="IMAGINE_MESH_KEY"):
        mesh_sealer(SETTINGS.model_copy(update={"mesh": "udpout://127.0.0.1:1"}), {}, 2e9)


def test_warming_up_leaves_the_real_drone_untouched():
    warm_up(SETTINGS, None)
    runner = build_runner(SETTINGS, None, None)
    assert not runner.evidence.belief().any()


def test_a_square_room_is_square():
    ranges = square_room(LD19, 2.0)
    assert ranges[[0, 90, 180, 270]] == pytest.approx([2.0] * 4)
    assert ranges[45] == pytest.approx(2.0 * 2**0.5, rel=1e-6)


def test_a_report_that_cannot_be_written_is_an_input_error(tmp_path):
    with pytest.raises(InputError, match="cannot be written"):
        write_report(tmp_path / "nowhere" / "report.json", {})


def test_the_report_of_a_drone_that_never_ticked_is_whole():
    report = FlightRecord(3).as_json(build_runner(SETTINGS, None, None).evidence, None)
    assert report["id"] == 3
    assert report["tick_ms"]["max"] == 0.0


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def wired(**changes) -> DroneSettings:
    urls = {"vehicle": f"udpin://127.0.0.1:{free_port()}", "lidar": f"udpin://127.0.0.1:{free_port()}"}
    return SETTINGS.model_copy(update=urls | changes)


def test_a_model_that_does_not_fit_ends_before_anything_flies(tmp_path):
    path = write_policy(tmp_path / "fast.onnx", make_contract(rate_hz=50.0))
    with pytest.raises(InputError, match="rate_hz"):
        run_drone(wired(policy=path))


@pytest.mark.parametrize("port", ["vehicle", "lidar"])
def test_a_port_in_use_ends_in_one_line(port):
    settings = wired()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as holder:
        holder.bind(("127.0.0.1", int(getattr(settings, port).rpartition(":")[2])))
        with pytest.raises(InputError, match="in use"):
            run_drone(settings)


def test_silence_ends_as_failed_work():
    with pytest.raises(WorkError, match="no LiDAR scan"):
        run_drone(wired())


def test_a_report_that_cannot_be_written_does_not_hide_what_befell_the_flight(tmp_path, caplog):
    with pytest.raises(WorkError, match="no LiDAR scan"):
        run_drone(wired(report=tmp_path / "nowhere" / "report.json"))
    assert "cannot be written" in caplog.text


RUN = """
import sys
from imagine.onboard.process import run_drone
from imagine.onboard.settings import DroneSettings
sys.exit(run_drone(DroneSettings.model_validate_json(sys.stdin.read())))
"""


@pytest.mark.timeout(120)
def test_a_real_process_answers_every_scan_and_heeds_sigterm(tmp_path):
    settings = wired(silence_s=30.0, report=tmp_path / "report.json")
    command = [sys.executable, "-c", RUN]
    with (
        subprocess.Popen(command, stdin=subprocess.PIPE, text=True) as process,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as vehicle,
    ):
        vehicle.bind(("127.0.0.1", 0))
        process.stdin.write(settings.model_dump_json())
        process.stdin.close()
        codec = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        companion, lidar = (("127.0.0.1", int(url.rpartition(":")[2])) for url in (settings.vehicle, settings.lidar))

        def next_of(kind: str, timeout_s: float):
            deadline = time.monotonic() + timeout_s
            while time.monotonic() < deadline:
                if select.select([vehicle], [], [], 0.1)[0]:
                    for message in codec.parse_buffer(vehicle.recv(2048)) or []:
                        if message.get_type() == kind:
                            return message
                else:
                    vehicle.sendto(mavlink.MAVLink_heartbeat_message(2, 12, 1, 0, 3, 3).pack(codec), companion)
            raise AssertionError(f"no {kind} came in {timeout_s} s")

        assert next_of("HEARTBEAT", 60.0).type == mavlink.MAV_TYPE_ONBOARD_CONTROLLER
        for tick in range(1, 6):
            attitude = mavlink.MAVLink_attitude_message(100 * tick, 0.0, 0.0, 1.5708, 0.0, 0.0, 0.0)
            vehicle.sendto(attitude.pack(codec), companion)
            vehicle.sendto(b"\xfd noise", companion)
            lidar_noise = b"noise"
            vehicle.sendto(lidar_noise, lidar)
            vehicle.sendto(encode_scan(Scan(0.1 * tick, square_room(LD19, 2.0)), LD19), lidar)
            assert next_of("ODOMETRY", 5.0).time_usec == 100_000 * tick
            assert next_of("SET_POSITION_TARGET_LOCAL_NED", 5.0).time_boot_ms == 100 * tick
        process.send_signal(signal.SIGTERM)
        assert process.wait(20) == 0
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["setpoints"] == 5
    assert report["dropped"]["malformed"] == 5
    assert report["dropped"]["lidar_malformed"] == 5
    assert report["dropped"]["mesh_lost"] == 0
