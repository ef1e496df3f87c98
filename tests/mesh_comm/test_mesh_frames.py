"""Drones without a shared frame: a peer's map is held apart until its place is known, and is right when it is."""

from __future__ import annotations

import math

import numpy as np
import pytest
from frames_room import FLAT, SQUARE, Stranger, share
from numpy.typing import NDArray
from radio_room import Drone, exchange, make_drone, same_layers

from imagine.core.evidence import EvidenceMap
from imagine.core.frames import IDENTITY, Pose, compose, inverse, relative, transform_points, wrap_angle
from imagine.core.raster import CELL
from imagine.mesh_comm.placement import Placements
from imagine.mesh_comm.settings import MeshSettings

FRAMES = {1: Pose(0.5, 0.7, 0.4), 2: Pose(7.3, 2.2, -2.1)}


def strangers(walls: NDArray[np.float64] = FLAT, **settings: object) -> list[Stranger]:
    return [Stranger(make_drone(i, **settings), FRAMES[i], 8.0 * (i - 1), walls) for i in (1, 2)]


def own_cells(stranger: Stranger) -> int:
    evidence = stranger.drone.evidence
    return int(np.count_nonzero(evidence.layers[evidence.own].cells))


def believed(stranger: Stranger) -> int:
    return int(np.count_nonzero(stranger.drone.evidence.belief()))


def off_walls_m(stranger: Stranger, peer: int) -> NDArray[np.float64]:
    """How far the walls of a peer's placed map lie from the flat's, metres."""
    evidence = stranger.drone.evidence
    rows, columns = np.nonzero(evidence.placed()[peer] > 2)
    column0, row0 = evidence.origin_cells
    at = transform_points(stranger.frame, np.column_stack((columns + column0 + 0.5, rows + row0 + 0.5)) * CELL)
    start, along = FLAT[:, :2], FLAT[:, 2:] - FLAT[:, :2]
    share = np.einsum("nwk,wk->nw", at[:, None] - start, along) / (along**2).sum(axis=1)
    nearest = start + np.clip(share, 0.0, 1.0)[..., None] * along
    off: NDArray[np.float64] = np.hypot(*np.moveaxis(at[:, None] - nearest, -1, 0)).min(axis=1)
    return off


def test_a_peers_map_is_no_part_of_the_belief_until_its_place_is_known_and_then_lies_right() -> None:
    one, two = team = strangers(frame="unknown")
    share(team, 0.0, 3.0)
    assert np.count_nonzero(one.drone.evidence.layers[2].cells) > 500  # it is held
    assert believed(one) == own_cells(one)
    assert one.drone.node.place(2).standing in ("unknown", "candidate")
    assert one.drone.node.peers(3.0)[2].pose is None
    assert len(one.drone.node.teammates(3.0)) == 0
    assert one.drone.node.scan_cells == one.drone.node.map_cells == 0
    share(team, 3.0, 45.0)
    for drone, peer in ((one, 2), (two, 1)):
        place = drone.drone.node.place(peer)
        assert place.standing == "trusted"
        assert place.pose is not None
        true = relative(FRAMES[drone.drone.node.id], FRAMES[peer])
        assert math.hypot(place.pose.x - true.x, place.pose.y - true.y) < 0.1
        assert abs(wrap_angle(place.pose.yaw - true.yaw)) < math.radians(1.5)
        assert drone.drone.node.map_cells > 0
        assert np.quantile(off_walls_m(drone, peer), 0.95) < 0.2
    pose = one.drone.node.peers(45.0)[2].pose
    assert pose is not None
    shown = compose(FRAMES[1], pose)
    assert math.hypot(shown.x - two.true.x, shown.y - two.true.y) < 0.2
    np.testing.assert_allclose(one.drone.node.teammates(45.0)[0], pose[:2], atol=0.2)


def test_what_a_drone_sends_on_is_the_peers_map_as_its_source_drew_it() -> None:
    layout = {i: tuple(pose) for i, pose in FRAMES.items()}
    team = strangers(frame="layout", layout=layout, protocol="multi-hop")
    drones = [stranger.drone for stranger in team]
    share(team, 0.0, 6.0)
    assert drones[0].node.place(2).pose not in (None, IDENTITY)  # placed, and yet kept as it was sent
    exchange(drones, np.arange(6.0, 9.0, 0.1))
    assert same_layers(drones)


def test_with_a_known_layout_the_peers_map_counts_at_once_in_its_place() -> None:
    team = strangers(frame="layout", layout={i: tuple(pose) for i, pose in FRAMES.items()})
    share(team, 0.0, 1.0)
    one = team[0]
    assert one.drone.node.place(2).standing == "given"
    assert believed(one) > own_cells(one) + 500
    assert one.drone.node.scan_cells > 500
    assert np.quantile(off_walls_m(one, 2), 0.95) < 0.2


