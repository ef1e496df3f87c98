"""The ground station for a real fleet, over real UDP and a real websocket."""

from __future__ import annotations

import json
import queue
import socket
import threading
import time
from contextlib import ExitStack
from pathlib import Path

import pytest

from imagine.core.errors import InputError, WorkError
from imagine.core.evidence import EvidenceMap
from imagine.core.frames import Pose
from imagine.core.lidar import LD19
from imagine.gcs.snapshot import FleetSnapshot
from imagine.gcs.station import StationSettings, run_station
from imagine.mesh_comm.keyring import KeyRing
from imagine.mesh_comm.messages import Status
from imagine.mesh_comm.node import MeshNode, MeshSettings
from imagine.mesh_comm.seal import Sealer

client = pytest.importorskip("websockets.sync.client", reason="the gcs extra is not installed")

KEY = bytes(range(32))
DEADLINE_S = 15.0


def test_a_drone_on_udp_is_shown_and_obeys_the_page(tmp_path: Path) -> None:
    modem = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    modem.bind(("127.0.0.1", 0))
    modem.settimeout(0.02)
    settings = StationSettings(
        mesh=f"udpout://127.0.0.1:{modem.getsockname()[1]}", port=0, boot_file=str(tmp_path / "made" / "boot")
    )
    urls: queue.Queue[str] = queue.Queue()
    shots: queue.Queue[FleetSnapshot] = queue.Queue()
    last: list[FleetSnapshot] = []
    stop = threading.Event()
    station = threading.Thread(
        target=lambda: last.append(run_station(settings, KeyRing.of(KEY), urls.put, shots.put, stop)), daemon=True
    )
    station.start()
    node = MeshNode(EvidenceMap(own=1), LD19, 4.0, MeshSettings(), Sealer(KEY, 1, 1))
    end = time.monotonic() + DEADLINE_S
    page, open_pages = None, ExitStack()
    orders: list[str] = []
    try:
        while not orders:
            assert time.monotonic() < end, "the order did not come"
            try:
                datagram, ground = modem.recvfrom(2048)
            except TimeoutError:
                continue
            now = time.monotonic()
            node.receive(datagram, now)
            node.set_status(Status(1, now, Pose(1.0, 2.0, 0.5), armed=True, ladder="policy"))
            for reply in node.poll(now):
                modem.sendto(reply, ground)
            orders += [order.action for order in node.commands()]
            if page is None and not shots.empty() and [d.id for d in shots.get().drones] == [1]:
                page = open_pages.enter_context(
                    client.connect(urls.get(timeout=DEADLINE_S).replace("http", "ws") + "ws")
                )
                page.send(json.dumps({"command": "land", "target": 1}))
    finally:
        stop.set()
        station.join(DEADLINE_S)
        open_pages.close()
        modem.close()
    assert orders == ["land"]
    assert not station.is_alive()
    assert (last[0].drones[0].x, last[0].drones[0].state) == (1.0, "policy")


def test_a_mesh_link_that_makes_no_sense_is_an_input_error(tmp_path: Path) -> None:
    settings = StationSettings(mesh="carrier pigeon", port=0, boot_file=str(tmp_path / "boot"))
    with pytest.raises(InputError, match="carrier pigeon"):
        run_station(settings, KeyRing.of(KEY), print, print, threading.Event())


def test_a_second_ground_station_ends_with_the_first_one(tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        port = probe.getsockname()[1]
    refusals: list[str] = []

    def run(number: int) -> None:
        url = f"udpbcast://239.255.77.77:{port}?interface=lo"
        settings = StationSettings(mesh=url, port=0, boot_file=str(tmp_path / f"boot-{number}"))
        try:
            run_station(settings, KeyRing.of(KEY), lambda url: None, lambda shot: None, stop)
        except WorkError as error:
            refusals.append(str(error))

    stop = threading.Event()
    stations = [threading.Thread(target=run, args=(number,), daemon=True) for number in range(2)]
    for station in stations:
        station.start()
    for station in stations:
        station.join(DEADLINE_S)
    stop.set()
    assert len(refusals) == 2
    assert all("another ground station" in text for text in refusals)
