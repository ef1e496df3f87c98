"""A room with inner walls, a way through it, and what a LiDAR measures on that way."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from imagine.core.frames import Pose, wrap_angle
from imagine.core.lidar import LidarSpec, Scan

# a 10 x 8 m room with inner walls that leave a way round, metres: x1 y1 x2 y2
ROOM = np.array(
    [
        [0, 0, 10, 0], [10, 0, 10, 8], [10, 8, 0, 8], [0, 8, 0, 0],
        [3, 0, 3, 3], [3, 5, 3, 6.2], [6.5, 8, 6.5, 4.5], [6.5, 2.8, 6.5, 1.6], [8, 4.5, 10, 4.5],
    ],
    dtype=np.float64,
)  # fmt: skip
ROUND = np.array([[1.5, 1.5], [1.5, 4], [4.5, 4], [4.5, 1], [8.5, 1], [8.5, 3.5], [5, 3.5], [4.8, 7], [1.5, 7]])


def cast(pose: Pose, spec: LidarSpec, walls: NDArray[np.float64] = ROOM) -> NDArray[np.float64]:
    """Return the true ranges `[beams]` from a pose to the nearest wall, inf past the sensor's reach."""
    angle = spec.bearings + pose.yaw
    dx, dy = np.cos(angle)[:, None], np.sin(angle)[:, None]
    ex, ey = walls[:, 2] - walls[:, 0], walls[:, 3] - walls[:, 1]
    px, py = walls[:, 0] - pose.x, walls[:, 1] - pose.y
    cross = dx * ey - dy * ex
    with np.errstate(divide="ignore", invalid="ignore"):
        along_ray, along_wall = (px * ey - py * ex) / cross, (px * dy - py * dx) / cross
    hit = (np.abs(cross) > 1e-12) & (along_ray > 0) & (along_wall >= 0) & (along_wall <= 1)
    ranges = np.where(hit, along_ray, np.inf).min(axis=1)
    return np.where(ranges > spec.range_max, np.inf, ranges)


def measure(pose: Pose, stamp: float, spec: LidarSpec, rng: np.random.Generator) -> Scan:
    return Scan(stamp, (cast(pose, spec) + rng.normal(0.0, spec.noise_std, spec.beams)).astype(np.float32))


def fly(waypoints: NDArray[np.float64], speed: float = 0.8, rate_hz: float = 10.0) -> list[Pose]:
    """Return the poses of a flight through waypoints at constant speed, looking round as it goes."""
    lengths = np.hypot(*np.diff(waypoints, axis=0).T)
    at = np.concatenate(([0.0], np.cumsum(lengths)))
    s = np.arange(0.0, at[-1], speed / rate_hz)
    x, y = np.interp(s, at, waypoints[:, 0]), np.interp(s, at, waypoints[:, 1])
    return [Pose(float(a), float(b), wrap_angle(1.5 * math.sin(c))) for a, b, c in zip(x, y, s, strict=True)]
