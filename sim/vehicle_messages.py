"""The MAVLink messages that the vehicle sends, built from its state. All frames pass through core/ned.py here."""

from __future__ import annotations

import math
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from imagine.core.ned import swap_enu_ned, swap_flu_frd, swap_yaw
from imagine.sim.flight_control import FlightControl, Mode
from imagine.sim.vehicle_estimate import VehicleEstimate

Message = Any
"""A message object of pymavlink, which is not typed."""

_CELL_FULL_MV, _CELL_EMPTY_MV = 4200, 3500
_CURRENT_FLYING_CA, _CURRENT_IDLE_CA = 700, 70
_TEXT_BYTES = 50
_UINT16_MAX = 65535

_SENSORS = (
    mavlink.MAV_SYS_STATUS_SENSOR_3D_GYRO
    | mavlink.MAV_SYS_STATUS_SENSOR_3D_ACCEL
    | mavlink.MAV_SYS_STATUS_SENSOR_3D_MAG
    | mavlink.MAV_SYS_STATUS_SENSOR_ABSOLUTE_PRESSURE
    | mavlink.MAV_SYS_STATUS_SENSOR_BATTERY
)
_POSITION = mavlink.MAV_SYS_STATUS_SENSOR_VISION_POSITION
_PREARM = mavlink.MAV_SYS_STATUS_PREARM_CHECK
_CAPABILITIES = (
    mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2
    | mavlink.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
    | mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
    | mavlink.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_LOCAL_NED
    | mavlink.MAV_PROTOCOL_CAPABILITY_FLIGHT_TERMINATION
)
_PX4_VERSION = 1 << 24 | 16 << 16 | 0 << 8 | 255  # 1.16.0, release


def boot_ms(now: float) -> int:
    """Return time_boot_ms of simulated seconds."""
    return round(1000.0 * now)


def heartbeat(control: FlightControl) -> Message:
    """HEARTBEAT: mode, armed, and whether the vehicle has taken over."""
    base = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | mavlink.MAV_MODE_FLAG_STABILIZE_ENABLED
    base |= mavlink.MAV_MODE_FLAG_GUIDED_ENABLED
    if control.mode is not Mode.OFFBOARD:
        base |= mavlink.MAV_MODE_FLAG_AUTO_ENABLED
    if control.armed:
        base |= mavlink.MAV_MODE_FLAG_SAFETY_ARMED
    if control.in_failsafe:
        state = mavlink.MAV_STATE_CRITICAL
    else:
        state = mavlink.MAV_STATE_ACTIVE if control.armed else mavlink.MAV_STATE_STANDBY
    return mavlink.MAVLink_heartbeat_message(
        mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_PX4, base, control.mode.custom_mode, state, 3
    )


def attitude(estimate: VehicleEstimate, now: float) -> Message:
    """ATTITUDE: heading clockwise from north and its rate; the vehicle stays level."""
    _, _, yaw_speed = swap_flu_frd(0.0, 0.0, estimate.yaw_rate)
    return mavlink.MAVLink_attitude_message(boot_ms(now), 0.0, 0.0, swap_yaw(estimate.yaw), 0.0, 0.0, yaw_speed)


def attitude_quaternion(estimate: VehicleEstimate, now: float) -> Message:
    """ATTITUDE_QUATERNION: the same attitude as a unit quaternion."""
    _, _, yaw_speed = swap_flu_frd(0.0, 0.0, estimate.yaw_rate)
    half = swap_yaw(estimate.yaw) / 2.0
    return mavlink.MAVLink_attitude_quaternion_message(
        boot_ms(now), math.cos(half), 0.0, 0.0, math.sin(half), 0.0, 0.0, yaw_speed
    )


def local_position(estimate: VehicleEstimate, height_m: float, climb_mps: float, now: float) -> Message:
    """LOCAL_POSITION_NED: position and velocity north, east, down."""
    north, east, down = swap_enu_ned(estimate.x, estimate.y, height_m)
    v_north, v_east, v_down = swap_enu_ned(estimate.vx, estimate.vy, climb_mps)
    return mavlink.MAVLink_local_position_ned_message(boot_ms(now), north, east, down, v_north, v_east, v_down)


