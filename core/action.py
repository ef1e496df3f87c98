"""From a policy's numbers to the body-frame velocity that is commanded."""

from __future__ import annotations

import math
from typing import Literal

import numba
import numpy as np
from numpy.typing import NDArray

from imagine.core.contract import ActionSpec


def to_body_velocity(
    action: NDArray[np.float32], spec: ActionSpec, axes: Literal["map", "heading"], yaw: float
) -> tuple[float, float, float]:
    """Return (vx forward, vy left, yaw rate) in m/s and rad/s of an action in [-1, 1], clipped to it.

    `plane` actions lie along `axes`; longer ones than 1 keep their direction. `yaw` is the drone's heading in the map.
    """
    ax, ay, turn = (*map(float, action), 0.0)[:3]
    return _body_velocity(
        ax, ay, turn, spec.mode == "body", axes == "map", spec.speed_mps, spec.yaw_rate_rps, float(yaw)
    )


def _body_velocity(
    ax: float, ay: float, turn: float, body_mode: bool, map_axes: bool, speed: float, fastest_yaw: float, yaw: float
) -> tuple[float, float, float]:
    ax, ay = min(max(ax, -1.0), 1.0), min(max(ay, -1.0), 1.0)
    if body_mode:
        return ax * speed, ay * speed, min(max(turn, -1.0), 1.0) * fastest_yaw
    length = max(1.0, math.sqrt(ax * ax + ay * ay))
    vx, vy = ax / length * speed, ay / length * speed
    if map_axes:
        c, s = math.cos(yaw), math.sin(yaw)
        vx, vy = c * vx + s * vy, -s * vx + c * vy
    return vx, vy, 0.0


body_velocity_kernel = numba.njit(cache=True, nogil=True)(_body_velocity)
"""The same compiled, for batches; of what a policy gives, `turn` counts in body mode alone."""
