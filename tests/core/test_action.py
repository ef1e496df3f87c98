"""Actions: numbers in [-1, 1] become body velocities, along the axes that the observation has."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imagine.core.action import (
    Axes,
    Held,
    action_parameters,
    action_toward_kernel,
    body_velocity_kernel,
    intended_velocity,
    intent_kernel,
    to_body_velocity,
    to_intent,
)
from imagine.core.contract import ActionSpec
from imagine.core.frames import Pose, rotate

NUMBERS = st.floats(-1.5, 1.5, width=32)
YAWS = st.floats(-7.0, 7.0)
METRES = st.floats(-5.0, 5.0)
PLANE, BODY = ActionSpec(), ActionSpec(mode="body", speed_mps=0.6, yaw_rate_rps=2.0)
FORWARD = ActionSpec(mode="forward", speed_mps=0.6, yaw_rate_rps=2.0)
WAYPOINT = ActionSpec(mode="waypoint", waypoint_range_m=3.0)
ALL = (PLANE, BODY, FORWARD, WAYPOINT)


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


@given(NUMBERS, NUMBERS, YAWS)
def test_forward_flies_ahead_alone_and_turns_on_the_spot_for_negative_speeds(a: float, b: float, yaw: float) -> None:
    for axes in ("map", "heading"):
        vx, vy, rate = to_body_velocity(act(a, b), FORWARD, axes, yaw)
        assert vx == pytest.approx(0.6 * min(max(a, 0.0), 1.0))
        assert vy == 0.0
        assert rate == pytest.approx(2.0 * min(max(b, -1.0), 1.0))


@given(NUMBERS, NUMBERS, METRES, METRES, YAWS, st.sampled_from(["map", "heading"]))
def test_a_waypoint_lies_within_reach_along_the_axes(
    a: float, b: float, x: float, y: float, yaw: float, axes: Axes
) -> None:
    px, py, _ = to_intent(act(a, b), WAYPOINT, axes, Pose(x, y, yaw))
    dx, dy = (px - x, py - y) if axes == "map" else rotate(-yaw, px - x, py - y)
    ca, cb = (min(max(number, -1.0), 1.0) for number in (a, b))
    assert math.hypot(dx, dy) == pytest.approx(3.0 * min(1.0, math.hypot(ca, cb)), abs=1e-6)
    assert dx * cb - dy * ca == pytest.approx(0.0, abs=1e-6)
    assert dx * ca + dy * cb >= -1e-9


@given(METRES, METRES, METRES, METRES, YAWS)
def test_a_waypoint_is_flown_to_straight_and_no_faster_than_it_can_be_stopped_at(
    px: float, py: float, x: float, y: float, yaw: float
) -> None:
    vx, vy, rate = intended_velocity((px, py, 0.0), WAYPOINT, "heading", Pose(x, y, yaw))
    speed, distance = math.hypot(vx, vy), math.hypot(px - x, py - y)
    assert rate == 0.0
    assert speed <= 0.8 + 1e-9
    assert speed * 0.4 + speed * speed / 2.0 <= distance + 1e-9  # response, and braking with 1 m/s²
    assert speed == pytest.approx(0.8) or speed * 0.4 + speed * speed / 2.0 == pytest.approx(distance, abs=1e-6)
    mx, my = rotate(yaw, vx, vy)
    assert mx * (py - y) - my * (px - x) == pytest.approx(0.0, abs=1e-6)


def test_a_drone_stops_at_its_waypoint() -> None:
    """Flown with the twin's lag of 0.15 s and 2 m/s², commanded ten times a second."""
    x, velocity, farthest = 0.0, 0.0, 0.0
    for tick in range(60):
        wanted, _, _ = intended_velocity((1.5, 0.0, 0.0), WAYPOINT, "map", Pose(x, 0.0, 0.0))
        for _ in range(5):
            change = (wanted - velocity) * (1.0 - math.exp(-0.02 / 0.15))
            velocity += min(max(change, -0.04), 0.04)
            x += velocity * 0.02
        farthest = max(farthest, x)
        if tick == 12:
            assert velocity > 0.75  # far from the point it flies as fast as it may
    assert farthest < 1.52
    assert x == pytest.approx(1.5, abs=0.02)
    assert velocity == pytest.approx(0.0, abs=0.01)


