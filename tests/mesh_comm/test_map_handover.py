"""What it takes to hand over the map of a whole house, by real nodes, sealing included."""

from __future__ import annotations

import lzma

import numpy as np
import pytest
from numpy.typing import NDArray
from radio_room import CAP_M, KEY, LIDAR

from imagine.core.evidence import EvidenceMap
from imagine.core.frames import Pose
from imagine.core.raster import TILE
from imagine.mesh_comm.messages import MAX_DATAGRAM, Status
from imagine.mesh_comm.node import MeshNode, MeshSettings
from imagine.mesh_comm.seal import Sealer
from imagine.sim.exploration import Exploration
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.train.baselines import baseline

TEAM = 3


@pytest.fixture(scope="module")
def layers() -> list[NDArray[np.int8]]:
    """Return what each of three drones has seen by itself of level 6, the furnished house, when all of it is known."""
    env = Exploration(ExplorationSettings(levels=("6",), worlds=1, drones=TEAM, stop_coverage=1.0), seed=5)
    observation, pilot = env.reset(), baseline("coordinated", 0)
    pilot.begin(env)
    for _ in range(900):
        observation = env.step(np.nan_to_num(pilot.act(env, observation))).observation
    seen, coverable = env.maps.arrays.seen[0], env.maps.arrays.coverable[0]
    assert (seen & coverable).sum() > 0.99 * coverable.sum()
    return [env.maps.arrays.layers[0, drone, drone].copy() for drone in range(TEAM)]


def node_with(number: int, layer: NDArray[np.int8] | None) -> tuple[MeshNode, EvidenceMap]:
    evidence = EvidenceMap(number, half_extent_m=16.0)
    if layer is not None:
        own = evidence.layers[number]
        own.cells[: layer.shape[0], : layer.shape[1]] = layer
        rows, columns = own.versions.shape
        has_any = own.cells.reshape(rows, TILE, columns, TILE).any(axis=(1, 3))
        own.versions[has_any] = 200 + np.arange(has_any.sum()) * 37 % 600  # as they come after a minute or two
        own.clock = 800
    settings = MeshSettings(protocol="one-hop")
    node = MeshNode(evidence, LIDAR, CAP_M, settings, Sealer(KEY, number, 1))
    node.set_status(Status(number, 0.0, Pose(0.0, 0.0, 0.0)))
    return node, evidence


def hand_over(layers: list[NDArray[np.int8]]) -> int:
    """Let nodes that hold `layers` meet one that knows nothing until it has it all; return the bytes of all tiles."""
    givers = [node_with(number, layer) for number, layer in enumerate(layers, start=1)]
    taker, taken = node_with(9, None)
    everyone = [node for node, _ in givers] + [taker]
    for tick in range(80):
        for sender in everyone:
            for datagram in sender.poll(0.1 * tick):
                assert len(datagram) <= MAX_DATAGRAM
                for node in everyone:
                    if node is not sender:
                        node.receive(datagram, 0.1 * tick)
    assert all(node.stats == {} for node in everyone)
    for node, evidence in givers:
        assert taken.versions(node.id) == evidence.versions(node.id) != {}
        assert all(
            np.array_equal(taken.tile(node.id, key), evidence.tile(node.id, key)) for key in evidence.versions(node.id)
        )
    return sum(node.bytes_sent["tile"] for node, _ in givers)


def xz_bytes(layer: NDArray[np.int8]) -> int:
    """Return what `xz -9` makes of a layer, cut to the tiles that hold any, of which only free or occupied is kept."""
    rows, columns = np.nonzero(layer)
    low, high = (rows.min() // TILE, columns.min() // TILE), (rows.max() // TILE + 1, columns.max() // TILE + 1)
    cut = layer[low[0] * TILE : high[0] * TILE, low[1] * TILE : high[1] * TILE]
    return len(lzma.compress(np.sign(cut).tobytes(), preset=9))


def float32_bytes(layer: NDArray[np.int8]) -> int:
    """Return what the tiles that hold any take as raw float32."""
    rows, columns = layer.shape
    return int(layer.reshape(rows // TILE, TILE, columns // TILE, TILE).any(axis=(1, 3)).sum()) * TILE * TILE * 4


def test_a_layer_takes_less_than_thrice_what_xz_makes_of_free_and_occupied(layers: list[NDArray[np.int8]]) -> None:
    for layer in layers:
        sent = hand_over([layer])
        assert sent < 2 * xz_bytes(layer)
        assert sent * 60 < float32_bytes(layer)


def test_the_whole_map_takes_no_more_than_its_layers(layers: list[NDArray[np.int8]]) -> None:
    sent = hand_over(layers)
    assert sent < 2 * sum(map(xz_bytes, layers))
    assert sent * 60 < sum(map(float32_bytes, layers))
