"""The critic's images: kept up to date pixel by pixel, they equal those counted from all cells each time."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from imagine.core.errors import InputError
from imagine.core.raster import CELL, TILE
from imagine.sim.critic_images import CRITIC_CELLS, CRITIC_CHANNELS, CriticImages
from imagine.sim.exploration import Exploration
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.sim.team_maps import MapArrays
from imagine.sim.workers import Workers

LARGE_LEVEL = "{title: a hall, size_m: [29, 21], launch: [1, 1], walls: [[[9, 0], [9, 14]], [[18, 21], [18, 5]]]}"


@numba.njit
def counted_from_all_cells(critic, seen, coverable, origins, poses):  # type: ignore[no-untyped-def]
    """Fill images, zeros before, by walking over all cells of every world."""
    worlds, drones, _, side, _ = critic.shape
    rows, columns = seen.shape[1], seen.shape[2]
    block = max(8, math.ceil(max(rows, columns) / side))
    for world in range(worlds):
        for row in range(rows):
            for column in range(columns):
                if coverable[world, row, column]:
                    channel = 1 if seen[world, row, column] else 0
                    critic[world, 0, channel, row // block, column // block] += 1.0 / (block * block)
        for i in range(side):
            for j in range(side):
                critic[world, 0, 2, i, j] = 1.0 - critic[world, 0, 0, i, j] - critic[world, 0, 1, i, j]
        for drone in range(1, drones):
            critic[world, drone, :3] = critic[world, 0, :3]
        for drone in range(drones):
            i = (math.floor(poses[world, drone, 1] / CELL) - origins[world, 1]) // block
            j = (math.floor(poses[world, drone, 0] / CELL) - origins[world, 0]) // block
            if 0 <= i < side and 0 <= j < side:
                for viewer in range(drones):
                    critic[world, viewer, 3 if viewer == drone else 4, i, j] = 1.0


def plain(maps: MapArrays, poses: NDArray[np.float64]) -> NDArray[np.float32]:
    worlds, drones = maps.gained.shape
    images = np.zeros((worlds, drones, CRITIC_CHANNELS, CRITIC_CELLS, CRITIC_CELLS), np.float32)
    counted_from_all_cells(images, maps.seen, maps.coverable, maps.origins, poses)
    return images


def assert_same(images: NDArray[np.float32], expected: NDArray[np.float32], cells: int) -> None:
    """Compare to the last bit where a pixel's cells are a power of two, else to what adding them up rounds."""
    if cells <= CRITIC_CELLS * 8:
        np.testing.assert_array_equal(images, expected)
    else:
        np.testing.assert_allclose(images, expected, atol=1e-5)


def blank(worlds: int, drones: int, rows: int, columns: int) -> MapArrays:
    """Return maps of which only what the images are made from has a size."""
    none: dict[str, Any] = {name: np.zeros(0) for name in MapArrays._fields}
    return MapArrays(
        **none
        | {
            "seen": np.zeros((worlds, rows, columns), bool),
            "coverable": np.zeros((worlds, rows, columns), bool),
            "fresh": np.zeros((worlds, rows // TILE, columns // TILE), np.uint8),
            "gained": np.zeros((worlds, drones), np.int64),
            "origins": np.zeros((worlds, 2), np.int64),
        }
    )


@settings(max_examples=40, deadline=None)
@given(st.data(), st.integers(1, 12), st.integers(1, 12), st.integers(1, 4), st.integers(0, 2**32 - 1))
def test_kept_images_equal_those_counted_from_all_cells(
    data: st.DataObject, tile_rows: int, tile_columns: int, drones: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    rows, columns = tile_rows * TILE, tile_columns * TILE
    maps = blank(2, drones, rows, columns)
    critic = CriticImages(maps, Workers(1))
    for world in range(2):
        maps.coverable[world] = rng.random((rows, columns)) < rng.random()
    maps.origins[...] = rng.integers(-100, 100, (2, 2))
    out = rng.random(critic.shape).astype(np.float32)
    for move in data.draw(st.lists(st.sampled_from(["see", "look", "look into", "clear"]), min_size=1, max_size=12)):
        world = int(rng.integers(2))
        poses = rng.uniform(-20.0, 50.0, (2, drones, 3))
        if move == "see":
            for _ in range(rng.integers(1, 4)):  # of what cannot be covered too, which is nothing new
                i, j = rng.integers(tile_rows) * TILE, rng.integers(tile_columns) * TILE
                at = (world, slice(i, i + TILE), slice(j, j + TILE))
                before = maps.seen[at] & maps.coverable[at]
                maps.seen[at] |= rng.random((TILE, TILE)) < 0.05
                if ((maps.seen[at] & maps.coverable[at]) != before).any():
                    maps.fresh[world, i // TILE, j // TILE] = 1
        elif move == "clear":
            maps.seen[world] = False
            maps.fresh[world] = 0
            maps.coverable[world] = rng.random((rows, columns)) < 0.5
            critic.clear(world)
        else:
            images = critic.fill(poses, out if move == "look into" else None)
            assert (images is out) == (move == "look into")
            assert_same(images, plain(maps, poses), max(rows, columns))


def test_in_flight_images_equal_those_counted_from_all_cells(tmp_path: Path) -> None:
    hall = tmp_path / "hall.yaml"
    hall.write_text(LARGE_LEVEL)
    for levels in (("1", "3", "4"), ("1", str(hall))):
        env = Exploration(ExplorationSettings(levels=levels, worlds=5, episode_ticks=40, stagger=True), 3)
        maps, rng = env.maps.arrays, np.random.default_rng(0)
        assert_same(env.reset().critic, plain(maps, env.twin.poses), max(maps.seen.shape[1:]))
        restarts = 0
        for tick in range(90):
            step = env.step(np.clip(np.nan_to_num(env.planner_actions()) + rng.normal(0, 0.3, (5, 3, 2)), -1, 1))
            restarts += int(step.done.sum())
            if tick % 7 < 3:  # with gaps, in which more becomes new than a tick brings
                assert_same(step.observation.critic, plain(maps, env.twin.poses), max(maps.seen.shape[1:]))
        assert restarts >= 5
        assert maps.seen.any()


def test_images_go_into_an_array_of_the_caller() -> None:
    env = Exploration(ExplorationSettings(levels=("1",), worlds=2), 0)
    expected = env.reset().critic
    rollout = np.full((4, 6, CRITIC_CHANNELS, CRITIC_CELLS, CRITIC_CELLS), np.nan, np.float32)
    env.critic_images(rollout[2])
    np.testing.assert_array_equal(rollout[2].reshape(expected.shape), expected)
    assert np.isnan(rollout[[0, 1, 3]]).all()


@pytest.mark.parametrize(
    "wrong",
    [
        np.zeros((2, 3, 5, 32, 31), np.float32),
        np.zeros((2, 3, 5, 32, 32)),
        np.zeros((2, 3, 5, 32, 64), np.float32)[..., ::2],
    ],
    ids=["shape", "type", "gaps"],
)
def test_what_cannot_hold_the_images_is_refused(wrong: NDArray[Any]) -> None:
    env = Exploration(ExplorationSettings(levels=("1",), worlds=2), 0)
    env.reset()
    with pytest.raises(InputError, match="critic images: cannot be written into"):
        env.critic_images(wrong)
