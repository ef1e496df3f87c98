"""The MAVLink link over real UDP on the loopback: what is sent arrives as meant, what is damaged is counted."""

from __future__ import annotations

import dataclasses
import math
import select
import socket

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as mavlink

from imagine.core.errors import InputError
from imagine.core.frames import Pose
from imagine.onboard.mavlink import MavlinkAutopilot
from imagine.onboard.records import FlightMode, OdometryOut, Setpoint, VehicleCommand

SYSTEM = 7
PX4_OFFBOARD, PX4_LAND, PX4_LOITER = 6 << 16, (4 << 16) | (6 << 24), (4 << 16) | (3 << 24)


class Vehicle:
    """The other end: a socket and pymavlink, as system 7."""

    def __init__(self, link: MavlinkAutopilot, component: int = 1, system: int = SYSTEM) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.address = ("127.0.0.1", link.port)
        self.codec = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)

    def send(self, *messages) -> None:
        for message in messages:
            self.socket.sendto(message.pack(self.codec), self.address)

    def heartbeat(self, custom_mode: int = PX4_LOITER, armed: bool = False, autopilot: int = 12) -> None:
        base = 1 | (mavlink.MAV_MODE_FLAG_SAFETY_ARMED if armed else 0)
        self.send(mavlink.MAVLink_heartbeat_message(2, autopilot, base, custom_mode, 3, 3))

    def attitude(self, time_s: float = 1.0, yaw: float = 0.0, yaw_speed: float = 0.0) -> None:
        self.send(mavlink.MAVLink_attitude_message(round(1000 * time_s), 0.0, 0.0, yaw, 0.0, 0.0, yaw_speed))

    def receive(self):
        """The next message, within a second."""
        ready, _, _ = select.select([self.socket], [], [], 1.0)
        assert ready, "nothing came"
        (message,) = self.codec.parse_buffer(self.socket.recv(2048))
        return message


@pytest.fixture
def link():
    opened = MavlinkAutopilot(free_url(), SYSTEM)
    yield opened
    opened.close()


def free_url() -> str:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return f"udpin://127.0.0.1:{probe.getsockname()[1]}"


@pytest.fixture
def vehicle(link):
    other = Vehicle(link)
    yield other
    other.socket.close()


@pytest.fixture
def met(link, vehicle):
    """Both ends, once they know each other."""
    vehicle.heartbeat()
    vehicle.attitude()
    assert link.wait_telemetry(1.0, 1.0) is not None
    return link, vehicle


def test_nothing_is_known_before_heartbeat_and_attitude(link, vehicle):
    assert link.telemetry() is None
    vehicle.heartbeat()
    assert link.wait_telemetry(0.0, 0.05) is None
    vehicle.attitude(1.0)
    assert link.wait_telemetry(1.0, 1.0) is not None


@pytest.mark.parametrize(
    ("ned_yaw", "map_yaw"), [(0.0, math.pi / 2), (math.pi / 2, 0.0), (math.pi, -math.pi / 2), (-math.pi / 2, math.pi)]
)
def test_headings_arrive_in_the_map_frame(met, ned_yaw, map_yaw):
    link, vehicle = met
    vehicle.attitude(2.0, ned_yaw, yaw_speed=0.5)
    telemetry = link.wait_telemetry(2.0, 1.0)
    assert math.cos(telemetry.yaw - map_yaw) == pytest.approx(1.0)
    assert telemetry.yaw_rate == pytest.approx(-0.5)
    assert telemetry.stamp == 2.0


@pytest.mark.parametrize(
    ("custom_mode", "mode"),
    [
        (PX4_OFFBOARD, FlightMode.OFFBOARD),
        (PX4_LAND, FlightMode.LAND),
        (PX4_LOITER, FlightMode.HOLD),
        (3 << 16, FlightMode.POSITION),
        (1 << 16, FlightMode.MANUAL),
        (4 << 16 | 5 << 24, FlightMode.OTHER),
        (0xFFFFFFFF, FlightMode.OTHER),
    ],
)
def test_px4_modes_are_read(met, custom_mode, mode):
    link, vehicle = met
    vehicle.heartbeat(custom_mode, armed=True)
    vehicle.attitude(2.0)
    telemetry = link.wait_telemetry(2.0, 1.0)
    assert telemetry.mode is mode
    assert telemetry.armed


def test_the_modes_of_an_unknown_autopilot_are_not_guessed(met):
    link, vehicle = met
    vehicle.heartbeat(PX4_OFFBOARD, autopilot=3)
    vehicle.attitude(2.0)
    assert link.wait_telemetry(2.0, 1.0).mode is FlightMode.OTHER


