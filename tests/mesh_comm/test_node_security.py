"""Whole nodes with wrong, changed and signing keys, and with clocks that differ by hours."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from radio_room import CAP_M, KEY, LIDAR, Drone, exchange, make_drone, same_layers

from imagine.core.evidence import EvidenceMap, TileKey
from imagine.core.frames import Pose
from imagine.mesh_comm.keyring import KeyRing, SwarmKey, ground_public
from imagine.mesh_comm.messages import MAX_DATAGRAM, Status
from imagine.mesh_comm.node import MeshNode, MeshSettings
from imagine.mesh_comm.seal import Sealer

POSES = (Pose(0.0, 0.0, 0.0), Pose(2.0, -1.0, 1.0), Pose(-2.0, 1.0, -2.0))
SIGN, OTHER = bytes(range(1, 33)), bytes(range(2, 34))
BLANK = np.ones((32, 32), np.int8)
SIGNING = KeyRing((SwarmKey(KEY),), ground_public(SIGN), SIGN)


def keyed(id_: int, keys: KeyRing | bytes, boot: int = 1, unix_time_s: float = 0.0) -> Drone:
    evidence = EvidenceMap(id_, half_extent_m=6.4)
    return Drone(MeshNode(evidence, LIDAR, CAP_M, MeshSettings(), Sealer(keys, id_, boot, unix_time_s)), evidence)


def settle(drones: list[Drone], start: float = 0.0, ticks: int = 60) -> None:
    """Scan ten times, each from its place, and talk on."""
    for tick in range(ticks):
        now = start + tick / 10
        for drone, pose in zip(drones, POSES, strict=False):
            if tick < 10 and drone.node.id:
                drone.fly(pose, now)
        exchange(drones, np.array([now]))


def test_a_drone_with_the_wrong_key_sees_nothing_and_changes_nothing() -> None:
    alone = [make_drone(1), make_drone(2)]
    settle(alone)
    with_stranger = [make_drone(1), make_drone(2), make_drone(3, key=bytes(32))]
    settle(with_stranger)
    for drone, reference in zip(with_stranger, alone, strict=False):
        assert np.array_equal(drone.evidence.belief(), reference.evidence.belief())
        assert set(drone.node.peers(6.0)) == {1, 2} - {drone.node.id}
        assert drone.node.stats["unknown-key"] > 10
    stranger = with_stranger[2]
    assert stranger.node.peers(6.0) == {}
    assert set(stranger.evidence.layers) == {3}
    assert set(stranger.node.stats) == {"unknown-key"}


def test_a_key_that_ends_in_flight_ends_what_its_holder_says() -> None:
    ring = KeyRing((SwarmKey(KEY, accepted_until=1003.0), SwarmKey(OTHER, sends_from=1001.0)))
    drones = [keyed(1, ring, unix_time_s=1000.0), keyed(2, ring, unix_time_s=1000.0), keyed(3, KEY)]
    settle(drones)
    assert same_layers(drones[:2])  # the change went unnoticed
    assert drones[0].node.peers(5.9)[2].is_live
    assert not drones[0].node.peers(5.9)[3].is_live
    assert drones[0].node.stats["expired-key"] > 0
    assert drones[2].node.stats["unknown-key"] > 0  # and it hears no more of the others either


@pytest.mark.parametrize("offsets_h", [(0.0, 3.0, -5.0), (1e5, 0.0, 12.0)])
def test_clocks_that_differ_by_hours_change_nothing(offsets_h: tuple[float, ...]) -> None:
    together, apart = [[make_drone(id_) for id_ in (1, 2, 3)] for _ in range(2)]
    settle(together)
    offsets = [3600.0 * hours for hours in offsets_h]
    for tick in range(60):
        now = tick / 10
        for drone, pose, offset in zip(apart, POSES, offsets, strict=True):
            if tick < 10:
                drone.fly(pose, now + offset)
        for drone, offset in zip(apart, offsets, strict=True):
            for datagram in drone.poll(now + offset):
                for other, theirs in zip(apart, offsets, strict=True):
                    if other is not drone:
                        other.node.receive(datagram, now + theirs)
    assert same_layers(apart)
    for drone, reference, offset in zip(apart, together, offsets, strict=True):
        assert np.array_equal(drone.evidence.belief(), reference.evidence.belief())
        peers = drone.node.peers(5.9 + offset)
        assert all(peer.is_live for peer in peers.values())
        assert {id_: peer.pose for id_, peer in peers.items()} == {
            id_: peer.pose for id_, peer in reference.node.peers(5.9).items()
        }
        assert not drone.node.stats


def test_only_the_signing_ground_is_obeyed_and_its_orders_are_passed_on_as_signed() -> None:
    ground, near, far = keyed(0, SIGNING), keyed(1, SIGNING.for_drones()), keyed(2, SIGNING.for_drones())
    captured = keyed(0, dataclasses.replace(SIGNING, ground_sign=None, ground_verify=None), boot=9)
    near.node.set_status(Status(1, 0.0, Pose(0.0, 0.0, 0.0)))
    for now in (0.0, 0.1):
        far.fly(Pose(0.5, now, 0.0), now)  # so that `near` holds of its map, and tells the ground
        exchange([near, far], np.array([now]))
    captured.node.send_command("land", 0, 0.0)
    exchange([captured, near], np.arange(0.0, 1.0, 0.1))
    assert near.node.commands() == []
    assert near.node.stats["unsigned"] > 0
    ground.node.send_command("hold", 0, 1.0)
    exchange([ground, near, far], np.arange(1.0, 2.0, 0.1), hears=lambda a, b: abs(a - b) == 1)  # by way of `near`
    assert [order.action for order in far.node.commands()] == ["hold"]


def test_datagrams_of_a_signing_ground_are_not_longer_than_others() -> None:
    longest = []
    for keys in (SIGNING, KEY):
        ground, rng, lengths = keyed(0, keys), np.random.default_rng(1), []
        for tick in range(400):  # digests of every length
            for row in (-1, 0):
                version = int(rng.integers(1, 2**31))
                ground.evidence.merge_tile(1, TileKey(tick % 40 - 20, tick // 40 * 2 + row), version, BLANK)
            lengths += [len(datagram) for datagram in ground.node.poll(tick / 2)]
        longest.append(max(lengths))
    assert all(MAX_DATAGRAM - 64 < length <= MAX_DATAGRAM for length in longest)
