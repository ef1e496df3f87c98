"""Visit maps: ticks spent in planning cells, counted, kept while the map grows, and shown around the drone."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imagine.core.errors import InputError
from imagine.core.evidence import EvidenceMap
from imagine.core.frames import Pose
from imagine.core.frontier import frontier_field
from imagine.core.lidar import LD19, Scan
from imagine.core.observation import observe
from imagine.core.observation_spec import ObservationSpec
from imagine.core.peer_poses import PeerPoses
from imagine.core.visits import VisitMap, count_visit, visit_levels

METRES = st.floats(-30.0, 30.0)
NOBODY = PeerPoses.none()
SCAN = Scan(0.0, np.full(360, np.inf, np.float32))
TEAM = ObservationSpec(view_cells=16, visits="team", visits_full_ticks=50)


def heard(x: float, y: float, age_s: float) -> PeerPoses:
    return PeerPoses(np.array([[x, y]]), np.array([age_s]))


@given(st.lists(st.tuples(METRES, METRES), min_size=1, max_size=12))
def test_every_tick_is_kept_where_it_was_spent_while_the_map_grows(places: list[tuple[float, float]]) -> None:
    evidence, visits = EvidenceMap(1, half_extent_m=3.2), VisitMap()
    for x, y in places:
        evidence.cover(x, y, x, y)
        visits.fit(evidence.origin_cells, evidence.shape)
        visits.count(x, y, heard(y, x, 0.0) if abs(x) < 3.0 and abs(y) < 3.0 else NOBODY)
    assert visits.own.shape == (evidence.shape[0] // 2, evidence.shape[1] // 2)
    assert visits.own.sum() == len(places)
    assert visits.peers.sum() == sum(abs(x) < 3.0 and abs(y) < 3.0 for x, y in places)
    for x, y in places:
        row = math.floor(y / 0.2) - visits.origin_cells[1] // 2
        column = math.floor(x / 0.2) - visits.origin_cells[0] // 2
        assert visits.own[row, column] >= 1


def test_a_count_stops_at_its_largest_and_outside_nothing_is_counted() -> None:
    visits = np.full((2, 2), 65534, np.uint16)
    for _ in range(3):
        count_visit(visits, 0, 0, 0.1, 0.1)
        count_visit(visits, 0, 0, -0.1, 0.1)
        count_visit(visits, 0, 0, 0.1, 0.41)
    assert visits.tolist() == [[65535, 65534], [65534, 65534]]


def test_a_peer_counts_while_it_is_heard_and_not_when_it_was_lost() -> None:
    visits = VisitMap()
    visits.fit((-64, -64), (128, 128))
    for age in (0.0, 0.3, 6 * 0.1, 0.7, 2.0, math.inf):
        visits.count(0.0, 0.0, heard(1.0, 1.0, age))
    assert visits.peers.sum() == visits.peers[32 + 5, 32 + 5] == 3


def test_brightness_is_logarithmic_from_nothing_to_full() -> None:
    levels = visit_levels(7)
    assert levels.dtype == np.float32
    assert levels == pytest.approx([math.log2(1 + n) / 3 for n in range(8)])


def see(spec: ObservationSpec, visits: VisitMap | None, pose: Pose) -> dict[str, np.ndarray]:
    belief = np.zeros((128, 128), np.int8)
    return observe(spec, belief, frontier_field(belief), (-64, -64), pose, (0.0, 0.0), 0.0, SCAN, LD19, None, visits)


def visited(own: list[tuple[float, float]], peers: list[tuple[float, float]]) -> VisitMap:
    visits = VisitMap()
    visits.fit((-64, -64), (128, 128))
    for x, y in own:
        visits.count(x, y, NOBODY)
    for x, y in peers:
        visits.count(99.0, 99.0, heard(x, y, 0.0))
    return visits


def test_own_and_peers_visits_show_behind_the_maps_at_every_scale() -> None:
    visits = visited([(1.1, 0.1)] * 50 + [(0.5, 0.3)] * 3, [(-0.5, -0.5)] * 7)
    views = see(TEAM, visits, Pose(0.01, 0.01, 0.0))["views"]
    assert views.shape == (8, 16, 16)
    maps_alone = see(ObservationSpec(view_cells=16), None, Pose(0.01, 0.01, 0.0))["views"]
    np.testing.assert_array_equal(views[:4], maps_alone)
    fine_own, fine_peers, coarse_own, coarse_peers = views[4:]
    three, seven = math.log(4) / math.log(51), math.log(8) / math.log(51)
    assert fine_own[10:12, 12:14] == pytest.approx(three)  # (0.4 to 0.6, 0.2 to 0.4): two pixels of 0.1 m a side
    assert fine_own.max() == pytest.approx(three)  # (1.1, 0.1) lies beyond the fine view
    assert (fine_own > 0).sum() == 4
    assert coarse_own[8, 10] == 1.0  # full, and its block of 0.4 m has an emptier cell beside it
    assert coarse_own[8, 9] == pytest.approx(three)
    assert (coarse_own > 0).sum() == 2
    assert coarse_peers[6, 6] == fine_peers[2, 2] == pytest.approx(seven)
    assert ((coarse_peers > 0).sum(), (fine_peers > 0).sum()) == (1, 4)


def test_alone_a_drone_sees_its_own_visits_only() -> None:
    visits = visited([(0.5, 0.3)], [(-0.5, -0.5)])
    alone = see(ObservationSpec(view_cells=16, visits="self", visits_full_ticks=50), visits, Pose(0.0, 0.0, 0.0))
    team = see(TEAM, visits, Pose(0.0, 0.0, 0.0))
    np.testing.assert_array_equal(alone["views"][4:], team["views"][[4, 6]])


@pytest.mark.parametrize("turns", [1, 2, 3])
def test_visits_turn_with_the_view(turns: int) -> None:
    """A drone that turned sees the world turned the other way: what was ahead of it stays ahead."""
    yaw = turns * math.pi / 2
    c, s = round(math.cos(yaw)), round(math.sin(yaw))
    places = [(0.5, 0.3), (1.3, -0.7), (-0.3, 0.9), (0.5, 0.3)]
    straight = see(TEAM, visited(places, places[:2]), Pose(0.03, 0.13, 0.0))  # in the middle of no cell
    turned_places = [(c * x - s * y, s * x + c * y) for x, y in places]
    turned = see(
        ObservationSpec(view_cells=16, visits="team", visits_full_ticks=50, axes="heading"),
        visited(turned_places, turned_places[:2]),
        Pose(c * 0.03 - s * 0.13, s * 0.03 + c * 0.13, yaw),
    )
    assert straight["views"][4:].max() > 0.0
    np.testing.assert_array_equal(turned["views"][4:], straight["views"][4:])


@pytest.mark.parametrize("wrong", ["none", "elsewhere", "small"])
def test_visits_that_do_not_lie_under_the_belief_are_refused(wrong: str) -> None:
    visits = VisitMap()
    visits.fit((0, -64) if wrong == "elsewhere" else (-64, -64), (64, 64) if wrong == "small" else (128, 128))
    with pytest.raises(InputError, match="fitted"):
        see(TEAM, None if wrong == "none" else visits, Pose(0.0, 0.0, 0.0))


def test_position_heading_and_peers_follow_the_motion() -> None:
    spec = ObservationSpec(
        view_cells=16, axes="heading", position=True, position_extent_m=4.0, heading=True, peers=2, peers_range_m=5.0
    )
    belief = np.zeros((128, 128), np.int8)
    pose = Pose(1.0, -20.0, math.pi / 2)
    motion = observe(
        spec, belief, frontier_field(belief), (-64, -64), pose, (0.0, 0.8), 3.0, SCAN, LD19, heard(1.0, -19.0, 1.0)
    )["motion"]
    assert (spec.version, motion.shape) == (2, (9,))
    # velocity ahead, yaw rate; position along the map's axes, bounded; heading; one peer known of two
    assert motion == pytest.approx([1.0, 0.0, 1.0, 0.25, -2.0, 0.0, 1.0, 0.2, 1.0], abs=1e-6)


@pytest.mark.parametrize(
    ("options", "motion", "channels"),
    [
        ({}, 3, 4),
        ({"position": True}, 5, 4),
        ({"heading": True}, 5, 4),
        ({"peers": 3}, 6, 4),
        ({"visits": "self"}, 3, 6),
        ({"visits": "team", "peers": 1, "position": True}, 6, 8),
    ],
)
def test_each_option_adds_its_own_numbers(options: dict[str, object], motion: int, channels: int) -> None:
    spec = ObservationSpec.model_validate(options)
    assert spec.version == (2 if options else 1)
    assert spec.shapes["motion"] == (motion,)
    assert spec.shapes["views"][0] == channels
