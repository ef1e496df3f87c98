"""From a policy's numbers to a safe setpoint: definitions are those of `core.action` and `core.shield`."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from imagine.core.contract import ActionSpec
from imagine.core.lidar import LidarSpec
from imagine.core.shield import BACK_OFF_MPS, MARGIN_M, REACTION_S
from imagine.core.vehicle_limits import VehicleLimits

_BRAKING_SHARE = 0.7  # of the greatest acceleration
_PASSES = 4


def intent(
    action: NDArray[np.float32], spec: ActionSpec, map_axes: bool, pose: tuple[float, float, float]
) -> tuple[float, ...]:
    """Return what a decision taken at `pose` means from now on: a waypoint in the map, else the clipped action."""
    clipped = np.clip(action.astype(np.float64), -1.0, 1.0).tolist()
    if spec.mode != "waypoint":
        return tuple(clipped)
    x, y, yaw = pose
    dx, dy = _shortened(*clipped)
    if not map_axes:
        dx, dy = math.cos(yaw) * dx - math.sin(yaw) * dy, math.sin(yaw) * dx + math.cos(yaw) * dy
    return x + dx * spec.waypoint_range_m, y + dy * spec.waypoint_range_m


def body_velocity(
    intended: tuple[float, ...], spec: ActionSpec, map_axes: bool, pose: tuple[float, float, float]
) -> tuple[float, float, float]:
    """Return (vx forward, vy left, yaw rate), m/s and rad/s, that an intent asks of a drone at `pose`."""
    x, y, yaw = pose
    if spec.mode == "body":
        forward, left, turn = intended
        return forward * spec.speed_mps, left * spec.speed_mps, turn * spec.yaw_rate_rps
    a, b = intended
    if spec.mode == "forward":
        return max(a, 0.0) * spec.speed_mps, 0.0, b * spec.yaw_rate_rps
    if spec.mode == "waypoint":
        response, braking = spec.waypoint_response_s, spec.waypoint_braking_mps2
        away = math.hypot(a - x, b - y)
        # stopping from v takes v response + v²/(2 braking) metres, solved for v
        speed = min(spec.speed_mps, braking * (math.sqrt(response**2 + 2.0 * away / braking) - response))
        vx, vy = (a - x) / max(away, 1e-9) * speed, (b - y) / max(away, 1e-9) * speed
    else:
        vx, vy = (part * spec.speed_mps for part in _shortened(a, b))
    if map_axes or spec.mode == "waypoint":
        c, s = math.cos(yaw), math.sin(yaw)
        vx, vy = c * vx + s * vy, -s * vx + c * vy
    return vx, vy, 0.0


def _shortened(x: float, y: float) -> tuple[float, float]:
    length = max(1.0, math.hypot(x, y))
    return x / length, y / length


def shielded(
    vx: float, vy: float, ranges: NDArray[np.float32], lidar: LidarSpec, limits: VehicleLimits
) -> tuple[float, float]:
    """Return the body-frame velocity nearest to (vx, vy) that can stop before every return, m/s."""
    braking = _BRAKING_SHARE * limits.acceleration_mps2
    delay = limits.lag_s + REACTION_S
    speed = math.hypot(vx, vy)
    near = ranges.astype(np.float64)
    close = (near >= lidar.range_min) & (
        near < limits.radius_m + MARGIN_M + speed * delay + speed * speed / (2.0 * braking)
    )
    if not close.any():
        return vx, vy
    clear = near[close] - limits.radius_m - MARGIN_M
    stopping = braking * (np.sqrt(delay * delay + 2.0 * np.maximum(clear, 0.0) / braking) - delay)
    limit = np.where(clear > 0.0, stopping, np.maximum(-BACK_OFF_MPS, 4.0 * clear))
    bearings = lidar.bearings[close]
    ux, uy = np.cos(bearings), np.sin(bearings)
    returns = list(zip(ux.tolist(), uy.tolist(), limit.tolist(), strict=True))
    for _ in range(_PASSES):  # one return after the other: each projection starts from the last one's result
        clipped = False
        for x, y, most in returns:
            excess = vx * x + vy * y - most
            if excess > 1e-9:
                vx, vy, clipped = vx - excess * x, vy - excess * y, True
        if not clipped:
            return vx, vy
    approach, allowed = vx * ux + vy * uy, np.maximum(limit, 0.0)
    fast = approach > allowed
    scale = float((allowed[fast] / approach[fast]).min(initial=1.0))
    return scale * vx, scale * vy
