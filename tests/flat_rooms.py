"""Rooms with straight walls for tests of maps, and what a noiseless LiDAR measures in them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from imagine.core.frames import Pose
from imagine.core.lidar import LidarSpec, Scan


def walls_of_box(x0: float, y0: float, x1: float, y1: float) -> NDArray[np.float64]:
    """Return the four walls of an axis-parallel box, `[4, 4]` (x0, y0, x1, y1)."""
    return np.array([[x0, y0, x1, y0], [x1, y0, x1, y1], [x1, y1, x0, y1], [x0, y1, x0, y0]], float)


def distances(walls: NDArray[np.float64], pose: Pose, lidar: LidarSpec) -> NDArray[np.float64]:
    """Return the exact range of every beam, metres; inf past the sensor's reach."""
    bearing = (lidar.bearings + pose.yaw)[:, None]
    ux, uy = np.cos(bearing), np.sin(bearing)
    ax, ay = walls[:, 0] - pose.x, walls[:, 1] - pose.y
    ex, ey = walls[:, 2] - walls[:, 0], walls[:, 3] - walls[:, 1]
    facing = ux * ey - uy * ex
    with np.errstate(divide="ignore", invalid="ignore"):
        along = (ax * ey - ay * ex) / facing
        share = (ax * uy - ay * ux) / facing
        hit = (along >= 0.0) & (share >= -1e-12) & (share <= 1.0 + 1e-12)
    nearest = np.where(hit, along, np.inf).min(axis=1)
    return np.where(nearest <= lidar.range_max, nearest, np.inf)


def look(walls: NDArray[np.float64], pose: Pose, lidar: LidarSpec, stamp: float = 0.0) -> Scan:
    """Return the scan taken at a pose."""
    return Scan(stamp, distances(walls, pose, lidar).astype(np.float32))


def clearance(walls: NDArray[np.float64], x: float, y: float) -> float:
    """Return the distance from a point to the nearest wall, metres."""
    ex, ey = walls[:, 2] - walls[:, 0], walls[:, 3] - walls[:, 1]
    t = np.clip(((x - walls[:, 0]) * ex + (y - walls[:, 1]) * ey) / (ex * ex + ey * ey), 0.0, 1.0)
    return float(np.hypot(x - walls[:, 0] - t * ex, y - walls[:, 1] - t * ey).min())
