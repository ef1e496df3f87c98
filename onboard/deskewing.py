"""A spinning LiDAR's scan, put right: each beam where the end of the turn would have seen what it met.

Beams come one after another, and a scan is stamped at the end of its turn: the beam taken i-th of n was taken (1 − i /
n) of the turn before the stamp. A turn begins at beam 0 and goes counter-clockwise, or clockwise, as many sensors do. A
sensor that sees part of a turn takes its beams in that part of the period.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from imagine.core.frames import Pose, rotate
from imagine.core.lidar import LidarSpec, Scan, points, returns


def deskewed_points(scan: Scan, spec: LidarSpec, motion: Pose, clockwise: bool = False) -> NDArray[np.float64]:
    """Return the hit points `[hits, 2]` in the body frame at the scan's stamp, the end of its turn, metres.

    `motion` is the drone's from one stamp to the next, in the frame of the former; it is taken as uniform over the
    turn, as KISS-ICP does. Beam i of n was taken (1 − i / n) of the turn before the stamp.
    """
    cloud, hit = points(scan, spec), np.flatnonzero(returns(scan, spec))
    left = _turn_left(spec, clockwise)[hit]
    back_x, back_y = rotate(-motion.yaw, -motion.x, -motion.y)
    c, s = np.cos(-motion.yaw * left), np.sin(-motion.yaw * left)
    x, y = cloud.T
    return np.column_stack((c * x - s * y + left * back_x, s * x + c * y + left * back_y))


def deskewed_scan(scan: Scan, spec: LidarSpec, motion: Pose, clockwise: bool = False) -> Scan:
    """Return the scan that the end of the turn would have given, with `motion` as `deskewed_points` takes it.

    Each return goes to the beam nearest to where it now lies, the nearest one where several meet; a beam without
    return stays without in its new direction. Beams that nothing comes to are invalid (nan).
    """
    hits = deskewed_points(scan, spec, motion, clockwise)
    endless = np.flatnonzero(np.isposinf(scan.ranges))
    ranges = np.full(spec.beams, np.nan)
    beams, kept = _beams_at(spec, spec.bearings[endless] - motion.yaw * _turn_left(spec, clockwise)[endless])
    ranges[beams[kept]] = np.inf
    beams, kept = _beams_at(spec, np.arctan2(hits[:, 1], hits[:, 0]))
    np.fmin.at(ranges, beams[kept], np.hypot(hits[:, 0], hits[:, 1])[kept])
    return Scan(scan.stamp, ranges.astype(np.float32))


def _turn_left(spec: LidarSpec, clockwise: bool) -> NDArray[np.float64]:
    """Return the share of a whole turn's time from each beam to the stamp, `[beams]`."""
    order = np.arange(spec.beams)
    if clockwise:
        whole = spec.fov > 2.0 * math.pi - 1e-6
        order = -order % spec.beams if whole else order[::-1]
    left: NDArray[np.float64] = (1.0 - order / spec.beams) * spec.fov / (2.0 * math.pi)
    return left


def _beams_at(spec: LidarSpec, bearings: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return the beams nearest to bearings, and which of them the sensor has."""
    steps = np.rint((bearings - spec.start) % (2.0 * math.pi) / spec.increment).astype(np.int64)
    steps %= round(2.0 * math.pi / spec.increment)
    return steps, steps < spec.beams
