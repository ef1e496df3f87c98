"""The only place where the map frame (ENU) and body frame (FLU) meet MAVLink's NED and FRD.

Map frame: x east, y north, z up, yaw counter-clockwise from x. NED: x north, y east, z down, yaw clockwise from
north. Body FLU: x forward, y left, z up. Body FRD: x forward, y right, z down. Each conversion is its own inverse.
"""

from __future__ import annotations

import math

from imagine.core.frames import wrap_angle


def swap_enu_ned(x: float, y: float, z: float) -> tuple[float, float, float]:
    """Convert a vector between ENU and NED, in either direction."""
    return y, x, -z


def swap_yaw(yaw: float) -> float:
    """Convert a heading between the map's yaw and NED's, in either direction, wrapped to (-pi, pi]."""
    return wrap_angle(math.pi / 2.0 - yaw)


def swap_flu_frd(x: float, y: float, z: float) -> tuple[float, float, float]:
    """Convert a body vector (or angular rate) between FLU and FRD, in either direction."""
    return x, -y, -z
