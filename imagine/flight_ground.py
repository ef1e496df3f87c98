"""The ground station of a simulated flight: the fleet on the twin's radio and clock, the page in a thread."""

from __future__ import annotations

import time
from dataclasses import replace

from imagine.gcs.fleet import Fleet
from imagine.gcs.server import PUSH_PERIOD_S, GroundServer
from imagine.gcs.snapshot import FleetSnapshot
from imagine.gcs.station import obey
from imagine.mesh_comm.messages import GROUND
from imagine.mesh_comm.seal import Sealer
from imagine.mesh_comm.settings import MeshSettings
from imagine.runner_processes import RunnerProcesses
from imagine.sim.flight_control import Mode
from imagine.sim.server import SitlServer, TickRecord

_SNAPSHOT_TICKS = 2


class FlightGround:
    """Serves the page while entered; `listen` is called once a tick."""

    def __init__(self, radio: MeshSettings, key: bytes, port: int) -> None:
        """Join the swarm of `key` as its ground; `port` is that of the page, 0 any free one."""
        self.fleet = Fleet(radio, Sealer(key, GROUND, boot=1))
        self.server = GroundServer(port=port)
        self._noted: dict[int, str] = {}

    @property
    def url(self) -> str:
        """The page's address."""
        return self.server.url

    def listen(
        self, server: SitlServer, record: TickRecord, coverage: float, processes: RunnerProcesses
    ) -> FleetSnapshot | None:
        """Hand this tick's radio traffic to the fleet, its answers to the radio; return a fresh snapshot at times."""
        now = record.time_s
        for datagram in record.ground_inbox:
            self.fleet.receive(datagram, now)
        obey(self.fleet, self.server, now)
        for datagram in self.fleet.poll(now):
            server.send_from_ground(datagram)
        self._note_failures(record, processes)
        if record.tick % _SNAPSHOT_TICKS:
            return None
        snapshot = self.fleet.snapshot(now, coverage)
        self.server.publish(snapshot)
        return snapshot

    def finish(self, time_s: float, coverage: float, ending: str) -> None:
        """Leave a last word on the page, and the time for it to arrive before the server goes."""
        self.server.publish(replace(self.fleet.snapshot(time_s, coverage), over=ending))
        time.sleep(2.0 * PUSH_PERIOD_S)

    def _note_failures(self, record: TickRecord, processes: RunnerProcesses) -> None:
        """Tell the pilot what only the twin can see: why a drone went silent and what its vehicle does about it."""
        for vehicle in record.vehicles:
            why = processes.ended_badly(vehicle.drone)
            if not why and vehicle.failsafes:
                why = "vehicle failsafe"
            if not why:
                continue
            causes = ", ".join(f.reason for f in vehicle.failsafes)
            doing = "landed" if not vehicle.armed else "landing" if vehicle.mode is Mode.LAND else vehicle.mode.name
            text = f"{why}; vehicle: {causes + ', ' if causes else ''}{doing.lower()}"
            if self._noted.get(vehicle.drone) != text:
                self._noted[vehicle.drone] = text
                self.fleet.note(vehicle.drone, text, lost=not processes.is_running(vehicle.drone))

    def __enter__(self) -> FlightGround:
        self.server.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.server.stop()
