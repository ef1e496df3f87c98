"""Planar poses (SE(2)) in the map frame: x east, y north, yaw counter-clockwise from x, metres and radians."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class Pose(NamedTuple):
    """A planar pose: position in metres, yaw in radians."""

    x: float
    y: float
    yaw: float


IDENTITY = Pose(0.0, 0.0, 0.0)


def wrap_angle(angle: float) -> float:
    """Return the same direction in (-pi, pi]."""
    wrapped = math.remainder(angle, 2.0 * math.pi)
    return math.pi if wrapped == -math.pi else wrapped


def compose(a: Pose, b: Pose) -> Pose:
    """Return a ∘ b: the pose `b`, given in the frame of `a`, expressed in the frame `a` is given in."""
    c, s = math.cos(a.yaw), math.sin(a.yaw)
    return Pose(a.x + c * b.x - s * b.y, a.y + s * b.x + c * b.y, wrap_angle(a.yaw + b.yaw))


def inverse(p: Pose) -> Pose:
    """Return the pose that undoes `p`: compose(p, inverse(p)) is the identity."""
    c, s = math.cos(p.yaw), math.sin(p.yaw)
    return Pose(-c * p.x - s * p.y, s * p.x - c * p.y, wrap_angle(-p.yaw))


def relative(a: Pose, b: Pose) -> Pose:
    """Return `b` as seen from `a`: compose(a, relative(a, b)) is `b`."""
    return compose(inverse(a), b)


def transform_points(pose: Pose, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Carry points `[n, 2]` from the frame of `pose` into the frame `pose` is given in."""
    c, s = math.cos(pose.yaw), math.sin(pose.yaw)
    moved: NDArray[np.float64] = points @ np.array([[c, s], [-s, c]]) + np.array([pose.x, pose.y])
    return moved


def placed_bounds(
    pose: Pose, x: tuple[float, float], y: tuple[float, float]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the least and the greatest x and y, `[2]` each, that a rectangle takes up once `pose` has placed it."""
    placed = transform_points(pose, np.array([[at_x, at_y] for at_x in x for at_y in y], np.float64))
    return placed.min(axis=0), placed.max(axis=0)


def rotate(yaw: float, x: float, y: float) -> tuple[float, float]:
    """Rotate the vector (x, y) counter-clockwise by `yaw`."""
    c, s = math.cos(yaw), math.sin(yaw)
    return c * x - s * y, s * x + c * y
