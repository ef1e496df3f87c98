"""The served twin with runners in threads: lockstep repeats exactly, lost runners are left behind, ports are named."""

from __future__ import annotations

import math
import select
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as mavlink

from imagine.core.errors import InputError, WorkError
from imagine.core.lidar import LidarSpec, Scan
from imagine.core.lidar_wire import decode_scan
from imagine.core.ned import swap_enu_ned, swap_flu_frd, swap_yaw
from imagine.mesh_comm.markers import decode_marker, encode_marker
from imagine.mesh_comm.udp_modem import HELLO
from imagine.sim.drone_edge import Endpoint
from imagine.sim.flight_control import STREAM_LOST, Mode
from imagine.sim.level import load_level
from imagine.sim.server import SitlServer, SitlSettings, TickRecord
from imagine.sim.sockets import bind_udp, free_listen_port
from imagine.sim.twin import Twin

pytestmark = [pytest.mark.sitl, pytest.mark.timeout(60)]

LIDAR = LidarSpec(beams=36)


def address(url: str) -> tuple[str, int]:
    host, port = url.split("//")[1].split(":")
    return host, int(port)


class TrivialRunner(threading.Thread):
    """Takes off, turns away from what is near, and tells its peers what it heard; it knows its true pose."""

    def __init__(self, endpoint: Endpoint, twin: Twin) -> None:
        super().__init__(daemon=True)
        self.drone = endpoint.drone
        self.heard: list[bytes] = []
        self.stop = threading.Event()
        self.texts: list[str] = []
        self._twin = twin
        self._vehicle = bind_udp(*address(endpoint.vehicle), "vehicle")
        self._lidar = bind_udp(*address(endpoint.lidar), "lidar")
        self._mesh = bind_udp("127.0.0.1", 0, "mesh")
        self._modem = address(endpoint.mesh or "")
        self._codec = mavlink.MAVLink(None, srcSystem=self.drone, srcComponent=191)
        self._peer: tuple[str, int] | None = None
        self._attitude_ms = self._ticks = 0
        self._marker = -math.inf
        self._custom_mode = 0

    def run(self) -> None:
        self._mesh.sendto(HELLO, self._modem)
        scan: Scan | None = None
        while not self.stop.is_set():
            select.select([self._vehicle, self._lidar, self._mesh], [], [], 0.1)
            for datagram in self._read(self._vehicle):
                self._hear_vehicle(datagram)
            for datagram in self._read(self._mesh):
                marker = decode_marker(datagram)
                if marker is not None:
                    self._marker = marker
                elif datagram != HELLO:
                    self.heard.append(datagram)
            for datagram in self._read(self._lidar):
                scan = decode_scan(datagram, LIDAR)
            if scan is not None and self._attitude_ms >= 1000 * scan.stamp and self._marker >= scan.stamp:
                self._answer(scan)
                scan = None
        for link in (self._vehicle, self._lidar, self._mesh):
            link.close()

    def _read(self, link: socket.socket) -> Iterator[bytes]:
        while True:
            try:
                datagram, source = link.recvfrom(65535)
            except BlockingIOError:
                return
            if link is self._vehicle and self._peer is None:
                self._peer = source
                self._send(mavlink.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3))
            yield datagram

    def _hear_vehicle(self, datagram: bytes) -> None:
        message = self._codec.decode(bytearray(datagram))
        if message.get_type() == "ATTITUDE":
            self._attitude_ms = message.time_boot_ms
        elif message.get_type() == "HEARTBEAT":
            self._custom_mode = message.custom_mode
        elif message.get_type() == "STATUSTEXT":
            self.texts.append(message.text)

    def _answer(self, scan: Scan) -> None:
        self._ticks += 1
        x, y, yaw = self._twin.poses[0, self.drone - 1]  # the twin waits meanwhile
        north, east, _ = swap_enu_ned(x, y, 0.0)
        half = swap_yaw(yaw) / 2.0
        variances = [0.01] * 21
        self._send(
            mavlink.MAVLink_odometry_message(
                0, 20, 12, north, east, 0.0, [math.cos(half), 0.0, 0.0, math.sin(half)],
                0, 0, 0, 0, 0, 0, variances, variances,
            )
        )  # fmt: skip
        if self._ticks == 12:
            self._command(mavlink.MAV_CMD_DO_SET_MODE, 1, 6)
        if self._ticks == 13:
            self._command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1)
        self._mesh.sendto(b"%d heard %d at %d" % (self.drone, len(self.heard), self._ticks), self._modem)
        self._mesh.sendto(encode_marker(scan.stamp), self._modem)
        ahead = float(np.min(scan.ranges[[-2, -1, 0, 1, 2]]))
        forward, turn = (0.5, 0.3) if ahead > 0.8 else (0.0, 1.5)
        vx, vy, vz = swap_flu_frd(forward, 0.0, 0.5 if self._ticks < 35 else 0.0)
        self._send(
            mavlink.MAVLink_set_position_target_local_ned_message(
                round(1000 * scan.stamp), self.drone, 1, 8, 0x5C7,
                0, 0, 0, vx, vy, vz, 0, 0, 0, 0, swap_flu_frd(0, 0, turn)[2],
            )
        )  # fmt: skip

    def _command(self, command: int, *params: float) -> None:
        padded = [*params, *[0.0] * (7 - len(params))]
        self._send(mavlink.MAVLink_command_long_message(self.drone, 1, command, 0, *padded))

    def _send(self, message: Any) -> None:
        assert self._peer is not None
        self._vehicle.sendto(message.pack(self._codec), self._peer)


