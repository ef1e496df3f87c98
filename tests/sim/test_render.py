"""Pictures show what is there, where it is: read back pixel by pixel at places of the map."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from imagine.core.observation_spec import ObservationSpec
from imagine.sim import render
from imagine.sim.exploration import Exploration
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.sim.render import draw_scene, frame_of, render_world
from imagine.sim.scene import Scene, Trails, take_scene

ROOMS = """
title: two rooms, somebody in the one and a crate in the other
outline: [[0, 0], [10, 0], [10, 4], [7, 6], [0, 6]]
launch: [1.2, 1.2]
walls:
  - [[5, 0], [5, 5.2]]
boxes:
  - {center: [3.5, 0.9], size: [0.8, 0.8]}
circles:
  - {center: [8, 1.5], radius: 0.4}
people:
  - {loop: [[3.5, 5], [1, 5]], radius: 0.3}
crates:
  - {center: [7, 3.5], size: [1.2, 0.6], yaw_deg: 90}
"""
PX = 900


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Exploration:
    """Two drones that have looked round the left room; the way into the right one is out of their scans' range."""
    level = tmp_path_factory.mktemp("levels") / "rooms.yaml"
    level.write_text(ROOMS)
    env = Exploration(
        ExplorationSettings(
            levels=(str(level),), worlds=1, drones=2, mirror=False, random_launch=False, stop_coverage=1.0,
            observation=ObservationSpec(view_cells=16),
        ),
        seed=0, restart=False,
    )  # fmt: skip
    env.reset()
    for _ in range(5):
        env.step(np.zeros((1, 2, 2), np.float32))
    return env


class Picture:
    """A picture with the map's places."""

    def __init__(self, scene: Scene, size_px: int = PX) -> None:
        self.image = draw_scene(scene, size_px)
        self.frame = frame_of(scene.level, size_px)

    def at(self, x: float, y: float) -> tuple[int, ...]:
        row, column = self.frame.pixel(x, y)
        return tuple(self.image[row, column].tolist())

    def around(self, x: float, y: float, reach_m: float) -> set[tuple[int, ...]]:
        (top, left), (bottom, right) = (
            self.frame.pixel(x - reach_m, y + reach_m),
            self.frame.pixel(x + reach_m, y - reach_m),
        )
        return set(map(tuple, self.image[top : bottom + 1, left : right + 1].reshape(-1, 3).tolist()))


def near(colour: tuple[int, ...], other: tuple[int, ...], tolerance: int = 3) -> bool:
    return all(abs(a - b) <= tolerance for a, b in zip(colour, other, strict=True))


def test_what_was_seen_stands_out_from_what_was_not(world: Exploration) -> None:
    picture = Picture(take_scene(world, 0))
    assert picture.at(1.25, 3.25) == render.SEEN_FLOOR
    assert picture.at(8.25, 4.25) == render.UNSEEN_FLOOR
    assert picture.at(9.75, 5.75) == render.BACKDROP  # beyond the slanting wall
    assert picture.at(8.0, 1.5) == render.UNSEEN_SOLID  # the post
    assert picture.at(3.6, 0.7) == render.UNSEEN_SOLID  # within the box, where no beam goes
    assert picture.at(5.0, 0.3) in (render.UNSEEN_SOLID, render.SEEN_SOLID)  # the wall, behind the box
    assert near(picture.at(1.25, 2.0), render.GRID_SEEN)  # a line every metre


def test_north_is_up_and_east_is_right(world: Exploration) -> None:
    frame = frame_of(take_scene(world, 0).level, PX)
    assert frame.pixel(1.0, 4.0)[0] < frame.pixel(1.0, 1.0)[0]
    assert frame.pixel(1.0, 4.0)[1] < frame.pixel(3.0, 4.0)[1]
    picture = draw_scene(take_scene(world, 0), PX)
    assert picture.shape == (frame.header + frame.height, frame.width, 3)
    assert frame.pixel(-0.29, 6.29) == (frame.header, 0)


