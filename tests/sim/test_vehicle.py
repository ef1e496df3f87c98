"""The PX4-like vehicle: what it accepts, when it flies, and when it takes over by itself."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as mavlink

from imagine.core.ned import swap_enu_ned, swap_flu_frd, swap_yaw
from imagine.sim.flight_control import ODOMETRY_LOST, STREAM_LOST, Mode, VehicleSettings
from imagine.sim.vehicle import Vehicle

DT = 0.1
GCS, COMPANION = 255, 1
BODY_VELOCITY = 0x5C7
NED_VELOCITY_AND_YAW = 0x9C7


class Rig:
    """A vehicle with a clock and a perfect companion that feeds it each tick."""

    def __init__(self, **overrides: Any) -> None:
        self.vehicle = Vehicle(3, VehicleSettings(**overrides), np.random.default_rng(0), yaw=0.3)
        self.now = 0.0
        self.sent: list[Any] = []
        self.pose = (1.0, 2.0, 0.3)

    def receive(self, message: Any, source: int = COMPANION) -> list[Any]:
        message._header.srcSystem, message._header.srcComponent = source, 191
        return self.vehicle.receive(message, self.now)

    def odometry(self, **changes: Any) -> None:
        x, y, yaw = self.pose
        north, east, down = swap_enu_ned(x, y, 0.0)
        half = swap_yaw(yaw) / 2.0
        fields: dict[str, Any] = {
            "time_usec": 0, "frame_id": 20, "child_frame_id": 12, "x": north, "y": east, "z": down,
            "q": [math.cos(half), 0.0, 0.0, math.sin(half)], "vx": 0.0, "vy": 0.0, "vz": 0.0, "rollspeed": 0.0,
            "pitchspeed": 0.0, "yawspeed": 0.0, "pose_covariance": [0.01] * 21, "velocity_covariance": [0.01] * 21,
        }  # fmt: skip
        self.receive(mavlink.MAVLink_odometry_message(**(fields | changes)))

    def setpoint(
        self, forward: float = 0.0, left: float = 0.0, climb: float = 0.0, turn: float = 0.0, system: int = 3,
        frame: int = 8, mask: int = BODY_VELOCITY, yaw: float = 0.0,
    ) -> None:  # fmt: skip
        vx, vy, vz = swap_flu_frd(forward, left, climb)
        self.receive(
            mavlink.MAVLink_set_position_target_local_ned_message(
                0, system, 1, frame, mask, 0, 0, 0, vx, vy, vz, 0, 0, 0, yaw, swap_flu_frd(0.0, 0.0, turn)[2]
            )
        )

    def command(self, number: int, *params: float, system: int = 3) -> int | None:
        """Send a COMMAND_LONG and return the result in its acknowledgement."""
        padded = [*params, *[0.0] * (7 - len(params))]
        answers = self.receive(mavlink.MAVLink_command_long_message(system, 1, number, 0, *padded), GCS)
        acks = [m for m in answers if m.get_type() == "COMMAND_ACK"]
        assert len(acks) <= 1
        return acks[0].result if acks else None

    def run(self, seconds: float, stream: bool = True, odometry: bool = True, **setpoint: Any) -> list[Any]:
        """Let time pass; return all that the vehicle sent meanwhile."""
        sent: list[Any] = []
        for _ in range(round(seconds / DT)):
            self.now = round(self.now + DT, 6)
            sent += self.vehicle.step(self.now, DT, 0.0)
            if odometry:
                self.odometry()
            if stream:
                self.setpoint(**setpoint)
        return sent

    def fly(self) -> None:
        """Take off by velocity in OFFBOARD, as the runner does."""
        self.run(1.5)
        self.command(mavlink.MAV_CMD_DO_SET_MODE, 1, 6)
        assert self.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1) == mavlink.MAV_RESULT_ACCEPTED
        self.run(2.0, climb=0.5)
        assert self.vehicle.mode is Mode.OFFBOARD
        assert self.vehicle.height_m > 0.5


def kinds(messages: list[Any]) -> set[str]:
    return {m.get_type() for m in messages}


def texts(messages: list[Any]) -> str:
    return " ".join(m.text for m in messages if m.get_type() == "STATUSTEXT")


def test_offboard_is_acknowledged_but_not_entered_before_a_second_of_setpoints() -> None:
    rig = Rig()
    rig.run(0.5)
    assert rig.command(mavlink.MAV_CMD_DO_SET_MODE, 1, 6) == mavlink.MAV_RESULT_ACCEPTED
    assert rig.vehicle.mode is Mode.HOLD
    rig.run(1.0)
    rig.command(mavlink.MAV_CMD_DO_SET_MODE, 1, 6)
    assert rig.vehicle.mode is Mode.OFFBOARD


def test_a_stream_slower_than_two_hertz_does_not_open_offboard() -> None:
    rig = Rig()
    for _ in range(5):
        rig.setpoint()
        rig.run(0.7, stream=False)
    rig.command(mavlink.MAV_CMD_DO_SET_MODE, 1, 6)
    assert rig.vehicle.mode is Mode.HOLD


def test_setpoints_that_px4_does_not_take_are_counted_and_make_no_stream() -> None:
    rig = Rig()
    for _ in range(15):
        rig.run(DT, stream=False)
        rig.setpoint(forward=math.nan)
        rig.setpoint(frame=9)
        rig.setpoint(mask=0xDF8)
        rig.setpoint(system=7)
    rig.command(mavlink.MAV_CMD_DO_SET_MODE, 1, 6)
    assert rig.vehicle.mode is Mode.HOLD
    assert rig.vehicle.rejected == {"setpoint not finite": 15, "setpoint frame": 15, "setpoint is not a velocity": 15}


def test_without_odometry_it_has_no_position_and_does_not_arm() -> None:
    rig = Rig()
    sent = rig.run(2.0, odometry=False)
    assert "LOCAL_POSITION_NED" not in kinds(sent)
    assert {"HEARTBEAT", "ATTITUDE", "SYS_STATUS", "EXTENDED_SYS_STATE", "DISTANCE_SENSOR"} <= kinds(sent)
    denied = rig.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1)
    assert denied == mavlink.MAV_RESULT_TEMPORARILY_REJECTED
    assert "no position" in texts(rig.run(DT, odometry=False))
    rig.run(1.0)
    assert rig.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1) == mavlink.MAV_RESULT_ACCEPTED


@pytest.mark.parametrize(
    "changes",
    [
        {"frame_id": 21},
        {"child_frame_id": 1},
        {"x": math.nan},
        {"vy": 3e38},
        {"q": [0.0] * 4},
        {"pose_covariance": [math.nan] * 21},
    ],
)
def test_odometry_it_cannot_use_gives_no_position(changes: dict[str, Any]) -> None:
    rig = Rig()
    for _ in range(10):
        rig.run(DT, odometry=False)
        rig.odometry(**changes)
    assert rig.vehicle.rejected.total() == 10
    assert rig.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1) == mavlink.MAV_RESULT_TEMPORARILY_REJECTED


def test_position_follows_the_odometry_and_height_stays_the_barometers() -> None:
    rig = Rig(height_noise_std_m=0.0)
    rig.fly()
    rig.pose = (1.2, 1.9, 0.3)
    rig.run(1.0)
    position = [m for m in rig.run(DT) if m.get_type() == "LOCAL_POSITION_NED"][-1]
    x, y, z = swap_enu_ned(position.x, position.y, position.z)
    assert (x, y) == pytest.approx((1.2, 1.9), abs=0.01)
    assert z == pytest.approx(rig.vehicle.height_m)


def test_the_odometrys_yaw_pulls_the_heading_slowly_and_resets_it_when_far_off() -> None:
    rig = Rig(gyro_bias_std_rps=0.0, gyro_noise_std_rps=0.0)
    rig.run(1.0)
    assert rig.vehicle.estimate.yaw == pytest.approx(0.3)
    rig.pose = (1.0, 2.0, 0.4)
    rig.run(DT)
    assert 0.3 < rig.vehicle.estimate.yaw < 0.32
    rig.run(12.0)
    assert rig.vehicle.estimate.yaw == pytest.approx(0.4, abs=0.005)
    rig.pose = (1.0, 2.0, -1.0)
    rig.run(DT)
    assert rig.vehicle.estimate.yaw == pytest.approx(-1.0, abs=0.01)


def test_body_setpoints_move_it_once_airborne_only() -> None:
    rig = Rig(gyro_bias_std_rps=0.0)
    rig.run(1.5, forward=0.4, left=0.2, turn=0.5)
    rig.command(mavlink.MAV_CMD_DO_SET_MODE, 1, 6)
    assert rig.vehicle.velocity_setpoint(rig.now) == (0.0, 0.0, 0.0)
    rig.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1)
    assert rig.vehicle.velocity_setpoint(rig.now) == (0.0, 0.0, 0.0)
    rig.run(1.0, forward=0.4, left=0.2, turn=0.5, climb=0.5)
    assert rig.vehicle.velocity_setpoint(rig.now) == pytest.approx((0.4, 0.2, 0.5))


def test_ned_velocity_with_yaw_turns_toward_the_yaw() -> None:
    rig = Rig(gyro_bias_std_rps=0.0, gyro_noise_std_rps=0.0)
    rig.fly()
    # frame 1: (vx, vy, vz) are north, east, down; the map's north is y
    rig.run(0.5, forward=0.5, frame=1, mask=NED_VELOCITY_AND_YAW, yaw=swap_yaw(0.5))
    forward, left, turn = rig.vehicle.velocity_setpoint(rig.now)
    assert (forward, left) == pytest.approx((0.5 * math.sin(0.3), 0.5 * math.cos(0.3)), abs=0.01)
    assert turn == pytest.approx(2.0 * (0.5 - 0.3), abs=0.02)


def test_a_lost_stream_lands_it_within_the_deadline_and_says_so() -> None:
    rig = Rig()
    rig.fly()
    lost_at = rig.now
    sent = rig.run(1.2, stream=False)
    assert rig.vehicle.mode is Mode.LAND
    assert [(f.reason, round(f.time_s - lost_at, 3)) for f in rig.vehicle.failsafes] == [(STREAM_LOST, 1.0)]
    assert STREAM_LOST in texts(sent)
    assert any(m.get_type() == "HEARTBEAT" and m.custom_mode == Mode.LAND.custom_mode for m in sent)
    assert rig.vehicle.velocity_setpoint(rig.now)[:2] == (0.0, 0.0)
    rig.run(5.0, stream=False)
    assert not rig.vehicle.armed
    assert rig.vehicle.height_m == 0.0


def test_it_returns_to_offboard_when_the_stream_returns() -> None:
    rig = Rig()
    rig.fly()
    rig.run(1.2, stream=False)
    assert rig.vehicle.mode is Mode.LAND
    rig.run(1.2)
    assert rig.vehicle.mode is Mode.OFFBOARD


def test_a_commanded_landing_is_no_failsafe_and_the_stream_does_not_undo_it() -> None:
    rig = Rig()
    rig.fly()
    assert rig.command(mavlink.MAV_CMD_NAV_LAND) == mavlink.MAV_RESULT_ACCEPTED
    rig.run(2.0)
    assert rig.vehicle.mode is Mode.LAND
    rig.run(4.0)
    assert not rig.vehicle.armed
    assert not rig.vehicle.failsafes


def test_lost_odometry_makes_it_hold_then_land_and_the_wind_carry_it() -> None:
    rig = Rig(wind_mps=(0.2, 0.0))
    rig.fly()
    assert rig.vehicle.velocity_setpoint(rig.now)[:2] == (0.0, 0.0)
    rig.run(1.5, odometry=False, forward=0.5)
    assert rig.vehicle.mode is Mode.OFFBOARD
    drift = rig.vehicle.velocity_setpoint(rig.now)[:2]
    yaw = rig.vehicle.estimate.yaw
    assert drift == pytest.approx((0.2 * math.cos(yaw), -0.2 * math.sin(yaw)))
    rig.run(4.0, odometry=False)
    assert rig.vehicle.mode is Mode.LAND
    assert [f.reason for f in rig.vehicle.failsafes] == [ODOMETRY_LOST]


def test_takeoff_climbs_to_its_height_and_holds() -> None:
    rig = Rig()
    rig.run(1.0, stream=False)
    rig.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1)
    assert rig.command(mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 1.5) == mavlink.MAV_RESULT_ACCEPTED
    rig.run(6.0, stream=False)
    assert rig.vehicle.mode is Mode.HOLD
    assert rig.vehicle.height_m == pytest.approx(1.5, abs=0.1)


def test_it_disarms_by_itself_when_nothing_flies_and_not_in_the_air() -> None:
    rig = Rig()
    rig.run(1.0)
    rig.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1)
    rig.run(9.0)
    assert rig.vehicle.armed
    rig.run(2.0)
    assert not rig.vehicle.armed
    rig.fly()
    assert rig.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0) == mavlink.MAV_RESULT_TEMPORARILY_REJECTED
    assert rig.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0, 21196) == mavlink.MAV_RESULT_ACCEPTED
    rig.run(1.0)
    assert rig.vehicle.height_m == 0.0


def test_the_battery_drains_in_flight_and_an_empty_one_lands_it() -> None:
    rig = Rig(endurance_s=20.0)
    rig.fly()
    full = rig.vehicle.battery
    rig.run(5.0)
    assert full - rig.vehicle.battery == pytest.approx(0.25, abs=0.01)
    rig.run(15.0)
    assert [f.reason for f in rig.vehicle.failsafes] == ["battery low"]


def test_every_command_to_it_is_acknowledged_and_none_to_others() -> None:
    rig = Rig()
    assert rig.command(mavlink.MAV_CMD_DO_ORBIT) == mavlink.MAV_RESULT_UNSUPPORTED
    assert rig.command(mavlink.MAV_CMD_NAV_LAND, system=4) is None
    assert rig.command(mavlink.MAV_CMD_NAV_LAND, system=0) == mavlink.MAV_RESULT_ACCEPTED
    answers = rig.receive(
        mavlink.MAVLink_command_int_message(3, 1, 0, mavlink.MAV_CMD_REQUEST_MESSAGE, 0, 0, 148, 0, 0, 0, 0, 0, 0), GCS
    )
    assert [m.get_type() for m in answers] == ["COMMAND_ACK", "AUTOPILOT_VERSION"]
    assert (answers[0].target_system, answers[0].result) == (GCS, mavlink.MAV_RESULT_ACCEPTED)


def test_message_intervals_can_be_set_and_asked_for() -> None:
    rig = Rig()
    rig.run(1.0)
    rig.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, mavlink.MAVLINK_MSG_ID_DISTANCE_SENSOR, -1)
    rig.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION, 200_000)
    sent = rig.run(1.0)
    assert "DISTANCE_SENSOR" not in kinds(sent)
    assert sum(m.get_type() == "ATTITUDE_QUATERNION" for m in sent) == 5


def test_parameters_are_listed_read_and_set_as_px4_encodes_them() -> None:
    rig = Rig()
    listed = rig.receive(mavlink.MAVLink_param_request_list_message(3, 1), GCS)
    assert len(listed) == listed[0].param_count
    read = rig.receive(mavlink.MAVLink_param_request_read_message(3, 1, b"COM_OF_LOSS_T", -1), GCS)
    assert read[0].param_value == 1.0
    rig.receive(mavlink.MAVLink_param_set_message(3, 1, b"COM_OF_LOSS_T", 0.5, mavlink.MAV_PARAM_TYPE_REAL32), GCS)
    rig.fly()
    rig.run(0.6, stream=False)
    assert rig.vehicle.mode is Mode.LAND


def test_attitude_is_the_last_of_each_ticks_telemetry() -> None:
    rig = Rig()
    for _ in range(20):
        assert rig.run(DT)[-1].get_type() == "ATTITUDE"


HANDLED = (
    mavlink.MAVLink_command_long_message, mavlink.MAVLink_command_int_message, mavlink.MAVLink_set_mode_message,
    mavlink.MAVLink_set_position_target_local_ned_message, mavlink.MAVLink_odometry_message,
    mavlink.MAVLink_param_request_read_message, mavlink.MAVLink_param_set_message, mavlink.MAVLink_ping_message,
    mavlink.MAVLink_mission_request_list_message, mavlink.MAVLink_timesync_message, mavlink.MAVLink_statustext_message,
)  # fmt: skip
COMMANDS = (21, 22, 176, 185, 400, 510, 511, 512, 520, 31000)


def decoded(kind: Any, payload: bytes) -> Any:
    """Return the message of a frame with this payload, as a link would."""
    frame = bytearray([0xFD, kind.unpacker.size, 0, 0, 0, 9, 191, kind.id & 0xFF, kind.id >> 8 & 0xFF, kind.id >> 16])
    frame += payload[: kind.unpacker.size]
    crc = mavlink.x25crc(frame[1:] + bytes([kind.crc_extra])).crc
    return mavlink.MAVLink(None).decode(frame + crc.to_bytes(2, "little"))


@settings(max_examples=150, deadline=None)
@given(
    messages=st.lists(
        st.tuples(
            st.sampled_from(HANDLED),
            st.binary(min_size=255, max_size=255),
            st.sampled_from(COMMANDS),
            st.lists(st.floats(width=32), min_size=7, max_size=7),
        ),
        max_size=8,
    )
)
def test_no_content_of_any_message_breaks_it(messages: list[tuple[Any, bytes, int, list[float]]]) -> None:
    rig = Rig()
    rig.run(1.2)
    for kind, payload, command, params in messages:
        message = decoded(kind, payload)
        message.target_system = message.target_component = 0
        if hasattr(message, "command"):
            message.command = command
            for number, value in enumerate(params, start=1):
                setattr(message, f"param{number}", value)
        codec = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        for answer in [*rig.vehicle.receive(message, rig.now), *rig.run(2 * DT)]:
            answer.pack(codec)
        assert all(math.isfinite(value) for value in rig.vehicle.velocity_setpoint(rig.now))
        assert 0.0 <= rig.vehicle.height_m <= rig.vehicle.settings.ceiling_m