def distance_sensor(height_m: float, now: float) -> Message:
    """DISTANCE_SENSOR: a rangefinder that looks down, in centimetres."""
    centimetres = max(2, min(800, round(100.0 * height_m)))
    return mavlink.MAVLink_distance_sensor_message(
        boot_ms(now),
        2,
        800,
        centimetres,
        mavlink.MAV_DISTANCE_SENSOR_LASER,
        0,
        mavlink.MAV_SENSOR_ROTATION_PITCH_270,
        1,
    )


def extended_sys_state(control: FlightControl) -> Message:
    """EXTENDED_SYS_STATE: on the ground, taking off, in the air or landing."""
    if control.landed:
        landed = mavlink.MAV_LANDED_STATE_ON_GROUND
    elif control.mode is Mode.TAKEOFF:
        landed = mavlink.MAV_LANDED_STATE_TAKEOFF
    elif control.mode is Mode.LAND:
        landed = mavlink.MAV_LANDED_STATE_LANDING
    else:
        landed = mavlink.MAV_LANDED_STATE_IN_AIR
    return mavlink.MAVLink_extended_sys_state_message(mavlink.MAV_VTOL_STATE_UNDEFINED, landed)


def sys_status(control: FlightControl, now: float) -> Message:
    """SYS_STATUS: health bits (position, pre-arm check) and the battery."""
    health = _SENSORS
    if control.has_position(now):
        health |= _POSITION
    if control.can_arm(now):
        health |= _PREARM
    known = _SENSORS | _POSITION | _PREARM
    return mavlink.MAVLink_sys_status_message(
        known,
        known,
        health,
        200,
        _battery_mv(control),
        _current_ca(control),
        _battery_percent(control),
        0,
        0,
        0,
        0,
        0,
        0,
    )


def battery_status(control: FlightControl) -> Message:
    """BATTERY_STATUS of a single lithium cell."""
    voltages = [_battery_mv(control)] + [_UINT16_MAX] * 9
    return mavlink.MAVLink_battery_status_message(
        0,
        mavlink.MAV_BATTERY_FUNCTION_ALL,
        mavlink.MAV_BATTERY_TYPE_LIPO,
        3000,
        voltages,
        _current_ca(control),
        -1,
        -1,
        _battery_percent(control),
        round(control.battery * control.settings.endurance_s),
    )


def autopilot_version(system_id: int) -> Message:
    """AUTOPILOT_VERSION: what it can do, and who it is."""
    return mavlink.MAVLink_autopilot_version_message(
        _CAPABILITIES, _PX4_VERSION, 0, 0, 0, [0] * 8, [0] * 8, [0] * 8, 0, 0, system_id
    )


def home_position() -> Message:
    """HOME_POSITION: the origin of the local frame; without GPS there is no place on Earth to give."""
    return mavlink.MAVLink_home_position_message(0, 0, 0, 0.0, 0.0, 0.0, [1.0, 0.0, 0.0, 0.0], 0.0, 0.0, 0.0)


def status_text(text: str, severity: int, text_id: int) -> list[Message]:
    """STATUSTEXT, in chunks of 50 bytes under one id when it is longer."""
    raw = text.encode("ascii", "replace")
    if len(raw) <= _TEXT_BYTES:
        return [mavlink.MAVLink_statustext_message(severity, raw)]
    chunks = [raw[at : at + _TEXT_BYTES] for at in range(0, len(raw), _TEXT_BYTES)]
    return [mavlink.MAVLink_statustext_message(severity, chunk, text_id, n) for n, chunk in enumerate(chunks)]


def _battery_mv(control: FlightControl) -> int:
    return round(_CELL_EMPTY_MV + control.battery * (_CELL_FULL_MV - _CELL_EMPTY_MV))


def _battery_percent(control: FlightControl) -> int:
    return round(100.0 * control.battery)


def _current_ca(control: FlightControl) -> int:
    return _CURRENT_FLYING_CA if control.armed and not control.landed else _CURRENT_IDLE_CA
