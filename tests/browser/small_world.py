"""A few rooms of straight walls, rays against them, and closed paths to fly along: enough world to look at a page."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from imagine.core.frames import Pose
from imagine.core.lidar import LidarSpec, Scan

# x0, y0, x1, y1 in metres: a hall of 10 x 7 m, two walls with a door each, and a box
WALLS = np.array(
    [
        (-5, -3.5, 5, -3.5), (5, -3.5, 5, 3.5), (5, 3.5, -5, 3.5), (-5, 3.5, -5, -3.5),
        (-1.5, -3.5, -1.5, -0.8), (-1.5, 0.4, -1.5, 3.5), (2, 3.5, 2, 0.9), (2, -0.4, 2, -3.5),
        (3.2, -2.4, 4.1, -2.4), (4.1, -2.4, 4.1, -1.5), (4.1, -1.5, 3.2, -1.5), (3.2, -1.5, 3.2, -2.4),
    ]
)  # fmt: skip

PATHS = {
    1: [(-3, 0), (-3, 2.4), (-4.2, 2.4), (-4.2, -2.5), (-2.5, -2.5), (-2.5, -0.2)],
    2: [(0, 0), (0.4, 2.6), (-0.7, 2.6), (-0.7, -2.6), (1.1, -2.6), (1.1, 0)],
    3: [(2.8, 0.2), (4, 2.5), (2.7, 2.7), (2.8, -0.8), (4.5, -0.8), (4.4, 0.6)],
}


def cast(pose: Pose, spec: LidarSpec, stamp: float) -> Scan:
    """Return what a LiDAR at `pose` measures; no return beyond its range."""
    bearing = spec.bearings + pose.yaw
    dx, dy = np.cos(bearing)[:, None], np.sin(bearing)[:, None]
    ax, ay = WALLS[:, 0] - pose.x, WALLS[:, 1] - pose.y
    ex, ey = WALLS[:, 2] - WALLS[:, 0], WALLS[:, 3] - WALLS[:, 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        cross = dx * ey - dy * ex
        along_ray = (ax * ey - ay * ex) / cross
        along_wall = (ax * dy - ay * dx) / cross
    hit = (along_ray > 0) & (along_wall >= 0) & (along_wall <= 1)
    nearest: NDArray[np.float64] = np.where(hit, along_ray, np.inf).min(axis=1)
    return Scan(stamp, np.where(nearest <= spec.range_max, nearest, np.inf).astype(np.float32))


def pose_on_path(drone: int, distance_m: float) -> Pose:
    """Return where a drone is after flying `distance_m` along its closed path, nose ahead."""
    corners = np.array([*PATHS[drone], PATHS[drone][0]], float)
    steps = np.diff(corners, axis=0)
    lengths = np.hypot(steps[:, 0], steps[:, 1])
    left = distance_m % lengths.sum()
    leg = int(np.searchsorted(np.cumsum(lengths), left, side="right"))
    share = (left - lengths[:leg].sum()) / lengths[leg]
    x, y = corners[leg] + share * steps[leg]
    return Pose(float(x), float(y), math.atan2(steps[leg, 1], steps[leg, 0]))