def test_a_layout_that_is_a_little_off_is_put_right_by_the_maps() -> None:
    layout = {1: tuple(FRAMES[1]), 2: tuple(compose(FRAMES[2], Pose(0.2, -0.15, 0.05)))}
    team = strangers(frame="layout", layout=layout)
    share(team, 0.0, 30.0)
    place = team[0].drone.node.place(2)
    true = relative(FRAMES[1], FRAMES[2])
    assert place.pose is not None
    assert math.hypot(place.pose.x - true.x, place.pose.y - true.y) < 0.1


def test_a_layout_that_the_maps_deny_is_withdrawn() -> None:
    layout = {1: tuple(FRAMES[1]), 2: tuple(compose(FRAMES[2], Pose(2.0, -1.5, 0.9)))}
    team = strangers(frame="layout", layout=layout)
    share(team, 0.0, 2.0)
    assert team[0].drone.node.place(2).standing == "given"
    share(team, 2.0, 20.0)
    assert team[0].drone.node.place(2).standing != "given"


def test_a_room_that_looks_the_same_from_four_sides_is_never_trusted() -> None:
    way = [(1.5, 1.5), (4.5, 1.6), (4.4, 4.5), (1.6, 4.4)]
    team = strangers(SQUARE, frame="unknown")
    for second in range(30):
        share(team, float(second), second + 1.0, way)
        assert team[0].drone.node.place(2).pose is None
        assert team[1].drone.node.place(1).pose is None
    assert believed(team[0]) == own_cells(team[0])


def test_a_shared_frame_is_the_identity() -> None:
    node = make_drone(1).node
    assert node.place(2).pose == IDENTITY
    assert inverse(IDENTITY) == IDENTITY


def test_news_of_a_restart_by_a_relay_ends_a_place_as_the_restarted_drone_itself_does() -> None:
    listening, relay = (make_drone(i, protocol="multi-hop", frame="unknown") for i in (1, 3))
    first, again = (make_drone(2, boot, protocol="multi-hop", frame="unknown") for boot in (1, 2))
    now = 0.0
    for life in (first, again):
        life.fly(Pose(0.0, 0.0, 0.0), now)
        relay.fly(Pose(1.0, 0.0, 0.0), now)
        exchange([life, relay], np.array([now + 0.1 * tick for tick in range(30)]))
        exchange([relay, listening], np.array([now + 3.0 + 0.1 * tick for tick in range(30)]))
        assert listening.evidence.layers[2].boot == life.evidence.layers[2].boot
        if life is first:
            listening.evidence.place(2, Pose(1.0, 2.0, 0.5))
        now += 10.0
    assert listening.node.place(2).pose is None
    exchange([again, listening], np.array([now + 0.1 * tick for tick in range(5)]))
    assert listening.node.place(2).pose is None


@pytest.mark.parametrize("settings", [{"frame": "layout"}, {"layout": {1: (0.0, 0.0, 0.0)}}])
def test_a_layout_and_its_frame_go_together(settings: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="layout"):
        MeshSettings.model_validate(settings)


def test_when_the_drone_that_lends_the_ground_its_frame_restarts_the_others_stay_where_they_are_shown() -> None:
    evidence = EvidenceMap(0, shares_frame=False)
    places = Placements(evidence, MeshSettings(frame="unknown").alignment)
    for source in (1, 2):
        evidence.layer(source).cells[:16, :16] = 8
    assert places.advance(0.0) == [1]
    shown = Pose(3.0, 1.0, 0.5)
    evidence.place(2, shown)
    places.forget(1)
    assert places.place(1).pose is None
    assert places.place(2).pose == shown
    evidence.place(2, None)
    places.forget(2)
    places.forget(1)
    assert places.advance(100.0) == [1]  # nobody has a place: the next one heard lends its frame
    assert places.place(1).pose == IDENTITY


def test_the_ground_shows_all_in_the_frame_of_the_first_drone_it_hears() -> None:
    team = strangers(frame="unknown")
    ground = make_drone(0, frame="unknown")
    for second in range(40):
        for tick in range(10):
            now = second + tick / 10
            for stranger in team:
                stranger.fly(now)
            talk = [(drone, drone.poll(now)) for drone in (team[0].drone, team[1].drone, ground)]
            for sender, datagrams in talk:
                for other in (team[0].drone, team[1].drone, ground):
                    for datagram in datagrams if other is not sender else []:
                        other.node.receive(datagram, now)
    anchor, other_id = (1, 2) if ground.node.place(1).pose == IDENTITY else (2, 1)
    assert ground.node.place(anchor).pose == IDENTITY
    pose = ground.node.place(other_id).pose
    assert pose is not None
    true = relative(FRAMES[anchor], FRAMES[other_id])
    assert math.hypot(pose.x - true.x, pose.y - true.y) < 0.1
    assert ground.node.peers(40.0)[other_id].pose is not None
    assert believed_share(ground) > 0.9


def believed_share(ground: Drone) -> float:
    """How much of the better known drone's map the ground shows, in cells."""
    held = max(np.count_nonzero(layer.cells) for layer in ground.evidence.layers.values())
    return float(np.count_nonzero(ground.evidence.belief()) / held)
