"""The fleet seen by the ground, joined to real mesh nodes by real sealed datagrams, under a driven clock."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from rich.console import Console

from imagine.core.errors import InputError
from imagine.core.evidence import EvidenceMap, TileKey
from imagine.core.frames import Pose
from imagine.core.lidar import LD19, Scan
from imagine.core.raster import TILE
from imagine.gcs.belief import BeliefTiles
from imagine.gcs.fleet import EVENTS_KEPT, Fleet
from imagine.gcs.orders import GIVE_UP_S
from imagine.gcs.snapshot import FleetSnapshot
from imagine.gcs.table import render
from imagine.gcs.track import STALE_S, TRAIL_POINTS, TRAIL_STEP_M
from imagine.mesh_comm.messages import Command, Status
from imagine.mesh_comm.node import MeshNode, MeshSettings
from imagine.mesh_comm.seal import Sealer

KEY = bytes(range(32))
SETTINGS = MeshSettings()
TICK_S = 0.1


class Drone:
    """A drone in a round room of 2 m around itself: enough to map and to talk."""

    def __init__(self, id_: int, boot: int = 1) -> None:
        self.evidence = EvidenceMap(own=id_)
        self.node = MeshNode(self.evidence, LD19, 4.0, SETTINGS, Sealer(KEY, id_, boot))
        self.id = id_
        self.pose = Pose(4.5 * (id_ - 2), 0.0, 0.0)  # rooms that do not overlap
        self.ladder, self.reason, self.battery = "policy", "", 0.9
        self.orders: list[Command] = []

    def tick(self, now: float) -> list[bytes]:
        scan = Scan(now, np.full(LD19.beams, 2.0, np.float32))
        self.evidence.integrate(self.pose, scan, LD19, 4.0)
        status = Status(
            self.id, now, self.pose, (0.3, 0.0), 1.0, self.battery, "OFFBOARD", True, self.ladder, self.reason
        )
        self.node.set_status(status)
        self.node.offer_scan(scan, self.pose, now)
        self.orders += self.node.commands()
        return self.node.poll(now)


class Air:
    """Everyone hears everyone, except who is `silent` (sends nothing) or `deaf`."""

    def __init__(self, ids: tuple[int, ...] = (1, 2, 3)) -> None:
        self.fleet = Fleet(SETTINGS, Sealer(KEY, 0, 1))
        self.drones = {i: Drone(i) for i in ids}
        self.silent: set[int] = set()
        self.deaf: set[int] = set()
        self.now = 0.0

    def run(self, seconds: float) -> FleetSnapshot:
        for _ in range(round(seconds / TICK_S)):
            self.now += TICK_S
            said = {0: self.fleet.poll(self.now)}
            said |= {i: drone.tick(self.now) for i, drone in self.drones.items() if i not in self.silent}
            for sender, datagrams in said.items():
                for datagram in datagrams:
                    if sender:
                        self.fleet.receive(datagram, self.now)
                    for i, drone in self.drones.items():
                        if i != sender and i not in self.deaf | self.silent:
                            drone.node.receive(datagram, self.now)
        return self.fleet.snapshot(self.now)


def texts(snapshot: FleetSnapshot, drone: int) -> list[str]:
    return [event.text for event in snapshot.events if event.drone == drone]


def test_shows_what_each_drone_tells() -> None:
    air = Air()
    air.drones[2].ladder, air.drones[2].reason, air.drones[2].battery = "hold", "no frontier reachable", 0.15
    air.drones[1].pose = Pose(1.5, -0.5, 0.7)
    shot = air.run(2.0)
    one, two, three = shot.drones
    assert (one.id, one.x, one.y, one.yaw) == pytest.approx((1, 1.5, -0.5, 0.7), abs=1e-5)
    assert (two.state, two.reason, two.battery) == ("hold", "no frontier reachable", pytest.approx(0.15))
    assert (one.mode, one.armed, one.flying, one.stale) == ("OFFBOARD", True, True, False)
    assert one.age_s <= 0.5 + TICK_S
    assert set(one.bytes_sent) == {"scan", "tile", "digest", "status"}
    assert one.own_cells > 500
    assert three.hears == (1, 2)
    assert shot.links == ((1, 2), (1, 3), (2, 3))
    assert shot.flying == 3
    assert shot.elapsed_s == pytest.approx(1.9)


def test_what_changes_in_flight_is_told_as_an_event() -> None:
    air = Air()
    air.run(1.0)
    air.drones[2].ladder, air.drones[2].reason, air.drones[2].battery = "hold", "no frontier reachable", 0.15
    assert texts(air.run(1.0), 2) == ["joined the swarm", "hold: no frontier reachable", "battery low, 15%"]
    air.drones[2].ladder, air.drones[2].reason = "policy", ""
    assert texts(air.run(1.0), 2)[-1] == "exploring"


def test_merged_map_is_what_the_drones_saw() -> None:
    air = Air()
    shot = air.run(3.0)
    union = sum((np.count_nonzero(drone.evidence.layers[i].cells) for i, drone in air.drones.items()), 0)
    assert 0.9 * union <= shot.map.known_cells <= union
    assert shot.known_free_m2 == pytest.approx(shot.map.free_cells * 0.01)
    assert air.fleet.evidence.layers[0].clock == 0, "the ground writes no map"


def test_a_silent_drone_turns_stale_and_says_so_and_comes_back() -> None:
    air = Air()
    air.run(2.0)
    air.silent = {3}
    shot = air.run(STALE_S - 0.6)
    assert not any(drone.stale for drone in shot.drones)
    shot = air.run(1.1)
    assert [drone.stale for drone in shot.drones] == [False, False, True]
    assert shot.drones[2].age_s > STALE_S
    assert all(3 not in link for link in shot.links)
    assert any("not heard" in text for text in texts(shot, 3))
    air.silent = set()
    shot = air.run(1.0)
    assert not shot.drones[2].stale
    assert texts(shot, 3)[-1] == "heard again"


def test_a_note_tells_why_and_marks_lost_at_once() -> None:
    air = Air()
    air.run(1.0)
    air.fleet.note(2, "runner process ended (killed by SIGKILL)", lost=True)
    air.fleet.note(2, "runner process ended (killed by SIGKILL)", lost=True)
    shot = air.fleet.snapshot(air.now)
    assert (shot.drones[1].lost, shot.drones[1].stale) == (True, True)
    assert shot.drones[1].note == "runner process ended (killed by SIGKILL)"
    assert texts(shot, 2).count("runner process ended (killed by SIGKILL)") == 1
    assert shot.flying == 2


def test_a_note_on_a_drone_never_heard_shows_it_without_a_place() -> None:
    air = Air((1,))
    air.run(1.0)
    air.fleet.note(4, "runner did not start", lost=True)
    missing = air.fleet.snapshot(air.now).drones[1]
    assert (missing.id, missing.located, missing.stale, missing.note) == (4, False, True, "runner did not start")


def test_trail_is_decimated_and_bounded() -> None:
    air = Air((1,))
    air.run(1.0)
    for _ in range(20):  # hovering adds nothing
        shot = air.run(TICK_S)
    assert shot.drones[0].trail.end == 1
    for step in range(6 * TRAIL_POINTS):  # where scans show nothing new, statuses alone tell where it is, two a second
        air.drones[1].pose = Pose(0.08 * step % 30.0, 0.0, 0.0)
        shot = air.run(TICK_S)
    trail = shot.drones[0].trail
    assert len(trail.points) == TRAIL_POINTS
    assert trail.end > TRAIL_POINTS
    gaps = np.hypot(*np.diff(np.array(trail.points), axis=0).T)
    assert gaps.min() >= TRAIL_STEP_M - 1e-9
    assert trail.since(trail.end) == ()
    assert trail.since(trail.end - 3) == trail.points[-3:]
    assert trail.since(0) == trail.points


def test_map_versions_name_exactly_the_tiles_that_changed() -> None:
    evidence, tiles = EvidenceMap(own=0), BeliefTiles()
    evidence.merge_tile(1, TileKey(0, 0), 1, np.full((TILE, TILE), -3, np.int8))
    evidence.merge_tile(1, TileKey(1, 0), 1, np.full((TILE, TILE), 4, np.int8))
    first = tiles.view(evidence)
    assert tiles.view(evidence) is first
    assert (first.known_cells, first.free_cells) == (2 * TILE * TILE, TILE * TILE)
    evidence.merge_tile(2, TileKey(1, 0), 1, np.full((TILE, TILE), 1, np.int8))
    evidence.merge_tile(2, TileKey(-9, 12), 1, np.full((TILE, TILE), 1, np.int8))  # the grid grows: its corner moves
    second = tiles.view(evidence)
    assert {key for key, _ in second.since(first.version)} == {TileKey(1, 0), TileKey(-9, 12)}
    assert second.tiles[TileKey(1, 0)].cells == np.full((TILE, TILE), 5, np.int8).tobytes()
    assert first.tiles[TileKey(1, 0)].cells == np.full((TILE, TILE), 4, np.int8).tobytes(), "a snapshot never changes"
    assert second.since(second.version) == []
    assert len(second.since(0)) == 3


def test_a_tile_emptied_by_its_source_is_sent_empty() -> None:
    evidence, tiles = EvidenceMap(own=0), BeliefTiles()
    evidence.merge_tile(1, TileKey(0, 0), 1, np.full((TILE, TILE), -3, np.int8))
    first = tiles.view(evidence)
    evidence.merge_tile(1, TileKey(0, 0), 2, np.zeros((TILE, TILE), np.int8))
    second = tiles.view(evidence)
    assert [(key, tile.cells) for key, tile in second.since(first.version)] == [(TileKey(0, 0), bytes(TILE * TILE))]
    assert second.known_cells == 0


def test_an_order_reaches_every_drone_once_and_is_confirmed() -> None:
    air = Air()
    air.run(1.0)
    air.fleet.command("hold")
    shot = air.run(3.0)
    for drone in air.drones.values():
        assert [order.action for order in drone.orders] == ["hold"]
    assert shot.command is not None
    assert (shot.command.action, shot.command.confirmed) == ("hold", (1, 2, 3))
    assert air.run(10.0).command is None


def test_an_order_waits_for_a_drone_out_of_reach_and_gives_up_in_the_end() -> None:
    air = Air()
    air.run(1.0)
    air.deaf = {2}
    air.fleet.command("hold")
    shot = air.run(10.0)
    assert shot.command is not None
    assert shot.command.confirmed == (1, 3)
    air.deaf = set()
    shot = air.run(3.5)
    assert shot.command is not None
    assert shot.command.confirmed == (1, 2, 3)
    # told anew under a new nonce, it may obey twice: orders are idempotent
    assert {order.action for order in air.drones[2].orders} == {"hold"}
    assert [order.action for order in air.drones[1].orders] == ["hold"], "those who confirmed are not told again"

    air.deaf = {2}
    air.fleet.command("land")
    shot = air.run(GIVE_UP_S + 1.0)
    assert "never confirmed the order to land" in texts(shot, 2)
    air.deaf = set()
    air.run(5.0)
    assert {order.action for order in air.drones[2].orders} == {"hold"}, "an old order surprises nobody"


def test_a_newer_order_to_one_drone_voids_the_older_to_all_for_that_drone() -> None:
    air = Air()
    air.run(1.0)
    air.deaf = {1, 2}
    air.fleet.command("hold")
    air.run(3.0)
    air.fleet.command("resume", target=1)
    air.deaf = set()
    air.run(4.0)
    assert [order.action for order in air.drones[1].orders] == ["resume"]
    assert [order.action for order in air.drones[2].orders] == ["hold"]
    assert [order.action for order in air.drones[3].orders] == ["hold"]


@pytest.mark.parametrize(
    ("action", "target", "says"), [("jump", 0, "expected one of hold"), ("hold", 9, "known drones")]
)
def test_an_impossible_order_is_refused(action: str, target: int, says: str) -> None:
    air = Air()
    air.run(1.0)
    with pytest.raises(InputError, match=says):
        air.fleet.command(action, target)


def test_forged_and_malformed_datagrams_are_counted_and_change_nothing() -> None:
    air = Air()
    before = air.run(1.0)
    stranger = MeshNode(EvidenceMap(own=7), LD19, 4.0, SETTINGS, Sealer(bytes(32), 7, 1))
    stranger.set_status(Status(7, air.now, Pose(0.0, 0.0, 0.0)))
    for datagram in [*stranger.poll(air.now), b"", b"\xa7M" + bytes(60)]:
        air.fleet.receive(datagram, air.now)
    after = air.fleet.snapshot(air.now)
    assert after.dropped_datagrams == before.dropped_datagrams + 3
    assert [drone.id for drone in after.drones] == [1, 2, 3]


def test_rate_is_what_the_drone_sends_and_survives_its_restart() -> None:
    air = Air((1, 2))
    air.run(3.0)
    for _ in range(50):
        shot = air.run(TICK_S)
    sent = air.drones[1].node.bytes_sent
    assert sum(shot.drones[0].bytes_sent.values()) <= sum(sent.values())
    assert 50.0 < shot.drones[0].rate_bps < SETTINGS.rate_bytes_per_s
    air.drones[1] = Drone(1, boot=2)
    for _ in range(30):
        assert air.run(TICK_S).drones[0].rate_bps >= 0.0


def test_events_are_bounded_and_turns_of_policy_and_rescue_are_not_news() -> None:
    air = Air((1,))
    air.run(1.0)
    for turn in range(6):
        air.drones[1].ladder = "frontier" if turn % 2 else "policy"
        shot = air.run(0.6)
    assert texts(shot, 1) == ["joined the swarm"]
    for number in range(EVENTS_KEPT + 50):
        air.fleet.note(1, f"note {number}")
    shot = air.fleet.snapshot(air.now)
    assert len(shot.events) == EVENTS_KEPT
    assert shot.events[-1].text == f"note {EVENTS_KEPT + 49}"


def test_a_snapshot_is_immutable_and_outlives_what_follows() -> None:
    air = Air()
    shot = air.run(1.0)
    with pytest.raises(dataclasses.FrozenInstanceError):
        shot.elapsed_s = 0.0  # type: ignore[misc]
    with pytest.raises(TypeError):
        shot.map.tiles[TileKey(0, 0)] = shot.map.tiles[TileKey(0, 0)]  # type: ignore[index]
    known, x = shot.map.known_cells, shot.drones[0].x
    air.drones[1].pose = Pose(-4.0, 0.0, 0.0)
    air.run(2.0)
    assert (shot.map.known_cells, shot.drones[0].x) == (known, x)


def test_the_ground_is_mesh_id_zero() -> None:
    with pytest.raises(InputError, match="mesh id 0"):
        Fleet(SETTINGS, Sealer(KEY, 3, 1))


def test_table_shows_every_drone_and_why_one_is_gone() -> None:
    air = Air()
    air.run(1.0)
    air.fleet.note(3, "killed by SIGKILL", lost=True)
    console = Console(width=160, record=True, file=None, quiet=False, force_terminal=False)
    with console.capture() as capture:
        console.print(render(air.fleet.snapshot(air.now, coverage=0.5)))
    text = capture.get()
    assert "coverage 50.0%" in text
    for word in ("D1", "D2", "D3", "lost", "killed by SIGKILL", "2 of 3 flying"):
        assert word in text
