"""The batched air: who gets to know what, when and at what cost, by protocol, budget, latency and loss."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest
from air_team import AirTeam, Rooms, new_air
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from imagine.core.errors import InputError
from imagine.core.lidar import LD19
from imagine.core.raster import TILE
from imagine.mesh_comm.messages import MAX_DATAGRAM
from imagine.mesh_comm.settings import MeshSettings
from imagine.sim import air
from imagine.sim.air import DIGEST, SCAN, STATUS, TILES, Air
from imagine.sim.air_receive import deliver, peer_place
from imagine.sim.air_send import send
from imagine.sim.level import load_level
from imagine.sim.radio import RadioSettings

LEVEL = load_level("4")
ROOMS = Rooms(LEVEL, 3)
CHAIN = np.array([[2.0, 2.0, 0.0], [6.0, 2.5, 1.0], [10.0, 2.0, 2.0]])
"""4 m from one to the next: with a range of 5 m the ends do not hear each other."""


def team(radio: dict[str, object] | None = None, key: int = 7, **mesh: object) -> AirTeam:
    settings_ = MeshSettings.model_validate(mesh)
    return AirTeam(new_air(LEVEL, 3, RadioSettings.model_validate(radio or {}), settings_), LEVEL, key=key)


def wander(start: NDArray[np.float64], ticks: int, seed: int = 0) -> Iterator[NDArray[np.float64]]:
    """Yield poses of drones that drift about their places."""
    rng = np.random.default_rng(seed)
    poses = start.copy()
    for _ in range(ticks):
        poses[:, :2] = np.clip(
            poses[:, :2] + rng.uniform(-0.08, 0.08, (len(poses), 2)), start[:, :2] - 1.0, start[:, :2] + 1.0
        )
        yield poses.copy()


def fly(
    who: AirTeam, ticks: int, start: NDArray[np.float64] = CHAIN, each: Callable[[], None] = lambda: None, seed: int = 0
) -> AirTeam:
    for poses in wander(start, ticks, seed):
        who.tick(poses, ROOMS.scan(poses))
        each()
    return who


def park(who: AirTeam, ticks: int, at: NDArray[np.float64] = CHAIN) -> AirTeam:
    for _ in range(ticks):
        who.tick(at, None)
    return who


def test_off_tells_where_everyone_is_and_nothing_of_the_map() -> None:
    silent = fly(team(protocol="off"), 30)
    assert (silent.air.messages_sent[0, :, [SCAN, TILES, DIGEST]] == 0).all()
    assert (silent.air.messages_sent[0, :, STATUS] == 6).all()  # at ticks 1, 6, ... 26
    assert not any(
        silent.layers[holder, source].any() for holder in range(3) for source in range(3) if holder != source
    )
    assert not silent.dirty.any()
    peers = silent.air.state.peers[0]
    assert (peers["heard_tick"] > 0).tolist() == [[False, True, False], [True, False, True], [False, True, False]]


def test_one_hop_reaches_neighbours_and_no_further() -> None:
    chain = park(fly(team(), 25), 40)
    assert all(chain.holds_all_of(*pair) for pair in [(0, 1), (1, 0), (1, 2), (2, 1)])
    assert not chain.air.state.notes[0]["provisional"].any()
    for far in [(0, 2), (2, 0)]:
        assert not chain.layers[far].any()
        assert not chain.versions[far].any()


def test_relays_reach_the_end_of_the_chain() -> None:
    chain = park(fly(team(protocol="multi-hop"), 25), 60)
    assert all(chain.holds_all_of(holder, source) for holder in range(3) for source in range(3))


def test_a_relay_carries_what_it_heard_to_whom_it_meets_later() -> None:
    apart = np.array([[2.0, 2.0, 0.0], [3.0, 2.0, 1.0], [13.0, 10.0, 2.0]])
    carried = park(fly(team(protocol="multi-hop"), 20, apart), 20, apart)
    assert not carried.layers[2, 0].any()
    met = np.array([[2.0, 2.0, 0.0], [12.0, 10.0, 1.0], [13.0, 10.0, 2.0]])
    park(carried, 40, met)
    assert carried.holds_all_of(2, 0)


def test_when_all_hear_each_other_nobody_relays() -> None:
    together = park(fly(team({"range_m": 50.0}, protocol="multi-hop"), 25), 30)
    alone = park(fly(team({"range_m": 50.0}), 25), 30)
    assert all(together.holds_all_of(holder, source) for holder in range(3) for source in range(3))
    assert together.bytes_sent[:, TILES].sum() < 1.2 * alone.bytes_sent[:, TILES].sum()


@settings(max_examples=20)
@given(
    st.sampled_from(["one-hop", "multi-hop"]),
    st.floats(0.0, 0.6),
    st.sampled_from([0.0, 0.02, 0.35]),
    st.sampled_from([2_000.0, 8_000.0, 31_250.0]),
    st.booleans(),
    st.integers(0, 99),
)
def test_a_tile_is_always_what_its_source_had_at_that_version(
    protocol: str, loss: float, latency_s: float, rate: float, tiles_first: bool, seed: int
) -> None:
    """Whatever is lost, late or passed on: what is not provisional is the source's tile of that version, and so are
    all copies that may be passed on; and a scan is never drawn on a tile that contains it."""
    chain = team({"loss": loss, "latency_s": latency_s}, seed, protocol=protocol, rate_bytes_per_s=rate)
    history: dict[tuple[int, int, int, int], NDArray[np.int8]] = {}
    state = chain.air.state

    def tile(cells: NDArray[np.int8], row: int, column: int) -> NDArray[np.int8]:
        return cells[row * TILE : (row + 1) * TILE, column * TILE : (column + 1) * TILE]

    def check() -> None:
        state.nodes[0]["scans_ahead"] += 4 * tiles_first  # as after ticks that were short of bytes: scans follow tiles
        for source in range(3):
            for row, column in np.argwhere(chain.versions[source, source] == chain.clocks[source]):
                key = (source, row, column, int(chain.clocks[source]))
                history[key] = tile(chain.layers[source, source], row, column).copy()
        for holder, source, row, column in np.argwhere(chain.versions):
            if holder == source:
                continue
            truth = history[source, row, column, int(chain.versions[holder, source, row, column])]
            if not state.notes[0, holder, source, row * chain.versions.shape[3] + column]["provisional"]:
                assert np.array_equal(tile(chain.layers[holder, source], row, column), truth)
            if chain.versions[holder, source, row, column] == chain.versions[source, source, row, column]:
                assert np.array_equal(tile(chain.layers[holder, source], row, column), truth)
            if protocol == "multi-hop":
                assert np.array_equal(tile(state.confirmed[0, holder, source], row, column), truth)

    fly(chain, 40, each=check, seed=seed)
    assert chain.versions[1, 0].any() or loss > 0.2  # then four seconds may be too short for a whole tile


@pytest.mark.parametrize("rate", [1_000.0, 1_300.0])
def test_no_more_bytes_are_sent_in_any_window_than_the_budget_allows(rate: float) -> None:
    slow = team(rate_bytes_per_s=rate, burst_bytes=1200.0)
    sent = [np.zeros(3, np.int64)]
    fly(slow, 60, each=lambda: sent.append(slow.bytes_sent.sum(axis=1)))
    totals = np.array(sent)
    for ticks in (1, 5, 10, 30, 60):
        assert (totals[ticks:] - totals[:-ticks] <= 1200.0 + rate * ticks * 0.1 + 1e-6).all()
    left = slow.air.state.nodes[0]["tokens"]
    assert (left >= 0.0).all()
    assert (left + totals[-1] <= 1200.0 + rate * 59 * 0.1 + 1e-6).all()  # the first tick finds the bucket full
    assert (totals[-1] > 0.7 * rate * 6.0).all()  # and what is allowed is used
    assert (slow.air.messages_sent[0, :, [SCAN, TILES]] > 0).all()  # neither scans nor tiles starve


def test_a_team_short_of_bytes_catches_up() -> None:
    slow = fly(team(rate_bytes_per_s=1_500.0, burst_bytes=1200.0), 40)
    assert not slow.holds_all_of(1, 0)
    park(slow, 120)
    assert slow.holds_all_of(1, 0)
    before = slow.air.messages_sent[0].copy()
    park(slow, 20)
    np.testing.assert_array_equal(slow.air.messages_sent[0, :, [SCAN, TILES]], before[:, [SCAN, TILES]].T)  # settled


def test_a_message_arrives_at_the_first_tick_after_its_time_on_air_and_the_latency() -> None:
    for latency_s, ticks in ((0.0, 1), (0.02, 1), (0.15, 2), (0.25, 3)):
        late = team({"latency_s": latency_s}, protocol="off")
        for _ in range(ticks):
            late.tick(CHAIN, None)
            assert (late.air.state.peers[0]["heard_tick"] < 0).all()
        late.tick(CHAIN, None)
        assert late.air.state.peers[0, 0, 1]["heard_tick"] == 1 + ticks


def test_a_slow_radio_delays_by_the_bytes_before() -> None:
    slow = team({"rate_bps": 8 * 500.0, "latency_s": 0.0}, protocol="off", status_period_s=0.1)
    arrivals = []
    for _ in range(10):
        slow.tick(CHAIN, None)
        arrivals.append(int(slow.air.state.links[0, 0, 1]["delivered_bytes"]))
    first = 172  # a status before anything is known
    assert arrivals[0] == 0
    assert all(delivered <= 500.0 * 0.1 * tick for tick, delivered in enumerate(arrivals))
    assert arrivals[-1] >= first


def test_what_the_radio_queue_does_not_hold_is_paid_for_and_lost() -> None:
    full = fly(team({"rate_bps": 8 * 1_000.0, "queue_bytes": 600}), 30)
    assert (full.air.state.nodes[0]["dropped"] > 0).all()
    in_flight = full.air.state.nodes[0]["messages"].sum()
    links = full.air.state.links[0]
    heard = sum(int(links[name].sum()) for name in ("delivered", "lost", "out_of_range"))
    assert heard == 2 * (full.air.messages_sent[0].sum() - full.air.state.nodes[0]["dropped"].sum() - in_flight)


def test_losses_come_at_their_rate_and_repeat_with_the_key() -> None:
    def lost(key: int) -> NDArray[np.int64]:
        return np.array(fly(team({"loss": 0.3}, key), 60).air.state.links[0].tolist())

    links = lost(1)
    delivered, missed = links[..., 0].sum(), links[..., 2].sum()
    assert missed / (delivered + missed) == pytest.approx(0.3, abs=0.05)
    np.testing.assert_array_equal(lost(1), links)
    assert not np.array_equal(lost(2), links)


def test_a_lossy_link_ends_with_the_same_map() -> None:
    lossy = park(fly(team({"loss": 0.5}), 25), 150)
    assert all(lossy.holds_all_of(*pair) for pair in [(0, 1), (1, 0), (1, 2), (2, 1)])


def test_a_scan_is_drawn_ahead_of_its_tiles_and_exactly() -> None:
    """With tiles held back, what a peer's scans draw is what the source has drawn itself."""
    ahead = team(tile_period_s=1e6, digest_period_s=1e6)
    fly(ahead, 12)
    provisional = ahead.air.state.notes[0, 1, 0]["provisional"]
    assert provisional.any()
    missing = ahead.layers[0, 0].astype(int) - ahead.layers[1, 0]
    sent = ahead.air.messages_sent[0, 0, SCAN]
    assert 0 < sent < 11  # from tick 2 on, when the others have been heard, where a scan shows something new
    source_knows = ahead.layers[0, 0] != 0
    assert (source_knows & (ahead.layers[1, 0] == 0)).sum() < 0.01 * source_knows.sum()  # the few not worth a scan yet
    assert np.abs(missing).max() <= 16
    assert (ahead.dirty[1] > 0).any()
    changed = np.abs(ahead.layers[1, 0]).reshape(ahead.dirty.shape[1], TILE, -1, TILE).max(axis=(1, 3)) > 0
    assert (ahead.dirty[1][changed] == 1).all()