def test_height_is_counted_from_where_it_was_armed_until_a_rangefinder_is_heard(met):
    link, vehicle = met
    local = mavlink.MAVLink_local_position_ned_message
    vehicle.send(local(1100, 0.0, 0.0, -3.0, 0.0, 0.0, 0.0))  # 3 m by its own zero, on the ground
    vehicle.heartbeat(PX4_OFFBOARD, armed=True)
    vehicle.send(local(1500, 0.0, 0.0, -4.0, 0.0, 0.0, -0.25))
    vehicle.attitude(1.5)
    telemetry = link.wait_telemetry(1.5, 1.0)
    assert telemetry.height_m == pytest.approx(1.0)
    assert telemetry.climb_mps == pytest.approx(0.25)
    assert telemetry.position_ok
    vehicle.send(mavlink.MAVLink_distance_sensor_message(1900, 2, 800, 130, 0, 0, 25, 1))
    vehicle.attitude(2.0)
    assert link.wait_telemetry(2.0, 1.0).height_m == pytest.approx(1.3)


def downward(time_ms, centimetres, **quality):
    return mavlink.MAVLink_distance_sensor_message(time_ms, 20, 800, centimetres, 0, 0, 25, 1, **quality)


def test_what_a_rangefinder_cannot_measure_is_no_height(met):
    link, vehicle = met
    vehicle.send(downward(1900, 130), downward(1950, 19), downward(1950, 801), downward(1950, 50, signal_quality=1))
    vehicle.attitude(2.0)
    assert link.wait_telemetry(2.0, 1.0).height_m == pytest.approx(1.3)


def test_a_rangefinder_that_falls_silent_in_flight_leaves_its_last_height_to_age(met):
    link, vehicle = met
    vehicle.heartbeat(PX4_OFFBOARD, armed=True)
    vehicle.send(downward(1900, 130))
    vehicle.attitude(2.0)
    heard = link.wait_telemetry(2.0, 1.0)
    assert (heard.ranged, heard.height_age_s) == (True, pytest.approx(0.1))
    vehicle.heartbeat(PX4_OFFBOARD, armed=True)
    vehicle.send(mavlink.MAVLink_local_position_ned_message(3900, 0.0, 0.0, -4.0, 0.0, 0.0, 0.0))
    vehicle.attitude(4.0)
    silent = link.wait_telemetry(4.0, 1.0)
    assert (silent.ranged, silent.height_age_s) == (False, pytest.approx(2.1))
    assert silent.height_m == pytest.approx(1.3)


def test_a_rangefinder_too_near_the_ground_to_see_it_does_not_forbid_taking_off(met):
    link, vehicle = met
    vehicle.send(downward(1000, 130))
    vehicle.attitude(3.0)
    vehicle.heartbeat()
    vehicle.heartbeat(PX4_OFFBOARD, armed=True)
    vehicle.attitude(3.1)
    told = link.wait_telemetry(3.1, 1.0)
    assert (told.ranged, told.height_age_s, told.height_m) == (False, 0.0, 0.0)


def test_without_heartbeats_the_telemetry_grows_old(met):
    link, vehicle = met
    vehicle.attitude(3.4)
    assert link.wait_telemetry(3.4, 1.0).stamp == 3.4
    vehicle.attitude(6.0)
    assert link.wait_telemetry(6.0, 1.0).stamp == 3.5
    vehicle.heartbeat()
    vehicle.attitude(6.1)
    assert link.wait_telemetry(6.1, 1.0).stamp == 6.1


def test_another_address_is_not_obeyed_while_the_vehicle_speaks(met):
    link, vehicle = met
    impostor = Vehicle(link)
    impostor.attitude(50.0)
    impostor.socket.close()
    vehicle.attitude(2.0)
    assert link.wait_telemetry(2.0, 1.0).stamp == 2.0
    assert link.dropped["foreign"] == 1
    link.send_setpoint(Setpoint(), stamp=1.0)
    assert vehicle.receive().get_type() == "SET_POSITION_TARGET_LOCAL_NED"


def test_what_the_network_or_the_wire_cannot_take_is_counted(met):
    link, vehicle = met
    good = OdometryOut(1.0, Pose(0.0, 0.0, 0.0), 1.0, (0.0, 0.0, 0.0), 0.0, 0.01, 0.01, 0.01, 0.01, 0)
    link.send_odometry(dataclasses.replace(good, yaw_variance=math.nan))
    link.send_odometry(dataclasses.replace(good, stamp=-1.0))
    link.send_odometry(dataclasses.replace(good, stamp=math.inf))
    link.send_setpoint(Setpoint(vx=1e300), stamp=1.0)
    link._peer = ("255.255.255.255", 9)  # a broadcast without leave: the system refuses it
    link.send_setpoint(Setpoint(), stamp=1.0)
    assert link.dropped["unsent"] == 5
    assert not select.select([vehicle.socket], [], [], 0.0)[0]


