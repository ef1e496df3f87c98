"""MAVSDK, the most used companion library, against a served vehicle in real time."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as mavlink

from imagine.core.lidar import LidarSpec
from imagine.core.ned import swap_enu_ned, swap_yaw
from imagine.sim.flight_control import Mode
from imagine.sim.level import load_level
from imagine.sim.server import SitlServer, SitlSettings, TickRecord
from imagine.sim.sockets import bind_udp
from imagine.sim.twin import Twin

mavsdk = pytest.importorskip("mavsdk", reason="MAVSDK is not installed")

pytestmark = [pytest.mark.sitl, pytest.mark.timeout(90)]


class ServedVehicle:
    """A twin of one drone on a thread of its own, and external odometry from the truth, as a runner would send it."""

    def __init__(self) -> None:
        twin = Twin([load_level("0")], 1, LidarSpec(beams=36))
        self.server = SitlServer(twin, SitlSettings(lockstep=False, mesh=False), seed=1)
        self.record: TickRecord | None = None
        self.error: BaseException | None = None
        self._odometry = bind_udp("127.0.0.1", 0, "odometry")
        self._codec = mavlink.MAVLink(None, srcSystem=1, srcComponent=mavlink.MAV_COMP_ID_ONBOARD_COMPUTER)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        try:
            while not self._stop.is_set():
                self._send_odometry()
                self.record = self.server.tick()
        except Exception as error:
            self.error = error

    def _send_odometry(self) -> None:
        x, y, yaw = self.server.twin.poses[0, 0]
        north, east, down = swap_enu_ned(x, y, 0.0)
        half = swap_yaw(yaw) / 2.0
        variances = [0.01] + [0.0] * 20
        message = mavlink.MAVLink_odometry_message(
            0, mavlink.MAV_FRAME_LOCAL_FRD, mavlink.MAV_FRAME_BODY_FRD, north, east, down,
            [math.cos(half), 0.0, 0.0, math.sin(half)], 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, variances, variances,
        )  # fmt: skip
        self._odometry.sendto(message.pack(self._codec), ("127.0.0.1", self.server.edges[0].link.port))

    def close(self) -> None:
        self._stop.set()
        self._thread.join(timeout=5.0)
        self.server.close()
        self._odometry.close()
        assert self.error is None, self.error

    def until(self, condition: Callable[[TickRecord], bool], timeout_s: float) -> TickRecord:
        """Return the first record that satisfies the condition."""
        deadline = time.monotonic() + timeout_s
        while time.monotonic() < deadline and self.error is None:
            record = self.record
            if record is not None and condition(record):
                return record
            time.sleep(0.02)
        pytest.fail(f"not reached within {timeout_s} s: {self.error or self.record}")


@pytest.fixture
def served() -> Iterator[ServedVehicle]:
    vehicle = ServedVehicle()
    yield vehicle
    vehicle.close()


def poll(read: Callable[[], bool], timeout_s: float, what: str) -> None:
    deadline = time.monotonic() + timeout_s
    while not read():
        if time.monotonic() > deadline:
            pytest.fail(f"{what}: not within {timeout_s} s")
        time.sleep(0.05)


def test_mavsdk_connects_arms_takes_off_flies_offboard_and_lands(served: ServedVehicle) -> None:
    from mavsdk.component_type import ComponentType
    from mavsdk.mavsdk import Configuration, Mavsdk
    from mavsdk.plugins.action import Action, ActionResult
    from mavsdk.plugins.offboard import Offboard, OffboardResult, VelocityBodyYawspeed
    from mavsdk.plugins.telemetry import Telemetry

    url = served.server.endpoints[0].vehicle
    configuration = Configuration.create_with_component_type(ComponentType.COMPANION_COMPUTER)
    with Mavsdk(configuration) as sdk:
        sdk.add_any_connection(url)
        system = sdk.first_autopilot(timeout_s=10.0)
        assert system is not None, "MAVSDK found no autopilot"
        telemetry, action, offboard = Telemetry(system), Action(system), Offboard(system)

        poll(lambda: telemetry.health().is_local_position_ok, 5.0, "local position health")
        x, y, yaw = served.until(lambda r: r.time_s > 0.0, 1.0).poses[0]
        north, east, _ = swap_enu_ned(x, y, 0.0)
        poll(lambda: abs(telemetry.position_velocity_ned().position.north_m - north) < 0.05, 3.0, "position")
        assert telemetry.position_velocity_ned().position.east_m == pytest.approx(east, abs=0.05)
        assert math.radians(telemetry.attitude_euler().yaw_deg) == pytest.approx(swap_yaw(yaw), abs=0.1)
        poll(lambda: telemetry.battery().remaining_percent > 90.0, 3.0, "battery")

        assert action.set_takeoff_altitude(0.8) == ActionResult.SUCCESS
        assert action.arm() == ActionResult.SUCCESS
        poll(telemetry.armed, 3.0, "armed")
        assert action.takeoff() == ActionResult.SUCCESS
        served.until(lambda r: r.vehicles[0].height_m > 0.7, 6.0)
        poll(telemetry.in_air, 3.0, "in the air")

        offboard.set_velocity_body(VelocityBodyYawspeed(0.0, 0.0, 0.0, 0.0))
        start = served.until(lambda r: r.vehicles[0].mode is Mode.HOLD, 5.0).poses[0]

        def enter() -> bool:
            assert offboard.start() == OffboardResult.SUCCESS
            record = served.record
            return record is not None and record.vehicles[0].mode is Mode.OFFBOARD

        poll(enter, 6.0, "OFFBOARD entered, once the stream has run for a second")
        offboard.set_velocity_body(VelocityBodyYawspeed(0.3, 0.0, 0.0, 0.0))

        def flown(record: TickRecord) -> float:
            return float(np.hypot(*(record.poses[0, :2] - start[:2])))

        moved = served.until(lambda r: flown(r) > 0.4, 5.0)
        ahead = np.arctan2(*(moved.poses[0, :2] - start[:2])[::-1])
        assert ahead == pytest.approx(start[2], abs=0.15)

        assert action.land() == ActionResult.SUCCESS
        down = served.until(lambda r: not r.vehicles[0].armed, 8.0)
        assert down.vehicles[0].height_m == 0.0
        assert not down.vehicles[0].failsafes
        poll(lambda: not telemetry.armed(), 3.0, "disarmed")
