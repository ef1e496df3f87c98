"""The shield: whatever is wanted, a drone with lag and limited acceleration never touches a wall it sees."""

from __future__ import annotations

import math

import numpy as np
import pytest
from flat_rooms import clearance, look, walls_of_box
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from imagine.core.frames import Pose, rotate
from imagine.core.lidar import LidarSpec, Scan
from imagine.core.shield import BACK_OFF_MPS, MARGIN_M, REACTION_S, approach_limit, shield_velocity
from imagine.core.vehicle_limits import VehicleLimits

LIDAR = LidarSpec(beams=180, noise_std=0.0)
LIMITS = VehicleLimits()
TICK_S, SUBSTEPS = 0.1, 5
SEEDS = st.integers(0, 2**32 - 1)


def random_room(rng: np.random.Generator) -> NDArray[np.float64]:
    """Return a 6 x 5 m room with a few boxes, none near the middle."""
    walls = [walls_of_box(0.0, 0.0, 6.0, 5.0)]
    for _ in range(int(rng.integers(1, 6))):
        x, y, w, h = rng.uniform(0.2, 5.0), rng.uniform(0.2, 4.0), *rng.uniform(0.1, 0.9, 2)
        if not (x < 3.5 and x + w > 2.5 and y < 3.0 and y + h > 2.0):
            walls.append(walls_of_box(x, y, x + w, y + h))
    return np.concatenate(walls)


def advance(
    pose: Pose, velocity: NDArray[np.float64], setpoint: tuple[float, float, float], limits: VehicleLimits
) -> tuple[Pose, NDArray[np.float64]]:
    """Fly one tick: velocity follows the body setpoint with the airframe's lag and greatest acceleration."""
    dt = TICK_S / SUBSTEPS
    blend = 1.0 - math.exp(-dt / limits.lag_s) if limits.lag_s > 0 else 1.0
    x, y, yaw = pose
    for _ in range(SUBSTEPS):
        change = (np.array(rotate(yaw, setpoint[0], setpoint[1])) - velocity) * blend
        size = math.hypot(*change)
        if size > limits.acceleration_mps2 * dt:
            change *= limits.acceleration_mps2 * dt / size
        velocity = velocity + change
        x, y, yaw = x + velocity[0] * dt, y + velocity[1] * dt, yaw + setpoint[2] * dt
    return Pose(float(x), float(y), yaw), velocity


def nearest_in_flight(seed: int, limits: VehicleLimits, turning_rps: float) -> float:
    """Fly full speed at random through a random room behind the shield; return the least distance to a wall."""
    rng = np.random.default_rng(seed)
    walls = random_room(rng)
    pose, velocity = Pose(3.0, 2.5, float(rng.uniform(-3, 3))), np.zeros(2)
    wanted = np.zeros(3)
    nearest = math.inf
    for tick in range(150):
        if tick % 12 == 0:  # long enough to arrive
            wanted = np.array([*rotate(float(rng.uniform(-4, 4)), 0.8, 0.0), turning_rps * rng.uniform(-1.0, 1.0)])
        vx, vy = shield_velocity(wanted[0], wanted[1], look(walls, pose, LIDAR), LIDAR, limits)
        pose, velocity = advance(pose, velocity, (vx, vy, float(wanted[2])), limits)
        nearest = min(nearest, clearance(walls, pose.x, pose.y))
    return nearest


@settings(max_examples=10)
@given(SEEDS, st.floats(0.02, 0.4), st.floats(1.5, 4.0))
def test_a_shielded_drone_touches_nothing(seed: int, lag_s: float, acceleration_mps2: float) -> None:
    limits = VehicleLimits(lag_s=lag_s, acceleration_mps2=acceleration_mps2)
    assert nearest_in_flight(seed, limits, 0.0) > limits.radius_m


@settings(max_examples=10)
@given(SEEDS)
def test_nor_does_it_while_it_turns(seed: int) -> None:
    """A body-frame setpoint turns with the drone until the next scan; the margin covers that."""
    assert nearest_in_flight(seed, LIMITS, LIMITS.yaw_rate_rps) > LIMITS.radius_m


@given(st.floats(0.0, 5.0), st.floats(0.02, 0.4), st.floats(1.0, 4.0))
def test_the_limit_is_the_speed_that_stops_at_the_margin(range_m: float, lag_s: float, acceleration: float) -> None:
    v = approach_limit(range_m, 0.08, lag_s, acceleration)
    clear = range_m - 0.08 - MARGIN_M
    if clear <= 0.0:
        assert -BACK_OFF_MPS <= v <= 0.0
    else:
        assert v * (lag_s + REACTION_S) + v * v / (2.0 * 0.7 * acceleration) == pytest.approx(clear, rel=1e-6)


@given(SEEDS, st.floats(-7.0, 7.0))
def test_no_return_is_approached_faster_than_its_limit(seed: int, direction: float) -> None:
    rng = np.random.default_rng(seed)
    ranges = rng.uniform(0.2, 3.0, LIDAR.beams).astype(np.float32)
    ranges[rng.random(LIDAR.beams) < 0.3] = np.inf
    ranges[rng.random(LIDAR.beams) < 0.1] = np.nan
    wx, wy = rotate(direction, 0.8, 0.0)
    vx, vy = shield_velocity(wx, wy, Scan(0.0, ranges), LIDAR, LIMITS)
    approach = vx * np.cos(LIDAR.bearings) + vy * np.sin(LIDAR.bearings)
    for speed, r in zip(approach, ranges, strict=True):
        if np.isfinite(r):
            assert speed <= max(0.0, approach_limit(float(r), LIMITS.radius_m, LIMITS.lag_s, 2.0)) + 1e-6
    assert math.hypot(vx, vy) <= 0.8 + 1e-9


@given(st.floats(-0.57, 0.57), st.floats(-0.56, 0.56), st.sampled_from([1.0, 5.0, math.inf, math.nan]))
def test_motion_with_room_around_is_left_alone(vx: float, vy: float, r: float) -> None:
    scan = Scan(0.0, np.full(LIDAR.beams, r, np.float32))
    assert shield_velocity(vx, vy, scan, LIDAR, LIMITS) == (vx, vy)


def test_flying_along_and_away_from_a_near_wall_is_left_alone() -> None:
    walls = np.array([[-50.0, 0.5, 50.0, 0.5]])
    scan = look(walls, Pose(0.0, 0.0, 0.0), LIDAR)
    for wanted in ((0.8, -0.05), (-0.8, -0.05), (0.0, -0.8)):
        assert shield_velocity(*wanted, scan, LIDAR, LIMITS) == pytest.approx(wanted, abs=1e-9)


def test_a_wall_takes_only_the_motion_toward_it() -> None:
    walls = np.array([[0.4, -50.0, 0.4, 50.0]])
    scan = look(walls, Pose(0.0, 0.0, 0.0), LIDAR)
    vx, vy = shield_velocity(0.6, 0.4, scan, LIDAR, LIMITS)
    assert 0.0 < vx <= approach_limit(0.4, LIMITS.radius_m, LIMITS.lag_s, LIMITS.acceleration_mps2) + 1e-6
    assert vy == pytest.approx(0.4, abs=0.05)


def test_a_wall_inside_the_margin_is_backed_away_from() -> None:
    walls = np.array([[0.12, -50.0, 0.12, 50.0]])
    scan = look(walls, Pose(0.0, 0.0, 0.0), LIDAR)
    vx, _ = shield_velocity(0.0, 0.0, scan, LIDAR, LIMITS)
    assert -BACK_OFF_MPS <= vx < 0.0
