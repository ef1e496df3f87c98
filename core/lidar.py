"""2D LiDAR: what a sensor is, and what one turn of it gives."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from imagine.core.errors import InputError


@dataclass(frozen=True)
class LidarSpec:
    """A 2D LiDAR: beam i looks along `start + i * fov / beams`, counter-clockwise from straight ahead.

    Angles in radians, ranges and noise in metres, rate in hertz. A full turn has `start` 0: beam 0 is straight ahead.
    """

    beams: int
    fov: float = 2.0 * math.pi
    range_min: float = 0.05
    range_max: float = 12.0
    rate_hz: float = 10.0
    noise_std: float = 0.01
    start: float = 0.0

    def __post_init__(self) -> None:
        if self.beams < 1:
            raise InputError(f"LiDAR: beams is {self.beams}, needs at least 1")
        if not 0.0 < self.fov <= 2.0 * math.pi + 1e-9:
            raise InputError(f"LiDAR: fov is {self.fov} rad, needs to be in (0, 2 pi]")
        if not 0.0 <= self.range_min < self.range_max:
            raise InputError(f"LiDAR: range_min {self.range_min} m must lie below range_max {self.range_max} m")
        if not self.noise_std >= 0.0:
            raise InputError(f"LiDAR: noise_std is {self.noise_std} m, needs to be 0 or more")
        if not self.rate_hz > 0.0:
            raise InputError(f"LiDAR: rate_hz is {self.rate_hz}, needs to be positive")

    @property
    def increment(self) -> float:
        """Angle between neighbouring beams, in radians."""
        return self.fov / self.beams

    @cached_property
    def bearings(self) -> NDArray[np.float64]:
        """Bearing of each beam in the body frame, radians, `[beams]`."""
        return self.start + np.arange(self.beams, dtype=np.float64) * self.increment


LD19 = LidarSpec(beams=360)
"""The reference sensor: LDRobot LD19 class, 360 beams over 360 degrees, 0.05-12 m, 10 Hz."""

RING72 = LidarSpec(beams=72, range_min=0.1, range_max=8.0, noise_std=0.03)
"""A low-cost ring: 5 degrees a beam, as MAVLink's OBSTACLE_DISTANCE carries what surrounds a drone (72 distances)."""

RANGER4 = LidarSpec(beams=4, range_min=0.04, range_max=4.0, noise_std=0.02)
"""Four rangers, front, left, back and right, as on Bitcraze's Multi-ranger deck: ST VL53L1X (DocID031281: up to 4 m, 50
Hz; within 20 mm; none under 40 mm). Their cones of 27 degrees are taken as single beams; at our 10 Hz."""

_URG_STEP = 2.0 * math.pi / 1024.0
URG04LX = LidarSpec(
    beams=682, fov=682 * _URG_STEP, range_min=0.02, range_max=5.6, noise_std=0.01, start=-340 * _URG_STEP
)
"""Hokuyo URG-04LX class, blind behind: steps 44 to 725 of 1024 a turn, front at 384 (240 degrees), 0.02-5.6 m, 10 Hz
(SCIP 2.0 manual C-42-03320B; within 30 mm up to 1 m, 3 % beyond)."""

PRESETS: dict[str, LidarSpec] = {"ld19": LD19, "ring72": RING72, "ranger4": RANGER4, "urg04lx": URG04LX}


TEAMMATE_RADIUS_M = 0.25
"""Returns that land so near to a teammate's reported position are the teammate: its radius and both pose errors."""


@dataclass(frozen=True)
class Scan:
    """One turn of a LiDAR: stamp in seconds, ranges in metres, no return = inf, invalid = nan."""

    stamp: float
    ranges: NDArray[np.float32] = field(repr=False)


def returns(scan: Scan, spec: LidarSpec) -> NDArray[np.bool_]:
    """Tell which beams hit something the sensor can measure, `[beams]`."""
    r = scan.ranges
    return np.isfinite(r) & (r >= spec.range_min) & (r <= spec.range_max)


def points(scan: Scan, spec: LidarSpec) -> NDArray[np.float64]:
    """Return the hit points in the body frame, metres, `[hits, 2]`."""
    hit = returns(scan, spec)
    r = scan.ranges[hit].astype(np.float64)
    bearing = spec.bearings[hit]
    return np.column_stack((r * np.cos(bearing), r * np.sin(bearing)))


def mask_near(
    ranges: NDArray[np.float32],
    spec: LidarSpec,
    pose: tuple[float, float, float],
    targets: NDArray[np.float64],
    radius: float,
) -> NDArray[np.float32]:
    """Return the ranges with every return that lands within `radius` of a target made invalid (nan).

    Teammates are seen by the LiDAR but must not be mapped. `pose` and `targets` `[n, 2]` are in the map frame, metres.
    """
    if len(targets) == 0:
        return ranges
    x, y, yaw = pose
    out = ranges
    for tx, ty in targets.tolist():
        away = math.hypot(tx - x, ty - y)
        if away > spec.range_max + radius:
            continue
        # only a return about as far away as the target can be on it; what is no return is neither nan nor finite here
        candidates = np.flatnonzero(np.abs(ranges - np.float32(away)) < radius + 1e-3)
        if not len(candidates):
            continue
        r = ranges[candidates].astype(np.float64)
        bearing = spec.start + yaw + candidates * spec.increment
        near = (x + r * np.cos(bearing) - tx) ** 2 + (y + r * np.sin(bearing) - ty) ** 2 < radius * radius
        if near.any():
            out = out.copy() if out is ranges else out
            out[candidates[near]] = np.nan
    return out if out is not ranges else ranges.copy()
