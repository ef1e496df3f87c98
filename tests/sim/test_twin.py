"""The twin's physics: nothing passes a wall, limits hold, contacts count, and equal seeds fly equal ways."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from imagine.core.errors import InputError
from imagine.core.frames import Pose
from imagine.core.lidar import LidarSpec
from imagine.core.vehicle_limits import VehicleLimits
from imagine.sim.level import BUILT_IN, Level, load_level
from imagine.sim.twin import TICK_S, Twin

ROOM = load_level("0")
FEW_BEAMS = LidarSpec(beams=16)
LIMITS = VehicleLimits()
SUBSTEP_M = LIMITS.speed_mps * 0.02  # the solver takes notice of what it meets after at most this way into it


def clearance(level: Level, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distance from each point to the nearest edge or post of a level."""
    x0, y0, x1, y1 = level.segments.T[:, None, :]
    px, py = points[:, :1], points[:, 1:]
    dx, dy = x1 - x0, y1 - y0
    t = np.clip(((px - x0) * dx + (py - y0) * dy) / (dx * dx + dy * dy), 0.0, 1.0)
    nearest = np.hypot(px - x0 - t * dx, py - y0 - t * dy).min(axis=1)
    for x, y, radius in level.circles:
        nearest = np.minimum(nearest, np.hypot(points[:, 0] - x, points[:, 1] - y) - radius)
    return np.asarray(nearest)


def alone(pose: Pose, level: Level = ROOM, limits: VehicleLimits = LIMITS) -> Twin:
    twin = Twin([level], 1, FEW_BEAMS, limits)
    twin.set_level(0, level, [pose])
    return twin


def fly(twin: Twin, forward: float, left: float, rate: float, ticks: int) -> None:
    for _ in range(ticks):
        twin.step(np.broadcast_to(np.array([forward, left, rate]), (twin.worlds, twin.drones, 3)).copy())


def wander(twin: Twin, rng: np.random.Generator, ticks: int) -> None:
    """Fly full speed somewhere, another way every second."""
    shape = (twin.worlds, twin.drones)
    for tick in range(ticks):
        if tick % 10 == 0:
            angle, rate = rng.uniform(-math.pi, math.pi, shape), rng.uniform(-3.0, 3.0, shape)
            setpoints = np.stack((0.8 * np.cos(angle), 0.8 * np.sin(angle), rate), axis=-1)
        twin.step(setpoints)


def test_no_drone_is_ever_in_a_wall_or_another_drone() -> None:
    levels = [load_level(name) for name in BUILT_IN]
    twin = Twin(levels, 3, FEW_BEAMS)
    rng = np.random.default_rng(0)
    for _ in range(150):
        wander(twin, rng, 10)
        for world, level in enumerate(levels):
            points = twin.poses[world, :, :2]
            assert level.is_free(points).all()
            assert clearance(level, points).min() > LIMITS.radius_m - SUBSTEP_M
            apart = np.linalg.norm(points[:, None] - points[None], axis=-1)[np.triu_indices(3, 1)]
            assert apart.min() > 2 * LIMITS.radius_m - 2 * SUBSTEP_M
    assert twin.contacts.sum() > 100  # they did run into things


def test_limits_are_obeyed() -> None:
    twin = Twin([load_level("6")], 3, FEW_BEAMS)
    rng = np.random.default_rng(1)
    for _ in range(300):
        before, touched = twin.velocity.copy(), twin.contacts.copy()
        twin.step(rng.uniform(-50.0, 50.0, (1, 3, 3)))
        assert np.hypot(twin.velocity[..., 0], twin.velocity[..., 1]).max() <= LIMITS.speed_mps + 1e-9
        assert np.abs(twin.velocity[..., 2]).max() <= LIMITS.yaw_rate_rps + 1e-9
        change = np.hypot(*np.moveaxis(twin.velocity[..., :2] - before[..., :2], -1, 0))
        apart = np.linalg.norm(twin.poses[0, :, None, :2] - twin.poses[0, None, :, :2], axis=-1) + 9.0 * np.eye(3)
        free = (twin.contacts == touched) & (clearance(twin.levels[0], twin.poses[0, :, :2]) > 0.2)
        free &= apart.min(axis=1) > 0.4  # who leans on another all along begins no contact
        assert change[free].max(initial=0.0) <= LIMITS.acceleration_mps2 * TICK_S + 1e-9
        assert (np.abs(twin.poses[..., 2]) <= math.pi).all()


def test_velocity_follows_with_the_lag_and_acceleration_of_the_airframe() -> None:
    gentle = alone(Pose(1.0, 3.0, 0.0), limits=VehicleLimits(lag_s=0.3))
    fly(gentle, 0.5, 0.0, 0.0, 3)  # 0.5 m/s over 0.3 s asks for less than 2 m/s²: a plain first-order lag
    assert gentle.velocity[0, 0, 0] == pytest.approx(0.5 * (1 - math.exp(-1.0)), rel=1e-6)
    hard = alone(Pose(1.0, 3.0, 0.0), limits=VehicleLimits(lag_s=0.0, acceleration_mps2=1.0))
    fly(hard, 0.8, 0.0, 0.0, 5)
    assert hard.velocity[0, 0, 0] == pytest.approx(0.5, rel=1e-6)


def test_setpoints_are_in_the_body_frame_and_yaw_turns_left() -> None:
    twin = alone(Pose(3.0, 1.0, math.pi / 2))
    fly(twin, 0.8, 0.0, 0.0, 20)
    assert twin.poses[0, 0] == pytest.approx([3.0, 1.0 + 0.8 * 2.0 - 0.8 * 0.2, math.pi / 2], abs=0.1)
    assert twin.velocity[0, 0, :2] == pytest.approx([0.0, 0.8], abs=0.01)
    fly(twin, 0.0, 0.0, 1.0, 10)
    assert twin.velocity[0, 0, 2] == pytest.approx(1.0, abs=0.01)
    assert twin.poses[0, 0, 2] > math.pi / 2 + 0.7


