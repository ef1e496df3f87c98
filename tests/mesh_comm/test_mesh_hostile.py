"""Bytes that are none of the swarm's, in masses: nothing crashes, nothing changes, nothing grows.

`IMAGINE_HOSTILE` says how many; `imagine bench mesh` plays a million.
"""

from __future__ import annotations

import os
import tracemalloc

import numpy as np
from radio_room import CAP_M, KEY, LIDAR, exchange, make_drone

from imagine.core.evidence import EvidenceMap, TileKey
from imagine.core.frames import Pose
from imagine.mesh_comm.codec import pack_versions
from imagine.mesh_comm.messages import Digest, Holding, encode
from imagine.mesh_comm.node import MeshNode, MeshSettings
from imagine.mesh_comm.seal import Sealer
from imagine.train.mesh_bench.endurance import play, state

COUNT = int(os.environ.get("IMAGINE_HOSTILE", "20000"))


def test_altered_and_random_datagrams_change_nothing_and_take_no_memory() -> None:
    team = [make_drone(i, protocol="multi-hop") for i in (0, 1, 2)]
    for tick in range(20):
        for drone in team[1:]:
            drone.fly(Pose(0.1 * tick, 0.5 * drone.node.id, 0.0), 0.1 * tick)
        exchange(team, np.array([0.1 * tick]))
    team[0].node.send_command("hold", 0, 2.0)
    exchange(team, np.array([2.0, 2.1]))
    sound = [datagram for drone in team for _, datagram in drone.sent]
    evidence = EvidenceMap(9)
    node = MeshNode(evidence, LIDAR, CAP_M, MeshSettings(protocol="multi-hop"), Sealer(KEY, 9, 1))
    for datagram in sound:
        node.receive(datagram, 2.2)
    node.commands()
    before, refused = state(node, evidence), sum(node.stats.values())
    rng = np.random.default_rng(4)
    play(node, sound, 1000, rng, 2.2)
    tracemalloc.start()
    start, _ = tracemalloc.get_traced_memory()
    play(node, sound, COUNT, rng, 2.2)
    end, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert state(node, evidence) == before
    assert sum(node.stats.values()) == refused + 1000 + COUNT
    assert end - start < 50_000


def test_digests_of_more_tiles_than_any_map_has_take_no_memory() -> None:
    drone, liar = make_drone(1, protocol="multi-hop"), Sealer(KEY, 9, 1)
    tracemalloc.start()
    start, _ = tracemalloc.get_traced_memory()
    for source in (1, 2):
        for column in range(-160, 148, 12):
            keys = [TileKey(column + i, row) for i in range(1, 13) for row in range(-160, 161)]
            listed = Holding(source, (column, 160), (column + 12, 160), pack_versions(dict.fromkeys(keys, 1)), 1)
            drone.node.receive(liar.seal(encode(Digest(1.0, [listed])), 0.0), 0.0)
    end, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert drone.node.stats == {}
    assert end - start < 1_000_000  # of 200 000 tiles that are claimed
