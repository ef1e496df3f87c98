"""The radio medium between the drones: range, walls, rate, latency and loss. Pure: time and positions come in.

Every station broadcasts. A datagram waits until its sender's radio is free, is on air for its size over the rate,
arrives after the latency, and is heard by each station within range that does not lose it. Station 0 is the ground.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from imagine.core.config import Settings

GROUND = 0
"""Station number of the ground station; drones count from 1."""


class RadioSettings(Settings):
    """The radio's limits: metres, bits per second, seconds, bytes; loss is a probability."""

    range_m: float = Field(default=5.0, gt=0.0, description="distance at which two drones still hear each other")
    ground_range_m: float | None = Field(default=None, gt=0.0, description="the ground station's range; none: any")
    rate_bps: float = Field(default=250_000.0, gt=0.0, description="bits per second of each sender")
    latency_s: float = Field(default=0.02, ge=0.0, le=10.0, description="delay on top of the time on air")
    loss: float = Field(default=0.0, ge=0.0, le=1.0, description="chance that a receiver in range misses a datagram")
    queue_bytes: int = Field(default=16_384, ge=1, description="what waits to be sent; more is dropped")
    wall_m: float = Field(default=0.0, ge=0.0, description="range that each wall (of two faces) between costs")


@dataclass
class StationCounters:
    """What one station sent, and what its full queue dropped."""

    sent: int = 0
    sent_bytes: int = 0
    dropped: int = 0


@dataclass
class LinkCounters:
    """What became of the datagrams from one station to another."""

    delivered: int = 0
    delivered_bytes: int = 0
    lost: int = 0
    out_of_range: int = 0


@dataclass(frozen=True)
class Delivery:
    """A datagram that `receiver` hears from `sender`."""

    receiver: int
    sender: int
    datagram: bytes = field(repr=False)


class RadioMedium:
    """The air between stations 0 (ground) and 1 to `drones`; the same inputs always give the same deliveries."""

    def __init__(
        self,
        drones: int,
        settings: RadioSettings,
        rng: np.random.Generator,
        walls: NDArray[np.float64] | None = None,
    ) -> None:
        """`rng` draws the losses; `walls` `[n, 4]` (x0, y0, x1, y1), metres, are the faces of all walls."""
        self.settings = settings
        self.stations = drones + 1
        self.sent = [StationCounters() for _ in range(self.stations)]
        self.links = [[LinkCounters() for _ in range(self.stations)] for _ in range(self.stations)]
        self._rng = rng
        self._walls = np.empty((0, 4)) if walls is None else walls
        self._busy_until = [0.0] * self.stations
        self._in_flight: list[tuple[float, int, int, bytes]] = []
        self._sequence = 0

    def send(self, sender: int, datagram: bytes, now: float) -> bool:
        """Put a datagram into the sender's queue at the time `now`, in seconds; False when the queue is full."""
        counters = self.sent[sender]
        start = max(now, self._busy_until[sender])
        waiting_bytes = (start - now) * self.settings.rate_bps / 8.0
        if waiting_bytes + len(datagram) > self.settings.queue_bytes:
            counters.dropped += 1
            return False
        counters.sent += 1
        counters.sent_bytes += len(datagram)
        self._busy_until[sender] = start + 8.0 * len(datagram) / self.settings.rate_bps
        arrival = self._busy_until[sender] + self.settings.latency_s
        heapq.heappush(self._in_flight, (arrival, sender, self._sequence, datagram))
        self._sequence += 1
        return True

    def deliver(self, now: float, positions: NDArray[np.float64]) -> list[Delivery]:
        """Return what has arrived by `now`, by arrival, sender and order of sending; drones at `positions` `[n, 2]`."""
        deliveries: list[Delivery] = []
        reach: NDArray[np.bool_] | None = None
        while self._in_flight and self._in_flight[0][0] <= now + 1e-9:
            _, sender, _, datagram = heapq.heappop(self._in_flight)
            if reach is None:
                reach = self.in_reach(positions)
            for receiver in range(self.stations):
                if receiver == sender:
                    continue
                link = self.links[sender][receiver]
                if not reach[sender, receiver]:
                    link.out_of_range += 1
                elif self.settings.loss > 0.0 and self._rng.random() < self.settings.loss:
                    link.lost += 1
                else:
                    link.delivered += 1
                    link.delivered_bytes += len(datagram)
                    deliveries.append(Delivery(receiver, sender, datagram))
        return deliveries

    def in_reach(self, positions: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Tell which stations hear each other, `[stations, stations]`; the ground stands at the map's origin."""
        places = np.zeros((self.stations, 2))
        places[1:] = positions[:, :2]
        distance = np.linalg.norm(places[:, None] - places[None], axis=2)
        limit = np.full_like(distance, self.settings.range_m)
        if self.settings.wall_m > 0.0 and len(self._walls):
            for a in range(1, self.stations):
                for b in range(a + 1, self.stations):
                    limit[a, b] -= self.settings.wall_m * _crossings(places[a], places[b], self._walls) / 2
                    limit[b, a] = limit[a, b]
        ground_range = self.settings.ground_range_m
        limit[GROUND, :] = limit[:, GROUND] = np.inf if ground_range is None else ground_range
        reach: NDArray[np.bool_] = distance <= limit
        return reach


def _crossings(a: NDArray[np.float64], b: NDArray[np.float64], walls: NDArray[np.float64]) -> int:
    """Count the segments `walls` `[n, 4]` that the line from `a` to `b` crosses."""
    along = b - a
    start, wall = walls[:, :2], walls[:, 2:] - walls[:, :2]
    denominator = along[0] * wall[:, 1] - along[1] * wall[:, 0]
    offset = start - a
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (offset[:, 0] * wall[:, 1] - offset[:, 1] * wall[:, 0]) / denominator
        u = (offset[:, 0] * along[1] - offset[:, 1] * along[0]) / denominator
    return int(np.count_nonzero((denominator != 0.0) & (t >= 0.0) & (t <= 1.0) & (u >= 0.0) & (u <= 1.0)))
