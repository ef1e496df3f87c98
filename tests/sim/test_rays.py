"""LiDAR rays against a slow exact reference: in every level, at corners, along axes, at walls, in partial views."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from ray_reference import furthest_error, reference

from imagine.core.lidar import LidarSpec
from imagine.sim.level import BUILT_IN, Level, load_level, mirrored
from imagine.sim.rays import angle_of, cast_rays
from imagine.sim.sensing import Sensing
from imagine.sim.workers import Workers

SEEDS = st.integers(0, 2**32 - 1)
NO_WALLS, NO_POSTS = np.empty((0, 4)), np.empty((0, 3))
LEVELS = {name: load_level(name) for name in BUILT_IN}
RAYS = 10_000


def sense(
    level: Level, poses: NDArray[np.float64], spec: LidarSpec, reach_m: float | None = None
) -> NDArray[np.float64]:
    """Return noiseless ranges `[n, beams]` from poses `[n, 3]`, as the twin finds them."""
    sensing = Sensing(1, len(poses), spec, 0, Workers(1))
    sensing.set_level(0, level)
    return sensing.scan(poses[None], np.zeros((1, len(poses), 3)), 0.0, 0, reach_m=reach_m)[0].astype(np.float64)


def expected(level: Level, poses: NDArray[np.float64], spec: LidarSpec, range_max: float) -> NDArray[np.float64]:
    bearings = poses[:, 2, None] + spec.bearings
    places = np.repeat(poses[:, :2], spec.beams, axis=0)
    ranges = reference(level.segments, level.circles, places, bearings.ravel(), range_max)
    return ranges.reshape(len(poses), spec.beams)


def free_poses(level: Level, count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    low, high = level.outline.min(axis=0), level.outline.max(axis=0)
    places = rng.uniform(low, high, (4 * count, 2))
    places = places[level.is_free(places)][:count]
    assert len(places) == count
    return np.column_stack((places, rng.uniform(-20.0, 20.0, count)))


def ideal(beams: int, **rest: float) -> LidarSpec:
    return LidarSpec(beams=beams, noise_std=0.0, range_min=0.0, **rest)


@pytest.mark.parametrize("reach_m", [None, 4.0])
@pytest.mark.parametrize("name", BUILT_IN)
def test_ten_thousand_rays_in_every_level_are_the_references(name: str, reach_m: float | None) -> None:
    level, spec = LEVELS[name], ideal(4)
    poses = free_poses(level, RAYS // spec.beams, np.random.default_rng(int(name)))
    found = sense(level, poses, spec, reach_m)
    assert np.isfinite(found).mean() > 0.5
    assert furthest_error(found, expected(level, poses, spec, reach_m or spec.range_max)) <= 0.001


@pytest.mark.parametrize("name", BUILT_IN)
def test_whole_scans_are_the_references_in_mirrored_levels_too(name: str) -> None:
    rng, spec = np.random.default_rng(7), ideal(360)
    for swap, flip_x, flip_y in ((True, False, False), (False, True, False), (True, True, True)):
        level = mirrored(LEVELS[name], swap, flip_x, flip_y)
        poses = free_poses(level, 12, rng)
        assert furthest_error(sense(level, poses, spec), expected(level, poses, spec, spec.range_max)) <= 0.001


@pytest.mark.parametrize("name", BUILT_IN)
def test_rays_right_at_a_corner_meet_it_or_pass_it_but_never_slip_in(name: str) -> None:
    """A ray to a corner may see either side of it, as the reference does a hair to the left or right."""
    level, rng = LEVELS[name], np.random.default_rng(11)
    corners = level.segments[:, :2]
    for x, y, _ in free_poses(level, 6, rng):
        bearings = np.arctan2(corners[:, 1] - y, corners[:, 0] - x)
        found = sense(level, np.column_stack((np.full(len(corners), x), np.full(len(corners), y), bearings)), ideal(1))
        places = np.tile((x, y), (len(corners), 1))
        hair = np.stack([reference(level.segments, level.circles, places, bearings + d, 12.0) for d in (-1e-8, 1e-8)])
        low, high = hair.min(axis=0), hair.max(axis=0)
        assert ((found[:, 0] >= low - 0.001) & (found[:, 0] <= high + 0.001)).all()


@pytest.mark.parametrize("name", BUILT_IN)
def test_rays_along_the_axes_from_places_in_line_with_walls(name: str) -> None:
    """Places on a lattice of 5 cm lie exactly on the lines of many walls, which they see edge-on."""
    level, rng = LEVELS[name], np.random.default_rng(12)
    cells = np.round(free_poses(level, 400, rng)[:, :2] / 0.05) * 0.05
    cells = cells[level.is_free(cells, 1e-6)]
    poses = np.column_stack((cells, rng.integers(-4, 5, len(cells)) * (math.pi / 2.0)))
    found = sense(level, poses, ideal(4))
    # an edge in line with the ray is met at its end or not at all: the reference a hair to each side tells
    bearings = (poses[:, 2, None] + ideal(4).bearings).ravel()
    places = np.repeat(cells, 4, axis=0)
    hair = [reference(level.segments, level.circles, places, bearings + d, 12.0) for d in (-1e-9, 0.0, 1e-9)]
    low, high = np.min(hair, axis=0), np.max(hair, axis=0)
    assert (found.ravel() >= low - 0.001).all()
    assert (found.ravel() <= high + 0.001).all()


@pytest.mark.parametrize("gap_m", [0.0, 1e-15, 1e-9, 1e-8, 2e-7, 1e-5, 1e-3])
def test_a_sensor_that_touches_a_wall_does_not_see_through_it(gap_m: float) -> None:
    level, spec = LEVELS["1"], ideal(360)
    box = level.polygons[0]
    for a, b in zip(box, np.roll(box, -1, axis=0), strict=True):
        outward = np.array([b[1] - a[1], a[0] - b[0]]) / math.dist(a, b)
        for share in (0.2, 0.5, 0.77):
            place = a + share * (b - a) + gap_m * outward
            away = np.array([place + 1e-4 * outward])
            if not level.is_free(away)[0]:
                continue
            poses = np.array([[*place, 0.3]])
            found, wall_side = sense(level, poses, spec)[0], math.atan2(-outward[1], -outward[0])
            into = np.cos(spec.bearings + 0.3 - wall_side) > 0.1
            lengths = gap_m / np.cos(spec.bearings + 0.3 - wall_side)
            np.testing.assert_allclose(found[into], lengths[into], atol=2e-4)
            out = np.cos(spec.bearings + 0.3 - wall_side) < -0.1
            free = expected(level, np.array([[*away[0], 0.3]]), spec, 12.0)[0]
            assert np.median(np.abs(found[out] - free[out])) < 0.002


def test_a_sensor_on_a_corner_sees_nothing_beyond_the_walls() -> None:
    level, spec = LEVELS["0"], ideal(360)
    found = sense(level, np.array([[0.0, 0.0, 0.0]]), spec)[0]
    assert (found[91:360] < 1e-3).all()
    np.testing.assert_allclose(found[1:90], expected(level, np.array([[1e-9, 1e-9, 0.0]]), spec, 12.0)[0, 1:90])


def cast(
    segments: NDArray[np.float64], circles: NDArray[np.float64], x: float, y: float, heading: float, spec: LidarSpec
) -> NDArray[np.float64]:
    ranges = np.empty(spec.beams)
    cast_rays(ranges, segments, circles, x, y, heading + spec.start, spec.increment, spec.range_max)
    return ranges


@given(SEEDS, st.integers(1, 200), st.floats(0.2, 2 * math.pi), st.floats(-7, 7), st.floats(-20, 20))
def test_any_field_of_view_among_random_walls_and_posts(
    seed: int, beams: int, fov: float, start: float, heading: float
) -> None:
    rng = np.random.default_rng(seed)
    walls = rng.uniform(-5.0, 5.0, (rng.integers(0, 9), 4))
    count = int(rng.integers(0, 6))
    posts = np.column_stack((rng.uniform(-5.0, 5.0, (count, 2)), rng.uniform(0.05, 0.6, count)))
    posts = posts[np.hypot(posts[:, 0], posts[:, 1]) > posts[:, 2]]
    spec = LidarSpec(beams=beams, fov=fov, start=start, range_max=4.0)
    right = reference(walls, posts, np.zeros((beams, 2)), spec.bearings + heading, spec.range_max)
    np.testing.assert_allclose(cast(walls, posts, 0.0, 0.0, heading, spec), right, rtol=1e-9)


@pytest.mark.parametrize("heading", [0.0, math.pi / 2, math.pi, -math.pi / 2, 2 * math.pi, 100.0])
def test_a_drone_in_the_middle_of_a_room_sees_all_corners(heading: float) -> None:
    """Beams that point right into a corner, where two walls meet, hit one of them."""
    room = LEVELS["0"]
    spec = LidarSpec(beams=8)
    ranges = cast(room.segments, room.circles, 3.0, 3.0, heading, spec)
    assert np.isfinite(ranges).all()
    if heading != 100.0:
        np.testing.assert_allclose(ranges, [3.0, 3.0 * math.sqrt(2)] * 4, rtol=1e-9)


def test_a_known_post_and_nothing_behind_the_sensor() -> None:
    post = np.array([[2.0, 0.0, 0.5]])
    assert cast(NO_WALLS, post, 0.0, 0.0, 0.0, LidarSpec(beams=4)).tolist() == [1.5, math.inf, math.inf, math.inf]
    seen = cast(NO_WALLS, post, 4.0, 0.0, 0.0, LidarSpec(beams=4))
    assert seen[2] == pytest.approx(1.5)
    assert np.isinf(seen[[0, 1, 3]]).all()


def test_what_lies_past_the_reach_gives_no_return() -> None:
    wall = np.array([[3.0, -9.0, 3.0, 9.0]])
    ranges = cast(wall, NO_POSTS, 0.0, 0.0, 0.0, LidarSpec(beams=360, range_max=4.0))
    assert ranges[0] == pytest.approx(3.0)
    assert np.isfinite(ranges).sum() == 2 * math.floor(math.degrees(math.acos(0.75))) + 1


@given(st.floats(-1e6, 1e6), st.floats(-1e6, 1e6))
def test_angles_are_those_of_the_arc_tangent(x: float, y: float) -> None:
    if max(abs(x), abs(y)) < 1e-6:
        return
    off = angle_of(x, y) - math.atan2(y, x)
    assert abs(math.remainder(off, 2.0 * math.pi)) < 2e-8
