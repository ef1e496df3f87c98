"""The safety shield: never faster toward an obstacle than the drone can stop before it."""

from __future__ import annotations

import math

import numba

from imagine.core.lidar import LidarSpec, Scan
from imagine.core.vehicle_limits import VehicleLimits

MARGIN_M = 0.08
"""Clearance kept between airframe and obstacle, metres: sensor noise, a scan's age and estimate error together."""
BACK_OFF_MPS = 0.2
"""Greatest speed away from an obstacle that came inside the margin."""
REACTION_S = 0.1
"""One tick at 10 Hz: how long a setpoint stands before the next scan can change it."""
_BRAKING_SHARE = 0.7  # of the greatest acceleration: what is sure to be had while turning as well
_PASSES = 4


@numba.njit(cache=True, nogil=True)
def approach_limit(range_m, radius, lag, acceleration):  # type: ignore[no-untyped-def]
    """Return the greatest speed toward a return at `range_m` that still stops before it, m/s; negative inside.

    Stopping from v takes v (lag + REACTION_S) + v²/(2 a) metres; this is that, solved for v.
    """
    lag += REACTION_S
    clear = range_m - radius - MARGIN_M
    if clear <= 0.0:
        return max(-BACK_OFF_MPS, 4.0 * clear)
    braking = _BRAKING_SHARE * acceleration
    return braking * (math.sqrt(lag * lag + 2.0 * clear / braking) - lag)


@numba.njit(cache=True, nogil=True)
def shield_kernel(vx, vy, ranges, range_min, start, increment, radius, lag, acceleration):  # type: ignore[no-untyped-def]
    """Return the body-frame velocity nearest to (vx, vy) found by projecting it on every return's speed limit."""
    speed = math.sqrt(vx * vx + vy * vy)
    far = radius + MARGIN_M + speed * (lag + REACTION_S) + speed * speed / (2.0 * _BRAKING_SHARE * acceleration)
    for _ in range(_PASSES):
        clipped = False
        for beam in range(ranges.shape[0]):
            r = ranges[beam]
            if not (range_min <= r < far):
                continue
            bearing = start + beam * increment
            ux, uy = math.cos(bearing), math.sin(bearing)
            excess = vx * ux + vy * uy - approach_limit(r, radius, lag, acceleration)
            if excess > 1e-9:
                vx -= excess * ux
                vy -= excess * uy
                clipped = True
        if not clipped:
            return vx, vy
    # The projections did not settle (a narrow corner): what is left is scaled down until nothing is exceeded.
    scale = 1.0
    for beam in range(ranges.shape[0]):
        r = ranges[beam]
        if not (range_min <= r < far):
            continue
        bearing = start + beam * increment
        approach = vx * math.cos(bearing) + vy * math.sin(bearing)
        limit = max(0.0, approach_limit(r, radius, lag, acceleration))
        if approach > limit:
            scale = min(scale, limit / approach)
    return scale * vx, scale * vy


def shield_velocity(vx: float, vy: float, scan: Scan, lidar: LidarSpec, limits: VehicleLimits) -> tuple[float, float]:
    """Return the safe body-frame velocity (m/s, forward and left) nearest to the one wanted, given the newest scan."""
    vx, vy = shield_kernel(
        float(vx), float(vy), scan.ranges, lidar.range_min, lidar.start, lidar.increment,
        limits.radius_m, limits.lag_s, limits.acceleration_mps2,
    )  # fmt: skip
    return float(vx), float(vy)
