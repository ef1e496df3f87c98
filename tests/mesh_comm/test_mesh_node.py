"""What a swarm can rely on: maps converge whatever the radio does, the budget holds, hostile bytes do nothing."""

from __future__ import annotations

import copy

import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from radio_room import CAP_M, KEY, LIDAR, Drone, carrying, contents, exchange, make_drone, room_scan, same_layers

from imagine.core.errors import InputError
from imagine.core.evidence import EvidenceMap, TileKey
from imagine.core.frames import Pose
from imagine.core.lidar import Scan
from imagine.mesh_comm import messages
from imagine.mesh_comm.codec import pack_tile, pack_versions, unpack_ranges
from imagine.mesh_comm.messages import MAX_DATAGRAM, Digest, Status, Tile, Tiles
from imagine.mesh_comm.node import MeshNode, MeshSettings
from imagine.mesh_comm.orders import Orders
from imagine.mesh_comm.seal import Sealer

QUICK = settings(max_examples=10, deadline=None, suppress_health_check=[HealthCheck.too_slow])


def ticks(start: float, seconds: float) -> np.ndarray:
    return start + 0.1 * np.arange(round(seconds / 0.1))


def snapshot(evidence: EvidenceMap) -> dict[int, tuple[bytes, bytes, bytes]]:
    layers = evidence.layers.items()
    return {s: (v.cells.tobytes(), v.versions.tobytes(), v.provisional.tobytes()) for s, v in layers}


def own_tiles(evidence: EvidenceMap) -> dict[TileKey, bytes]:
    """Return the cells of own tiles by their place: the grid around them may grow."""
    return {key: evidence.tile(evidence.own, key).tobytes() for key in evidence.versions(evidence.own)}


def wander(rng: np.random.Generator, drone: Drone, now: float) -> None:
    x, y, yaw = rng.uniform(-4, 5), rng.uniform(-3, 2), rng.uniform(-3, 3)
    drone.fly(Pose(float(x), float(y), float(yaw)), now)


def known_cells(drone: Drone) -> bytes:
    """Return the cells that a drone knows, with their places in the map: grids may reach further than what is known."""
    belief, (column0, row0) = drone.evidence.belief(), drone.evidence.origin_cells
    rows, columns = np.nonzero(belief)
    return np.stack((rows + row0, columns + column0, belief[rows, columns])).tobytes()


@QUICK
@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(2, 4),
    protocol=st.sampled_from(["one-hop", "multi-hop"]),
    loss=st.sampled_from([0.0, 0.3, 0.8]),
)
def test_maps_converge_after_loss_duplication_and_reordering(seed: int, count: int, protocol: str, loss: float) -> None:
    rng = np.random.default_rng(seed)
    drones = [make_drone(i + 1, protocol=protocol) for i in range(count)]
    in_the_air: list[tuple[Drone, bytes]] = []
    for now in ticks(0.0, 3.0):
        for drone in drones:
            wander(rng, drone, float(now))
        for drone in drones:
            for datagram in drone.poll(float(now)):
                for other in drones:
                    if other is not drone and rng.random() >= loss:
                        in_the_air += [(other, datagram)] * int(rng.integers(1, 3))
        rng.shuffle(in_the_air)  # type: ignore[arg-type]
        arrived = int(rng.integers(0, len(in_the_air) + 1))
        for other, datagram in in_the_air[:arrived]:
            other.node.receive(datagram, float(now))
        del in_the_air[:arrived]
    exchange(drones, ticks(3.0, 6.0))
    assert same_layers(drones)
    beliefs = {known_cells(drone) for drone in drones}
    assert len(beliefs) == 1  # nothing counted twice anywhere, or the sums would differ


def test_provisional_scans_are_seen_before_their_tiles_and_replaced_by_them() -> None:
    a, b = make_drone(1), make_drone(2)
    b.fly(Pose(0.0, 0.0, 0.0), 0.0)
    exchange([a, b], np.array([0.0]))  # now a has heard b
    a.fly(Pose(1.0, 0.0, 0.0), 0.1)
    exchange([a, b], np.array([0.1]))
    assert b.evidence.layers[1].provisional.any()
    assert not b.evidence.versions(1)
    assert b.node.scan_cells > 0
    assert b.node.map_cells == 0
    exchange([a, b], ticks(0.2, 3.0))
    assert same_layers([a, b])


def test_a_late_scan_is_not_drawn_over_a_tile_that_contains_it() -> None:
    a, b = make_drone(1), make_drone(2)
    b.fly(Pose(0.0, 0.0, 0.0), 0.0)
    exchange([a, b], np.array([0.0]))
    a.fly(Pose(1.0, 0.0, 0.0), 0.1)
    late = a.poll(0.1)  # the scan among them; b hears it only at the end
    exchange([a, b], ticks(0.2, 3.0))
    assert same_layers([a, b])
    before = snapshot(b.evidence)
    for datagram in late:
        b.node.receive(datagram, 3.3)
    assert snapshot(b.evidence) == before


def chain(a: int, b: int) -> bool:
    return abs(a - b) == 1


