"""Everyone a node has heard, and who of them is in reach now."""

from __future__ import annotations

import logging
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from imagine.core.frames import IDENTITY, Pose, compose, rotate, transform_points
from imagine.mesh_comm.messages import GROUND
from imagine.mesh_comm.peers import Peer, PeerRecord
from imagine.mesh_comm.seal import Opened
from imagine.mesh_comm.settings import MeshSettings

_log = logging.getLogger(__name__)


class PeerBook:
    """The records of all peers by id; a peer is live when it was heard within the settings' timeout.

    Peers say where they are in their own frames. `frame_of` tells where a peer's frame lies in the own (None: nobody
    knows), and what is shown here is in the own.
    """

    def __init__(self, settings: MeshSettings, frame_of: Callable[[int], Pose | None]) -> None:
        """Start with nobody heard."""
        self._settings = settings
        self._frame_of = frame_of
        self._records: dict[int, PeerRecord] = {}  # by id, in order

    def hear(self, opened: Opened, now: float) -> PeerRecord:
        """Note that a peer was heard, and return its record."""
        record = self._records.get(opened.sender)
        if record is None:
            record = self._records[opened.sender] = PeerRecord(opened.sender, opened.boot, now)
            self._records = dict(sorted(self._records.items()))
        if record.boot != opened.boot:
            _log.warning("mesh peer %d has restarted", opened.sender)
            record.restart(opened.boot)
        if now - record.heard_at > self._settings.peer_timeout_s:
            record.met = None
        record.heard_at = now
        return record

    def boot(self, id_: int) -> int:
        """Return the number of the start that a peer was last heard in, 0 where it never was."""
        record = self._records.get(id_)
        return 0 if record is None else record.boot

    def starts(self) -> dict[int, int]:
        """Return the latest start of everyone ever heard, and of those whose maps they hold, by id."""
        latest = {id_: record.boot for id_, record in self._records.items()}
        for record in self._records.values():
            for source, held in record.holdings.items():
                latest[source] = max(latest.get(source, 0), held.boot)
        return latest

    def is_live(self, id_: int, now: float) -> bool:
        """Tell whether a peer was heard lately."""
        record = self._records.get(id_)
        return record is not None and now - record.heard_at <= self._settings.peer_timeout_s

    def live(self, now: float) -> list[PeerRecord]:
        """Return the records of the live peers, by id."""
        timeout_s = self._settings.peer_timeout_s
        return [record for record in self._records.values() if now - record.heard_at <= timeout_s]

    def map_listeners(self, now: float) -> list[PeerRecord]:
        """Return the live peers that take scans and tiles under the protocol: the ground always does."""
        return [record for record in self.live(now) if record.id == GROUND or self._settings.protocol != "off"]

    def has_drone(self, now: float) -> bool:
        """Tell whether any drone is live."""
        return any(record.id != GROUND for record in self.live(now))

    def view(self, now: float) -> dict[int, Peer]:
        """Return everyone ever heard as the outside sees them, by id."""
        return {
            id_: Peer(id_, max(0.0, now - r.heard_at), self.is_live(id_, now), *self._placed(r), r.status)
            for id_, r in self._records.items()
        }

    def ages(self, now: float, most: int) -> dict[int, float]:
        """Return the seconds since each peer was heard, of the `most` heard last."""
        latest = sorted(self._records.values(), key=lambda record: (-record.heard_at, record.id))[:most]
        return {record.id: round(max(0.0, now - record.heard_at), 3) for record in latest}

    def positions(self, now: float) -> NDArray[np.float64]:
        """Return where the live peers should be by now, `[n, 2]` metres, own frame; without those of unknown frames."""
        return np.array(self.places(now), np.float64).reshape(-1, 2)

    def places(self, now: float, leave_out: int | None = None) -> list[tuple[float, float]]:
        """Return what `positions` does as a list, without peer `leave_out`."""
        places: list[tuple[float, float]] = []
        timeout_s = self._settings.peer_timeout_s
        for record in self._records.values():
            if record.id == leave_out or now - record.heard_at > timeout_s:
                continue
            place, frame = record.position(now), self._frame_of(record.id)
            if place is None or frame is None:
                continue
            if frame != IDENTITY:
                x, y = transform_points(frame, np.array([place]))[0].tolist()
                place = x, y
            places.append(place)
        return places

    def _placed(self, record: PeerRecord) -> tuple[Pose | None, tuple[float, float]]:
        """Return a peer's pose and velocity in the own frame; None, and standing, where nobody knows its frame."""
        frame = self._frame_of(record.id)
        if frame is None:
            return None, (0.0, 0.0)
        if frame == IDENTITY:
            return record.pose, record.velocity
        return None if record.pose is None else compose(frame, record.pose), rotate(frame.yaw, *record.velocity)