def test_rings_that_are_full_hold_the_sender_back_and_lose_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(air, "_MOST_SCANS", 6)
    distant = team({"latency_s": 3.0, "range_m": 50.0}, peer_timeout_s=60.0)
    most = distant.air.state.windows.shape[2] - 1
    counts = []
    fly(distant, 80, each=lambda: counts.append(distant.air.state.nodes[0, 0][["scans", "tiles", "messages"]].tolist()))
    scans, tiles, messages = np.array(counts).max(axis=0)
    assert scans == most
    assert tiles <= distant.air.state.tile_cells.shape[2]
    assert messages <= distant.air.state.messages.shape[2]
    park(distant, 120)
    assert all(distant.holds_all_of(holder, source) for holder in range(3) for source in range(3))
    assert (distant.air.state.nodes[0]["scans"] == 0).all()
    assert (distant.air.state.nodes[0]["busy_slots"] == 0).all()


def test_a_world_in_a_batch_is_the_same_as_alone() -> None:
    mesh, radio = MeshSettings(protocol="multi-hop"), RadioSettings(loss=0.2)
    together = [AirTeam(new_air(LEVEL, 3, radio, mesh, worlds=3), LEVEL, world, key=40 + world) for world in range(3)]
    for other in together[1:]:
        other.air = together[0].air
    alone = AirTeam(new_air(LEVEL, 3, radio, mesh), LEVEL, 0, key=41)
    paths = [list(wander(CHAIN, 30, seed)) for seed in range(3)]
    for tick in range(30):
        for member, path in zip(together, paths, strict=True):
            member.tick(path[tick], ROOMS.scan(path[tick]))
    for poses in paths[1]:
        alone.tick(poses, ROOMS.scan(poses))
    ours, theirs = together[1], alone
    for name in ("layers", "versions", "dirty", "clocks"):
        np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))
    for name, array in ours.air.state._asdict().items():
        if name != "rules":
            np.testing.assert_array_equal(array[1], getattr(theirs.air.state, name)[0], err_msg=name)
    assert not np.array_equal(together[0].layers, ours.layers)


