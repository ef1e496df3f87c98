"""The exchange that the mesh is held against: scans as they are, and the whole map at every reconnection.

Drones in reach broadcast every scan, uncompressed, and whenever two come into reach of each other both broadcast their
whole map: what they have seen and heard so far, one float32 for each cell of the level, to be summed into the
others'. Who is in reach they notice twice a second, as the mesh does by its statuses, but at no cost, and nothing costs
headers, seals or repeats here. Over a radio with a rate, scans go first, and a newer map replaces one that waits.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from imagine.core.evidence import EvidenceMap
from imagine.core.frames import Pose
from imagine.core.lidar import Scan
from imagine.core.raster import CELL
from imagine.sim.radio import RadioMedium, RadioSettings
from imagine.train.mesh_bench.flights import TICK_S, Flight
from imagine.train.mesh_bench.team import HALF_EXTENT_M, has_evidence

_FLOAT_BYTES = 4
_NOTICE_TICKS = 5


@dataclass
class _Waiting:
    """What a drone still has to send of a scan (`tick` it was taken at) or of a map (`cells` it knew)."""

    left_bytes: float
    tick: int = 0
    cells: NDArray[np.bool_] | None = None


@dataclass
class WholeMaps:
    """A flight's drones under that exchange; `rate_bps` infinite: everything is heard a tick later."""

    flight: Flight
    radio: RadioSettings
    rate_bps: float = math.inf
    bytes_sent: int = 0
    reconnections: int = 0
    ticks: int = 0
    _scans: list[list[_Waiting]] = field(default_factory=list)
    _map: list[_Waiting | None] = field(default_factory=list)

    def __post_init__(self) -> None:
        """Let everyone start with nothing known."""
        drones = self.flight.drones
        rng = np.random.default_rng(0)
        self._medium = RadioMedium(drones, self.radio, rng, self.flight.level.segments)
        self._maps = [EvidenceMap(number, HALF_EXTENT_M) for number in range(1, drones + 1)]
        self._told = np.zeros((drones, *self._maps[0].shape), np.bool_)
        self._ever = self._told.copy()
        self._noticed = np.zeros((drones, drones), np.bool_)
        self._met = np.zeros((drones, drones), np.bool_)
        self._scans = [[] for _ in range(drones)]
        self._map = [None] * drones
        corners = self.flight.level.segments.reshape(-1, 2)
        columns, rows = np.ceil(np.ptp(corners, axis=0) / CELL).astype(int).tolist()
        self.scan_bytes = _FLOAT_BYTES * (self.flight.lidar.beams + 3)
        self.map_bytes = _FLOAT_BYTES * rows * columns

    def tick(self) -> None:
        """Map the scans of the next tick, and let what is sent be heard by all in reach."""
        tick, flight = self.ticks, self.flight
        self.ticks += 1
        reach = self._medium.in_reach(flight.poses[tick])[1:, 1:]
        if tick % _NOTICE_TICKS == 0:
            self._noticed = reach
        in_touch = self._noticed & reach
        heard = [self._advance(sender) for sender in range(flight.drones)]
        for sender, messages in enumerate(heard):
            for receiver in np.flatnonzero(reach[sender]).tolist():
                for message in messages:
                    self._take(receiver, sender, message)
        for drone in range(flight.drones):
            self._draw(self._maps[drone], drone, drone, tick)
        known = self._told | np.array([has_evidence(evidence) for evidence in self._maps])
        self._ever |= known
        for drone in range(flight.drones):
            if in_touch[drone].any():
                self._scans[drone].append(_Waiting(self.scan_bytes, tick))
            if (in_touch[drone] & ~self._met[drone]).any():
                self.reconnections += 1
                self._map[drone] = _Waiting(self.map_bytes, cells=known[drone])
        self._met = in_touch

    def known(self) -> NDArray[np.bool_]:
        """Tell of which cells each drone ever had evidence, `[drones, rows, columns]`.

        A map that is sent tells of those alone that have evidence then: what cancels out is unknown again.
        """
        return self._ever.copy()

    def _advance(self, sender: int) -> list[_Waiting]:
        """Send for a tick; return what is complete."""
        budget = self.rate_bps / 8.0 * TICK_S
        done: list[_Waiting] = []
        while budget > 0.0:
            waiting = self._scans[sender][0] if self._scans[sender] else self._map[sender]
            if waiting is None:
                break
            now = min(budget, waiting.left_bytes)
            budget -= now
            waiting.left_bytes -= now
            self.bytes_sent += math.ceil(now)
            if waiting.left_bytes > 0.0:
                break
            done.append(waiting)
            if waiting.cells is None:
                self._scans[sender].pop(0)
            else:
                self._map[sender] = None
        return done

    def _take(self, receiver: int, sender: int, message: _Waiting) -> None:
        if message.cells is not None:
            self._told[receiver] |= message.cells
        else:
            self._draw(self._maps[receiver], receiver, sender, message.tick)

    def _draw(self, evidence: EvidenceMap, holder: int, source: int, tick: int) -> None:
        flight = self.flight
        pose, scan = Pose(*flight.poses[tick, source].tolist()), Scan(0.0, flight.ranges[tick, source])
        if holder == source:
            evidence.integrate(pose, scan, flight.lidar, flight.range_cap_m)
        else:
            evidence.integrate_provisional(source + 1, pose, scan, flight.lidar, flight.range_cap_m)