@pytest.mark.parametrize(("protocol", "crosses"), [("off", False), ("one-hop", False), ("multi-hop", True)])
def test_only_multi_hop_carries_maps_along_a_chain(protocol: str, crosses: bool) -> None:
    drones = [make_drone(i, protocol=protocol) for i in (1, 2, 3)]
    for now in ticks(0.0, 2.0):
        for drone in drones:
            drone.fly(Pose(drone.node.id - 2.0, 0.5, float(now)), float(now))
        exchange(drones, np.array([now]), chain)
    exchange(drones, ticks(2.0, 6.0), chain)
    assert (1 in drones[2].evidence.layers) == crosses
    assert (1 in drones[1].evidence.layers) == (protocol != "off")
    assert same_layers(drones) == crosses


def test_a_relayed_tile_is_the_confirmed_one_even_while_scans_are_drawn_over_it() -> None:
    a, b, c = (make_drone(i, protocol="multi-hop") for i in (1, 2, 3))
    b.fly(Pose(0.0, 0.0, 0.0), 0.0)
    a.fly(Pose(1.0, 0.0, 0.0), 0.0)
    exchange([a, b], ticks(0.0, 3.0))
    confirmed = b.evidence.versions(1)
    truth = {key: b.evidence.tile(1, key).copy() for key in confirmed}
    a.fly(Pose(1.0, 0.3, 0.4), 3.1)
    for datagram in carrying(a.poll(3.1), messages.Scan):  # the tiles get lost
        b.node.receive(datagram, 3.1)
    assert b.evidence.layers[1].provisional.any()
    c.fly(Pose(0.0, 1.0, 0.0), 3.1)
    exchange([b, c], ticks(3.2, 1.5))  # the source is still taken to be in reach of the relay
    assert c.evidence.versions(1) == confirmed
    assert all(np.array_equal(c.evidence.tile(1, key), cells) for key, cells in truth.items())


def drawn_by_a_source_that_left() -> tuple[Drone, Drone, Drone]:
    """Return a drone that left, one that heard its last scan and no tile of it, and one that was with neither."""
    a, b, c = (make_drone(i, protocol="multi-hop") for i in (1, 2, 3))
    b.fly(Pose(0.0, 0.0, 0.0), 0.0)
    a.fly(Pose(-1.0, 0.0, 0.0), 0.0)
    exchange([a, b], ticks(0.0, 3.0))
    a.fly(Pose(4.5, 1.0, 0.4), 3.1)
    for datagram in carrying(a.poll(3.1), messages.Scan):
        b.node.receive(datagram, 3.1)
    c.fly(Pose(-3.0, -1.0, 0.0), 6.0)
    return a, b, c


def test_what_a_source_told_before_it_left_is_passed_on_until_the_source_confirms_it() -> None:
    a, b, c = drawn_by_a_source_that_left()
    exchange([b, c], ticks(6.0, 4.0))
    for key in (TileKey(column, row) for column in range(-6, 6) for row in range(-6, 6)):
        np.testing.assert_array_equal(c.evidence.tile(1, key) != 0, b.evidence.tile(1, key) != 0)
    assert c.evidence.versions(1) == b.evidence.versions(1)  # nothing of it is confirmed
    assert c.evidence.layers[1].provisional.any()
    sketches = [m for m in contents([d for _, d in b.sent]) if isinstance(m, messages.Sketch)]
    places = [messages.tile_key(tile) for sketch in sketches for tile in sketch.tiles]
    assert len(places) == len(set(places)) > 0  # each is told once
    exchange([a, b, c], ticks(10.0, 4.0))
    assert same_layers([a, b, c])


def test_a_drone_that_restarts_within_a_moment_is_told_again_what_is_left_of_a_source() -> None:
    _, b, c = drawn_by_a_source_that_left()
    exchange([b, c], ticks(6.0, 4.0))
    again = make_drone(3, boot=2, protocol="multi-hop")
    again.fly(Pose(-3.0, -1.0, 0.0), 10.0)
    exchange([b, again], ticks(10.0, 4.0))
    assert c.evidence.layers[1].provisional.any()
    for key in (TileKey(column, row) for column in range(-6, 6) for row in range(-6, 6)):
        np.testing.assert_array_equal(again.evidence.tile(1, key), c.evidence.tile(1, key))


def test_a_sketch_tells_nothing_to_who_holds_a_later_version_or_hears_the_source() -> None:
    a = drawn_by_a_source_that_left()[0]
    d = make_drone(4, protocol="multi-hop")
    exchange([a, d], ticks(6.0, 2.0))
    before = snapshot(d.evidence)
    cells = pack_tile(np.full((32, 32), 8, np.int8))
    held = d.evidence.versions(1)
    key = min(held)
    old = messages.Sketch(1, [Tile(key.column, key.row, held[key] - 1, cells)], 1)
    same = messages.Sketch(1, [Tile(key.column, key.row, held[key], cells)], 1)
    forger = Sealer(KEY, 9, 1)
    d.node.receive(forger.seal(messages.encode(same), 8.0), 8.0)
    assert snapshot(d.evidence) == before  # the source is in reach
    d.node.receive(forger.seal(messages.encode(old), 20.0), 20.0)
    assert snapshot(d.evidence) == before
    d.node.receive(forger.seal(messages.encode(same), 20.0), 20.0)
    assert snapshot(d.evidence) != before
    assert d.evidence.versions(1) == held
    assert d.node.stats == {}


