"""A cell clicked on the page: who saw it, when, and by which way it came to the ground."""

from __future__ import annotations

import http.client
import json
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest

from imagine.core.evidence import EvidenceMap
from imagine.core.frames import Pose
from imagine.core.lidar import LD19, Scan
from imagine.gcs.fleet import Fleet
from imagine.gcs.server import GroundServer
from imagine.gcs.station import obey
from imagine.mesh_comm.messages import Status
from imagine.mesh_comm.node import MeshNode, MeshSettings
from imagine.mesh_comm.seal import Sealer

pytest.importorskip("websockets", reason="the gcs extra is not installed")
KEY = bytes(32)


@pytest.fixture
def server() -> Iterator[GroundServer]:
    with GroundServer(port=0) as running:
        yield running


def asked(server: GroundServer, query: str) -> tuple[int, bytes]:
    host = server.url.removeprefix("http://").rstrip("/")
    connection = http.client.HTTPConnection(host, timeout=10.0)
    try:
        connection.request("GET", f"/api/provenance{query}")
        answer = connection.getresponse()
        return answer.status, answer.read()
    finally:
        connection.close()


def fleet_that_heard_a_drone() -> Fleet:
    """Drone 4 stands at the origin in a round room of 2 m and tells the ground, which answers with digests."""
    fleet = Fleet(MeshSettings(), Sealer(KEY, 0, 1))
    evidence = EvidenceMap(4)
    node = MeshNode(evidence, LD19, 4.0, MeshSettings(), Sealer(KEY, 4, 1))
    pose = Pose(0.05, 0.05, 0.0)
    for now in np.arange(0.0, 2.0, 0.1).tolist():
        scan = Scan(now, np.full(LD19.beams, 2.0, np.float32))
        evidence.integrate(pose, scan, LD19, 4.0)
        node.set_status(Status(4, now, pose))
        node.offer_scan(scan, pose, now)
        for datagram in node.poll(now):
            fleet.receive(datagram, now)
        for datagram in fleet.poll(now):
            node.receive(datagram, now)
    return fleet


def test_the_ground_tells_who_saw_a_cell_and_how_it_came(server: GroundServer) -> None:
    fleet, done = fleet_that_heard_a_drone(), threading.Event()

    def fly() -> None:
        while not done.wait(0.01):
            obey(fleet, server, 5.0)

    with ThreadPoolExecutor(1) as loop:
        loop.submit(fly)
        try:
            free: dict[str, Any] = json.loads(asked(server, "?x=1.03&y=0.02")[1])
            wall: dict[str, Any] = json.loads(asked(server, "?x=2.05&y=0.05")[1])
            unknown: dict[str, Any] = json.loads(asked(server, "?x=-9&y=9")[1])
        finally:
            done.set()
    assert free["belief"] < 0 < wall["belief"]
    assert (free["x"], free["y"]) == pytest.approx((1.05, 0.05))
    (seen,) = free["sightings"]
    assert seen["source"] == seen["via"] == 4
    assert seen["way"] in ("scan", "tile")
    assert 3.0 <= seen["age_s"] <= 5.0
    assert seen["units"] == free["belief"]
    assert unknown["sightings"] == []
    assert unknown["belief"] == 0


@pytest.mark.parametrize("query", ["", "?x=1", "?x=1&y=nan", "?x=1&y=1e9", "?x=one&y=2"])
def test_what_is_no_place_is_refused(server: GroundServer, query: str) -> None:
    status, text = asked(server, query)
    assert status == 400
    assert b"expected metres" in text


def test_a_loop_that_does_not_answer_leaves_nobody_waiting(server: GroundServer) -> None:
    assert asked(server, "?x=1&y=1")[0] == 503
    (question,) = server.take_questions()
    assert question.answer.cancelled()
