"""When a drone knew where its peers' frames lie in its own, and what its report says of that."""

from __future__ import annotations

import numpy as np
import pytest

from imagine.core.evidence import EvidenceMap
from imagine.core.frames import Pose
from imagine.core.lidar import LD19, Scan
from imagine.mesh_comm.messages import Status
from imagine.mesh_comm.node import MeshNode, MeshSettings
from imagine.mesh_comm.seal import Sealer
from imagine.onboard.places import PeerPlaces
from imagine.onboard.report import FlightRecord

KEY = bytes(32)
STANDING = Pose(0.0, 0.0, 0.0)


def node(number: int, settings: MeshSettings) -> MeshNode:
    return MeshNode(EvidenceMap(number), LD19, 4.0, settings, Sealer(KEY, number, 1))


def hear(listener: MeshNode, speaker: MeshNode, now: float) -> None:
    speaker.set_status(Status(speaker.id, now, STANDING))
    for datagram in speaker.poll(now):
        listener.receive(datagram, now)


def test_in_a_shared_frame_a_peer_counts_from_when_it_is_heard_and_nothing_is_told() -> None:
    own, peer, places = node(1, MeshSettings()), node(2, MeshSettings()), PeerPlaces()
    assert places.observe(own, 0.0) == []
    assert places.by_peer == {}
    hear(own, peer, 3.0)
    assert places.observe(own, 3.0) == []
    assert places.observe(own, 4.0) == []
    assert (places.by_peer[2].standing, places.by_peer[2].placed_s) == ("given", 3.0)


def test_a_layout_places_at_once_and_an_unknown_frame_does_not() -> None:
    layout = MeshSettings(frame="layout", layout={1: (0.0, 0.0, 0.0), 2: (2.0, -1.0, 0.5)})
    own, peer, places = node(1, layout), node(2, layout), PeerPlaces()
    hear(own, peer, 1.0)
    (event,) = places.observe(own, 1.0)
    assert (event.kind, event.text) == ("place", "drone 2 placed (given): x 2.00 m, y -1.00 m, yaw 0.500 rad")

    unknown = MeshSettings(frame="unknown")
    own, peer, places = node(1, unknown), node(2, unknown), PeerPlaces()
    hear(own, peer, 1.0)
    assert places.observe(own, 1.0) == []
    assert (places.by_peer[2].standing, places.by_peer[2].placed_s) == ("unknown", None)


def test_a_place_that_is_withdrawn_counts_no_more_and_is_told() -> None:
    layout = MeshSettings(frame="layout", layout={1: (0.0, 0.0, 0.0), 2: (2.0, -1.0, 0.5)})
    evidence = EvidenceMap(1)
    own = MeshNode(evidence, LD19, 4.0, layout, Sealer(KEY, 1, 1))
    peer, places = node(2, layout), PeerPlaces()
    hear(own, peer, 1.0)
    places.observe(own, 1.0)
    evidence.place(2, None)  # as the placements do when the maps deny a place
    (event,) = places.observe(own, 6.0)
    assert event.text == "drone 2: its place is not known any more"
    assert places.by_peer[2].placed_s is None
    evidence.place(2, Pose(2.0, -1.0, 0.5))
    (event,) = places.observe(own, 9.0)
    assert places.by_peer[2].placed_s == 9.0


def test_the_report_tells_places_and_what_bytes_bought() -> None:
    settings = MeshSettings()
    evidence, other = EvidenceMap(1), EvidenceMap(2)
    own = MeshNode(evidence, LD19, 4.0, settings, Sealer(KEY, 1, 1))
    peer, places = MeshNode(other, LD19, 4.0, settings, Sealer(KEY, 2, 1)), PeerPlaces()
    for now in np.arange(0.0, 3.0, 0.1).tolist():
        hear(own, peer, now)
        scan = Scan(now, np.full(LD19.beams, 2.0, np.float32))
        evidence.integrate(STANDING, scan, LD19, 4.0)
        own.set_status(Status(1, now, STANDING))
        own.offer_scan(scan, STANDING, now)
        for datagram in own.poll(now):
            peer.receive(datagram, now)
        places.observe(own, now)
    report = FlightRecord(1).as_json(evidence, own, places)
    assert report["frame"] == "shared"
    assert report["peers"] == [{"id": 2, "standing": "given", "placed_s": 0.0}]
    assert set(report["receipts"]) == {"scan", "tile", "repeat"}
    assert report["receipts"]["scan"]["bytes"] == own.bytes_sent["scan"] > 0
    assert sum(receipt["bytes"] for receipt in report["receipts"].values()) == pytest.approx(
        own.bytes_sent["scan"] + own.bytes_sent["tile"], abs=5
    )  # a message's bytes are shared out among its tiles in whole bytes
    assert sum(receipt["cells"] for receipt in report["receipts"].values()) > 300
