"""What drones of a world come to know from each other, by protocol, link and budget."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from imagine.core.lidar import LidarSpec
from imagine.sim.level import load_level
from imagine.sim.team_maps import TeamMaps
from imagine.sim.twin import Twin

LEVEL = load_level("4")
LIDAR = LidarSpec(beams=360, noise_std=0.0)
POSES = np.array([[[1.4, 1.4, 0.0], [8.0, 6.0, 1.0], [13.5, 10.0, 2.0]]])  # far apart: nobody sees what another does
CHAIN = np.array([[[False, True, False], [True, False, True], [False, True, False]]])
NOBODY, EVERYBODY = np.zeros((1, 3, 3), bool), ~np.eye(3, dtype=bool)[None]


def scans() -> NDArray[np.float32]:
    twin = Twin([LEVEL], 3, LIDAR)
    twin.poses[...] = POSES
    return twin.scan()


RANGES = scans()


def new_maps() -> TeamMaps:
    _, _, columns, rows = LEVEL.grid
    maps = TeamMaps(1, 3, rows, columns)
    maps.clear(0, LEVEL.coverable, LEVEL.grid[:2])
    return maps


def tick(maps: TeamMaps, links: NDArray[np.bool_], relays: bool = False, budget: int = 1000) -> NDArray[np.int64]:
    return maps.update(RANGES, POSES, (0.0, LIDAR.increment, LIDAR.range_min, 4.0), links, relays, budget)


def holds(maps: TeamMaps) -> list[list[bool]]:
    """Tell which drone (row) holds all that each source (column) has seen."""
    own = [maps.layers[0, source, source] for source in range(3)]
    return [[bool(np.array_equal(maps.layers[0, d, s], own[s])) for s in range(3)] for d in range(3)]


def knows_nothing(maps: TeamMaps, drone: int, source: int) -> bool:
    return not maps.layers[0, drone, source].any() and not maps.versions[0, drone, source].any()


def test_without_links_everyone_knows_only_its_own() -> None:
    maps = new_maps()
    for _ in range(3):
        tick(maps, NOBODY, relays=True)
    assert holds(maps) == np.eye(3, dtype=bool).tolist()
    assert all(knows_nothing(maps, d, s) for d in range(3) for s in range(3) if d != s)
    assert not maps.tiles_sent.any()


def test_one_hop_reaches_neighbours_and_no_further() -> None:
    maps = new_maps()
    for _ in range(4):
        tick(maps, CHAIN)
    assert holds(maps) == [[True, True, False], [True, True, True], [False, True, True]]
    assert knows_nothing(maps, 0, 2)
    assert knows_nothing(maps, 2, 0)


def test_relays_reach_the_end_of_the_chain_and_not_in_the_first_tick() -> None:
    maps = new_maps()
    tick(maps, CHAIN, relays=True)
    assert knows_nothing(maps, 2, 0)
    assert knows_nothing(maps, 0, 2)
    for _ in range(12):  # until nothing is new: evidence is clamped
        tick(maps, CHAIN, relays=True)
    assert np.array(holds(maps)).all()
    np.testing.assert_array_equal(maps.belief[0, 0], maps.belief[0, 2])
    np.testing.assert_array_equal(maps.distance[0, 0], maps.distance[0, 2])


@pytest.mark.parametrize(("source", "end"), [(0, 2), (2, 0)])
def test_a_tile_that_keeps_changing_is_relayed_all_the_same(source: int, end: int) -> None:
    maps = new_maps()
    tick(maps, CHAIN, relays=True)
    first = maps.layers[0, source, source].copy()
    tick(maps, CHAIN, relays=True)
    np.testing.assert_array_equal(maps.layers[0, end, source] != 0, first != 0)


def test_a_relay_carries_what_it_heard_while_the_source_was_in_range() -> None:
    maps = new_maps()
    meeting = np.zeros((1, 3, 3), bool)
    meeting[0, 0, 1] = meeting[0, 1, 0] = True
    tick(maps, meeting, relays=True)
    parted = np.zeros((1, 3, 3), bool)
    parted[0, 1, 2] = parted[0, 2, 1] = True
    told = maps.layers[0, 1, 0].copy()
    tick(maps, parted, relays=True)
    assert told.any()
    np.testing.assert_array_equal(maps.layers[0, 2, 0], told)


def test_a_link_one_way_carries_one_way() -> None:
    maps = new_maps()
    only_heard = np.zeros((1, 3, 3), bool)
    only_heard[0, 0, 1] = True  # what 0 sends reaches 1
    tick(maps, only_heard)
    assert holds(maps)[1][0]
    assert knows_nothing(maps, 0, 1)


@pytest.mark.parametrize("budget", [1, 3])
def test_senders_are_held_to_their_budget_and_catch_up(budget: int) -> None:
    maps = new_maps()
    for ticks in range(1, 60):
        tick(maps, EVERYBODY, budget=budget)
        assert (maps.tiles_sent <= budget * ticks).all()
    assert np.array(holds(maps)).all()
    before = maps.tiles_sent.copy()
    tick(maps, EVERYBODY, budget=budget)
    np.testing.assert_array_equal(maps.tiles_sent, before)  # nothing is sent twice


def test_one_broadcast_serves_all_who_hear_it() -> None:
    pair = EVERYBODY.copy()
    pair[0, 2, :] = pair[0, :, 2] = False
    to_one, to_two = new_maps(), new_maps()
    tick(to_one, pair)
    tick(to_two, EVERYBODY)
    assert to_one.tiles_sent[0, 0] == to_two.tiles_sent[0, 0] > 0


def test_the_belief_is_the_clamped_sum_of_what_is_held() -> None:
    maps = new_maps()
    for _ in range(6):
        tick(maps, EVERYBODY)
    total = np.clip(maps.layers[0].astype(int).sum(axis=1), -8, 8)
    np.testing.assert_array_equal(maps.belief[0], total)


def test_cells_are_discovered_once_and_by_whom_saw_them_first() -> None:
    maps = new_maps()
    gained = tick(maps, NOBODY)
    assert (gained > 0).all()
    assert not tick(maps, NOBODY).any()
    assert maps.discovered.tolist() == gained.tolist()
    assert maps.coverage()[0] == gained.sum() / LEVEL.coverable.sum()
    assert gained.sum() == (maps.seen[0] & maps.coverable[0]).sum()


def test_inactive_worlds_are_left_alone() -> None:
    _, _, columns, rows = LEVEL.grid
    maps = TeamMaps(2, 3, rows, columns)
    for world in range(2):
        maps.clear(world, LEVEL.coverable, LEVEL.grid[:2])
    lidar = (0.0, LIDAR.increment, LIDAR.range_min, 4.0)
    ranges, poses, links = (np.repeat(array, 2, axis=0) for array in (RANGES, POSES, EVERYBODY))
    gained = maps.update(ranges, poses, lidar, links, False, 20, np.array([False, True]))
    assert not gained[0].any()
    assert not maps.layers[0].any()
    assert not maps.belief[0].any()
    assert gained[1].all()
    maps.clear(1, LEVEL.coverable, LEVEL.grid[:2])
    assert not maps.layers[1].any()
    assert maps.coverage().tolist() == [0.0, 0.0]
    assert np.isinf(maps.distance[1]).all()
