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


def body_velocity(action: NDArray[np.float32], spec: ActionSpec, map_axes: bool, yaw: float) -> list[float]:
    """Return (vx forward, vy left, yaw rate), m/s and rad/s, of an action in [-1, 1], clipped to it."""
    ax, ay, *turn = np.clip(action.astype(np.float64), -1.0, 1.0).tolist()
    if spec.mode == "body":
        return [ax * spec.speed_mps, ay * spec.speed_mps, turn[0] * spec.yaw_rate_rps]
    length = max(1.0, math.hypot(ax, ay))
    vx, vy = ax / length * spec.speed_mps, ay / length * spec.speed_mps
    if map_axes:
        c, s = math.cos(yaw), math.sin(yaw)
        vx, vy = c * vx + s * vy, -s * vx + c * vy
    return [vx, vy, 0.0]


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