def test_a_cleared_world_starts_anew_and_others_go_on() -> None:
    air = new_air(LEVEL, 3, RadioSettings(), MeshSettings(protocol="multi-hop"), worlds=2)
    fresh = {name: array.copy() for name, array in air.state._asdict().items() if name != "rules"}
    for world in range(2):
        fly(AirTeam(air, LEVEL, world), 12)
    other = {name: array[1].copy() for name, array in air.state._asdict().items() if name != "rules"}
    air.clear(0)
    for name in fresh:
        now = getattr(air.state, name)
        np.testing.assert_array_equal(now[0], fresh[name][0], err_msg=name)
        np.testing.assert_array_equal(now[1], other[name], err_msg=name)


def test_a_large_map_is_exchanged_in_datagrams_that_fit() -> None:
    """Sixteen by twenty-five tiles of noise from each of five: digests and tiles take many datagrams."""
    drones, rows, columns = 5, 25, 16
    rng = np.random.default_rng(3)
    mesh = MeshSettings(protocol="multi-hop", rate_bytes_per_s=60_000.0)
    air = Air(1, drones, rows, columns, RadioSettings(rate_bps=600_000.0), mesh, LD19, 4.0, 0.1)
    layers = np.zeros((drones, drones, rows * TILE, columns * TILE), np.int8)
    versions = np.zeros((drones, drones, rows, columns), np.uint32)
    for source in range(drones):
        noise = rng.integers(-8, 9, (rows * TILE, columns * TILE))
        layers[source, source] = np.where(rng.random(noise.shape) < 0.05, noise, 0)
        versions[source, source] = rng.integers(1, 500, (rows, columns))
    poses = np.column_stack((4.0 * np.arange(drones), np.zeros((drones, 2))))  # a chain
    clocks, dirty = np.zeros(drones, np.uint32), np.zeros((drones, rows, columns), np.uint8)
    largest = 0
    nothing = np.zeros((0, 4)), np.full((drones, 360), np.nan, np.float32)
    alive = np.ones(drones, np.bool_)
    for tick in range(1, 2400):
        deliver(air.state, 0, tick, np.uint64(1), poses, alive, nothing[0], layers, versions, dirty)
        send(air.state, 0, tick, poses, np.zeros((drones, 3)), alive, nothing[1], clocks, layers, versions)
        largest = max(largest, int(air.state.messages["size"].max()))
        if tick % 50 == 0 and all((versions[:, source] == versions[source, source]).all() for source in range(drones)):
            break
    for source in range(drones):
        assert (versions[:, source] == versions[source, source]).all()
        assert (layers[:, source] == layers[source, source]).all()
    assert 1000 < largest <= MAX_DATAGRAM


