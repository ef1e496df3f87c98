"""From a policy's numbers to the body-frame velocity that is commanded, and back from a direction to numbers.

A decision becomes an *intent*, three numbers that keep their meaning while the drone moves on: a waypoint is a point of
the map, everything else the action itself. Every tick the intent becomes a body velocity. So a decision may stand for
several ticks, and who keeps it (a runner, the twin) keeps three numbers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numba
import numpy as np
from numpy.typing import NDArray

from imagine.core.contract import ActionSpec
from imagine.core.frames import Pose

PLANE, BODY, FORWARD, WAYPOINT = 0, 1, 2, 3
_CODES = {"plane": PLANE, "body": BODY, "forward": FORWARD, "waypoint": WAYPOINT}
_TURN_GAIN = 2.0  # 1/s: how fast a planned course is turned to; half the error is gone within four ticks of 0.1 s

Axes = Literal["map", "heading"]
Intent = tuple[float, float, float]
BodyVelocity = tuple[float, float, float]
"""Forward and left in m/s, yaw rate in rad/s."""
Parameters = tuple[int, bool, float, float, float, float, float]


def action_parameters(spec: ActionSpec, axes: Axes) -> Parameters:
    """Return what the kernels here need to know of a specification, as the plain numbers that they take."""
    return (
        _CODES[spec.mode], axes == "map", spec.speed_mps, spec.yaw_rate_rps,
        spec.waypoint_range_m, spec.waypoint_braking_mps2, spec.waypoint_response_s,
    )  # fmt: skip


@dataclass(frozen=True)
class Held:
    """A decision that stands: its intent, and for how many ticks more, the present one included."""

    intent: Intent
    ticks_left: int

    def passed(self) -> Held | None:
        """Return it one tick later, None where that ends it."""
        return Held(self.intent, self.ticks_left - 1) if self.ticks_left > 1 else None


def to_intent(action: NDArray[np.float32], spec: ActionSpec, axes: Axes, pose: Pose) -> Intent:
    """Return the intent of an action in [-1, 1] (clipped to it) taken at `pose`, metres and radians in the map."""
    a, b, c = (*map(float, action), 0.0)[:3]
    return _intent(a, b, c, action_parameters(spec, axes), float(pose.x), float(pose.y), float(pose.yaw))


def intended_velocity(intent: Intent, spec: ActionSpec, axes: Axes, pose: Pose) -> BodyVelocity:
    """Return (vx forward, vy left, yaw rate), m/s and rad/s, that an intent asks of a drone at `pose`."""
    return _body_velocity(*intent, action_parameters(spec, axes), float(pose.x), float(pose.y), float(pose.yaw))


def to_body_velocity(action: NDArray[np.float32], spec: ActionSpec, axes: Axes, yaw: float) -> BodyVelocity:
    """Return (vx forward, vy left, yaw rate) in m/s and rad/s of an action in [-1, 1], clipped to it, as it is taken.

    `yaw` is the drone's heading in the map. Later in a decision of several ticks, `intended_velocity` tells.
    """
    here = Pose(0.0, 0.0, float(yaw))
    return intended_velocity(to_intent(action, spec, axes, here), spec, axes, here)


def _intent(a: float, b: float, c: float, parameters: Parameters, x: float, y: float, yaw: float) -> Intent:
    mode, map_axes, _, _, reach, _, _ = parameters
    a, b, c = min(max(a, -1.0), 1.0), min(max(b, -1.0), 1.0), min(max(c, -1.0), 1.0)
    if mode != WAYPOINT:
        return a, b, c
    length = max(1.0, math.sqrt(a * a + b * b))
    dx, dy = a / length * reach, b / length * reach
    if not map_axes:
        cos_yaw, sin_yaw = math.cos(yaw), math.sin(yaw)
        dx, dy = cos_yaw * dx - sin_yaw * dy, sin_yaw * dx + cos_yaw * dy
    return x + dx, y + dy, 0.0


def _body_velocity(
    a: float, b: float, c: float, parameters: Parameters, x: float, y: float, yaw: float
) -> BodyVelocity:
    mode, map_axes, speed, fastest_yaw, _, braking, response = parameters
    if mode == BODY:
        return a * speed, b * speed, c * fastest_yaw
    if mode == FORWARD:
        return max(a, 0.0) * speed, 0.0, b * fastest_yaw
    if mode == WAYPOINT:
        # Stopping from v takes v response + v²/(2 braking) metres; this is that, solved for v (see core.shield).
        dx, dy = a - x, b - y
        distance = math.sqrt(dx * dx + dy * dy)
        stopping = braking * (math.sqrt(response * response + 2.0 * distance / braking) - response)
        share = min(speed, stopping) / max(distance, 1e-9)
        vx, vy = dx * share, dy * share
    else:
        length = max(1.0, math.sqrt(a * a + b * b))
        vx, vy = a / length * speed, b / length * speed
    if map_axes or mode == WAYPOINT:
        cos_yaw, sin_yaw = math.cos(yaw), math.sin(yaw)
        vx, vy = cos_yaw * vx + sin_yaw * vy, -sin_yaw * vx + cos_yaw * vy
    return vx, vy, 0.0


def _action_toward(
    ux: float, uy: float, parameters: Parameters, yaw: float, hold_s: float
) -> tuple[float, float, float]:
    mode, map_axes, speed, fastest_yaw, reach, braking, response = parameters
    if mode == WAYPOINT:
        v = math.sqrt(ux * ux + uy * uy) * speed
        ahead = v * (response + hold_s) + v * v / (2.0 * braking)
        share = min(1.0, ahead / reach) * speed / max(v, 1e-9)
        ux, uy = ux * share, uy * share
    if map_axes and mode in (PLANE, WAYPOINT):
        return ux, uy, 0.0
    cos_yaw, sin_yaw = math.cos(yaw), math.sin(yaw)
    ahead, left = cos_yaw * ux + sin_yaw * uy, -sin_yaw * ux + cos_yaw * uy
    if mode == FORWARD:
        off = math.atan2(left, ahead)
        return max(ahead, 0.0), min(max(_TURN_GAIN * off / fastest_yaw, -1.0), 1.0), 0.0
    return ahead, left, 0.0


intent_kernel = numba.njit(cache=True, nogil=True)(_intent)
"""`(a, b, c, action_parameters, x, y, yaw)` to the intent of a decision; compiled, for batches."""
body_velocity_kernel = numba.njit(cache=True, nogil=True)(_body_velocity)
"""`(*intent, action_parameters, x, y, yaw)` to (vx forward, vy left, yaw rate) of this tick; compiled, for batches."""
action_toward_kernel = numba.njit(cache=True, nogil=True)(_action_toward)
"""`(ux, uy, action_parameters, yaw, hold_s)` to the action that flies along a map-frame vector of length at most 1.

For labels of a planner. `hold_s` is how long the decision stands beyond its first tick: a waypoint is put so much
farther that full speed can be kept. Of three numbers the first `ActionSpec.size` count.
"""