@contextmanager
def flight(drones: int, watched: bool = False, **settings: Any) -> Iterator[tuple[SitlServer, list[TrivialRunner]]]:
    twin = Twin([load_level("1")], drones, LIDAR, seed=2)
    runners: list[TrivialRunner] = []

    def is_running(drone: int) -> bool:
        return runners[drone - 1].is_alive()

    server = SitlServer(twin, SitlSettings.model_validate(settings), seed=2, is_running=is_running if watched else None)
    runners += [TrivialRunner(endpoint, twin) for endpoint in server.endpoints]
    try:
        for runner in runners:
            runner.start()
        server.wait_connected(5.0)
        yield server, runners
    finally:
        for runner in runners:
            runner.stop.set()
        for runner in runners:
            runner.join(timeout=5.0)
        server.close()


def fly(ticks: int) -> tuple[list[TickRecord], list[list[bytes]]]:
    with flight(2, radio={"loss": 0.2}) as (server, runners):
        records = [server.tick() for _ in range(ticks)]
        return records, [runner.heard for runner in runners]


def test_two_lockstep_flights_are_the_same_to_the_last_bit() -> None:
    first, first_heard = fly(120)
    second, second_heard = fly(120)
    assert first[-1].vehicles[0].height_m > 0.5
    travelled = np.linalg.norm(first[-1].poses[:, :2] - first[0].poses[:, :2], axis=1)
    assert (travelled > 0.5).all()
    for a, b in zip(first, second, strict=True):
        assert np.array_equal(a.poses, b.poses)
        assert (a.vehicles, a.links, a.sent, a.ground_inbox) == (b.vehicles, b.links, b.sent, b.ground_inbox)
    assert first_heard == second_heard
    assert 60 < len(first_heard[0]) < 120  # a fifth was lost
    assert not first[-1].silent


def test_a_runner_that_stops_is_left_behind_its_vehicle_lands_and_the_others_fly_on() -> None:
    with flight(2, reply_timeout_s=0.5) as (server, runners):
        for _ in range(40):
            record = server.tick()
        assert [v.mode for v in record.vehicles] == [Mode.OFFBOARD, Mode.OFFBOARD]
        runners[1].stop.set()
        runners[1].join(timeout=5.0)
        lost_at = server.now
        before = record.poses[0]
        for _ in range(60):
            record = server.tick()
        assert record.silent == (2,)
        failed = record.vehicles[1].failsafes
        assert [f.reason for f in failed] == [STREAM_LOST]
        assert failed[0].time_s - lost_at <= 1.5
        assert not record.vehicles[1].armed
        assert record.vehicles[0].mode is Mode.OFFBOARD
        assert np.linalg.norm(record.poses[0, :2] - before[:2]) > 0.1


def test_a_runner_known_to_have_ended_is_not_waited_for() -> None:
    with flight(1, watched=True, reply_timeout_s=30.0) as (server, runners):
        server.tick()
        runners[0].stop.set()
        runners[0].join(timeout=5.0)
        started = time.monotonic()
        assert server.tick().silent == (1,)
        assert time.monotonic() - started < 1.0


def test_missing_runners_are_named() -> None:
    twin = Twin([load_level("0")], 2, LIDAR)
    with (
        SitlServer(twin, SitlSettings()) as server,
        pytest.raises(WorkError, match=r"drone 1, 2 did not connect within 0.2 s"),
    ):
        server.wait_connected(0.2)


def test_a_port_in_use_is_named_with_the_remedy() -> None:
    twin = Twin([load_level("0")], 1, LIDAR)
    with bind_udp("127.0.0.1", 0, "other") as other:
        port = other.getsockname()[1]
        base = port - 2001  # the modem of drone 1
        with pytest.raises(InputError, match=rf"modem of drone 1: UDP port {port} .*in use: .*other ports"):
            SitlServer(twin, SitlSettings(port_base=base))


def test_fixed_ports_lie_as_px4s_do() -> None:
    twin = Twin([load_level("0")], 1, LIDAR)
    base = free_listen_port("127.0.0.1")  # 14540 may be taken here
    with SitlServer(twin, SitlSettings(port_base=base, ground_modem=True)) as server:
        here = "127.0.0.1"
        assert server.endpoints == [
            Endpoint(1, f"udpin://{here}:{base + 1}", f"udpin://{here}:{base + 1001}", f"udpout://{here}:{base + 2001}")
        ]
        assert server.edges[0].link.port == base + 41
        assert server.ground_endpoint == f"udpout://{here}:{base + 2000}"


def test_real_time_keeps_its_speed_and_hears_the_ground() -> None:
    with flight(1, lockstep=False, speed=5.0) as (server, runners):
        started = time.monotonic()
        links: set[tuple[int, int]] = set()
        for tick in range(40):
            server.send_from_ground(b"tick %d" % tick)
            record = server.tick()
            links.update(record.links)
        elapsed = time.monotonic() - started
        assert 0.75 < elapsed < 3.0  # 40 ticks of a fiftieth of a second; the upper bound is for a busy machine
        assert record.vehicles[0].mode is Mode.OFFBOARD
        assert b"tick 10" in runners[0].heard
        assert links == {(0, 1), (1, 0)}
