"""Levels: all built-in ones can be flown and covered, mirrors keep areas, bad files are named by line and key."""

from __future__ import annotations

import itertools
import math
from pathlib import Path

import numpy as np
import pytest

from imagine.core.errors import InputError
from imagine.core.lidar import LidarSpec
from imagine.core.raster import CELL
from imagine.sim.coverage import Coverage
from imagine.sim.level import BUILT_IN, Level, load_level, mirrored
from imagine.sim.rays import cast_rays

LEVELS = {name: load_level(name) for name in BUILT_IN}
LIDAR = LidarSpec(beams=360, noise_std=0.0)
SIGHT_M = 4.0


def centres(level: Level, cells: np.ndarray) -> np.ndarray:
    column0, row0, _, _ = level.grid
    rows, columns = np.nonzero(cells)
    return np.column_stack(((columns + column0 + 0.5) * CELL, (rows + row0 + 0.5) * CELL))


@pytest.mark.parametrize("name", BUILT_IN)
def test_a_team_fits_at_the_launch_point(name: str) -> None:
    level = LEVELS[name]
    poses = level.launch_poses(3)
    assert math.dist(poses[0][:2], level.launch) <= 0.1
    points = np.array(poses)[:, :2]
    assert level.is_free(points, 0.2).all()
    assert min(math.dist(a, b) for a, b in itertools.combinations(points, 2)) >= 0.7
    assert {pose.yaw for pose in poses} == {0.0}


@pytest.mark.parametrize("name", BUILT_IN)
def test_from_where_drones_can_fly_all_that_counts_can_be_seen(name: str) -> None:
    level = LEVELS[name]
    assert not (level.flyable & ~level.coverable).any()
    coverage, seen = Coverage(level, 1, LIDAR, SIGHT_M), 0.0
    ranges = np.empty(LIDAR.beams)
    for x, y in centres(level, level.flyable)[::13]:
        cast_rays(ranges, level.segments, level.circles, x, y, 0.0, LIDAR.increment, LIDAR.range_max)
        seen = coverage.update(np.array([[x, y, 0.0]]), ranges.astype(np.float32)[None])
    assert seen > 0.995


def test_levels_grow_in_area() -> None:
    areas = [LEVELS[name].coverable.sum() * CELL * CELL for name in BUILT_IN]
    assert areas[0] == pytest.approx(36.0, rel=0.03)
    assert all(later > 0.85 * earlier for earlier, later in itertools.pairwise(areas))
    assert areas[6] > 5 * areas[0]
    assert len({LEVELS[name].title for name in BUILT_IN}) == len(BUILT_IN)


@pytest.mark.parametrize("name", BUILT_IN)
def test_free_points_are_inside_and_clear_of_all_obstacles(name: str) -> None:
    level = LEVELS[name]
    rng = np.random.default_rng(0)
    low, high = level.outline.min(axis=0), level.outline.max(axis=0)
    points = rng.uniform(low - 1.0, high + 1.0, (300, 2))
    free = level.is_free(points)
    assert (free <= ((points > low) & (points < high)).all(axis=1)).all()
    for polygon in level.polygons:
        assert not level.is_free(polygon.mean(axis=0)[None])[0]
    for x, y, _ in level.circles:
        assert not level.is_free(np.array([[x, y]]))[0]
    roomy = level.is_free(points, 0.3)
    assert not (roomy & ~free).any()
    for point in points[roomy][:20]:  # all that lies within the clearance is free as well
        ring = point + 0.29 * np.column_stack((np.cos(np.arange(12)), np.sin(np.arange(12))))
        assert level.is_free(ring).all()


@pytest.mark.parametrize("flags", list(itertools.product((False, True), repeat=3)))
def test_mirrors_keep_areas_and_undo_themselves(flags: tuple[bool, bool, bool]) -> None:
    level = LEVELS["3"]
    seen = mirrored(level, *flags)
    assert seen.coverable.sum() == pytest.approx(level.coverable.sum(), rel=0.01)
    assert seen.flyable.sum() == pytest.approx(level.flyable.sum(), rel=0.02)
    assert seen.segments.shape == level.segments.shape
    assert seen.is_free(np.array([seen.launch]), 0.25)[0]
    swap, flip_x, flip_y = flags
    back = mirrored(seen, swap, flip_y if swap else flip_x, flip_x if swap else flip_y)
    np.testing.assert_allclose(back.segments, level.segments, atol=1e-12)
    np.testing.assert_allclose(back.circles, level.circles, atol=1e-12)
    assert back.launch == pytest.approx(level.launch)


def test_a_mirror_that_swaps_axes_turns_a_long_room() -> None:
    level = LEVELS["4"]
    assert mirrored(level, True, False, False).outline.max(axis=0).tolist() == [12.0, 16.0]
    assert mirrored(level, False, True, True).outline.max(axis=0).tolist() == [16.0, 12.0]


def test_random_launches_are_apart_free_and_repeat_with_the_generator() -> None:
    level = LEVELS["5"]
    first = level.launch_poses(3, np.random.default_rng(7))
    assert first == level.launch_poses(3, np.random.default_rng(7))
    assert first != level.launch_poses(3, np.random.default_rng(8))
    points = np.array(first)[:, :2]
    assert level.is_free(points, 0.2).all()
    assert min(math.dist(a, b) for a, b in itertools.combinations(points, 2)) >= 0.7


