"""Actions: numbers in [-1, 1] become body velocities, along the axes that the observation has."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imagine.core.action import body_velocity_kernel, to_body_velocity
from imagine.core.contract import ActionSpec
from imagine.core.frames import rotate

NUMBERS = st.floats(-1.5, 1.5, width=32)
YAWS = st.floats(-7.0, 7.0)
PLANE, BODY = ActionSpec(), ActionSpec(mode="body", speed_mps=0.6, yaw_rate_rps=2.0)


def act(*numbers: float) -> np.ndarray:
    return np.array(numbers, np.float32)


def test_east_is_ahead_of_a_drone_that_looks_east_and_right_of_one_that_looks_north() -> None:
    assert to_body_velocity(act(1, 0), PLANE, "map", 0.0) == pytest.approx((0.8, 0.0, 0.0))
    assert to_body_velocity(act(1, 0), PLANE, "map", math.pi / 2) == pytest.approx((0.0, -0.8, 0.0))
    assert to_body_velocity(act(1, 0), PLANE, "heading", math.pi / 2) == pytest.approx((0.8, 0.0, 0.0))


@given(NUMBERS, NUMBERS, YAWS)
def test_plane_actions_keep_their_direction_and_the_speed_limit(ax: float, ay: float, yaw: float) -> None:
    vx, vy, rate = to_body_velocity(act(ax, ay), PLANE, "map", yaw)
    cx, cy = (min(max(a, -1.0), 1.0) for a in (ax, ay))
    assert rate == 0.0
    assert math.hypot(vx, vy) == pytest.approx(0.8 * min(1.0, math.hypot(cx, cy)), abs=1e-6)
    mx, my = rotate(yaw, vx, vy)
    assert mx * cy - my * cx == pytest.approx(0.0, abs=1e-6)
    assert mx * cx + my * cy >= -1e-9


@given(NUMBERS, NUMBERS, NUMBERS, YAWS)
def test_body_actions_are_scaled_and_clipped_whatever_the_heading(a: float, b: float, c: float, yaw: float) -> None:
    expected = np.clip([a, b, c], -1.0, 1.0) * [0.6, 0.6, 2.0]
    for axes in ("map", "heading"):
        assert to_body_velocity(act(a, b, c), BODY, axes, yaw) == pytest.approx(tuple(expected), abs=1e-6)


@given(NUMBERS, NUMBERS, NUMBERS, YAWS)
def test_what_is_compiled_for_training_commands_what_flies(a: float, b: float, c: float, yaw: float) -> None:
    for spec, axes in ((PLANE, "map"), (PLANE, "heading"), (BODY, "map")):
        trained = body_velocity_kernel(
            a, b, c, spec.mode == "body", axes == "map", spec.speed_mps, spec.yaw_rate_rps, yaw
        )
        assert trained == pytest.approx(to_body_velocity(act(a, b, c)[: spec.size], spec, axes, yaw), abs=1e-12)


def test_sizes() -> None:
    assert (PLANE.size, BODY.size) == (2, 3)