def test_a_waypoint_stays_in_the_map_while_its_decision_stands() -> None:
    intent = to_intent(act(0.5, 0.0), WAYPOINT, "heading", Pose(1.0, 1.0, math.pi / 2))
    assert intent == pytest.approx((1.0, 2.5, 0.0))
    vx, vy, _ = intended_velocity(intent, WAYPOINT, "heading", Pose(0.0, 2.5, 0.0))  # moved and turned since
    assert (vx > 0.5, vy) == (True, pytest.approx(0.0, abs=1e-9))
    assert math.hypot(*intended_velocity(intent, WAYPOINT, "heading", Pose(1.0, 2.5, 0.3))[:2]) < 1e-6


def test_a_decision_stands_for_its_ticks() -> None:
    held: Held | None = Held((1.0, 0.0, 0.0), 3)
    passed = 0
    while held is not None:
        held, passed = held.passed(), passed + 1
    assert passed == 3


@given(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), YAWS, st.sampled_from(["map", "heading"]), st.sampled_from(ALL))
def test_the_numbers_for_a_direction_fly_there(ux: float, uy: float, yaw: float, axes: Axes, spec: ActionSpec) -> None:
    """What a planner would do becomes an action that does it: the labels of imitation."""
    length = max(1.0, math.hypot(ux, uy))
    ux, uy = ux / length, uy / length
    numbers = action_toward_kernel(ux, uy, action_parameters(spec, axes), yaw, 0.0)
    assert max(map(abs, numbers)) <= 1.0 + 1e-9
    vx, vy, rate = to_body_velocity(np.array(numbers[: spec.size]), spec, axes, yaw)
    wanted = spec.speed_mps * ux, spec.speed_mps * uy
    if spec.mode == "forward":  # what lies aside is turned to
        ahead, left = rotate(-yaw, *wanted)
        assert vx == pytest.approx(max(ahead, 0.0), abs=1e-6)
        assert rate * left >= -1e-9
    else:
        assert (*rotate(yaw, vx, vy), rate) == pytest.approx((*wanted, 0.0), abs=1e-6)


def test_a_planned_waypoint_is_far_enough_to_keep_the_speed_while_it_stands() -> None:
    parameters = action_parameters(WAYPOINT, "map")
    a, _, _ = action_toward_kernel(1.0, 0.0, parameters, 0.0, 0.5)
    target = to_intent(act(a, 0.0), WAYPOINT, "map", Pose(0.0, 0.0, 0.0))
    assert intended_velocity(target, WAYPOINT, "map", Pose(0.4, 0.0, 0.0))[0] == pytest.approx(0.8)
    assert intended_velocity(target, WAYPOINT, "map", Pose(0.45, 0.0, 0.0))[0] < 0.8


@given(NUMBERS, NUMBERS, NUMBERS, METRES, METRES, YAWS, st.sampled_from(["map", "heading"]), st.sampled_from(ALL))
def test_what_is_compiled_for_training_commands_what_flies(
    a: float, b: float, c: float, x: float, y: float, yaw: float, axes: Axes, spec: ActionSpec
) -> None:
    parameters, pose = action_parameters(spec, axes), Pose(x, y, yaw)
    numbers = act(a, b, c)[: spec.size]
    intent = intent_kernel(a, b, c if spec.size == 3 else 0.0, parameters, x, y, yaw)
    assert intent == to_intent(numbers, spec, axes, pose)
    later = Pose(x + 0.1, y, yaw + 0.2)
    trained = body_velocity_kernel(*intent, parameters, *later)
    assert trained == pytest.approx(intended_velocity(intent, spec, axes, later), abs=1e-12)


def test_sizes_and_turning() -> None:
    assert [spec.size for spec in ALL] == [2, 3, 2, 2]
    assert [spec.turns for spec in ALL] == [False, True, True, False]
