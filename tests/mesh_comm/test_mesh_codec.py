"""What scans, tiles and version lists are packed into: exact, small, and safe to read whatever comes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from imagine.core.errors import InputError
from imagine.core.evidence import EvidenceMap, TileKey
from imagine.core.frames import Pose
from imagine.core.lidar import LD19, Scan
from imagine.core.raster import LIMIT, TILE
from imagine.mesh_comm.codec import pack_ranges, pack_tile, pack_versions, unpack_ranges, unpack_tile, unpack_versions
from imagine.mesh_comm.tile_model import PLAIN_TILE_BYTES
from imagine.mesh_comm.version_model import MOST_LISTED

ranges_m = st.lists(
    st.one_of(st.floats(0.0, 15.0, width=32), st.sampled_from([np.inf, np.nan])), min_size=1, max_size=80
)


@given(ranges_m, st.sampled_from([0.05, 2.0, 2.4, 4.0, 12.345, 30.0]))
def test_ranges_come_back_to_half_a_centimetre(values: list[float], cap: float) -> None:
    ranges = np.array(values, np.float32)
    back = unpack_ranges(pack_ranges(ranges, 0.05, cap), len(ranges), cap)
    measured = (ranges.astype(float) >= 0.05) & (ranges.astype(float) <= cap)
    assert np.all(np.abs(back[measured].astype(float) - ranges[measured]) <= 0.0051)
    assert np.all(back[measured].astype(float) <= cap)
    assert np.all(np.isposinf(back) == (ranges.astype(float) > cap))
    assert np.all(np.isnan(back) == (np.isnan(ranges) | (ranges.astype(float) < 0.05)))
    assert pack_ranges(back, 0.0, cap) == pack_ranges(ranges, 0.05, cap)  # what was heard can be said again


@pytest.mark.parametrize("cap", [2.4, 3.6, 4.0])  # as float32 the first is greater, the second less, the third equal
def test_hits_just_inside_the_cap_are_drawn_as_their_source_drew_them(cap: float) -> None:
    pose, ranges = Pose(0.05, 0.05, 0.0), np.full(LD19.beams, cap - 0.002, np.float32)
    heard = unpack_ranges(pack_ranges(ranges, LD19.range_min, cap), LD19.beams, cap)
    drawn = []
    for seen in (ranges, heard):
        evidence = EvidenceMap(1, half_extent_m=6.4)
        evidence.integrate(pose, Scan(0.0, seen), LD19, cap)
        drawn.append(evidence.layers[1].cells)
    assert (drawn[0] > 0).sum() > 100
    assert np.array_equal(*drawn)


def room_turn(noise_m: float) -> NDArray[np.float32]:
    bearing = (np.arange(360) + 0.5) * 2 * np.pi / 360
    ranges = np.minimum(3.0 / np.abs(np.cos(bearing)), 2.5 / np.abs(np.sin(bearing)))
    return (ranges + np.random.default_rng(3).normal(0, noise_m, 360)).astype(np.float32)


def test_a_room_takes_the_bits_that_its_noise_takes() -> None:
    """A normal error of one step has 2.05 bits; following the walls through it costs less than one more."""
    assert len(pack_ranges(room_turn(0.01), 0.05, 4.0)) * 8 < 360 * 3.05
    assert len(pack_ranges(room_turn(0.0), 0.05, 4.0)) * 8 < 360 * 2.05
    assert len(pack_ranges(np.full(360, np.inf, np.float32), 0.05, 4.0)) < 20


cells_of_noise = st.builds(
    lambda seed, share: np.where(
        np.random.default_rng(seed).random((TILE, TILE)) < share,
        np.random.default_rng(seed + 1).integers(-LIMIT, LIMIT + 1, (TILE, TILE)),
        0,
    ).astype(np.int8),
    st.integers(0, 2**31),
    st.floats(0.0, 1.0),
)


def flown_tiles() -> list[NDArray[np.int8]]:
    """Return the tiles of a map that a drone made on its way through a room."""
    evidence = EvidenceMap(1, half_extent_m=6.4)
    for k in range(12):
        turn = room_turn(0.01) + np.float32(0.01 * k)
        evidence.integrate(Pose(0.05 * k, -0.03 * k, 0.02 * k), Scan(0.1 * k, turn), LD19, 4.0)
    return [evidence.tile(1, key).copy() for key in evidence.versions(1)]


@given(cells_of_noise)
def test_any_tile_comes_back_equal_and_fits_a_datagram(cells: NDArray[np.int8]) -> None:
    packed = pack_tile(cells)
    assert np.array_equal(unpack_tile(packed), cells)
    assert len(packed) <= PLAIN_TILE_BYTES < 700


@pytest.mark.parametrize("value", [-LIMIT, -1, 0, 1, LIMIT])
def test_even_tiles_take_a_few_bytes(value: int) -> None:
    cells = np.full((TILE, TILE), value, np.int8)
    assert np.array_equal(unpack_tile(pack_tile(cells)), cells)
    assert len(pack_tile(cells)) <= (6 if value % LIMIT == 0 else 200)
    assert pack_tile(np.zeros((TILE, TILE), np.int8)) == b""


def test_tiles_of_maps_come_back_equal_and_small() -> None:
    tiles = flown_tiles()
    packed = [pack_tile(cells) for cells in tiles]
    assert len(tiles) >= 4
    assert all(np.array_equal(unpack_tile(p), cells) for p, cells in zip(packed, tiles, strict=True))
    assert sum(map(len, packed)) < 120 * len(tiles)


def test_only_tiles_are_packed() -> None:
    for cells in (
        np.full((TILE, TILE), LIMIT + 1, np.int8),
        np.full((TILE, TILE), -LIMIT - 1, np.int8),
        np.zeros((TILE, TILE + 1), np.int8),
        np.zeros((TILE, TILE), np.int16),
    ):
        with pytest.raises(InputError, match="mesh tile"):
            pack_tile(cells)


def test_cells_of_a_view_are_packed_as_those_of_a_copy() -> None:
    large = np.zeros((3 * TILE, 3 * TILE), np.int8)
    large[TILE : 2 * TILE, TILE : 2 * TILE] = flown_tiles()[0]
    view = large[TILE : 2 * TILE, TILE : 2 * TILE]
    assert pack_tile(view) == pack_tile(view.copy())


tile_keys = st.builds(TileKey, st.integers(-160, 160), st.integers(-160, 160))
versions = st.dictionaries(tile_keys, st.integers(1, 2**32 - 1), max_size=300)


@given(versions)
def test_versions_come_back_equal(held: dict[TileKey, int]) -> None:
    assert unpack_versions(pack_versions(held)) == held


def test_a_map_of_one_version_takes_little_and_comes_back() -> None:
    held = {TileKey(column, row): 70 for column in range(-32, 32) for row in range(-32, 32)}
    assert len(held) == MOST_LISTED
    assert unpack_versions(pack_versions(held)) == held
    assert len(pack_versions(held)) < 200
    with pytest.raises(InputError, match="split"):
        pack_versions({**held, TileKey(99, 99): 1})


def read_all(packed: bytes) -> None:
    """Read bytes as anything: either they are refused, or what they tell is within bounds."""
    for read in (unpack_tile, lambda data: unpack_ranges(data, 360, 4.0), unpack_versions):
        try:
            found = read(packed)
        except InputError:
            continue
        if isinstance(found, dict):
            assert len(found) <= 64 * (len(packed) + 1)
            assert all(max(abs(key.column), abs(key.row)) <= 160 and 0 <= v < 2**32 for key, v in found.items())
        elif found.dtype == np.int8:
            assert found.shape == (TILE, TILE)
            assert np.abs(found).max() <= LIMIT
        else:
            assert found.shape == (360,)
            hits = found[np.isfinite(found)]
            assert ((hits >= 0.0) & (hits <= np.float32(4.0))).all()


@settings(max_examples=300, deadline=None)
@given(st.binary(max_size=1200))
def test_noise_is_refused_or_read_within_bounds(noise: bytes) -> None:
    read_all(noise)


_SOUND = [pack_tile(cells) for cells in flown_tiles()] + [
    pack_ranges(room_turn(0.01), 0.05, 4.0),
    pack_versions({TileKey(k % 7, k // 7): 5 * k + 1 for k in range(60)}),
    pack_tile(np.random.default_rng(0).integers(-LIMIT, LIMIT + 1, (TILE, TILE)).astype(np.int8)),
]


@settings(max_examples=300, deadline=None)
@given(st.sampled_from(_SOUND), st.data())
def test_cut_and_altered_bytes_are_refused_or_read_within_bounds(sound: bytes, data: st.DataObject) -> None:
    damaged = bytearray(sound)
    for _ in range(data.draw(st.integers(0, 3))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] = data.draw(st.integers(0, 255))
    read_all(bytes(damaged[: data.draw(st.integers(0, len(damaged)))]))


def test_bytes_left_over_are_refused() -> None:
    tile, turn = _SOUND[0], pack_ranges(room_turn(0.01), 0.05, 4.0)
    listed = pack_versions({TileKey(k, 0): 9 for k in range(40)})
    for more in (b"\x01", b"\xff" * 400):
        with pytest.raises(InputError, match="cells"):
            unpack_tile(tile + b"\0\0\0\0" + more)
        with pytest.raises(InputError, match="ranges"):
            unpack_ranges(turn + b"\0\0\0\0" + more, 360, 4.0)
        with pytest.raises(InputError, match="list"):
            unpack_versions(listed + b"\0\0\0\0" + more)


def test_a_plain_tile_beyond_the_limit_is_refused() -> None:
    with pytest.raises(InputError, match="within"):
        unpack_tile(b"\xff" * PLAIN_TILE_BYTES)


def test_few_bytes_cannot_claim_many_tiles() -> None:
    held = {TileKey(column, row): 70 for column in range(-32, 32) for row in range(-32, 32)}
    packed = pack_versions(held)
    with pytest.raises(InputError, match="claim"):
        unpack_versions(packed.rstrip(b"\0")[: MOST_LISTED // 64 - 2])
