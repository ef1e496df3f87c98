"""Whatever the radio does and whoever restarts: once it heals, all maps agree, and nothing is counted twice."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from radio_room import Drone, exchange, make_drone, same_layers

from imagine.core.frames import Pose
from imagine.core.raster import LIMIT
from imagine.mesh_comm import messages
from imagine.mesh_comm.messages import Tiles

QUICK = settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.too_slow])


@dataclass
class Weather:
    """What the radio does for a second: who hears whom (a bit for each pair), losses, repeats, order, restarts."""

    links: int
    loss: float
    repeats: int
    restarts: int | None


weathers = st.lists(
    st.builds(
        Weather, st.integers(0, 63), st.sampled_from([0.0, 0.3, 0.7]), st.integers(1, 3),
        st.sampled_from([None, None, None, 0, 1, 2]),
    ),
    min_size=2, max_size=5,
)  # fmt: skip


def ticks(start: float, seconds: float) -> np.ndarray:
    return start + 0.1 * np.arange(round(seconds / 0.1))


def pair_bit(a: int, b: int) -> int:
    low, high = sorted((a, b))
    return 1 << (low * (7 - low) // 2 + high - low - 1)


def live_through(
    seconds: list[Weather], seed: int, count: int, protocol: str, scheduler: str
) -> tuple[list[Drone], float]:
    """Fly a team through all that; return its drones and the time."""
    rng = np.random.default_rng(seed)
    drones = [make_drone(i + 1, protocol=protocol, scheduler=scheduler) for i in range(count)]
    boots = [1] * count
    air: list[tuple[int, bytes]] = []
    now = 0.0
    for weather in seconds:
        if weather.restarts is not None and weather.restarts < count:
            boots[weather.restarts] += 1
            drones[weather.restarts] = make_drone(
                weather.restarts + 1, boot=boots[weather.restarts], protocol=protocol, scheduler=scheduler
            )
        for _ in range(10):
            now = round(now + 0.1, 6)
            for drone in drones:
                x, y, yaw = rng.uniform(-4, 5), rng.uniform(-3, 2), rng.uniform(-3, 3)
                drone.fly(Pose(float(x), float(y), float(yaw)), now)
            for a, drone in enumerate(drones):
                for datagram in drone.poll(now):
                    for b in range(count):
                        if b != a and weather.links & pair_bit(a, b) and rng.random() >= weather.loss:
                            air += [(b, datagram)] * int(rng.integers(1, weather.repeats + 1))
            rng.shuffle(air)  # type: ignore[arg-type]
            arrive = int(rng.integers(0, len(air) + 1))  # the rest is late, at worst until after a restart
            for b, datagram in air[:arrive]:
                drones[b].node.receive(datagram, now)
            del air[:arrive]
    for b, datagram in air:
        drones[b].node.receive(datagram, now)
    return drones, now


def placed(drone: Drone, half: int = 320) -> np.ndarray:
    """Return a belief on a grid that is the same for all."""
    belief, (column, row) = drone.evidence.belief(), drone.evidence.origin_cells
    out = np.zeros((2 * half, 2 * half), np.int8)
    out[row + half : row + half + belief.shape[0], column + half : column + half + belief.shape[1]] = belief
    return out


@QUICK
@given(weathers, st.integers(0, 2**32 - 1), st.integers(2, 4), st.sampled_from(["one-hop", "multi-hop"]),
       st.sampled_from(["information", "fifo"]))  # fmt: skip
def test_maps_agree_once_the_radio_heals_and_no_evidence_counts_twice(
    seconds: list[Weather], seed: int, count: int, protocol: str, scheduler: str
) -> None:
    drones, now = live_through(seconds, seed, count, protocol, scheduler)
    exchange(drones, ticks(now + 0.1, 8.0))
    assert same_layers(drones)
    # what is believed is each drone's own evidence, once: nothing of earlier lives, nothing twice
    total = np.zeros((640, 640), np.int16)
    for drone in drones:
        layer, (column, row) = drone.evidence.layers[drone.node.id].cells, drone.evidence.origin_cells
        total[row + 320 : row + 320 + layer.shape[0], column + 320 : column + 320 + layer.shape[1]] += layer
    for drone in drones:
        np.testing.assert_array_equal(placed(drone), np.clip(total, -LIMIT, LIMIT))


def test_tiles_of_an_earlier_life_are_not_taken_from_a_relay_that_missed_the_restart() -> None:
    a, b, c = (make_drone(i, protocol="multi-hop") for i in (1, 2, 3))
    for now in ticks(0.0, 2.0):
        a.fly(Pose(1.0, 0.0, float(now)), float(now))
        b.fly(Pose(0.0, 0.0, 0.0), float(now))
        exchange([a, b, c], np.array([now]))
    exchange([a, b, c], ticks(2.0, 3.0))
    old = c.evidence.versions(1)
    assert old
    again = make_drone(1, boot=2, protocol="multi-hop")  # c is out of reach, and hears nothing of it
    again.fly(Pose(-3.0, -2.0, 0.0), 5.0)
    exchange([again, b], ticks(5.0, 3.0))
    assert same_layers([again, b])
    new = b.evidence.versions(1)
    exchange([b, c], ticks(8.0, 3.0))  # c still has the old tiles, in greater versions
    assert max(old.values()) > max(new.values())
    assert b.evidence.versions(1) == new
    assert c.evidence.versions(1) == new
    assert c.evidence.layers[1].boot == 2


def test_an_old_life_that_is_passed_on_is_counted_and_changes_nothing() -> None:
    a, b = make_drone(1, boot=5), make_drone(2)
    a.fly(Pose(1.0, 0.0, 0.0), 0.0)
    b.fly(Pose(0.0, 0.0, 0.0), 0.0)
    exchange([a, b], ticks(0.0, 3.0))
    before = b.evidence.versions(1), b.evidence.layers[1].cells.copy()
    from imagine.mesh_comm.codec import pack_tile
    from imagine.mesh_comm.messages import Tile
    from imagine.mesh_comm.seal import Sealer

    cells = pack_tile(np.full((32, 32), 8, np.int8))
    stale = Tiles(1, [Tile(0, 0, 2**31, cells)], boot=4)
    b.node.receive(Sealer(bytes(range(32)), 1, 5, first_counter=10**6).seal(messages.encode(stale), 3.1), 3.1)
    assert b.evidence.versions(1) == before[0]
    assert np.array_equal(b.evidence.layers[1].cells, before[1])
    assert b.node.stats == {"old-life": 1}


def test_receipts_count_cells_that_a_digest_confirmed_and_those_that_never_were() -> None:
    a, b = make_drone(1), make_drone(2)
    for now in ticks(0.0, 1.0):  # alone: nobody is told
        a.fly(Pose(float(now), 0.0, 0.0), float(now))
        a.poll(float(now))
    seen = int((a.evidence.layers[1].cells != 0).sum())
    b.node.set_status(messages.Status(2, 1.0, Pose(0.0, 0.0, 0.0)))
    exchange([a, b], ticks(1.0, 3.0))
    tile = a.node.receipts["tile"]
    assert tile.cells == seen  # all of it was new to b, which has said so
    assert tile.lost_cells == 0
    assert tile.bytes > 0
    assert tile.bytes + a.node.receipts["repeat"].bytes == a.node.bytes_sent["tile"]
    assert tile.cells_per_byte > 1.0
    b.node.set_status(messages.Status(2, 9.0, Pose(0.0, 0.0, 0.0)))
    told = b.node.peers(4.0)[1].status
    assert told is not None
    assert told.taught["tile"] == seen


def test_with_few_bytes_tiles_that_tell_more_go_first() -> None:
    a, b = (make_drone(i, rate_bytes_per_s=600.0, burst_bytes=1200.0) for i in (1, 2))
    for now in ticks(0.0, 6.0):
        a.fly(Pose(-4.0 + float(now), -2.0 + float(now) / 2, 0.3), float(now))
        a.poll(float(now))
    b.node.set_status(messages.Status(2, 6.0, Pose(0.0, 0.0, 0.0)))
    sizes = []
    for now in ticks(6.0, 4.0):
        for datagram in b.poll(float(now)):
            a.node.receive(datagram, float(now))
        for datagram in a.poll(float(now)):
            b.node.receive(datagram, float(now))
        sizes.append(int((b.evidence.belief() != 0).sum()))
    first = next(size for size in sizes if size)
    assert first > 0.5 * sizes[-1]  # the first datagram of tiles brought more than all later ones


@QUICK
@given(weathers, st.integers(0, 2**16))
def test_no_cell_becomes_known_unnoticed(seconds: list[Weather], seed: int) -> None:
    drones, _ = live_through(seconds, seed, 3, "multi-hop", "information")
    for drone in drones:
        evidence, maps = drone.evidence, drone.node._state.maps
        known = int((sum(layer.cells.astype(int) for layer in evidence.layers.values()) != 0).sum())
        assert drone.node.own_cells + drone.node.scan_cells + drone.node.map_cells >= known
        counted = drone.node.map_cells
        maps.note_placed()  # looks through the whole map
        assert drone.node.map_cells == counted
