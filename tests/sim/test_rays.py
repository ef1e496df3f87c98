"""LiDAR rays against a slow exact reference, on every level, for partial fields of view and round posts."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from imagine.core.lidar import LidarSpec
from imagine.sim.level import BUILT_IN, load_level
from imagine.sim.rays import add_noise, cast_rays
from imagine.sim.twin import Twin

SEEDS = st.integers(0, 2**32 - 1)
NO_WALLS, NO_POSTS = np.empty((0, 4)), np.empty((0, 3))


def reference(
    segments: NDArray[np.float64],
    circles: NDArray[np.float64],
    x: float,
    y: float,
    bearings: NDArray[np.float64],
    range_max: float,
) -> NDArray[np.float64]:
    """Every beam against every obstacle."""
    ux, uy = np.cos(bearings)[:, None], np.sin(bearings)[:, None]
    ax, ay = segments[:, 0] - x, segments[:, 1] - y
    ex, ey = segments[:, 2] - segments[:, 0], segments[:, 3] - segments[:, 1]
    facing = ux * ey - uy * ex
    with np.errstate(divide="ignore", invalid="ignore"):
        along, share = (ax * ey - ay * ex) / facing, (ax * uy - ay * ux) / facing
        walls = np.where((along >= 0) & (share >= -1e-9) & (share <= 1 + 1e-9), along, np.inf)
        cx, cy, radius = (circles - [x, y, 0.0]).T
        middle = ux * cx + uy * cy
        root = radius**2 - (cx**2 + cy**2 - middle**2)
        near = middle - np.sqrt(root)
        posts = np.where((root >= 0) & (near >= 0), near, np.inf)
    nearest = np.concatenate((walls, posts, np.full((len(bearings), 1), np.inf)), axis=1).min(axis=1)
    return np.where(nearest <= range_max, nearest, np.inf)


def cast(
    segments: NDArray[np.float64], circles: NDArray[np.float64], x: float, y: float, heading: float, spec: LidarSpec
) -> NDArray[np.float64]:
    ranges = np.empty(spec.beams)
    cast_rays(ranges, segments, circles, x, y, heading + spec.start, spec.increment, spec.range_max)
    return ranges


@pytest.mark.parametrize("name", BUILT_IN)
def test_rays_in_every_level_are_the_references(name: str) -> None:
    level = load_level(name)
    rng = np.random.default_rng(int(name))
    low, high = level.outline.min(axis=0), level.outline.max(axis=0)
    spec = LidarSpec(beams=360, range_max=6.0)
    for x, y in rng.uniform(low + 0.05, high - 0.05, (60, 2)):
        heading = rng.uniform(-20.0, 20.0)
        expected = reference(level.segments, level.circles, x, y, spec.bearings + heading, spec.range_max)
        if not level.is_free(np.array([[x, y]]))[0]:
            continue
        np.testing.assert_allclose(cast(level.segments, level.circles, x, y, heading, spec), expected, rtol=1e-9)


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
    expected = reference(walls, posts, 0.0, 0.0, spec.bearings + heading, spec.range_max)
    np.testing.assert_allclose(cast(walls, posts, 0.0, 0.0, heading, spec), expected, rtol=1e-9)


@pytest.mark.parametrize("heading", [0.0, math.pi / 2, math.pi, -math.pi / 2, 2 * math.pi, 100.0])
def test_a_drone_in_the_middle_of_a_room_sees_all_corners(heading: float) -> None:
    """Beams that point right into a corner, where two walls meet, hit one of them."""
    room = load_level("0")
    spec = LidarSpec(beams=8)
    ranges = cast(room.segments, room.circles, 3.0, 3.0, heading, spec)
    assert np.isfinite(ranges).all()
    if heading != 100.0:
        np.testing.assert_allclose(ranges, [3.0, 3.0 * math.sqrt(2)] * 4, rtol=1e-9)


def test_a_known_post_and_nothing_behind_the_sensor() -> None:
    post = np.array([[2.0, 0.0, 0.5]])
    assert cast(NO_WALLS, post, 0.0, 0.0, 0.0, LidarSpec(beams=4)).tolist() == [1.5, math.inf, math.inf, math.inf]
    assert cast(NO_WALLS, post, 4.0, 0.0, 0.0, LidarSpec(beams=4)).tolist() == [math.inf, math.inf, 1.5, math.inf]


def test_what_lies_past_the_reach_gives_no_return() -> None:
    wall = np.array([[3.0, -9.0, 3.0, 9.0]])
    ranges = cast(wall, NO_POSTS, 0.0, 0.0, 0.0, LidarSpec(beams=360, range_max=4.0))
    assert ranges[0] == pytest.approx(3.0)
    assert np.isfinite(ranges).sum() == 2 * math.floor(math.degrees(math.acos(0.75))) + 1


def noisy(key: int, ranges: list[float] | NDArray[np.float64], std: float = 0.01) -> NDArray[np.float64]:
    out = np.array(ranges, float)
    add_noise(out, np.uint64(key), std, 0.05, 12.0)
    return out


def test_noise_is_gaussian_of_the_given_width_and_repeats_with_its_key() -> None:
    flat = np.full(20_000, 3.0)
    error = noisy(1, flat, 0.02) - 3.0
    assert error.mean() == pytest.approx(0.0, abs=5e-4)
    assert error.std() == pytest.approx(0.02, rel=0.03)
    assert (np.abs(error) < 0.04).mean() == pytest.approx(0.9545, abs=0.01)
    np.testing.assert_array_equal(noisy(1, flat, 0.02), noisy(1, flat, 0.02))
    other = noisy(2, flat, 0.02) - 3.0
    assert abs(np.corrcoef(error, other)[0, 1]) < 0.05
    assert abs(np.corrcoef(error[1:], error[:-1])[0, 1]) < 0.05


def test_noise_keeps_what_the_sensor_cannot_measure_apart() -> None:
    assert noisy(1, [math.inf, 0.01, 12.5, 3.0], 0.0).tolist()[0] == math.inf
    assert np.isnan(noisy(1, [0.01], 0.0)[0])
    assert noisy(1, [12.5], 0.0)[0] == math.inf
    assert noisy(1, [3.0], 0.0)[0] == 3.0


def test_a_worlds_scans_do_not_depend_on_the_worlds_beside_it() -> None:
    level, other = load_level("3"), load_level("6")
    alone = Twin([level], 2, seed=4)
    beside = Twin([level, other, level], 2, seed=4)
    for _ in range(3):
        alone.step(np.full((1, 2, 3), 0.3))
        beside.step(np.full((3, 2, 3), 0.3))
    np.testing.assert_array_equal(alone.scan()[0], beside.scan()[0])
    assert not np.array_equal(beside.scan()[0], beside.scan()[2])


def test_drones_see_each_other_as_posts() -> None:
    twin = Twin([load_level("0")], 2, LidarSpec(beams=360, noise_std=0.0))
    (ax, ay, _), (bx, by, _) = twin.poses[0]
    apart = math.hypot(bx - ax, by - ay)
    toward = math.atan2(by - ay, bx - ax)
    beam = round(math.degrees(toward)) % 360
    assert twin.scan()[0, 0, beam] == pytest.approx(apart - twin.limits.radius_m, abs=0.005)