def test_a_drone_tells_where_it_is_more_often_while_a_peer_is_near() -> None:
    told = {}
    for apart in (1.0, 4.0):
        a, b = make_drone(1), make_drone(2)
        for now in ticks(0.0, 10.0):
            for drone, x in ((a, 0.0), (b, apart)):
                drone.node.set_status(Status(drone.node.id, float(now), Pose(x, 0.0, 0.0)))
            exchange([a, b], np.array([now]))
        poses = [m for m in contents([d for _, d in a.sent]) if isinstance(m, messages.Here | Status)]
        told[apart] = len(poses)
    assert told[4.0] == 20
    assert 45 <= told[1.0] <= 50


@pytest.mark.parametrize("protocol", ["off", "one-hop", "multi-hop"])
def test_the_ground_sees_every_drone_it_hears_and_adds_nothing(protocol: str) -> None:
    ground, a, b = (make_drone(i, protocol=protocol) for i in (0, 1, 2))
    swarm = [ground, a, b]
    for now in ticks(0.0, 1.0):
        a.fly(Pose(-1.0, 0.0, float(now)), float(now))
        b.fly(Pose(2.0, 0.0, float(now)), float(now))
        exchange(swarm, np.array([now]))
    exchange(swarm, ticks(1.0, 4.0))
    for drone in (a, b):
        assert ground.evidence.versions(drone.node.id) == drone.evidence.versions(drone.node.id)
        assert 0 not in drone.evidence.layers
    assert not ground.evidence.layers[0].cells.any()
    assert ground.node.bytes_sent["tile"] == ground.node.bytes_sent["scan"] == 0
    assert (2 in a.evidence.layers) == (protocol != "off")
    status = ground.node.peers(5.0)[1].status
    assert status is not None
    assert status.mode == "OFFBOARD"
    assert status.links.keys() == {0, 2}


def test_scans_are_sent_only_to_someone() -> None:
    alone = make_drone(1)
    for now in ticks(0.0, 3.0):
        alone.fly(Pose(float(now), 0.0, 0.0), float(now))
        alone.poll(float(now))
    assert alone.node.bytes_sent["scan"] == alone.node.bytes_sent["tile"] == alone.node.bytes_sent["digest"] == 0
    assert alone.node.bytes_sent["status"] > 0


@QUICK
@given(seed=st.integers(0, 2**32 - 1), rate=st.sampled_from([600.0, 3000.0, 31250.0]), burst=st.integers(1200, 8000))
def test_budget_and_datagram_size_hold_at_any_rate(seed: int, rate: float, burst: int) -> None:
    rng = np.random.default_rng(seed)
    drones = [make_drone(i, protocol="multi-hop", rate_bytes_per_s=rate, burst_bytes=float(burst)) for i in (1, 2, 3)]
    for now in ticks(0.0, 4.0):
        for drone in drones:
            wander(rng, drone, float(now))
        exchange(drones, np.array([now]))
    for drone in drones:
        times = np.array([at for at, _ in drone.sent])
        sizes = np.array([len(datagram) for _, datagram in drone.sent])
        assert sizes.max() <= MAX_DATAGRAM
        assert sizes.sum() == sum(drone.node.bytes_sent.values())
        for first in range(len(times)):
            window = times[first:] - times[first]
            assert np.all(np.cumsum(sizes[first:]) <= rate * window + burst + 1e-6)


def test_a_tight_budget_starves_neither_scans_nor_tiles() -> None:
    a, b = (make_drone(i, rate_bytes_per_s=1500.0, burst_bytes=1500.0) for i in (1, 2))
    for now in ticks(0.0, 20.0):
        a.fly(Pose(float(now) / 5, 0.3 * float(np.sin(now)), float(now)), float(now))
        b.fly(Pose(-1.0, 0.0, 0.0), float(now))
        exchange([a, b], np.array([now]))
    assert a.node.bytes_sent["scan"] > 2000
    assert a.node.bytes_sent["tile"] > 2000


