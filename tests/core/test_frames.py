"""Planar poses form a group, and the conversions to MAVLink's frames undo themselves."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imagine.core.frames import IDENTITY, Pose, compose, inverse, relative, rotate, transform_points, wrap_angle
from imagine.core.ned import swap_enu_ned, swap_flu_frd, swap_yaw

METRES = st.floats(-100.0, 100.0)
ANGLES = st.floats(-50.0, 50.0)
POSES = st.builds(Pose, METRES, METRES, ANGLES)


def assert_same(a: Pose, b: Pose) -> None:
    assert math.dist(a[:2], b[:2]) < 1e-9
    assert abs(wrap_angle(a.yaw - b.yaw)) < 1e-9


@given(ANGLES)
def test_a_wrapped_angle_is_the_same_direction_within_half_a_turn(angle: float) -> None:
    wrapped = wrap_angle(angle)
    assert -math.pi < wrapped <= math.pi
    assert math.cos(wrapped) == pytest.approx(math.cos(angle), abs=1e-9)
    assert math.sin(wrapped) == pytest.approx(math.sin(angle), abs=1e-9)


@pytest.mark.parametrize("turns", [-3, -1, 1, 3])
def test_half_a_turn_wraps_to_plus_pi(turns: int) -> None:
    assert wrap_angle(turns * math.pi) == math.pi


@given(POSES, POSES, POSES)
def test_composition_is_associative(a: Pose, b: Pose, c: Pose) -> None:
    assert_same(compose(compose(a, b), c), compose(a, compose(b, c)))


@given(POSES)
def test_the_identity_changes_nothing_and_the_inverse_undoes(pose: Pose) -> None:
    assert_same(compose(pose, IDENTITY), pose)
    assert_same(compose(IDENTITY, pose), pose)
    assert_same(compose(pose, inverse(pose)), IDENTITY)
    assert_same(compose(inverse(pose), pose), IDENTITY)


@given(POSES, POSES)
def test_relative_poses_lead_back(a: Pose, b: Pose) -> None:
    assert_same(compose(a, relative(a, b)), b)


@given(POSES, METRES, METRES)
def test_points_move_as_poses_do(pose: Pose, x: float, y: float) -> None:
    moved = transform_points(pose, np.array([[x, y]]))[0]
    composed = compose(pose, Pose(x, y, 0.0))
    assert moved == pytest.approx(composed[:2], abs=1e-9)
    turned = rotate(pose.yaw, x, y)
    assert (pose.x + turned[0], pose.y + turned[1]) == pytest.approx(composed[:2], abs=1e-9)


def test_left_of_a_drone_that_looks_north_is_west() -> None:
    assert compose(Pose(5.0, 5.0, math.pi / 2), Pose(0.0, 1.0, 0.0))[:2] == pytest.approx((4.0, 5.0))


@given(METRES, METRES, METRES)
def test_vector_conversions_undo_themselves(x: float, y: float, z: float) -> None:
    assert swap_enu_ned(*swap_enu_ned(x, y, z)) == (x, y, z)
    assert swap_flu_frd(*swap_flu_frd(x, y, z)) == (x, y, z)


@given(ANGLES)
def test_heading_conversion_undoes_itself(yaw: float) -> None:
    assert abs(wrap_angle(swap_yaw(swap_yaw(yaw)) - yaw)) < 1e-9


@pytest.mark.parametrize(
    ("map_yaw", "compass_deg"), [(0.0, 90), (math.pi / 2, 0), (math.pi, -90), (-math.pi / 2, 180), (math.pi / 4, 45)]
)
def test_known_headings(map_yaw: float, compass_deg: float) -> None:
    assert math.degrees(swap_yaw(map_yaw)) == pytest.approx(compass_deg)


def test_known_vectors() -> None:
    east, up = (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)
    assert swap_enu_ned(*east) == (0.0, 1.0, 0.0)
    assert swap_enu_ned(*up) == (0.0, 0.0, -1.0)
    forward, left = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)
    assert swap_flu_frd(*forward) == (1.0, 0.0, 0.0)
    assert swap_flu_frd(*left) == (0.0, -1.0, 0.0)


@given(POSES, METRES, METRES)
def test_velocity_over_ground_is_the_same_by_both_ways(pose: Pose, forward: float, left: float) -> None:
    """FLU turned to ENU, then to NED, equals FRD turned by the compass heading (clockwise, z down)."""
    east, north = rotate(pose.yaw, forward, left)
    f, r, _ = swap_flu_frd(forward, left, 0.0)
    compass = swap_yaw(pose.yaw)
    c, s = math.cos(compass), math.sin(compass)
    assert swap_enu_ned(east, north, 0.0)[:2] == pytest.approx((c * f - s * r, s * f + c * r), abs=1e-9)