def test_running_into_a_wall_is_one_contact_and_stops_there() -> None:
    twin = alone(Pose(5.0, 3.0, 0.0))
    fly(twin, 0.8, 0.0, 0.0, 40)
    assert twin.contacts[0, 0] == 1
    assert twin.poses[0, 0, 0] == pytest.approx(6.0 - LIMITS.radius_m, abs=0.003)
    assert twin.poses[0, 0, 1] == pytest.approx(3.0, abs=1e-6)
    fly(twin, -0.8, 0.0, 0.0, 10)
    fly(twin, 0.8, 0.0, 0.0, 30)
    assert twin.contacts[0, 0] == 2


def test_a_wall_met_at_an_angle_is_slid_along() -> None:
    twin = alone(Pose(5.0, 1.0, math.pi / 4))
    fly(twin, 0.8, 0.0, 0.0, 50)
    assert twin.poses[0, 0, 0] == pytest.approx(6.0 - LIMITS.radius_m, abs=0.003)
    assert twin.poses[0, 0, 1] > 2.5
    assert twin.contacts[0, 0] == 1


def test_two_drones_that_meet_both_count_it() -> None:
    twin = Twin([ROOM], 2, FEW_BEAMS)
    twin.set_level(0, ROOM, [Pose(2.0, 3.0, 0.0), Pose(4.0, 3.0, math.pi)])
    fly(twin, 0.8, 0.0, 0.0, 30)
    assert twin.contacts[0].tolist() == [1, 1]
    assert twin.poses[0, 1, 0] - twin.poses[0, 0, 0] == pytest.approx(2 * LIMITS.radius_m, abs=0.003)


def test_a_new_level_starts_at_rest_with_no_contacts() -> None:
    twin = alone(Pose(5.5, 3.0, 0.0))
    fly(twin, 0.8, 0.0, 1.0, 20)
    assert twin.contacts[0, 0] == 1
    level = load_level("4")
    twin.set_level(0, level, [Pose(2.0, 2.0, 1.0)])
    assert twin.poses[0, 0].tolist() == [2.0, 2.0, 1.0]
    assert not twin.velocity.any()
    assert not twin.contacts.any()
    fly(twin, 0.0, 0.0, 0.0, 5)
    assert twin.poses[0, 0] == pytest.approx([2.0, 2.0, 1.0], abs=1e-9)
    fly(twin, 0.8, 0.0, 0.0, 20)  # past where the old room's wall stood, had it stayed
    assert twin.contacts[0, 0] == 0
    with pytest.raises(InputError, match="2 launch poses for 1 drones"):
        twin.set_level(0, level, level.launch_poses(2))


def test_the_same_seed_flies_the_same_way_and_sees_the_same() -> None:
    def flown(seed: int) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
        twin = Twin([load_level("3"), load_level("5")], 2, seed=seed)
        wander(twin, np.random.default_rng(0), 60)
        return twin.poses.copy(), twin.scan()

    first, again, other = flown(1), flown(1), flown(2)
    np.testing.assert_array_equal(first[0], again[0])
    np.testing.assert_array_equal(first[1], again[1])
    np.testing.assert_array_equal(first[0], other[0])  # the seed is the sensors'
    assert not np.array_equal(first[1], other[1])


def test_a_worlds_flight_does_not_depend_on_the_worlds_beside_it() -> None:
    level = load_level("3")
    many, one = Twin([load_level("5")] * 2 + [level], 2, FEW_BEAMS), Twin([level], 2, FEW_BEAMS)
    rng = np.random.default_rng(3)
    for _ in range(40):
        setpoints = rng.uniform(-1.0, 1.0, (3, 2, 3))
        many.step(setpoints)
        one.step(setpoints[2:])
    np.testing.assert_allclose(many.poses[2], one.poses[0], atol=1e-6)


@pytest.mark.parametrize("wrong", [math.nan, math.inf])
def test_a_setpoint_that_is_not_finite_is_refused_by_name(wrong: float) -> None:
    twin = Twin([ROOM, load_level("4")], 2, FEW_BEAMS)
    setpoints = np.zeros((2, 2, 3))
    setpoints[1, 0, 1] = wrong
    before = twin.poses.copy()
    with pytest.raises(InputError, match=r"level 4: setpoint .* of drone 0 in world 1, at \(.*\), is not finite"):
        twin.step(setpoints)
    np.testing.assert_array_equal(twin.poses, before)


def test_a_twin_needs_worlds_and_drones() -> None:
    with pytest.raises(InputError, match="at least one world"):
        Twin([], 3)
    with pytest.raises(InputError, match="at least one world and one drone"):
        Twin([ROOM], 0)


@pytest.mark.parametrize("seed", [0, 2**31, 2**63, 10**30])
def test_any_seed_gives_noise(seed: int) -> None:
    scan = Twin([ROOM], 1, FEW_BEAMS, seed=seed).scan()
    assert np.isfinite(scan).all()


def test_a_full_row_of_worlds_stays_in_its_rooms() -> None:
    twin = Twin([ROOM] * 40, 1, FEW_BEAMS)  # more than lie side by side in the space
    fly(twin, 0.8, 0.1, 0.0, 30)
    np.testing.assert_allclose(twin.poses, np.broadcast_to(twin.poses[0], twin.poses.shape), atol=1e-6)
    assert ROOM.is_free(twin.poses[:, 0, :2]).all()