def test_a_position_that_is_no_longer_sent_is_no_longer_ok(met):
    link, vehicle = met
    vehicle.send(mavlink.MAVLink_local_position_ned_message(1100, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    vehicle.attitude(5.0)
    assert not link.wait_telemetry(5.0, 1.0).position_ok


def test_battery_and_ground_contact_are_read(met):
    link, vehicle = met
    vehicle.send(
        mavlink.MAVLink_sys_status_message(0, 0, 0, 0, 3900, 100, 64, 0, 0, 0, 0, 0, 0),
        mavlink.MAVLink_extended_sys_state_message(0, mavlink.MAV_LANDED_STATE_IN_AIR),
    )
    vehicle.attitude(2.0)
    telemetry = link.wait_telemetry(2.0, 1.0)
    assert telemetry.battery == pytest.approx(0.64)
    assert not telemetry.landed


def test_texts_are_joined_and_told_once(met):
    link, vehicle = met
    text = "Arming denied: no position estimate, and the pilot should know why that is so"
    chunks = [text[:50], text[50:]]
    vehicle.send(mavlink.MAVLink_statustext_message(2, b"short"))
    for number, chunk in enumerate(chunks):
        vehicle.send(mavlink.MAVLink_statustext_message(2, chunk.encode(), 9, number))
    vehicle.attitude(2.0)
    assert link.wait_telemetry(2.0, 1.0).texts == ("short", text)
    assert link.telemetry().texts == ()


@pytest.mark.parametrize(
    ("command", "number", "params"),
    [
        (VehicleCommand.OFFBOARD, mavlink.MAV_CMD_DO_SET_MODE, (1.0, 6.0)),
        (VehicleCommand.ARM, mavlink.MAV_CMD_COMPONENT_ARM_DISARM, (1.0, 0.0)),
        (VehicleCommand.DISARM, mavlink.MAV_CMD_COMPONENT_ARM_DISARM, (0.0, 0.0)),
    ],
)
def test_a_command_goes_out_and_its_answer_comes_back(met, command, number, params):
    link, vehicle = met
    link.send_command(command)
    sent = vehicle.receive()
    assert (sent.command, sent.target_system, sent.target_component, sent.confirmation) == (number, SYSTEM, 1, 0)
    assert (sent.param1, sent.param2) == params
    assert (sent.get_srcSystem(), sent.get_srcComponent()) == (SYSTEM, 191)
    vehicle.send(mavlink.MAVLink_command_ack_message(number, mavlink.MAV_RESULT_TEMPORARILY_REJECTED))
    vehicle.attitude(2.0)
    (ack,) = link.wait_telemetry(2.0, 1.0).acks
    assert (ack.command, ack.accepted, ack.result) == (command, False, "TEMPORARILY_REJECTED")


def test_a_repeated_command_counts_its_confirmations(met):
    link, vehicle = met
    for expected in range(3):
        link.send_command(VehicleCommand.LAND)
        sent = vehicle.receive()
        assert (sent.command, sent.confirmation) == (mavlink.MAV_CMD_NAV_LAND, expected)


def test_a_setpoint_is_body_frame_velocity_and_yaw_rate(met):
    link, vehicle = met
    link.send_setpoint(Setpoint(vx=0.5, vy=0.25, vz=0.125, yaw_rate=1.0), stamp=12.3)
    sent = vehicle.receive()
    assert (sent.coordinate_frame, sent.type_mask, sent.time_boot_ms) == (8, 0x5C7, 12300)
    assert (sent.vx, sent.vy, sent.vz, sent.yaw_rate) == (0.5, -0.25, -0.125, -1.0)


def test_what_is_not_finite_is_never_sent(met):
    link, vehicle = met
    link.send_setpoint(Setpoint(vx=math.nan), stamp=1.0)
    link.send_setpoint(Setpoint(vx=0.5), stamp=2.0)
    assert vehicle.receive().time_boot_ms == 2000
    assert link.dropped["unsent"] == 1


def test_odometry_is_local_frd_with_finite_variances(met):
    link, vehicle = met
    link.send_odometry(
        OdometryOut(
            stamp=3.2,
            pose=Pose(2.0, 5.0, math.pi / 2),
            height_m=1.0,
            velocity=(0.5, 0.25, 0.0),
            yaw_rate=0.5,
            position_variance=0.01,
            height_variance=100.0,
            yaw_variance=0.02,
            velocity_variance=0.03,
            reset_counter=257,
        )
    )
    sent = vehicle.receive()
    assert (sent.frame_id, sent.child_frame_id, sent.time_usec) == (20, 12, 3_200_000)
    assert (sent.x, sent.y, sent.z) == (5.0, 2.0, -1.0)  # north, east, down
    assert sent.q == pytest.approx([1.0, 0.0, 0.0, 0.0])  # facing north
    assert (sent.vx, sent.vy, sent.yawspeed) == (0.5, -0.25, -0.5)
    assert [sent.pose_covariance[i] for i in (0, 6, 11, 20)] == pytest.approx([0.01, 0.01, 100.0, 0.02])
    assert all(map(math.isfinite, [*sent.pose_covariance, *sent.velocity_covariance]))
    assert sent.reset_counter == 1


def test_it_says_that_it_is_alive_once_a_second(met):
    link, vehicle = met
    link.beat()
    link.beat()
    beat = vehicle.receive()
    assert (beat.get_type(), beat.type, beat.autopilot) == ("HEARTBEAT", mavlink.MAV_TYPE_ONBOARD_CONTROLLER, 8)
    link.send_setpoint(Setpoint(), stamp=1.0)
    assert vehicle.receive().get_type() == "SET_POSITION_TARGET_LOCAL_NED"


@pytest.mark.parametrize(
    "damage",
    [
        lambda good: b"",
        lambda good: b"\xfd",
        lambda good: good[:-3],
        lambda good: good[:-1] + bytes([good[-1] ^ 1]),
        lambda good: b"hello" + good,
        lambda good: good[:2] + b"\xff" + good[3:],
    ],
)
def test_a_damaged_datagram_does_not_touch_the_next(met, damage):
    link, vehicle = met
    message = mavlink.MAVLink_attitude_message(9000, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
    damaged = damage(message.pack(vehicle.codec))
    vehicle.socket.sendto(damaged, vehicle.address)
    vehicle.attitude(2.0)
    telemetry = link.wait_telemetry(2.0, 1.0)
    assert telemetry.stamp == 2.0
    assert link.dropped["malformed"] == (1 if damaged else 0)


@given(noise=st.binary(max_size=300))
def test_no_bytes_whatever_raise(noise):
    with_noise = MavlinkAutopilot(free_url(), SYSTEM)
    try:
        for message in with_noise._messages(noise):
            with_noise._assembler.feed(message)
    finally:
        with_noise.close()


def test_other_systems_and_components_are_not_obeyed(met):
    link, vehicle = met
    stranger, camera = Vehicle(link, system=8), Vehicle(link, component=100)
    for other in (stranger, camera):
        other.attitude(50.0)
        other.socket.close()
    vehicle.attitude(2.0)
    assert link.wait_telemetry(2.0, 1.0).stamp == 2.0
    assert link.dropped["foreign"] == 2


def test_an_attitude_that_is_not_finite_is_left_out(met):
    link, vehicle = met
    vehicle.attitude(5.0, math.nan)
    assert link.wait_telemetry(5.0, 0.05) is None


def test_with_a_clock_telemetry_is_stamped_on_arrival():
    link = MavlinkAutopilot(free_url(), SYSTEM, clock=lambda: 123.0)
    vehicle = Vehicle(link)
    vehicle.heartbeat()
    vehicle.attitude(1.0)
    assert link.wait_telemetry(1.0, 1.0).stamp == 123.0
    link.close()
    vehicle.socket.close()


def test_a_port_in_use_is_an_input_error(link):
    with pytest.raises(InputError, match="in use"):
        MavlinkAutopilot(f"udpin://127.0.0.1:{link.port}", SYSTEM)


@pytest.mark.parametrize("url", ["tcp://127.0.0.1:1", "udpin://127.0.0.1", "udpin://:99999", "serial", "udpout://x:0"])
def test_a_wrong_url_is_an_input_error(url):
    with pytest.raises(InputError, match=url):
        MavlinkAutopilot(url, SYSTEM)


def test_udpout_speaks_first():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind(("127.0.0.1", 0))
        link = MavlinkAutopilot(f"udpout://127.0.0.1:{listener.getsockname()[1]}", SYSTEM)
        link.beat()
        ready, _, _ = select.select([listener], [], [], 1.0)
        link.close()
        assert ready
