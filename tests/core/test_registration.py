"""Two maps find each other by their walls, and say when they could lie otherwise."""

from __future__ import annotations

import math

import numpy as np
import pytest
from flat_rooms import look, walls_of_box
from numpy.typing import NDArray

from imagine.core.evidence import EvidenceMap
from imagine.core.frames import Pose, compose, inverse, relative, wrap_angle
from imagine.core.lidar import LidarSpec
from imagine.core.map_field import Field, field_of, judge
from imagine.core.registration import Search, Within, search

LIDAR = LidarSpec(beams=180, noise_std=0.0)
CAP_M = 4.0
FLAT = np.vstack(
    (walls_of_box(0, 0, 9, 6), [[3.5, 0, 3.5, 2], [3.5, 3.2, 3.5, 6], [6, 2.6, 9, 2.6]], walls_of_box(5, 4.6, 6, 5.2))
)
WEST = [(1.0, 1.0), (2.5, 2.6), (1.2, 4.5), (4.5, 2.6), (4.5, 4.0)]
EAST = [(4.6, 1.2), (5.2, 3.2), (7.5, 4.0), (8.0, 1.2), (4.4, 4.2), (2.6, 2.6)]


def mapped(walls: NDArray[np.float64], places: list[tuple[float, float]], frame: Pose) -> Field:
    """The field of what scans at some places of the flat show, drawn in a frame of its own."""
    evidence = EvidenceMap(1)
    for x, y in places:
        for yaw in (0.0, 0.01):  # twice: a hit and two misses are what a map is taken at its word for
            pose = Pose(x, y, yaw)
            evidence.integrate(compose(inverse(frame), pose), look(walls, pose, LIDAR), LIDAR, CAP_M)
    field = field_of(evidence.layers[1].cells, evidence.origin_cells)
    assert field is not None
    return field


def off(pose: Pose, true: Pose) -> tuple[float, float]:
    return math.hypot(pose.x - true.x, pose.y - true.y), abs(wrap_angle(pose.yaw - true.yaw))


@pytest.mark.parametrize("seed", range(8))
def test_overlapping_maps_find_their_relative_pose(seed: int) -> None:
    x, y, yaw, own_yaw = np.random.default_rng(seed).uniform((-3, -3, -math.pi, -math.pi), (3, 3, math.pi, math.pi))
    frames = Pose(1.0, 1.0, float(own_yaw)), Pose(float(3.0 + x), float(2.0 + y), float(yaw))
    best, *others = search(mapped(FLAT, WEST, frames[0]), mapped(FLAT, EAST, frames[1]))
    shift, turn = off(best.pose, relative(*frames))
    assert shift < 0.1
    assert turn < math.radians(1.0)
    assert best.fit.contradiction < 0.05
    assert all(other.fit.score < 0.75 * best.fit.score for other in others)


def test_how_a_search_is_sliced_makes_no_difference() -> None:
    reference, peer = mapped(FLAT, WEST, Pose(0, 0, 0.3)), mapped(FLAT, EAST, Pose(1, 2, 2.0))
    sliced = Search(reference, peer)
    slices = 0
    while not sliced.advance(7):
        slices += 1
    assert slices > 120 // 7
    assert sliced.found == search(reference, peer)


def test_a_room_alike_from_two_sides_has_two_answers_and_knowing_the_launch_leaves_one() -> None:
    hall = walls_of_box(0, 0, 5, 3)
    places = [(1.0, 1.0), (4.0, 2.0)]
    reference, peer = mapped(hall, places, Pose(1, 1, 0.2)), mapped(hall, places, Pose(4, 2, -1.0))
    best, rival, *_ = search(reference, peer)
    assert rival.fit.score > 0.9 * best.fit.score
    assert abs(abs(wrap_angle(best.pose.yaw - rival.pose.yaw)) - math.pi) < 0.05
    true = relative(Pose(1, 1, 0.2), Pose(4, 2, -1.0))
    bound = Search(reference, peer, Within(true.x, true.y, 1.0))
    while not bound.advance(120):
        pass
    assert bound.found is not None
    assert off(bound.found[0].pose, true)[0] < 0.1
    assert all(other.fit.score < 0.5 * bound.found[0].fit.score for other in bound.found[1:])


def test_a_corridor_is_known_not_to_fix_its_own_direction() -> None:
    corridor = np.array([[-20, 0, 20, 0], [-20, 2, 20, 2]], float)
    field = mapped(corridor, [(x, 1.0) for x in (-2.0, 0.0, 2.0)], Pose(0, 0, 0))
    assert judge(field, field, Pose(0, 0, 0)).hold < 0.1
    room = mapped(walls_of_box(0, 0, 4, 4), [(2, 2)], Pose(0, 0, 0))
    assert judge(room, room, Pose(0, 0, 0)).hold > 0.3


def test_walls_on_clear_space_contradict_and_walls_on_the_unknown_do_not() -> None:
    field = mapped(FLAT, WEST, Pose(0, 0, 0))
    assert judge(field, field, Pose(0, 0, 0)).contradicted == 0
    assert judge(field, field, Pose(1.0, 0.7, 0.0)).contradiction > 0.2
    apart = judge(field, field, Pose(30.0, 0.0, 0.0))
    assert (apart.matched, apart.contradicted, apart.overlap) == (0, 0, 0)


@pytest.mark.parametrize("value", [0, -8])
def test_a_map_without_walls_has_no_field(value: int) -> None:
    assert field_of(np.full((32, 32), value, np.int8), (0, 0)) is None
