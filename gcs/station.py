"""The ground station for a real fleet: mesh link, wall clock, web page and terminal table."""

from __future__ import annotations

import logging
import math
import select
import threading
import time
from collections.abc import Callable
from pathlib import Path

from pydantic import Field

from imagine.core.config import Settings
from imagine.core.errors import InputError, WorkError
from imagine.core.mapping import MapSettings
from imagine.gcs.cell_question import cell_state
from imagine.gcs.fleet import Fleet
from imagine.gcs.server import GroundServer
from imagine.gcs.snapshot import FleetSnapshot
from imagine.mesh_comm.keyring import KeyRing
from imagine.mesh_comm.keys import start_sealer
from imagine.mesh_comm.link_url import FORMS
from imagine.mesh_comm.links import open_link
from imagine.mesh_comm.messages import GROUND
from imagine.mesh_comm.namesake import ANSWER_S
from imagine.mesh_comm.settings import MeshSettings
from imagine.mesh_comm.udp_modem import UdpModemLink
from imagine.mesh_comm.udp_network import UdpNetworkLink

logger = logging.getLogger(__name__)

_LOOP_S = 0.05
_SNAPSHOT_S = 0.2


class StationSettings(Settings):
    """Where the ground station meets the swarm, and where it shows its page."""

    mesh: str = Field(default="udpbcast://239.255.77.77:17700", description=f"link of the swarm: {FORMS}")
    host: str = Field(default="127.0.0.1", description="address the page is served at")
    port: int = Field(default=8770, ge=0, le=65535, description="port of the page; 0 takes any free one")
    boot_file: str = Field(default="~/.imagine/ground.boot", description="remembers the boot number between starts")
    radio: MeshSettings = MeshSettings()
    map: MapSettings = MapSettings()


def run_station(
    settings: StationSettings,
    keys: KeyRing,
    on_start: Callable[[str], None],
    on_snapshot: Callable[[FleetSnapshot], None],
    stop: threading.Event,
) -> FleetSnapshot:
    """Run the ground station until `stop` is set; return its last snapshot.

    `keys` are the swarm's (`mesh_comm.keys.find_keys`). `on_start` gets the page's address, `on_snapshot` five
    snapshots a second, both from this thread. Raises InputError on a link or port that cannot be opened, WorkError
    once another ground station is known to be on the air: drones would heed only one of the two.
    """
    sealer = start_sealer(keys, GROUND, Path(settings.boot_file), time.time())
    fleet = Fleet(settings.radio, sealer, range_cap_m=settings.map.range_cap_m)
    link = open_link(settings.mesh)
    try:
        with GroundServer(settings.host, settings.port) as server:
            on_start(server.url)
            return _loop(fleet, link, server, on_snapshot, stop)
    finally:
        link.close()


def _loop(
    fleet: Fleet,
    link: UdpModemLink | UdpNetworkLink,
    server: GroundServer,
    on_snapshot: Callable[[FleetSnapshot], None],
    stop: threading.Event,
) -> FleetSnapshot:
    next_snapshot = time.monotonic()
    snapshot = fleet.snapshot(next_snapshot)
    refused_at = math.inf
    while not stop.is_set():
        select.select([link], [], [], _LOOP_S)
        now = time.monotonic()
        for datagram in link.receive():
            fleet.receive(datagram, now)
        if fleet.node.has_namesake:  # the other one must hear of it before this one ends
            refused_at = min(refused_at, now + ANSWER_S)
        if now >= refused_at:
            raise WorkError("another ground station is on the air, and drones heed only the one started last: end both")
        obey(fleet, server, now)
        for datagram in fleet.poll(now):
            link.send(datagram)
        if now >= next_snapshot:
            next_snapshot = now + _SNAPSHOT_S
            snapshot = fleet.snapshot(now)
            server.publish(snapshot)
            on_snapshot(snapshot)
    return snapshot


def obey(fleet: Fleet, server: GroundServer, now: float) -> None:
    """Pass on what pilots have asked for at the page; a request that makes no sense is logged and dropped.

    Questions about cells are answered.
    """
    for question in server.take_questions():
        if question.answer.set_running_or_notify_cancel():  # else nobody waits any more
            question.answer.set_result(cell_state(fleet.provenance(question.x, question.y), now))
    for request in server.take_requests():
        try:
            fleet.command(request.command, request.target, now)
        except InputError as error:
            logger.warning("the page's request was refused: %s", error)