def test_digests_of_a_large_team_leave_bytes_for_maps_at_a_very_low_rate() -> None:
    a, b = (make_drone(i, protocol="multi-hop", rate_bytes_per_s=833.0, burst_bytes=1200.0) for i in (1, 2))
    rng = np.random.default_rng(3)
    cells = np.full((32, 32), -8, np.int8)
    for source in range(3, 17):
        tiles = [Tile(i % 8 - 4, i // 8 - 2, int(rng.integers(1, 900)), pack_tile(cells)) for i in range(40)]
        a.node.receive(Sealer(KEY, source, 1).seal(messages.encode(Tiles(source, tiles, 1)), 0.0), 0.0)
    for now in ticks(0.0, 40.0):
        a.fly(Pose(0.02 * float(now), 0.0, 0.0), float(now))
        b.fly(Pose(0.0, 1.0, 0.0), float(now))
        exchange([a, b], np.array([now]))
    sent = a.node.bytes_sent
    assert sent["digest"] < 0.6 * sum(sent.values())
    assert sent["scan"] + sent["tile"] > 0.15 * sum(sent.values())
    assert b.evidence.versions(1)


def test_a_scan_of_many_beams_still_fits_a_datagram() -> None:
    from imagine.core.lidar import LidarSpec
    from imagine.mesh_comm.scan_exchange import draw_peer_scan, scan_message

    spec = LidarSpec(beams=3600)
    rng = np.random.default_rng(1)
    noise = Scan(0.0, rng.uniform(0.1, 4.0, 3600).astype(np.float32))
    message = scan_message(1, 5, Pose(0.0, 0.0, 0.0), noise, spec, CAP_M, 1170)
    assert len(messages.encode(message)) <= 1170
    assert message.beams < 3600
    assert message.beams * message.increment == pytest.approx(2 * np.pi, rel=1e-2)
    evidence = EvidenceMap(2)
    draw_peer_scan(evidence, message, np.zeros((0, 2)), 0.3)
    assert (evidence.belief() != 0).sum() > 500


def test_teammates_do_not_appear_as_walls() -> None:
    a, b = make_drone(1), make_drone(2)
    here, there = Pose(0.0, 0.0, 0.0), Pose(2.0, 0.0, 0.0)
    b.fly(there, 0.0)
    exchange([a, b], np.array([0.0]))
    scan = looking_at(there, here, 0.1)
    a.evidence.integrate(here, scan, LIDAR, CAP_M)
    a.node.offer_scan(scan, here, 0.1)
    exchange([a, b], np.array([0.1]))
    column0, row0 = b.evidence.origin_cells
    assert b.evidence.layers[1].cells[0 - row0, 19 - column0] <= 0
    assert b.evidence.layers[1].cells[5 - row0, 2 - column0] < 0
    assert np.allclose(a.node.teammates(0.1), [there[:2]])


def looking_at(teammate: Pose, here: Pose, now: float) -> Scan:
    """Return a scan whose beam straight ahead ends on a teammate."""
    scan = room_scan(here, now)
    scan.ranges[0] = np.hypot(teammate.x - here.x, teammate.y - here.y) - 0.05
    return scan


def test_a_sender_leaves_out_returns_from_teammates_it_knows() -> None:
    a, b = make_drone(1), make_drone(2)
    here, there = Pose(0.0, 0.0, 0.0), Pose(2.0, 0.0, 0.0)
    b.fly(there, 0.0)
    exchange([a, b], np.array([0.0]))
    scan = looking_at(there, here, 0.1)
    a.evidence.integrate(here, scan, LIDAR, CAP_M)
    a.node.offer_scan(scan, here, 0.1)
    (message,) = contents(carrying(a.poll(0.1), messages.Scan))
    assert isinstance(message, messages.Scan)
    ranges = unpack_ranges(message.packed, message.beams, CAP_M)
    assert np.isnan(ranges[0])
    assert np.isfinite(ranges).sum() > 15


def test_a_receiver_leaves_itself_out_of_a_scan_by_one_who_does_not_know_it() -> None:
    ground, a, b = (make_drone(i) for i in (0, 1, 2))
    here, there = Pose(0.0, 0.0, 0.0), Pose(2.0, 0.0, 0.0)
    b.fly(there, 0.0)
    exchange([ground, a], np.array([0.0]))  # a has never heard b, but the ground
    scan = looking_at(there, here, 0.1)
    a.evidence.integrate(here, scan, LIDAR, CAP_M)
    a.node.offer_scan(scan, here, 0.1)
    for datagram in carrying(a.poll(0.1), messages.Scan):
        b.node.receive(datagram, 0.1)
        ground.node.receive(datagram, 0.1)
    at = 0 - b.evidence.origin_cells[1], 19 - b.evidence.origin_cells[0]
    assert ground.evidence.layers[1].cells[at] > 0  # the ground cannot know better
    assert b.evidence.layers[1].cells[at] <= 0
    assert b.evidence.layers[1].cells.min() < 0


def test_a_tile_is_not_repeated_until_a_later_digest_still_lacks_it() -> None:
    a, b = make_drone(1), make_drone(2)
    a.fly(Pose(1.0, 0.0, 0.0), 0.0)
    b.fly(Pose(0.0, 0.0, 0.0), 0.0)
    a.evidence.integrate(Pose(1.0, 0.1, 0.0), room_scan(Pose(1.0, 0.1, 0.0), 0.0), LIDAR, CAP_M)
    tiles = len(a.evidence.versions(1))

    def sent_while(now: np.ndarray, heard: type) -> int:
        """Run without a ever reaching b, and count the tiles that a sends."""
        count = 0
        for t in now:
            count += sum(len(m.tiles) for m in contents(a.poll(float(t))) if isinstance(m, Tiles))
            for datagram in carrying(b.poll(float(t)), heard):
                a.node.receive(datagram, float(t))
        return count

    a_hello = carrying(a.poll(0.0), Status)
    b.node.receive(a_hello[0], 0.0)
    assert sent_while(np.array([0.1]), Digest) == 0
    assert sent_while(ticks(0.2, 2.0), Status) == tiles  # sent once; b's digests no longer come
    b.node.receive(a.poll(2.2)[0], 2.2)  # a sign of life, so that b goes on with digests
    assert sent_while(ticks(2.3, 1.5), Digest) >= tiles  # they still lack the tiles


def test_a_tile_that_keeps_changing_is_sent_once_a_period() -> None:
    a, b = make_drone(1), make_drone(2)
    for now in ticks(0.0, 4.0):
        a.fly(Pose(float(now) / 4, 0.0, float(now)), float(now))
        b.fly(Pose(-1.0, 0.0, 0.0), float(now))
        exchange([a, b], np.array([now]))
    sent: dict[tuple[int, int], list[float]] = {}
    for (now, _), message in zip(a.sent, contents([datagram for _, datagram in a.sent]), strict=True):
        for tile in message.tiles if isinstance(message, Tiles) else []:
            sent.setdefault((tile.column, tile.row), []).append(now)
    assert max(map(len, sent.values())) > 1
    assert all(np.diff(times).min(initial=9.0) >= 1.0 - 1e-6 for times in sent.values())


def test_nobody_relays_between_those_who_hear_each_other() -> None:
    drones = [make_drone(i, protocol="multi-hop") for i in (1, 2, 3)]
    rng = np.random.default_rng(2)
    relayed = 0
    for now in ticks(0.0, 5.0):
        for drone in drones:
            drone.fly(Pose(drone.node.id - 2.0 + float(now) / 4, 0.5, float(now)), float(now))
        # tiles get lost on the way to drone 3, so that others could think it needs their help
        exchange(drones, np.array([now]), lambda _, to: to != 3 or rng.random() > 0.5)
    for drone in drones:
        sent = contents([datagram for _, datagram in drone.sent])
        relayed += sum(isinstance(m, Tiles) and m.source != drone.node.id for m in sent)
        assert any(isinstance(m, Tiles) for m in sent)
    assert relayed == 0


def test_a_moving_teammate_is_followed_between_reports() -> None:
    a, b = make_drone(1), make_drone(2)
    b.node.set_status(Status(2, 0.0, Pose(1.0, 2.0, 0.0), velocity=(0.5, -0.2)))
    exchange([a, b], np.array([0.0]))
    assert np.allclose(a.node.teammates(0.4), [[1.2, 1.92]])
    assert a.node.teammates(5.0).shape == (0, 2)  # out of reach by now


def test_cells_are_credited_once_and_to_the_first() -> None:
    a, b = make_drone(1), make_drone(2)
    for now in ticks(0.0, 1.0):
        a.fly(Pose(-1.0, 0.0, float(now)), float(now))
        b.fly(Pose(2.0, 0.0, float(now)), float(now))
        exchange([a, b], np.array([now]))
    exchange([a, b], ticks(1.0, 4.0))
    node = b.node
    ever = node.own_cells + node.scan_cells + node.map_cells
    known_now = int((b.evidence.belief() != 0).sum())
    assert node.own_cells > 0
    assert node.scan_cells > 0
    assert known_now <= ever <= known_now + 0.05 * known_now  # a few cells fall back to exactly zero evidence
    silent = make_drone(3)
    silent.fly(Pose(0.0, 0.0, 0.0), 5.0)
    b.node.set_status(Status(2, 5.0, Pose(2.0, 0.0, 0.0)))
    exchange([b, silent], ticks(5.0, 4.0))
    assert silent.node.map_cells > 0  # b's tiles came without scans


def test_orders_reach_everyone_once_even_beyond_the_grounds_reach() -> None:
    ground, a, b = (make_drone(i) for i in (0, 1, 2))
    for now in ticks(0.0, 2.0):
        b.fly(Pose(0.5, 0.1 * now, 0.0), now)  # so that a holds of its map, and tells the ground
        exchange([ground, a, b], np.array([now]), chain)
    assert 2 not in ground.node.peers(2.0)
    first = ground.node.send_command("hold", 0, 2.0)
    exchange([ground, a, b], ticks(2.0, 3.0), chain)
    assert [(c.action, c.nonce) for c in a.node.commands()] == [("hold", first)]
    assert [(c.action, c.nonce) for c in b.node.commands()] == [("hold", first)]
    second = ground.node.send_command("land", 2, 5.0)
    exchange([ground, a, b], ticks(5.0, 3.0), chain)
    assert a.node.commands() == []
    assert [(c.action, c.nonce) for c in b.node.commands()] == [("land", second)]
    assert second > first


def test_an_order_to_fly_on_waits_until_a_drone_that_it_is_for_is_heard() -> None:
    ground, drone = make_drone(0), make_drone(1)
    nonce = ground.node.send_command("resume", 1, 0.0)
    assert not carrying(ground.poll(0.0), messages.Command)
    drone.node.set_status(Status(1, 0.1, Pose(0.0, 0.0, 0.0)))
    exchange([ground, drone], ticks(0.1, 0.5))
    assert [(c.action, c.nonce) for c in drone.node.commands()] == [("resume", nonce)]


@pytest.mark.parametrize("target", [0, 2])
@pytest.mark.parametrize("action", ["hold", "land"])
def test_a_drone_that_the_ground_never_heard_can_be_stopped(target: int, action: str) -> None:
    ground, known, silent = make_drone(0), make_drone(1), make_drone(2)
    known.node.set_status(Status(1, 0.0, Pose(0.0, 0.0, 0.0)))
    exchange([ground, known], ticks(0.0, 0.3))
    nonce = ground.node.send_command(action, target, 0.3)
    for datagram in carrying(ground.poll(0.3), messages.Command):
        silent.node.receive(datagram, 0.3)
    assert [(c.action, c.nonce) for c in silent.node.commands()] == [(action, nonce)]


@pytest.mark.parametrize("target", [0, 1])
def test_recorded_orders_do_nothing_to_a_drone_that_has_just_started(target: int) -> None:
    ground, drone = make_drone(0), make_drone(1)
    drone.node.set_status(Status(1, 0.0, Pose(0.0, 0.0, 0.0)))
    exchange([ground, drone], ticks(0.0, 0.3))
    ground.node.send_command("land", target, 0.3)
    exchange([ground, drone], ticks(0.3, 1.0))
    assert [c.action for c in drone.node.commands()] == ["land"]
    recorded = carrying([datagram for _, datagram in ground.sent], messages.Command)
    again = make_drone(1, boot=2)
    for datagram in recorded:
        again.node.receive(datagram, 5.0)
    assert again.node.commands() == []
    assert again.node.stats == {"old-life": len(recorded)}
    again.node.set_status(Status(1, 5.0, Pose(0.0, 0.0, 0.0)))
    exchange([ground, again], ticks(5.0, 0.3))
    ground.node.send_command("hold", target, 5.3)
    exchange([ground, again], ticks(5.3, 1.0))
    assert [c.action for c in again.node.commands()] == ["hold"]


def test_whoever_tells_the_ground_of_a_start_that_never_was_cannot_keep_a_drone_from_landing() -> None:
    ground, drone = make_drone(0), make_drone(1, boot=5)
    drone.node.set_status(Status(1, 0.0, Pose(0.0, 0.0, 0.0)))
    exchange([ground, drone], ticks(0.0, 0.3))
    lie = Digest(0.0, [messages.Holding(1, None, None, pack_versions({}), 2**32 - 1)])
    ground.node.receive(Sealer(KEY, 9, 1).seal(messages.encode(lie), 0.3), 0.3)
    for now, action in ((0.4, "resume"), (1.4, "land")):
        ground.node.send_command(action, 1, now)
        (order,) = carrying(ground.poll(now), messages.Command)
        drone.node.receive(order, now)
    assert [command.action for command in drone.node.commands()] == ["land"]
    assert drone.node.stats == {"old-life": 1}


def test_an_order_to_fly_on_is_refused_without_the_drones_name_and_passed_over_where_it_names_others() -> None:
    drone = make_drone(2)
    for number, order in enumerate((
        messages.Command("resume", 0, 7), messages.Command("resume", 2, 8, {1: 1}),
        messages.Command("resume", 0, 9, {1: 1}),
    )):  # fmt: skip
        sealed = Sealer(KEY, 0, 1 + number).seal(messages.encode(order), 0.0)
        drone.node.receive(sealed, 0.0)
    assert drone.node.commands() == []
    assert drone.node.stats == {"content": 2}


def test_an_order_to_more_drones_than_one_message_names_reaches_all() -> None:
    orders = Orders(0, 1, 2.0)
    nonce = orders.issue("land", 0, 0.0)
    (repeat,) = orders.due(0.0)
    starts = {id_: 2**32 - id_ for id_ in range(1, 255)}
    sent = repeat.commands(starts)
    assert {id_: boot for order in sent for id_, boot in order.starts.items()} == starts
    assert {(order.action, order.target, order.nonce) for order in sent} == {("land", 0, nonce)}
    sealed = 30 + 64  # header, tag and signature
    assert all(len(messages.encode(order)) + sealed <= MAX_DATAGRAM for order in sent)


def test_only_the_ground_gives_orders() -> None:
    drone, victim = make_drone(1), make_drone(2)
    with pytest.raises(InputError, match="only the ground"):
        drone.node.send_command("land", 0, 0.0)
    with pytest.raises(InputError, match="explode"):
        make_drone(0).node.send_command("explode", 0, 0.0)
    forged = Sealer(KEY, 1, 1).seal(messages.encode(messages.Command("land", 0, 7)), 0.0)
    victim.node.receive(forged, 0.0)
    assert victim.node.commands() == []
    assert victim.node.stats == {"content": 1}


def test_a_newer_order_silences_the_older_one() -> None:
    ground, a = make_drone(0), make_drone(1)
    a.node.set_status(Status(1, 0.0, Pose(0.0, 0.0, 0.0)))
    for datagram in a.poll(0.0):
        ground.node.receive(datagram, 0.0)
    ground.node.send_command("hold", 1, 0.0)
    assert carrying(ground.poll(0.0), messages.Command)
    ground.node.send_command("land", 0, 0.1)
    exchange([ground, a], ticks(0.1, 3.0))
    assert [c.action for c in a.node.commands()] == ["land"]


def test_a_restarted_drone_is_heard_again_and_its_map_replaces_the_old_one() -> None:
    a, b = make_drone(1, boot=1), make_drone(2)
    b.fly(Pose(0.0, 0.0, 0.0), 0.0)
    for now in ticks(0.0, 2.0):
        a.fly(Pose(1.0, 0.0, float(now)), float(now))
        exchange([a, b], np.array([now]))
    exchange([a, b], ticks(2.0, 2.0))
    old = b.evidence.versions(1)
    again = make_drone(1, boot=2)
    again.fly(Pose(-2.0, 0.0, 0.0), 4.0)
    exchange([again, b], ticks(4.0, 4.0))
    held = b.evidence.versions(1)
    assert same_layers([again, b])
    assert b.evidence.layers[1].boot == 2
    assert max(held.values()) < max(old.values())  # versions begin anew: the boot number is their high part
    assert old.keys() - held.keys()  # and what only the earlier life saw is gone
    for _, recording in a.sent:
        b.node.receive(recording, 9.0)
    assert b.evidence.versions(1) == held
    assert b.node.stats["old-boot"] == len(a.sent)


def test_a_restarted_drones_status_counts_although_its_clock_began_anew_and_a_pose_came_first() -> None:
    listening = make_drone(1)
    here = Pose(0.0, 0.0, 0.0)
    said = [
        (1, Status(2, 300.0, here, battery=0.2, links={3: 0.1})),
        (2, messages.Here(2, 1.0, here, (0.0, 0.0))),
        (2, Status(2, 1.5, here, battery=0.9)),
    ]
    for counter, (boot, message) in enumerate(said, start=1):
        sealer = Sealer(KEY, 2, boot, first_counter=counter)
        listening.node.receive(sealer.seal(messages.encode(message), 0.0), 0.0)
    status = listening.node.peers(0.0)[2].status
    assert status is not None
    assert status.battery == 0.9


def listener() -> Drone:
    drone = make_drone(2, protocol="multi-hop", max_sources=3)
    drone.fly(Pose(0.0, 0.0, 0.0), 0.0)
    return drone


@settings(max_examples=200, deadline=None)
@given(datagram=st.binary(max_size=1400))
def test_random_bytes_change_nothing_and_are_counted(datagram: bytes) -> None:
    drone = _LISTENER
    before, dropped = snapshot(drone.evidence), sum(drone.node.stats.values())
    drone.node.receive(datagram, 0.0)
    assert snapshot(drone.evidence) == before
    assert sum(drone.node.stats.values()) == dropped + 1


@settings(max_examples=300, deadline=None)
@given(data=st.data())
def test_mutated_messages_never_raise_even_under_the_right_key(data: st.DataObject) -> None:
    original = data.draw(st.sampled_from(_PAYLOADS))
    payload = bytearray(original)
    for _ in range(data.draw(st.integers(1, 4))):
        payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    payload = payload[: data.draw(st.integers(0, len(payload)))]
    drone = _LISTENER
    drone.node.receive(_FORGER.seal(bytes(payload), 0.0), 0.0)
    drone.node.poll(0.0)
    assert own_tiles(drone.evidence) == _OWN_TILES
    assert len(drone.evidence.layers) <= 4
    assert drone.evidence.belief().shape[0] <= 160 * 32


@settings(max_examples=100, deadline=None)
@given(data=st.data())
def test_a_datagram_altered_on_the_way_changes_nothing(data: st.DataObject) -> None:
    datagram = bytearray(_FORGER.seal(data.draw(st.sampled_from(_PAYLOADS)), 0.0))
    at = data.draw(st.integers(0, len(datagram) - 1))
    datagram[at] ^= 1 << data.draw(st.integers(0, 7))
    drone = _LISTENER
    before, dropped = snapshot(drone.evidence), sum(drone.node.stats.values())
    drone.node.receive(bytes(datagram), 0.0)
    assert snapshot(drone.evidence) == before
    assert sum(drone.node.stats.values()) == dropped + 1


def payloads() -> list[bytes]:
    sender = make_drone(1, protocol="multi-hop")
    sender.fly(Pose(0.5, 0.0, 0.0), 0.0)
    key, version = next(iter(sender.evidence.versions(1).items()))
    cells = pack_tile(sender.evidence.tile(1, key))
    from imagine.mesh_comm.digest import Held, digests
    from imagine.mesh_comm.scan_exchange import scan_message

    scan = scan_message(1, 1, Pose(0.5, 0.0, 0.0), room_scan(Pose(0.5, 0.0, 0.0), 0.0), LIDAR, CAP_M, 1170)
    made: list[messages.Message] = [
        scan,
        Tiles(1, [Tile(key.column, key.row, version, cells)], boot=1),
        Tiles(3, [Tile(key.column, key.row, version, cells)]),
        *digests(0.0, {2: Held(1, sender.evidence.versions(1)), 3: Held(1, {})}, 1170),
        Digest(0.0, []),
        Status(1, 0.0, Pose(0.5, 0.0, 0.0), reason="none", links={3: 0.5}),
        messages.Command("land", 2, 3),
    ]
    return [messages.encode(message) for message in made]


_LISTENER = listener()
_OWN_TILES = own_tiles(_LISTENER.evidence)
_PAYLOADS = payloads()
_FORGER = Sealer(KEY, 1, 1)


def test_a_tile_far_outside_is_refused_and_memory_stays_bounded() -> None:
    drone = listener()
    shape = drone.evidence.shape
    cells = pack_tile(np.ones((32, 32), np.int8))
    for column, row in ((160, 0), (-160, 0), (0, 160), (160, -160)):
        drone.node.receive(_FORGER.seal(messages.encode(Tiles(1, [Tile(column, row, 1, cells)], boot=1)), 0.0), 0.0)
    assert drone.evidence.shape == shape
    assert drone.node.stats["content"] == 4
    for source in range(3, 250):
        drone.node.receive(_FORGER.seal(messages.encode(Tiles(source, [Tile(0, 0, 1, cells)])), 0.0), 0.0)
    assert len(drone.evidence.layers) == 4  # own and max_sources


@pytest.mark.parametrize(
    "tiles",
    [
        Tiles(1, [Tile(0, 0, 1, b"\xff" * 900)], boot=1),
        Tiles(2, [Tile(0, 0, 2**31, b"\xff" * 900)], boot=1),  # the listener's own
        Tiles(1, [Tile(160, 0, 1, pack_tile(np.ones((32, 32), np.int8)))], boot=1),
        Tiles(200, [Tile(0, 0, 1, pack_tile(np.ones((32, 32), np.int8)))]),  # one source too many
    ],
    ids=["damaged", "own damaged", "far away", "too many sources"],
)
def test_nothing_is_noted_of_tiles_that_are_refused(tiles: Tiles) -> None:
    drone = listener()
    cells = pack_tile(np.ones((32, 32), np.int8))
    for source in (3, 4) if tiles.source == 1 else (3, 4, 5):
        drone.node.receive(_FORGER.seal(messages.encode(Tiles(source, [Tile(0, 0, 1, cells)])), 0.0), 0.0)
    record, noted = drone.node._state.peers.live(0.0)[0], len(drone.node._state.exchange._sent)
    before = copy.deepcopy(record.holdings)
    drone.node.receive(_FORGER.seal(messages.encode(tiles), 0.1), 0.1)
    assert drone.node.stats["content"] == 1
    assert record.holdings == before
    assert len(drone.node._state.exchange._sent) == noted


def test_what_newer_nodes_say_is_counted_and_hurts_nothing() -> None:
    drone = listener()
    before = snapshot(drone.evidence)
    order = messages.encode(messages.Command("land", 2, 3))
    kind_8, version_3 = bytes((order[0],)) + b"\x92\x08\x01", b"\x03" + order[1:]
    for payload in (kind_8, version_3, version_3):
        drone.node.receive(_FORGER.seal(payload, 0.0), 0.0)
    assert drone.node.stats == {"unknown-kind": 1, "wire-version": 2}
    status = msgspec.msgpack.decode(messages.encode(Status(1, 0.0, Pose(0.5, 0.0, 0.0)))[1:])
    drone.node.receive(_FORGER.seal(order[:1] + msgspec.msgpack.encode([*status, "news"]), 0.0), 0.0)
    assert drone.node.newer == 1
    assert drone.node.peers(0.0)[1].is_live
    assert sum(drone.node.stats.values()) == 3
    assert snapshot(drone.evidence) == before


def test_a_node_in_anothers_name_is_refused() -> None:
    drone = listener()
    status = messages.encode(Status(3, 0.0, Pose(0.0, 0.0, 0.0)))
    drone.node.receive(_FORGER.seal(status, 0.0), 0.0)
    assert drone.node.peers(0.0) == {}
    assert drone.node.stats == {"content": 1}


def test_the_same_calls_give_the_same_datagrams() -> None:
    def run() -> list[tuple[float, bytes]]:
        drones = [make_drone(i, protocol="multi-hop") for i in (1, 2, 3)]
        rng = np.random.default_rng(5)
        for now in ticks(0.0, 2.0):
            for drone in drones:
                wander(rng, drone, float(now))
            exchange(drones, np.array([now]))
        return [sent for drone in drones for sent in drone.sent]

    assert run() == run()


def test_a_map_of_another_drone_is_refused() -> None:
    with pytest.raises(InputError, match="map of 1"):
        MeshNode(EvidenceMap(1), LIDAR, CAP_M, MeshSettings(), Sealer(KEY, 2, 1))
