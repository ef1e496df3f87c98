"""What a companion computer sends the vehicle, read and checked: velocity setpoints and external odometry.

All frames pass through core/ned.py here. A reader returns the reason, as text, where the message cannot be used.
"""

from __future__ import annotations

import math

from pymavlink.dialects.v20 import common as mavlink

from imagine.core.frames import rotate
from imagine.core.ned import swap_enu_ned, swap_flu_frd, swap_yaw
from imagine.sim.flight_control import Setpoint
from imagine.sim.vehicle_estimate import ExternalPose, yaw_of_quaternion
from imagine.sim.vehicle_messages import Message

_SETPOINT_FRAMES = (mavlink.MAV_FRAME_LOCAL_NED, mavlink.MAV_FRAME_BODY_NED)  # PX4 takes no other
_ODOMETRY_FRAMES = (mavlink.MAV_FRAME_LOCAL_NED, mavlink.MAV_FRAME_LOCAL_FRD)
_IGNORE_POSITION, _IGNORE_VELOCITY = 0x007, 0x038
_IGNORE_YAW, _IGNORE_YAW_RATE = 0x400, 0x800
_FARTHEST_M, _FASTEST_MPS = 1e5, 1e3  # beyond these it is no odometry but noise


def read_setpoint(m: Message) -> Setpoint | str:
    """Read SET_POSITION_TARGET_LOCAL_NED: a velocity, with a yaw or a yaw rate."""
    mask = int(m.type_mask)
    if m.coordinate_frame not in _SETPOINT_FRAMES:
        return "setpoint frame"
    if mask & _IGNORE_POSITION != _IGNORE_POSITION or mask & _IGNORE_VELOCITY:
        return "setpoint is not a velocity"
    yaw_rate = 0.0 if mask & _IGNORE_YAW_RATE else float(m.yaw_rate)
    yaw = 0.0 if mask & _IGNORE_YAW else float(m.yaw)
    if not all(math.isfinite(value) for value in (m.vx, m.vy, m.vz, yaw_rate, yaw)):
        return "setpoint not finite"
    in_body = m.coordinate_frame == mavlink.MAV_FRAME_BODY_NED
    vx, vy, climb = (swap_flu_frd if in_body else swap_enu_ned)(m.vx, m.vy, m.vz)
    _, _, turn = swap_flu_frd(0.0, 0.0, yaw_rate)
    return Setpoint(vx, vy, climb, turn, None if mask & _IGNORE_YAW else swap_yaw(yaw), in_body)


def read_odometry(m: Message) -> ExternalPose | str:
    """Read ODOMETRY; its height is not used, and as on PX4 its variances must be finite."""
    if m.frame_id not in _ODOMETRY_FRAMES or m.child_frame_id != mavlink.MAV_FRAME_BODY_FRD:
        return "odometry frame"
    numbers = (m.x, m.y, m.z, *m.q, m.vx, m.vy, m.vz, m.pose_covariance[0], m.velocity_covariance[0])
    if not all(math.isfinite(value) for value in numbers) or not any(m.q):
        return "odometry not finite"
    if max(abs(m.x), abs(m.y)) > _FARTHEST_M or max(abs(m.vx), abs(m.vy)) > _FASTEST_MPS:
        return "odometry out of bounds"
    x, y, _ = swap_enu_ned(m.x, m.y, m.z)
    yaw = swap_yaw(yaw_of_quaternion(*m.q))
    forward, left, _ = swap_flu_frd(m.vx, m.vy, m.vz)
    vx, vy = rotate(yaw, forward, left)
    return ExternalPose(x, y, yaw, vx, vy, int(m.reset_counter))