def test_the_fallen_neither_speak_nor_hear() -> None:
    fallen = team(protocol="multi-hop")
    fallen.alive[1] = False  # the one in the middle of the chain
    for _ in range(10):
        fallen.tick(CHAIN, None)
    assert not fallen.bytes_sent[1].any()
    assert fallen.bytes_sent[[0, 2]].all(axis=0)[3]
    assert not fallen.air.state.reach[0].any()
    assert (fallen.air.state.peers[0]["heard_tick"] < 0).all()


def test_a_peer_is_expected_where_it_was_heading_and_forgotten_when_silent() -> None:
    moving = team(protocol="off")
    velocity = np.array([[0.5, -0.2, 0.0]] * 3)
    moving.tick(CHAIN, None, velocity)
    moving.tick(CHAIN, None, velocity)  # heard at tick 2
    peer, rules = moving.air.state.peers[0, 0, 1], moving.air.rules
    assert peer_place(peer, 2, rules) == pytest.approx((6.0, 2.5, True))
    assert peer_place(peer, 6, rules) == pytest.approx((6.2, 2.42, True))
    assert peer_place(peer, 22, rules) == pytest.approx((6.5, 2.3, True))  # no further than a second ahead
    assert not peer_place(peer, 23, rules)[2]
    assert not peer_place(moving.air.state.peers[0, 0, 2], 2, rules)[2]


def test_a_drone_takes_no_more_memory_than_it_may() -> None:
    _, _, columns, rows = load_level("6").grid
    for protocol, most in (("one-hop", 300_000), ("multi-hop", 600_000)):
        mesh = MeshSettings.model_validate({"protocol": protocol})
        air = Air(2, 3, rows // TILE, columns // TILE, RadioSettings(), mesh, LD19, 4.0, 0.1)
        assert air.bytes_per_drone < most
    single = Air(2, 1, rows // TILE, columns // TILE, RadioSettings(), MeshSettings(), LD19, 4.0, 0.1)
    assert single.bytes_per_drone < 100_000


def test_more_drones_than_bits_are_refused() -> None:
    with pytest.raises(InputError, match="1 to 32 drones a world, got 33"):
        Air(1, 33, 3, 3, RadioSettings(), MeshSettings(), LD19, 4.0, 0.1)