def test_what_the_team_believes_lies_over_what_is_there(world: Exploration) -> None:
    scene = take_scene(world, 0)
    column0, row0, _, _ = scene.level.grid
    believed = np.argwhere(scene.belief >= 4)
    assert len(believed) > 50
    away = scene.poses + np.array([8.0, 0.0, 0.0])
    picture = Picture(changed(scene, poses=away, people=np.empty((0, 3)), linked=np.zeros((2, 2), bool)))
    shown = [picture.at((column + column0 + 0.5) * 0.1, (row + row0 + 0.5) * 0.1) for row, column in believed]
    assert set(shown) == {render.OCCUPIED}
    belief = np.zeros_like(scene.belief)
    belief[30 - row0, 20 - column0] = 2  # half certain, in the midst of the room
    half = Picture(changed(scene, belief=belief)).at(2.05, 3.05)
    assert near(half, tuple((a + b) // 2 for a, b in zip(render.SEEN_FLOOR, render.OCCUPIED, strict=True)), 4)


def changed(scene: Scene, **changes: Any) -> Scene:
    return replace(scene, **changes)


@pytest.mark.parametrize("yaw", [0.0, math.pi / 2, -2.5])
def test_a_drone_shows_where_it_is_and_where_it_heads(world: Exploration, yaw: float) -> None:
    scene = take_scene(world, 0)
    poses = np.array([[2.0, 3.5, yaw], [8.5, 3.0, 0.0]])
    picture = Picture(changed(scene, poses=poses, linked=np.zeros((2, 2), bool)))
    assert render.DRONES[0] in picture.around(2.0, 3.5, 0.1)
    assert render.DRONES[1] in picture.around(8.5, 3.0, 0.1)
    radius = 0.011 * picture.frame.width / picture.frame.scale
    ahead, behind = (
        picture.at(2.0 + side * 1.45 * radius * math.cos(yaw), 3.5 + side * 1.45 * radius * math.sin(yaw))
        for side in (1, -1)
    )
    assert near(ahead, render.DRONES[0], 8)
    assert not near(behind, render.DRONES[0], 60)


def test_the_fallen_are_grey(world: Exploration) -> None:
    scene = take_scene(world, 0)
    poses = np.array([[2.0, 3.5, 0.0], [3.0, 3.5, 0.0]])
    picture = Picture(changed(scene, poses=poses, alive=np.array([False, True])))
    assert render.DEAD in picture.around(2.0, 3.5, 0.1)
    assert render.DRONES[0] not in picture.around(2.0, 3.5, 0.2)
    assert render.DRONES[1] in picture.around(3.0, 3.5, 0.1)


def test_links_run_between_those_who_reach_each_other(world: Exploration) -> None:
    scene = take_scene(world, 0)
    poses = np.array([[1.0, 3.5, 0.0], [3.0, 3.5, 0.0]])

    def bright(linked: NDArray[np.bool_], alive: tuple[bool, bool] = (True, True)) -> int:
        picture = Picture(changed(scene, poses=poses, linked=linked, alive=np.array(alive)))
        return sum(max(picture.at(x, 3.5)) > 150 for x in np.linspace(1.3, 2.7, 100))

    nobody, both = np.zeros((2, 2), bool), ~np.eye(2, dtype=bool)
    one = np.triu(both)
    assert bright(nobody) == 0
    assert 30 < bright(both) < 70  # dashes
    assert 10 < bright(one) < bright(both) - 10
    assert bright(both, (True, False)) == 0  # a fallen drone hears nobody


def test_people_and_crates_are_drawn_as_they_stand(world: Exploration) -> None:
    scene = take_scene(world, 0)
    assert scene.people.shape == (1, 3)
    x, y, radius = scene.people[0]
    assert radius == 0.3
    picture = Picture(scene)
    assert picture.at(x + 0.65 * radius, y) == render.PERSON
    assert picture.at(x + 1.2 * radius, y) not in (render.PERSON, render._darker(render.PERSON))
    assert picture.at(7.0, 2.91) == render._darker(render.CRATE)  # its edge: it is turned, deeper than wide
    assert picture.at(7.15, 3.5) == render.CRATE
    assert picture.at(7.5, 3.5) == render.UNSEEN_FLOOR
    people, crate = scene.people + np.array([0.0, -2.0, 0.0]), scene.crates[0] + np.array([1.5, 0.0])
    assert (scene.people == world.twin.mover_discs[0]).all()
    moved = Picture(changed(scene, people=people, crates=(crate,)))
    assert moved.at(x + 0.65 * radius, y - 2.0) == render.PERSON
    assert moved.at(8.65, 3.5) == render.CRATE
    assert moved.at(7.15, 3.5) == render.UNSEEN_FLOOR


def test_trails_and_scans_are_drawn_where_wanted(world: Exploration) -> None:
    poses = np.array([[0.7, 0.7, 0.0], [8.5, 3.0, 0.0]])
    scene = changed(take_scene(world, 0), poses=poses, linked=np.zeros((2, 2), bool))
    way = np.array([[0.7, 0.7], [0.7, 4.3], [4.2, 4.3]])
    plain, trailed = Picture(scene), Picture(changed(scene, trails=(way, way[:1])))
    assert plain.at(0.7, 2.5) == plain.at(2.5, 4.3) == render.SEEN_FLOOR
    for x, y in ((0.7, 2.5), (2.5, 4.3)):
        r, g, b = trailed.at(x, y)
        assert b > g > r > render.SEEN_FLOOR[0]  # drone 1 is blue
    assert trailed.at(2.5, 2.5) == plain.at(2.5, 2.5)
    scanned = Picture(changed(take_scene(world, 0, scans=True), poses=poses, linked=scene.linked))
    assert scanned.at(1.25, 3.25) != plain.at(1.25, 3.25)  # within reach of both
    assert scanned.at(8.25, 4.25) == plain.at(8.25, 4.25)  # behind the wall


def test_scans_end_at_walls_and_at_the_range_that_is_mapped(world: Exploration) -> None:
    scene = take_scene(world, 0, scans=True)
    for ends, (x, y, _) in zip(scene.scans, scene.poses, strict=True):
        assert len(ends) == world.lidar.beams
        assert (np.hypot(ends[:, 0] - x, ends[:, 1] - y) <= world.settings.map.range_cap_m + 1e-9).all()
        assert (ends[:, 0] < 5.05).all()
        np.testing.assert_allclose(ends[0, 1], y, atol=1e-6)  # beam 0 looks straight ahead, along x
        assert ends[90, 1] > y + 1.0  # and they run counter-clockwise


def test_the_bar_fills_with_the_coverage(world: Exploration) -> None:
    scene = take_scene(world, 0)
    for coverage in (0.0, 0.25, 1.0):
        picture = Picture(changed(scene, coverage=coverage))
        bar = picture.image[picture.frame.header - 1]
        assert (bar == render.BAR).all(axis=1).sum() == round(coverage * picture.frame.width)


@pytest.mark.parametrize("size_px", [1, 160, 333, 960, 2000])
def test_pictures_are_as_large_as_asked_for(world: Exploration, size_px: int) -> None:
    picture = render_world(world, 0, size_px)
    frame = frame_of(world.twin.levels[0], size_px)
    bound = max(size_px, render.SMALLEST_PX)
    assert picture.dtype == np.uint8
    assert 0.75 * bound <= picture.shape[1] == frame.width <= bound
    assert frame.height == picture.shape[0] - frame.header <= bound
    cell_px = frame.scale * 0.1
    assert cell_px == pytest.approx(round(cell_px)) or cell_px < 2.0


def test_a_drones_own_views_stand_beside_the_map(world: Exploration) -> None:
    views = np.zeros((4, 16, 16), np.float32)
    views[0, 0, :] = -1.0  # the lowest y of the first channel
    views[3, :, 15] = 1.0  # the highest x of the last
    plain, picture = render_world(world, 0, PX), render_world(world, 0, PX, views=views)
    frame = frame_of(world.twin.levels[0], PX)
    np.testing.assert_array_equal(picture[frame.header :, : frame.width], plain[frame.header :])
    panel = picture[frame.header :, frame.width :]
    rows, columns = np.nonzero((panel == render.DRONES[0]).all(axis=2))
    assert columns.max() < panel.shape[1] / 2
    size = columns.max() - columns.min() + 1
    assert rows.max() == rows.min() + len(set(rows)) - 1
    assert rows.min() > 0.9 * size  # at the lower edge of its image
    rows, columns = np.nonzero((panel == render.DRONES[1]).all(axis=2))
    assert columns.min() > panel.shape[1] / 2 + 0.9 * size
    assert rows.min() > size


def test_drawing_changes_nothing_and_a_scene_stays_as_it_was(world: Exploration) -> None:
    scene = take_scene(world, 0, Trails().add(world, 0), scans=True)
    before, maps = draw_scene(scene, PX), world.maps.belief.copy()
    render_world(world, 0, PX, scans=True)
    np.testing.assert_array_equal(world.maps.belief, maps)
    for _ in range(3):
        world.step(np.ones((1, 2, 2), np.float32))
    np.testing.assert_array_equal(draw_scene(scene, PX), before)
    assert (render_world(world, 0, PX) != before).any()


def test_trails_grow_with_the_episode_and_start_anew_with_the_next() -> None:
    env = Exploration(ExplorationSettings(levels=("0",), worlds=1, drones=2, mirror=False), seed=1)
    env.reset()
    trails = Trails()
    assert trails.ways == ()
    flown = [env.twin.poses[0, :, :2].copy()]
    early = trails.add(env, 0)
    for _ in range(4):
        env.step(np.ones((1, 2, 2), np.float32))
        flown.append(env.twin.poses[0, :, :2].copy())
        trails.add(env, 0)
        trails.add(env, 0)  # twice in a tick counts once
    np.testing.assert_array_equal(np.stack(trails.ways, axis=1), flown)
    assert [len(way) for way in early] == [1, 1]
    env.reset()
    assert [len(way) for way in trails.add(env, 0)] == [1, 1]


def test_a_level_larger_than_the_picture_is_drawn_smaller(tmp_path: Path) -> None:
    (tmp_path / "hall.yaml").write_text("{size_m: [60, 30], launch: [30, 15]}")
    settings = ExplorationSettings(
        levels=(str(tmp_path / "hall.yaml"),), worlds=1, drones=1, mirror=False, random_launch=False
    )
    env = Exploration(settings, seed=0)
    env.reset()
    picture = Picture(take_scene(env, 0), 160)  # a pixel is nearly four cells
    assert picture.image.shape[1] == 160
    assert near(picture.at(31.5, 17.0), render.SEEN_FLOOR, 8)
    assert near(picture.at(45.5, 16.5), render.UNSEEN_FLOOR, 8)
