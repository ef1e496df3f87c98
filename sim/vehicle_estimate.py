"""What the vehicle believes about its own motion: a gyro, corrected by the external odometry that is all it has."""

from __future__ import annotations

import math
from typing import NamedTuple

from imagine.core.frames import wrap_angle

_POSITION_GAIN = 0.5
_VELOCITY_GAIN = 0.5
_YAW_GAIN = 0.05  # a time constant of two seconds at 10 Hz
_YAW_JUMP_RAD = 0.5  # further off than this, the heading is reset instead of pulled


class ExternalPose(NamedTuple):
    """One ODOMETRY message in the map frame: metres, radians, m/s; `resets` is its reset counter."""

    x: float
    y: float
    yaw: float
    vx: float
    vy: float
    resets: int


class VehicleEstimate:
    """Position, velocity and yaw in the map frame, propagated by velocity and gyro, pulled toward the odometry."""

    def __init__(self, yaw: float) -> None:
        """Start with a known heading and no position."""
        self.x = self.y = self.vx = self.vy = 0.0
        self.yaw = wrap_angle(yaw)
        self.yaw_rate = 0.0
        self._resets: int | None = None

    def propagate(self, measured_yaw_rate: float, dt: float) -> None:
        """Advance by `dt` seconds with the yaw rate (rad/s, counter-clockwise) that the gyro measured."""
        self.yaw_rate = measured_yaw_rate
        self.yaw = wrap_angle(self.yaw + measured_yaw_rate * dt)
        self.x += self.vx * dt
        self.y += self.vy * dt

    def fuse(self, pose: ExternalPose) -> None:
        """Pull the estimate toward the odometry; at the first one, or after a reset of its source, take it over."""
        if self._resets != pose.resets:
            self._resets = pose.resets
            self.x, self.y, self.vx, self.vy = pose.x, pose.y, pose.vx, pose.vy
        else:
            self.x += _POSITION_GAIN * (pose.x - self.x)
            self.y += _POSITION_GAIN * (pose.y - self.y)
            self.vx += _VELOCITY_GAIN * (pose.vx - self.vx)
            self.vy += _VELOCITY_GAIN * (pose.vy - self.vy)
        error = wrap_angle(pose.yaw - self.yaw)
        gain = 1.0 if abs(error) > _YAW_JUMP_RAD else _YAW_GAIN
        self.yaw = wrap_angle(self.yaw + gain * error)

    def stop(self) -> None:
        """Give up dead reckoning: the last velocity is too old to go on with."""
        self.vx = self.vy = 0.0


def yaw_of_quaternion(w: float, x: float, y: float, z: float) -> float:
    """Return the heading of a rotation, about the third axis of its frame, in radians."""
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
