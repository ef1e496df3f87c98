"""The frontier planner explores small closed rooms to the end, and then says that nothing is left."""

from __future__ import annotations

import math

import numpy as np
import pytest
from flat_rooms import clearance, look, walls_of_box
from numpy.typing import NDArray

from imagine.core.evidence import EvidenceMap
from imagine.core.frames import Pose
from imagine.core.frontier import FrontierField, frontier_field, own_distance
from imagine.core.lidar import LidarSpec, Scan
from imagine.core.planner import plan_velocity, wall_repulsion
from imagine.core.raster import CELL

LIDAR = LidarSpec(beams=360, range_max=12.0, noise_std=0.0)
CAP_M = 4.0
TICK_S = 0.1


def two_rooms() -> NDArray[np.float64]:
    """Return two rooms, 9.02 x 4.02 m together, joined by a door of 1.2 m in a wall 0.1 m thick, and a cupboard."""
    return np.concatenate(
        [
            walls_of_box(-0.01, -0.01, 9.01, 4.01),
            walls_of_box(4.5, -0.01, 4.6, 2.4),
            walls_of_box(4.5, 3.6, 4.6, 4.01),
            walls_of_box(7.0, 1.2, 7.8, 1.9),
        ]
    )


def explore(walls: NDArray[np.float64], start: Pose, longest: int) -> tuple[EvidenceMap, Pose, int, float]:
    """Fly the planner's velocity until it has nothing to propose; return map, pose, ticks and least clearance."""
    evidence, pose, nearest = EvidenceMap(1), start, math.inf
    for tick in range(longest):
        scan = look(walls, pose, LIDAR)
        evidence.integrate(pose, scan, LIDAR, CAP_M)
        field = frontier_field(evidence.belief())
        velocity = plan_velocity(field, evidence.origin_cells, pose, scan, LIDAR, 0.8)
        assert (velocity is None) == (math.isinf(own_distance(field, evidence.origin_cells, pose.x, pose.y)))
        if velocity is None:
            return evidence, pose, tick, nearest
        assert math.hypot(*velocity) <= 0.8 + 1e-9
        pose = Pose(pose.x + TICK_S * velocity[0], pose.y + TICK_S * velocity[1], pose.yaw)
        nearest = min(nearest, clearance(walls, pose.x, pose.y))
    raise AssertionError(f"still exploring after {longest} ticks, at {pose}")


@pytest.mark.parametrize("yaw", [0.0, 2.5])
def test_it_explores_all_rooms_and_then_stops(yaw: float) -> None:
    walls = two_rooms()
    evidence, _, ticks, nearest = explore(walls, Pose(0.8, 0.8, yaw), longest=300)
    assert ticks > 30
    assert nearest > 0.08
    column0, row0 = evidence.origin_cells
    belief = evidence.belief()
    x = np.arange(0.25, 8.8, CELL)
    y = np.arange(0.25, 3.8, CELL)
    known = belief[np.ix_(np.floor(y / CELL).astype(int) - row0, np.floor(x / CELL).astype(int) - column0)] != 0
    cupboard = (x > 6.9) & (x < 7.9), (y > 1.1) & (y < 2.0)
    known[np.ix_(cupboard[1], cupboard[0])] = True
    assert known.mean() > 0.99


def test_a_closed_room_seen_at_once_leaves_nothing() -> None:
    walls = walls_of_box(-0.01, -0.01, 3.01, 3.01)
    _, _, ticks, _ = explore(walls, Pose(1.5, 1.5, 0.0), longest=20)
    assert ticks < 20


def test_it_follows_the_nearest_of_two_ways_out() -> None:
    """In a corridor closed by nothing at both ends, the drone heads for the nearer end, whatever its heading."""
    belief = np.zeros((20, 100), np.int8)
    belief[4:16, :] = -8
    belief[[2, 3, 16, 17], :] = 8
    field = frontier_field(belief)
    empty = Scan(0.0, np.full(360, np.inf, np.float32))
    for x, sign in ((2.0, -1.0), (8.0, 1.0)):
        for yaw in (0.0, 2.0):
            velocity = plan_velocity(field, (0, 0), Pose(x, 1.0, yaw), empty, LIDAR, 0.8)
            assert velocity is not None
            assert velocity[0] * sign == pytest.approx(0.8, abs=0.05)


def test_on_the_frontier_it_flies_on_into_the_unknown() -> None:
    belief = np.zeros((20, 20), np.int8)
    belief[:, :10] = -8
    field = frontier_field(belief)
    empty = Scan(0.0, np.full(360, np.inf, np.float32))
    velocity = plan_velocity(field, (0, 0), Pose(0.9, 1.1, 0.0), empty, LIDAR, 0.8)
    assert velocity == pytest.approx((0.8, 0.0), abs=0.1)


def test_the_map_grids_place_makes_no_difference() -> None:
    rng = np.random.default_rng(2)
    belief = rng.choice(np.array([0, -5, 5], np.int8), (40, 40), p=[0.1, 0.89, 0.01])
    empty = Scan(0.0, np.full(360, np.inf, np.float32))
    field = frontier_field(belief)
    here = plan_velocity(field, (0, 0), Pose(2.05, 1.95, 0.4), empty, LIDAR, 0.8)
    there = plan_velocity(field, (-64, 32), Pose(2.05 - 6.4, 1.95 + 3.2, 0.4), empty, LIDAR, 0.8)
    assert here is not None
    assert there == pytest.approx(here, abs=1e-9)


def test_far_outside_its_map_it_proposes_nothing() -> None:
    field = FrontierField(np.zeros((9, 9), np.int16), np.ones((9, 9), np.uint8), np.zeros((9, 9), np.uint8))
    empty = Scan(0.0, np.full(360, np.inf, np.float32))
    assert plan_velocity(field, (0, 0), Pose(90.0, -90.0, 0.0), empty, LIDAR, 0.8) is None


@pytest.mark.parametrize("yaw", [0.0, 1.3, -2.0])
def test_walls_push_away_the_harder_the_nearer(yaw: float) -> None:
    def push(distance: float) -> tuple[float, float]:
        scan = look(np.array([[distance, -50.0, distance, 50.0]]), Pose(0.0, 0.0, yaw), LIDAR)
        return wall_repulsion(scan.ranges, LIDAR.range_min, LIDAR.start, LIDAR.increment, yaw)

    assert push(0.5) == (0.0, 0.0)
    assert push(0.3)[0] < 0.0
    assert push(0.1)[0] < push(0.3)[0]
    assert push(0.1)[1] == pytest.approx(0.0, abs=0.01)
    assert math.hypot(*push(0.06)) <= 1.0
