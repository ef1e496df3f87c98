"""The evidence map: what it keeps when it grows, and that merging is a join whatever comes in which order."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from flat_rooms import look, walls_of_box
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from imagine.core.errors import InputError
from imagine.core.evidence import MAX_TILES, EvidenceMap, TileKey
from imagine.core.frames import Pose
from imagine.core.lidar import LidarSpec, Scan
from imagine.core.raster import CELL, LIMIT, TILE

LIDAR = LidarSpec(beams=90, noise_std=0.0)
CAP_M = 4.0
ROOM = walls_of_box(-3.0, -2.0, 5.0, 4.0)
SEEDS = st.integers(0, 2**32 - 1)
FEW = settings(max_examples=20)

Parcel = tuple[int, TileKey, int, NDArray[np.int8]]


def room_pose(rng: np.random.Generator) -> Pose:
    return Pose(float(rng.uniform(-2.5, 4.5)), float(rng.uniform(-1.5, 3.5)), float(rng.uniform(-3, 3)))


def explore(evidence: EvidenceMap, rng: np.random.Generator, scans: int) -> None:
    for _ in range(scans):
        pose = room_pose(rng)
        evidence.integrate(pose, look(ROOM, pose, LIDAR), LIDAR, CAP_M)


def parcels(evidence: EvidenceMap) -> list[Parcel]:
    """Return all tiles a map may relay, as they would go on the air."""
    return [
        (source, key, version, evidence.tile(source, key).copy())
        for source in evidence.layers
        for key, version in evidence.versions(source).items()
        if not evidence.is_provisional(source, key)
    ]


def history(seed: int, sources: tuple[int, ...] = (2, 3)) -> list[Parcel]:
    """Return tiles that peers sent over a while, several versions of most."""
    rng = np.random.default_rng(seed)
    sent: list[Parcel] = []
    for source in sources:
        peer = EvidenceMap(source, half_extent_m=1.0)
        for _ in range(3):
            explore(peer, rng, 2)
            sent += parcels(peer)
    return sent


def state(evidence: EvidenceMap) -> dict[tuple[int, TileKey], tuple[int, bytes]]:
    """Return what a map holds, wherever its grid begins."""
    return {(source, key): (version, cells.tobytes()) for source, key, version, cells in parcels(evidence)}


def merged(sent: list[Parcel]) -> EvidenceMap:
    evidence = EvidenceMap(1)
    for parcel in sent:
        evidence.merge_tile(*parcel)
    return evidence


@FEW
@given(SEEDS)
def test_merging_commutes_and_repeats_do_not_count(seed: int) -> None:
    sent = history(seed)
    rng = np.random.default_rng(seed)
    shuffled = [sent[i] for i in rng.permutation(len(sent))]
    repeated = shuffled + [sent[i] for i in rng.integers(len(sent), size=len(sent))]
    one, other = merged(sent), merged(repeated)
    assert state(one) == state(other)
    np.testing.assert_array_equal(one.belief(), other.belief())
    newest: dict[tuple[int, TileKey], tuple[int, bytes]] = {}
    for source, key, version, cells in sent:
        newest[(source, key)] = max(newest.get((source, key), (0, b"")), (version, cells.tobytes()))
    assert state(one) == newest


@FEW
@given(SEEDS)
def test_merging_associates_so_relays_bring_what_the_source_would(seed: int) -> None:
    first, second, third = history(seed, (2,)), history(seed + 1, (3,)), history(seed, (2, 3))
    left = merged([*parcels(merged([*first, *second])), *third])
    right = merged([*first, *parcels(merged([*second, *third]))])
    assert state(left) == state(right)


@FEW
@given(SEEDS)
def test_a_tile_is_taken_only_if_newer(seed: int) -> None:
    rng = np.random.default_rng(seed)
    evidence, key = EvidenceMap(1), TileKey(0, 0)
    held, held_cells = 0, np.zeros((TILE, TILE), np.int8)
    for version in rng.integers(1, 6, 10):
        cells = rng.integers(-LIMIT, LIMIT, (TILE, TILE), np.int8, endpoint=True)
        assert evidence.merge_tile(2, key, int(version), cells) == (version > held)
        if version > held:
            held, held_cells = int(version), cells
        assert evidence.versions(2) == {key: held}
        np.testing.assert_array_equal(evidence.tile(2, key), held_cells)


@FEW
@given(SEEDS)
def test_versions_advance_only_for_tiles_that_changed(seed: int) -> None:
    rng = np.random.default_rng(seed)
    evidence = EvidenceMap(1)
    explore(evidence, rng, 3)
    for _ in range(5):
        before = {key: (version, evidence.tile(1, key).copy()) for key, version in evidence.versions(1).items()}
        newest = max(version for version, _ in before.values())
        explore(evidence, rng, 1)
        for key, version in evidence.versions(1).items():
            old_version, old_cells = before.get(key, (0, np.zeros((TILE, TILE), np.int8)))
            if np.array_equal(old_cells, evidence.tile(1, key)):
                assert version == old_version
            else:
                assert version > newest


def test_a_scan_that_changes_nothing_leaves_all_versions() -> None:
    evidence = EvidenceMap(1)
    pose = Pose(0.0, 0.0, 0.0)
    scan = look(ROOM, pose, LIDAR)
    for _ in range(LIMIT):
        evidence.integrate(pose, scan, LIDAR, CAP_M)
    versions = evidence.versions(1)
    assert evidence.integrate(pose, scan, LIDAR, CAP_M) == 0
    assert evidence.versions(1) == versions


@FEW
@given(SEEDS, st.floats(-60, 60), st.floats(-60, 60))
def test_growth_keeps_everything(seed: int, x: float, y: float) -> None:
    evidence = EvidenceMap(1, half_extent_m=4.0)
    rng = np.random.default_rng(seed)
    explore(evidence, rng, 2)
    for parcel in history(seed, (2,)):
        evidence.merge_tile(*parcel)
    pose = room_pose(rng)
    evidence.integrate_provisional(3, pose, look(ROOM, pose, LIDAR), LIDAR, CAP_M)
    held, total = state(evidence), evidence.belief().astype(int).sum()
    clocks = {source: layer.clock for source, layer in evidence.layers.items()}
    provisional = sum(layer.provisional.sum() for layer in evidence.layers.values())
    (column0, row0), belief = evidence.origin_cells, evidence.belief()
    evidence.cover(x - 1.0, y - 1.0, x + 1.0, y + 1.0)
    column1, row1 = evidence.origin_cells
    inner = evidence.belief()[row0 - row1 :, column0 - column1 :][: belief.shape[0], : belief.shape[1]]
    np.testing.assert_array_equal(inner, belief)
    assert evidence.belief().astype(int).sum() == total
    assert state(evidence) == held
    assert {source: layer.clock for source, layer in evidence.layers.items()} == clocks
    assert sum(layer.provisional.sum() for layer in evidence.layers.values()) == provisional
    rows, columns = evidence.shape
    assert column1 * CELL <= x < (column1 + columns) * CELL
    assert row1 * CELL <= y < (row1 + rows) * CELL


@FEW
@given(SEEDS)
def test_where_the_grid_begins_makes_no_difference(seed: int) -> None:
    small, large = EvidenceMap(1, half_extent_m=0.5), EvidenceMap(1, half_extent_m=30.0)
    explore(small, np.random.default_rng(seed), 3)
    explore(large, np.random.default_rng(seed), 3)
    assert state(small) == state(large)


def test_a_peers_scan_counts_at_once_but_is_not_relayed_until_its_tiles_come() -> None:
    pose = Pose(0.5, 0.5, 0.0)
    scan = look(ROOM, pose, LIDAR)
    peer, evidence = EvidenceMap(2), EvidenceMap(1)
    peer.integrate(pose, scan, LIDAR, CAP_M)
    evidence.integrate_provisional(2, pose, scan, LIDAR, CAP_M)
    np.testing.assert_array_equal(evidence.belief(), peer.belief())
    assert parcels(evidence) == []
    assert evidence.versions(2) == {}
    for source, key, version, cells in parcels(peer):
        assert evidence.is_provisional(source, key)
        assert evidence.merge_tile(source, key, version, cells)
        assert not evidence.is_provisional(source, key)
    assert state(evidence) == state(peer)
    np.testing.assert_array_equal(evidence.belief(), peer.belief())


def test_a_tile_replaces_what_was_drawn_ahead_of_it() -> None:
    evidence, key = EvidenceMap(1), TileKey(0, 0)
    pose = Pose(0.5, 0.5, 0.0)
    assert evidence.merge_tile(2, key, 3, np.full((TILE, TILE), -5, np.int8))
    evidence.integrate_provisional(2, pose, look(ROOM, pose, LIDAR), LIDAR, CAP_M)
    assert evidence.is_provisional(2, key)
    assert evidence.versions(2)[key] == 3
    assert not evidence.merge_tile(2, key, 3, np.full((TILE, TILE), -5, np.int8))
    assert evidence.merge_tile(2, key, 4, np.full((TILE, TILE), 7, np.int8))
    assert not evidence.is_provisional(2, key)
    assert (evidence.tile(2, key) == 7).all()


@FEW
@given(SEEDS)
def test_the_belief_is_the_clamped_sum_over_sources(seed: int) -> None:
    evidence = merged(history(seed))
    explore(evidence, np.random.default_rng(seed), 2)
    total = np.sum([layer.cells.astype(int) for layer in evidence.layers.values()], axis=0)
    np.testing.assert_array_equal(evidence.belief(), np.clip(total, -LIMIT, LIMIT))
    assert len(evidence.layers) == 3


CELLS = np.zeros((TILE, TILE), np.int8)


@pytest.mark.parametrize(
    ("parcel", "said"),
    [
        ((1, TileKey(0, 0), 1, CELLS), "only drone 1 writes it"),
        ((2, TileKey(0, 0), 1, CELLS[:-1]), "int8 32x32"),
        ((2, TileKey(0, 0), 1, CELLS.astype(np.int16)), "int8 32x32"),
        ((2, TileKey(0, 0), 0, CELLS), "version 0"),
        ((2, TileKey(0, 0), 2**32, CELLS), "version 4294967296"),
        ((2, TileKey(0, 0), 1, CELLS + np.int8(LIMIT + 1)), "out of range"),
        ((2, TileKey(0, 0), 1, CELLS + np.int8(-128)), "out of range"),
        ((2, TileKey(MAX_TILES, 0), 1, CELLS), "far outside"),
        ((2, TileKey(0, -(2**62)), 1, CELLS), "far outside"),
    ],
)
def test_tiles_that_cannot_be_are_refused_and_leave_no_trace(parcel: Parcel, said: str) -> None:
    evidence = EvidenceMap(1)
    shape = evidence.shape
    with pytest.raises(InputError, match=said):
        evidence.merge_tile(*parcel)
    assert evidence.shape == shape
    assert not evidence.belief().any()
    assert evidence.versions(2) == {}


def test_a_map_grows_to_its_largest_extent_and_no_further() -> None:
    small, large = EvidenceMap(1), EvidenceMap(1, max_extent_m=512.0)
    for evidence, most_m in ((small, 128.0), (large, 512.0)):
        evidence.cover(-12.8, -12.8, most_m - 12.8 - 0.1, 0.0)
        assert evidence.shape == (256, round(most_m / CELL))
        with pytest.raises(InputError, match="far outside"):
            evidence.cover(0.0, 0.0, most_m, 0.0)
        scan = Scan(0.0, np.full(90, 1.0, np.float32))
        with pytest.raises(InputError, match="far outside"):
            evidence.integrate_provisional(2, Pose(-250.0, 0.0, 0.0), scan, LIDAR, CAP_M)
        assert evidence.shape == (256, round(most_m / CELL))
    for half_m, most_m in ((12.8, 25.0), (12.8, 600.0)):
        with pytest.raises(InputError, match="reserved"):
            EvidenceMap(1, half_m, most_m)


@pytest.mark.parametrize("pose", [Pose(math.nan, 0, 0), Pose(0, math.inf, 0), Pose(0, 0, math.nan), Pose(1e300, 0, 0)])
def test_poses_that_cannot_be_are_refused(pose: Pose) -> None:
    evidence = EvidenceMap(1)
    scan = Scan(0.0, np.full(90, 1.0, np.float32))
    with pytest.raises(InputError):
        evidence.integrate(pose, scan, LIDAR, CAP_M)
    with pytest.raises(InputError):
        evidence.integrate_provisional(2, pose, scan, LIDAR, CAP_M)
    assert not evidence.belief().any()


def test_ones_own_scans_are_not_a_peers() -> None:
    with pytest.raises(InputError, match="itself"):
        EvidenceMap(1).integrate_provisional(1, Pose(0, 0, 0), Scan(0.0, np.ones(90, np.float32)), LIDAR, CAP_M)


def test_what_was_never_seen_reads_as_nothing() -> None:
    evidence = EvidenceMap(1)
    assert not evidence.tile(7, TileKey(0, 0)).any()
    assert not evidence.tile(1, TileKey(10_000, 0)).any()
    assert evidence.versions(7) == {}
    assert not evidence.is_provisional(7, TileKey(0, 0))
    assert not evidence.is_provisional(1, TileKey(10_000, 0))


@pytest.mark.parametrize("begin", [(0.0, 0.0), (30.0, -8.0)])
def test_whatever_peers_send_there_is_room_for_own_scans_within_half_the_largest_extent(
    begin: tuple[float, float],
) -> None:
    evidence = EvidenceMap(1)
    evidence.begin_at(*begin)
    tile = np.full((TILE, TILE), -4, np.int8)
    home = math.floor(begin[0] / 3.2), math.floor(begin[1] / 3.2)
    for far in (TileKey(home[0] - 21, home[1]), TileKey(home[0], home[1] + 20), TileKey(-10_000, 0)):
        with pytest.raises(InputError, match="from where this drone began"):
            evidence.merge_tile(2, far, 1, tile)
    for column, row in itertools.product((-20, 19), (-20, 19)):
        assert evidence.merge_tile(2, TileKey(home[0] + column, home[1] + row), 1, tile)
    scan = Scan(0.0, np.full(LIDAR.beams, 3.0, np.float32))
    for x, y in itertools.product((-55.0, 55.0), (-55.0, 55.0)):
        evidence.integrate(Pose(begin[0] + x, begin[1] + y, 0.0), scan, LIDAR, CAP_M)
