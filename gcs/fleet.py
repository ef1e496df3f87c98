"""The fleet as the ground sees it: a mesh node that listens, shows and commands, and never writes a map."""

from __future__ import annotations

from collections import deque

from imagine.core.errors import InputError
from imagine.core.evidence import EvidenceMap
from imagine.core.lidar import LD19, LidarSpec
from imagine.core.mapping import MapSettings
from imagine.gcs.belief import BeliefTiles
from imagine.gcs.orders import Orders
from imagine.gcs.snapshot import DroneView, FleetEvent, FleetSnapshot, Severity
from imagine.gcs.track import Track
from imagine.mesh_comm.messages import ACTIONS, GROUND
from imagine.mesh_comm.node import MeshNode, MeshSettings, Peer
from imagine.mesh_comm.provenance import CellProvenance
from imagine.mesh_comm.seal import Sealer

EVENTS_KEPT = 200


class Fleet:
    """Joins the mesh as id 0 and keeps what a display needs. No I/O, no clock, no thread.

    `now` is seconds of any clock that does not run backwards, the same for all calls: simulated in the twin, monotonic
    in the field. `settings` and `sealer` (of id 0, under the swarm's key) must fit the swarm's.
    """

    def __init__(
        self,
        settings: MeshSettings,
        sealer: Sealer,
        lidar: LidarSpec = LD19,
        range_cap_m: float | None = None,
    ) -> None:
        """Join as the ground. Raises InputError if the sealer is another node's."""
        if sealer.own != GROUND:
            raise InputError(f"the ground station is mesh id {GROUND}, its sealer is of id {sealer.own}")
        self.evidence = EvidenceMap(own=GROUND)
        cap = MapSettings().range_cap_m if range_cap_m is None else range_cap_m
        self.node = MeshNode(self.evidence, lidar, cap, settings, sealer)
        self._tiles = BeliefTiles()
        self._tracks: dict[int, Track] = {}
        self._orders = Orders(settings.command_repeat_s)
        self._events: deque[FleetEvent] = deque(maxlen=EVENTS_KEPT)
        self._serial = 0
        self._started: float | None = None
        self._now = 0.0

    def receive(self, datagram: bytes, now: float) -> None:
        """Take one datagram off the radio; what is malformed or forged is counted and dropped."""
        self._start(now)
        self.node.receive(datagram, now)

    def poll(self, now: float) -> list[bytes]:
        """Return the datagrams to send now: digests, so that the drones know what to send, and orders."""
        self._start(now)
        self._confirm(self.node.peers(now), now)
        for action, drone in self._orders.due(now):
            self.node.send_command(action, drone, now)
        return self.node.poll(now)

    def command(self, action: str, target: int = 0, now: float | None = None) -> None:
        """Order `target` (0: all drones) to hold, land or resume; repeated until confirmed, for 30 s at most.

        `now` None: at the time of the latest call. Raises InputError on an unknown order or drone.
        """
        if action not in ACTIONS:
            raise InputError(f"command '{action}': expected one of {', '.join(ACTIONS)}")
        if target and target not in self._tracks:
            raise InputError(
                f"command '{action}' for drone {target}: known drones are {sorted(self._tracks) or 'none'}"
            )
        at = self._now if now is None else now
        self._start(at)
        nonce = self.node.send_command(action, target, at)
        # a drone known to be gone is told as well, but nobody waits for its answer
        told = {target} if target else {drone for drone, track in self._tracks.items() if not track.lost}
        self._orders.give(action, target, told, nonce, at)
        self._log(at, target, "info", f"pilot: {action}")

    def provenance(self, x: float, y: float) -> CellProvenance:
        """Return who saw the cell at (x, y), metres, when, and by which way that came to the ground."""
        return self.node.provenance(x, y)

    def note(self, drone: int, text: str, lost: bool = False) -> None:
        """Attach what someone else knows of a drone, such as why its process ended; an empty text takes it away.

        `lost` marks the drone gone at once, before its data are stale.
        """
        track = self._track(drone, self._now)
        if text and text != track.note:
            self._log(self._now, drone, "error" if lost else "warning", text)
        track.note, track.lost = text, lost

    def snapshot(self, now: float, coverage: float | None = None) -> FleetSnapshot:
        """Return everything a display shows, immutable. `coverage` (0-1) is for those who know the whole space."""
        begin = self._start(now)
        peers = {i: peer for i, peer in self.node.peers(now).items() if i != GROUND}
        for drone in peers:
            self._track(drone, now)
        self._confirm(peers, now)
        for action, drone in self._orders.give_up(now):
            self._log(now, drone, "warning", f"never confirmed the order to {action}")
        drones: list[DroneView] = []
        for drone, track in sorted(self._tracks.items()):
            view, news = track.observe(peers.get(drone), self.node.place(drone).standing, now)
            drones.append(view)
            for severity, text in news:
                self._log(now, drone, severity, text)
        return FleetSnapshot(
            time_s=now,
            elapsed_s=now - begin,
            drones=tuple(drones),
            map=self._tiles.view(self.evidence),
            links=_links(drones),
            coverage=coverage,
            events=tuple(self._events),
            command=self._orders.view(now),
            # a broadcast link hands back one's own datagrams: those are no fault
            dropped_datagrams=sum(count for reason, count in self.node.stats.items() if reason != "echo"),
        )

    def _confirm(self, peers: dict[int, Peer], now: float) -> None:
        obeyed = {i: peer.status.last_command for i, peer in peers.items() if peer.status is not None}
        self._orders.confirm(obeyed, now)

    def _start(self, now: float) -> float:
        """Keep the time, and return when the ground station first looked."""
        self._now = now
        if self._started is None:
            self._started = now
        return self._started

    def _track(self, drone: int, now: float) -> Track:
        if drone not in self._tracks:
            self._tracks[drone] = Track(drone, now)
        return self._tracks[drone]

    def _log(self, now: float, drone: int, severity: Severity, text: str) -> None:
        self._serial += 1
        begin = now if self._started is None else self._started
        self._events.append(FleetEvent(self._serial, now - begin, drone, severity, text))


def _links(drones: list[DroneView]) -> tuple[tuple[int, int], ...]:
    """Return the pairs of drones, lower id first, of which one hears the other; silent drones have none."""
    live = {drone.id for drone in drones if not drone.stale}
    pairs = {(min(a.id, b), max(a.id, b)) for a in drones if a.id in live for b in a.hears if b in live}
    return tuple(sorted(pairs))
