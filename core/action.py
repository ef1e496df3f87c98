"""From a policy's numbers to the body-frame velocity that is commanded."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from imagine.core.contract import ActionSpec
from imagine.core.frames import rotate


def to_body_velocity(
    action: NDArray[np.float32], spec: ActionSpec, axes: Literal["map", "heading"], yaw: float
) -> tuple[float, float, float]:
    """Return (vx forward, vy left, yaw rate) in m/s and rad/s of an action in [-1, 1], clipped to it.

    `plane` actions lie along `axes`; longer ones than 1 keep their direction. `yaw` is the drone's heading in the map.
    """
    numbers = [min(max(float(a), -1.0), 1.0) for a in action]
    if spec.mode == "body":
        return numbers[0] * spec.speed_mps, numbers[1] * spec.speed_mps, numbers[2] * spec.yaw_rate_rps
    ax, ay = numbers
    length = max(1.0, math.hypot(ax, ay))
    vx, vy = ax / length * spec.speed_mps, ay / length * spec.speed_mps
    if axes == "map":
        vx, vy = rotate(-yaw, vx, vy)
    return vx, vy, 0.0
