"""What messages are said to cost, held against messages of real nodes: framing to the byte, packed parts closely."""

from __future__ import annotations

import numpy as np
import pytest

from imagine.core.lidar import LD19
from imagine.mesh_comm import messages
from imagine.mesh_comm.codec import unpack_ranges, unpack_tile
from imagine.mesh_comm.settings import MeshSettings
from imagine.sim.air_costs import (
    SCAN_WEIGHTS,
    TILE_WEIGHTS,
    VERSIONS_WEIGHTS,
    digest_message_bytes,
    here_bytes,
    int_bytes,
    packed_ranges_bytes,
    packed_tile_bytes,
    scan_message_bytes,
    status_bytes,
    tile_in_message_bytes,
    tiles_message_bytes,
)
from imagine.sim.air_fit import collect
from imagine.sim.level import load_level
from imagine.sim.mesh_flight import RANGE_CAP_M, MeshFlight, Said
from imagine.sim.radio import RadioSettings


@pytest.fixture(scope="module")
def said() -> list[Said]:
    mesh = MeshSettings(protocol="multi-hop")
    return MeshFlight(load_level("4"), 3, RadioSettings(range_m=6.0), mesh, seed=3).fly(200).said


def test_framing_is_counted_to_the_byte(said: list[Said]) -> None:
    kinds = set()
    for item in said:
        message = item.message
        kinds.add(type(message))
        match message:
            case messages.Scan():
                expected = scan_message_bytes(len(message.packed), message.clock)
            case messages.Here():
                expected = here_bytes()
            case messages.Tiles() | messages.Sketch():
                each = [tile_in_message_bytes(len(tile.packed), tile.version) for tile in message.tiles]
                expected = tiles_message_bytes(len(message.tiles)) + sum(each)
            case messages.Digest():
                packed = sum(len(holding.packed) for holding in message.holdings)
                expected = digest_message_bytes(len(message.holdings), packed)
            case messages.Status():
                cells = (message.own_cells, message.scan_cells, message.map_cells)
                counters = np.array([*message.bytes_sent.values(), *cells])
                expected = status_bytes(counters, len(message.links))
                expected += sum(map(int_bytes, message.taught.values())) - 2 * 3  # said to take three bytes each
            case _:
                pytest.fail(f"a drone said {message}")
        assert item.sealed_bytes == expected
    assert kinds == {messages.Scan, messages.Tiles, messages.Digest, messages.Status, messages.Here}


@pytest.mark.parametrize(
    ("kind", "weights", "within"),
    [("scan", SCAN_WEIGHTS, 0.05), ("tile", TILE_WEIGHTS, 0.05), ("versions", VERSIONS_WEIGHTS, 0.08)],
)
def test_the_weights_still_fit_the_codec(
    said: list[Said], kind: str, weights: tuple[float, ...], within: float
) -> None:
    samples = collect(said)[kind]
    assert len(samples.packed_bytes) > 50
    estimated, packed = samples.estimated_bytes(weights), samples.packed_bytes
    assert estimated.sum() == pytest.approx(packed.sum(), rel=within)
    assert np.abs(estimated - packed).mean() < 0.12 * packed.mean()


def test_kernels_estimate_what_the_weights_say(said: list[Said]) -> None:
    scan = next(item.message for item in said if isinstance(item.message, messages.Scan))
    ranges = unpack_ranges(scan.packed, scan.beams, RANGE_CAP_M)
    assert packed_ranges_bytes(ranges, LD19.range_min, RANGE_CAP_M) == pytest.approx(len(scan.packed), rel=0.15)
    nothing = np.full(360, np.inf, np.float32)
    assert packed_ranges_bytes(nothing, LD19.range_min, RANGE_CAP_M) == round(SCAN_WEIGHTS[0] + SCAN_WEIGHTS[1])
    tiles = [tile for item in said if isinstance(item.message, messages.Tiles) for tile in item.message.tiles]
    tile = max(tiles, key=lambda tile: len(tile.packed))
    around = np.zeros((96, 128), np.int8)
    around[32:64, 64:96] = unpack_tile(tile.packed)
    assert packed_tile_bytes(around, 32, 64) == pytest.approx(len(tile.packed), rel=0.2)
    assert packed_tile_bytes(around, 0, 0) == round(TILE_WEIGHTS[0])


def test_a_scan_of_many_beams_is_thinned_to_a_datagram() -> None:
    noise = np.random.default_rng(0).uniform(0.1, 3.9, 3600).astype(np.float32)
    packed = packed_ranges_bytes(noise, 0.05, RANGE_CAP_M)
    assert packed > messages.MAX_DATAGRAM
    assert scan_message_bytes(packed, 1) == messages.MAX_DATAGRAM
