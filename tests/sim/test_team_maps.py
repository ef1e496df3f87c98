"""What drones of a batch make of their scans and of what they hold of others: as on board, where it changed."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_array_equal
from numpy.typing import NDArray

from imagine.core.evidence import EvidenceMap
from imagine.core.frames import Pose
from imagine.core.frontier import PAD, frontier_field
from imagine.core.frontier_paths import BLOCKED, FAR
from imagine.core.lidar import TEAMMATE_RADIUS_M, LidarSpec, Scan, mask_near
from imagine.core.raster import TILE, ray_table
from imagine.sim.level import load_level
from imagine.sim.team_maps import TeamMaps, derive, integrate_scan_of
from imagine.sim.twin import Twin
from imagine.sim.workers import Workers

LEVEL = load_level("4")
LIDAR = LidarSpec(beams=360, noise_std=0.0)
CAP_M = 4.0
POSES = np.array([[1.4, 1.4, 0.0], [8.0, 6.0, 1.0], [13.5, 10.0, 2.0]])  # far apart: nobody sees what another does
NOBODY = np.full((3, 2), np.nan)
MARKS, KEPT = np.empty(ray_table(CAP_M).sheet, np.int8), np.empty(LIDAR.beams, np.float32)


def scans(poses: NDArray[np.float64]) -> NDArray[np.float32]:
    twin = Twin([LEVEL], len(poses), LIDAR)
    twin.poses[0] = poses
    ranges: NDArray[np.float32] = twin.scan()[0]
    return ranges


RANGES = scans(POSES)


def new_maps(worlds: int = 1, drones: int = 3) -> TeamMaps:
    column0, row0, columns, rows = LEVEL.grid
    maps = TeamMaps(worlds, drones, rows, columns, LIDAR, CAP_M, Workers(1))
    for world in range(worlds):
        maps.clear(world, LEVEL.coverable, (column0, row0))
    return maps


def look(maps: TeamMaps, world: int = 0, places: NDArray[np.float64] = NOBODY) -> NDArray[np.int64]:
    """Let all drones of a world map their scans and derive what follows; return what each was the first to see."""
    arrays = maps.arrays
    for drone in range(3):
        arrays.gained[world, drone] = arrays.changed[world, drone] = 0
        integrate_scan_of(world, drone, arrays, maps.pens, RANGES[drone], POSES[drone], places, MARKS, KEPT)
    derive(world, world + 1, arrays, maps.scratch[0])
    return arrays.gained[world].copy()


def check_derived(maps: TeamMaps, world: int = 0) -> None:
    """Compare all that is derived with what it is from nothing."""
    arrays = maps.arrays
    assert not arrays.dirty[world].any()
    for drone in range(arrays.belief.shape[1]):
        belief = np.clip(arrays.layers[world, drone].astype(int).sum(axis=0), -8, 8).astype(np.int8)
        assert_array_equal(arrays.belief[world, drone], belief)
        field = frontier_field(belief)
        assert_array_equal(arrays.cost[world, drone], field.cost)
        assert_array_equal(arrays.states[world, drone], field.padded_states)
        assert arrays.frontiers[world, drone] == ((field.cost >= 0) & (field.cost < FAR)).any()


@given(st.integers(0, 2**32 - 1))
def test_a_scan_is_mapped_as_on_board_without_teammates_wherever_they_are_taken_to_be(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pose = Pose(rng.uniform(1.0, 5.0), rng.uniform(1.0, 5.0), rng.uniform(-7.0, 7.0))
    away, bearing = rng.uniform(0.2, 11.0, 3), rng.uniform(-4.0, 4.0, 3)
    places = np.array(pose[:2]) + (away * np.array((np.cos(bearing), np.sin(bearing)))).T
    ranges = rng.uniform(0.0, 12.0, LIDAR.beams).astype(np.float32)
    for mate in range(3):  # some returns are the teammates', within the range cap and beyond it
        near = np.abs((LIDAR.bearings + pose.yaw - bearing[mate] + np.pi) % (2 * np.pi) - np.pi) < 0.3 / away[mate]
        ranges[near] = away[mate] + rng.uniform(-0.3, 0.3, near.sum())
    ranges[rng.random(LIDAR.beams) < 0.1] = np.inf
    ranges[rng.random(LIDAR.beams) < 0.1] = np.nan
    known = rng.random(3) < 0.7
    kept = mask_near(ranges, LIDAR, pose, places[known], TEAMMATE_RADIUS_M)

    maps, evidence = new_maps(), EvidenceMap(1)
    evidence.cover(0.0, 0.0, 18.0, 14.0)
    places[~known] = np.nan
    for _ in range(3):
        integrate_scan_of(0, 1, maps.arrays, maps.pens, ranges, np.array(pose), places, MARKS, KEPT)
        evidence.integrate(pose, Scan(0.0, kept), LIDAR, CAP_M)
    (column, row), (column0, row0) = LEVEL.grid[:2], evidence.origin_cells
    rows, columns = maps.belief.shape[2:]
    window = np.s_[row - row0 : row - row0 + rows, column - column0 : column - column0 + columns]
    tiles = tuple(slice(part.start // TILE, part.stop // TILE) for part in window)
    assert_array_equal(maps.layers[0, 1, 1], evidence.layers[1].cells[window])
    assert_array_equal(maps.versions[0, 1, 1], evidence.layers[1].versions[tiles])
    assert maps.arrays.clocks[0].tolist() == [0, evidence.layers[1].clock, 0]
    assert not maps.layers[0, [0, 2]].any()
    assert not maps.layers[0, 1, [0, 2]].any()


def test_mapping_is_followed_by_belief_and_field() -> None:
    maps = new_maps()
    for _ in range(6):
        look(maps)
        check_derived(maps)
    assert maps.arrays.frontiers.all()


@pytest.mark.parametrize("drones", [1, 2, 3, 4, 7])
@pytest.mark.parametrize("seed", [0, 1])
def test_whatever_comes_into_the_layers_the_derived_is_as_from_nothing(drones: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    maps = new_maps(drones=drones)
    arrays = maps.arrays
    tile_rows, tile_columns = arrays.dirty.shape[2:]
    for _ in range(25):
        for _ in range(rng.integers(1, 6)):
            drone, source = rng.integers(drones, size=2)
            i, j = rng.integers(tile_rows), rng.integers(tile_columns)
            tile = arrays.layers[0, drone, source, i * TILE : (i + 1) * TILE, j * TILE : (j + 1) * TILE]
            coarse = rng.choice(np.array([-6, -1, 0, 0, 8], np.int8), (TILE // 4, TILE // 4))  # patches, as of rooms
            tile[:] = np.repeat(np.repeat(coarse, 4, axis=0), 4, axis=1)
            arrays.dirty[0, drone, i, j] = 1
        derive(0, 1, arrays, maps.scratch[0])
        check_derived(maps)


def test_what_is_not_dirty_is_not_looked_at() -> None:
    maps = new_maps()
    look(maps)
    before = maps.belief.copy(), maps.arrays.cost.copy()
    maps.layers[0, :, :, :TILE, :TILE] = 5
    derive(0, 1, maps.arrays, maps.scratch[0])
    assert_array_equal(maps.belief, before[0])
    maps.arrays.dirty[0, 1, 0, 0] = 1
    derive(0, 1, maps.arrays, maps.scratch[0])
    assert (maps.belief[0, 1, :TILE, :TILE] == 8).all()
    assert_array_equal(maps.belief[0, [0, 2]], before[0][0, [0, 2]])
    assert_array_equal(maps.arrays.cost[0, [0, 2]], before[1][0, [0, 2]])


def test_cells_are_discovered_once_and_by_whom_saw_them_first() -> None:
    maps = new_maps()
    gained = look(maps)
    assert (gained > 0).all()
    assert not look(maps).any()
    assert maps.discovered[0].tolist() == gained.tolist()
    assert maps.coverage()[0] == gained.sum() / LEVEL.coverable.sum()
    assert gained.sum() == (maps.seen[0] & maps.coverable[0]).sum()


def test_who_looks_second_discovers_only_what_is_new() -> None:
    apart, together = new_maps(), new_maps()
    alone = {}
    for drone, maps in ((0, apart), (1, new_maps())):
        integrate_scan_of(0, drone, maps.arrays, maps.pens, RANGES[0], POSES[0] + drone, NOBODY, MARKS, KEPT)
        alone[drone] = maps.seen[0] & maps.coverable[0]
    for drone in (0, 1):
        integrate_scan_of(0, drone, together.arrays, together.pens, RANGES[0], POSES[0] + drone, NOBODY, MARKS, KEPT)
    found = [alone[0].sum(), (alone[1] & ~alone[0]).sum(), 0]
    assert together.discovered[0].tolist() == found
    assert 0 < found[1] < alone[1].sum()


def test_a_world_is_worked_on_without_touching_others_and_can_be_cleared() -> None:
    maps = new_maps(worlds=2)
    gained = look(maps, world=1)
    assert gained.all()
    empty = new_maps().arrays
    assert_world_equals(maps, 0, empty)
    check_derived(maps, world=1)
    maps.clear(1, LEVEL.coverable, LEVEL.grid[:2])
    assert_world_equals(maps, 1, empty)
    assert maps.coverage().tolist() == [0.0, 0.0]
    assert (maps.arrays.cost[1][:, PAD:-PAD, PAD:-PAD] == BLOCKED).all()


def assert_world_equals(maps: TeamMaps, world: int, other: Any) -> None:
    for name, array in maps.arrays._asdict().items():
        assert_array_equal(array[world], getattr(other, name)[0], err_msg=name)
