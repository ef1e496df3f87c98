"""The batched air against the real thing: the same poses and scans through mesh nodes and radio, and through arrays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from air_team import AirTeam, new_air
from numpy.typing import NDArray

from imagine.core.evidence import TileKey
from imagine.core.raster import TILE
from imagine.mesh_comm.settings import MeshSettings
from imagine.sim.level import load_level
from imagine.sim.mesh_flight import MeshFlight
from imagine.sim.radio import RadioSettings

DRONES, FLOWN, PARKED = 3, 260, 40


@dataclass(frozen=True)
class Pair:
    """A flight of real nodes and the batched air's replay of it; `known` by tick and drone."""

    real: MeshFlight
    team: AirTeam
    real_known: NDArray[np.int64]
    known: NDArray[np.int64]


@pytest.fixture(
    scope="module",
    params=[
        ("one-hop", RadioSettings()),
        ("multi-hop", RadioSettings(range_m=4.0, latency_s=0.15)),
        ("one-hop", RadioSettings(model="path-loss", tx_dbm=-10.0)),
    ],
    ids=["disc", "relays", "path-loss"],
)
def pair(request: pytest.FixtureRequest) -> Pair:
    """Explore level 4, then stand still until nothing is new."""
    protocol, radio = request.param
    level, mesh = load_level("4"), MeshSettings(protocol=protocol)
    real = MeshFlight(level, DRONES, radio, mesh, seed=2, parked_from=FLOWN + 1).fly(FLOWN + PARKED)
    team = AirTeam(new_air(level, DRONES, radio, mesh), level)
    known = []
    for number, flown in enumerate(real.ticks, start=1):
        team.tick(flown.poses, flown.ranges if number <= FLOWN else None, flown.velocities)
        known.append(team.known)
    return Pair(real, team, np.array([flown.known for flown in real.ticks]), np.array(known))


def test_bytes_by_kind_agree(pair: Pair) -> None:
    real = pair.real.ticks[-1].bytes_sent
    assert (real.sum(axis=0) > 1000).all()
    np.testing.assert_allclose(pair.team.bytes_sent.sum(axis=0), real.sum(axis=0), rtol=0.1)
    np.testing.assert_allclose(pair.team.bytes_sent.sum(axis=1), real.sum(axis=1), rtol=0.1)


def test_beliefs_grow_alike(pair: Pair) -> None:
    most = pair.real_known[-1].max()
    apart = np.abs(pair.known - pair.real_known) / most
    assert pair.real_known[-1].min() > 5000
    assert apart.mean() < 0.001
    assert apart.max() < 0.01


def test_what_was_exchanged_is_the_same_map(pair: Pair) -> None:
    """Own layers at all times, and others' once nothing is new: versions and cells are equal to the last one."""
    level, team = pair.real.level, pair.team
    column0, row0, _, _ = level.grid
    settled = 0
    for holder, evidence in enumerate(pair.real.maps):
        for source in range(DRONES):
            for row, column in np.ndindex(team.versions.shape[2:]):
                key = TileKey(column + column0 // TILE, row + row0 // TILE)
                version = evidence.versions(source + 1).get(key, 0)
                truth = pair.real.maps[source].versions(source + 1).get(key, 0)
                if holder != source and version != truth:
                    continue  # out of reach since
                settled += holder != source and version > 0
                assert team.versions[holder, source, row, column] == version
                cells = team.layers[holder, source, row * TILE : (row + 1) * TILE, column * TILE : (column + 1) * TILE]
                np.testing.assert_array_equal(cells, evidence.tile(source + 1, key))
    assert settled > 20


def test_links_are_the_same(pair: Pair) -> None:
    ticks = np.array([[link.ticks for link in row[1:]] for row in pair.real.radio.links[1:]])
    np.testing.assert_array_equal(pair.team.air.state.links[0]["ticks"], ticks)
    assert 0 < ticks.sum() < DRONES * (DRONES - 1) * (FLOWN + PARKED)
    delivered = sum(link.delivered_bytes for row in pair.real.radio.links[1:] for link in row[1:])
    assert pair.team.air.state.links[0]["delivered_bytes"].sum() == pytest.approx(delivered, rel=0.1)


def test_who_made_cells_known_is_counted_alike(pair: Pair) -> None:
    real = np.array([(node.own_cells, node.scan_cells, node.map_cells) for node in pair.real.nodes])
    counted = pair.team.cells_known()
    np.testing.assert_allclose(counted.sum(axis=1), pair.known[-1], rtol=0.001)
    assert np.abs(counted - real).max() < 0.04 * real.sum(axis=1).max()


def test_everyone_is_heard_where_it_is(pair: Pair) -> None:
    now = len(pair.real.ticks) * 0.1
    for holder, node in enumerate(pair.real.nodes):
        for number, peer in node.peers(now).items():
            seen = pair.team.air.state.peers[0, holder, number - 1]
            assert 0.1 * (pair.team.ticks - seen["heard_tick"]) == pytest.approx(peer.age_s, abs=0.11)
            assert peer.pose is not None
            assert np.hypot(seen["x"] - peer.pose.x, seen["y"] - peer.pose.y) < 0.1