def test_a_room_too_small_for_the_team_says_so() -> None:
    with pytest.raises(InputError, match=r"room for \d+ drones around .* not 500"):
        LEVELS["0"].launch_poses(500)


def test_room_for_a_single_drone_is_told_as_one(tmp_path: Path) -> None:
    level = load_level(write(tmp_path, "size_m: [1.0, 1.0]\nlaunch: [0.5, 0.5]\n"))
    assert len(level.launch_poses(1)) == 1
    with pytest.raises(InputError, match=r"room for 1 drone around \(0\.5, 0\.5\), not 2: "):
        level.launch_poses(2)


def write(folder: Path, text: str) -> str:
    path = folder / "mine.yaml"
    path.write_text(text, encoding="utf-8")
    return str(path)


def test_a_file_is_a_level(tmp_path: Path) -> None:
    text = "outline: [[-2, -1], [4, -1], [4, 3], [-2, 3]]\nlaunch: [0, 0]\nboxes:\n  - {center: [2, 1], size: [1, 1]}\n"
    level = load_level(write(tmp_path, text))
    assert level.name == "mine"
    assert level.is_free(np.array([[0.0, 0.0], [2.0, 1.0], [-3.0, 0.0]])).tolist() == [True, False, False]
    assert level.coverable.sum() * CELL * CELL == pytest.approx(23.0, rel=0.05)


def test_a_level_can_add_to_another(tmp_path: Path) -> None:
    text = 'extends: "3"\ncircles:\n  - {center: [1.2, 8.9], radius: 0.3}\n'
    level = load_level(write(tmp_path, text))
    assert len(level.circles) == len(LEVELS["3"].circles) + 1
    assert level.launch == LEVELS["3"].launch
    assert not level.is_free(np.array([[1.2, 8.9]]))[0]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("size_m: [4, 4]\nlanch: [1, 1]\n", ":2: unknown key 'lanch'; did you mean 'launch'"),
        ("size_m: [4, 4]\n", ": key 'launch' is missing"),
        ("launch: [1, 1]\n", ": give either size_m or outline"),
        ("size_m: [4, 4]\noutline: [[0, 0], [1, 0], [1, 1]]\nlaunch: [1, 1]\n", "give either size_m or outline"),
        ("size_m: [4, 0.2]\nlaunch: [1, 1]\n", "size_m: each side must lie within"),
        ("size_m: [4, 4000]\nlaunch: [1, 1]\n", "size_m: each side must lie within"),
        ("size_m: [4, .inf]\nlaunch: [1, 1]\n", ":1: size_m.1: "),
        ("size_m: [4, 4]\nlaunch: [9, 9]\n", ":2: launch (9.0, 9.0) is in or within 0.25 m of a wall"),
        ("size_m: [4, 4]\nlaunch: [0.1, 2]\n", ":2: launch"),
        ("size_m: [4, 4]\nlaunch: [1, 1]\nwalls:\n  - [[1, 1]]\n", ":3: walls: a wall is a line of at least two"),
        ("size_m: [4, 4]\nlaunch: [1, 1]\nboxes:\n  - {center: [3, 3], size: [0, 1]}\n", ":4: boxes.0.size: "),
        ("size_m: [4, 4]\nlaunch: [1, 1]\ncircles:\n  - {center: [3, 3], radius: -1}\n", ":4: circles.0.radius: "),
        ("size_m: [4, 4]\nlaunch: [1, 1]\nboxes:\n  - {center: [3], size: [1, 1]}\n", ":4: key 'boxes.0.center.1'"),
        ("extends: '9'\n", ":1: extends: give one of 0, 1,"),
        ("outline: [[0, 0], [1, 1]]\nlaunch: [1, 1]\n", ":1: outline: "),
        ("outline:\n - [0, 0]\n - [9e5, 0]\n - [9e5, 9e5]\nlaunch: [9, 1]\n", ":3: outline.1: a level lies within"),
        ("size_m: [4, 4]\nlaunch: [1, 1]\nboxes:\n  - {center: [260, 1], size: [1, 1]}\n", ":4: boxes.0: a level lies"),
        ("size_m: [4, 4]\nlaunch: [1, 1]\nwalls:\n  - [[1, 2], [2, 2]]\n  - [[1, 3], [-90, 3]]\n", ":5: walls.1: a"),
        ("size_m: [4, 4]\nlaunch: [1, 1]\ncircles:\n  - {center: [9, 9], radius: 999}\n", ":4: circles.0: a level"),
        ("size_m: [4, 4\nlaunch: [1, 1]\n", ": not valid YAML: "),
    ],
)
def test_malformed_levels_are_named_by_file_line_and_key(tmp_path: Path, text: str, said: str) -> None:
    path = write(tmp_path, text)
    with pytest.raises(InputError) as caught:
        load_level(path)
    message = str(caught.value)
    assert message.startswith(path)
    assert said in message
    assert "\n" not in message


@pytest.mark.parametrize("name", ["7", "", "house", "absent.yaml", "level.txt", "."])
def test_an_unknown_level_lists_the_known_ones(name: str) -> None:
    with pytest.raises(InputError, match=r"unknown level .*0, 1, 2, 3, 4, 5, 6"):
        load_level(name)
