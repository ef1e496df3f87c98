"""The radio medium between the drones: range, walls, rate, latency and loss. Pure: time and positions come in.

Every station broadcasts. A datagram waits until its sender's radio is free, is on air for its size over the rate,
arrives after the latency, and is heard by each station within range that does not lose it. Station 0 is the ground.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass, field
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from imagine.core.config import Settings
from imagine.sim.propagation import Propagation, disc, fill_reach, path_loss
from imagine.sim.randomisation import Quantity, draw, positive, within

GROUND = 0
"""Station number of the ground station; drones count from 1."""


class RadioSettings(Settings):
    """The radio's limits: metres, decibels, bits per second, seconds, bytes; loss is a probability.

    `model` disc: heard within `range_m`, through any wall. `model` path-loss: heard while the received power is at
    least `threshold_dbm`; the path has `exponent_clear` in sight of each other and `exponent_walled` for its whole
    length as soon as one wall stands between, or, where `wall_db` is given, costs that much for every wall instead.
    The defaults are a 2.4 GHz radio of 1 mW: 31.6 m in the clear, 5.6 m behind walls.

    `range_m`, `tx_dbm` and `loss` may be ranges [low, high]: every world and episode, or flight, draws its own numbers.
    """

    model: Literal["disc", "path-loss"] = "disc"
    range_m: Annotated[Quantity, positive()] = Field(
        default=5.0, description="disc: distance at which two drones still hear each other"
    )
    tx_dbm: Annotated[Quantity, within(-60.0, 40.0)] = Field(default=0.0, description="path-loss: transmitted power")
    loss_1m_db: float = Field(default=40.0, ge=0.0, le=100.0, description="path-loss: over the first metre, 2.4 GHz")
    threshold_dbm: float = Field(default=-70.0, ge=-150.0, le=0.0, description="path-loss: least power that is heard")
    exponent_clear: float = Field(default=2.0, ge=1.0, le=8.0, description="path-loss: exponent in the clear")
    exponent_walled: float = Field(default=4.0, ge=1.0, le=8.0, description="path-loss: exponent through walls")
    wall_db: float | None = Field(
        default=None, gt=0.0, le=100.0, description="path-loss: loss per wall between, instead of the larger exponent"
    )
    ground_range_m: float | None = Field(default=None, gt=0.0, description="the ground station's range; none: any")
    rate_bps: float = Field(default=250_000.0, gt=0.0, description="bits per second of each sender")
    latency_s: float = Field(default=0.02, ge=0.0, le=10.0, description="delay on top of the time on air")
    loss: Annotated[Quantity, within(0.0, 1.0)] = Field(
        default=0.0, description="chance that a receiver in range misses a datagram"
    )
    queue_bytes: int = Field(default=16_384, ge=1, description="what waits to be sent; more is dropped")

    @property
    def propagation(self) -> Propagation:
        """How far drones hear each other, in the numbers of `sim.propagation`'s kernels; of ranges it is the middle."""
        if self.model == "disc":
            return disc(draw(self.range_m, None))
        budget_db = draw(self.tx_dbm, None) - self.loss_1m_db - self.threshold_dbm
        return path_loss(budget_db, self.exponent_clear, self.exponent_walled, self.wall_db)

    def drawn(self, rng: np.random.Generator) -> RadioSettings:
        """Return these settings with a number drawn from every range; without ranges nothing is drawn."""
        ranges = {name: value for name in _DRAWN if isinstance(value := getattr(self, name), tuple)}
        return self.model_copy(update={name: draw(value, rng) for name, value in ranges.items()}) if ranges else self


_DRAWN = ("range_m", "tx_dbm", "loss")


@dataclass
class StationCounters:
    """What one station sent, and what its full queue dropped."""

    sent: int = 0
    sent_bytes: int = 0
    dropped: int = 0


@dataclass
class LinkCounters:
    """What became of the datagrams from one station to another, and in how many ticks the two were in reach.

    A tick is a time at which deliveries were asked for.
    """

    delivered: int = 0
    delivered_bytes: int = 0
    lost: int = 0
    lost_bytes: int = 0
    out_of_range: int = 0
    ticks: int = 0


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
        """`rng` draws from ranges, then the losses; `walls` `[n, 4]` (x0, y0, x1, y1), metres, are all walls' faces."""
        self.settings = settings = settings.drawn(rng)
        self.stations = drones + 1
        self.sent = [StationCounters() for _ in range(self.stations)]
        self.links = [[LinkCounters() for _ in range(self.stations)] for _ in range(self.stations)]
        self._rng, self._loss = rng, draw(settings.loss, None)
        self._walls = np.empty((0, 4)) if walls is None else np.ascontiguousarray(walls, np.float64)
        self._propagation = settings.propagation
        self._busy_until = [0.0] * self.stations
        self._in_flight: list[tuple[float, int, int, bytes]] = []
        self._sequence = 0
        self._delivered_at = -np.inf

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
        reach = self.in_reach(positions)
        if now > self._delivered_at:
            self._delivered_at = now
            for sender, receiver in np.argwhere(reach):
                self.links[sender][receiver].ticks += 1
        while self._in_flight and self._in_flight[0][0] <= now + 1e-9:
            _, sender, _, datagram = heapq.heappop(self._in_flight)
            for receiver in range(self.stations):
                if receiver == sender:
                    continue
                link = self.links[sender][receiver]
                if not reach[sender, receiver]:
                    link.out_of_range += 1
                elif self._loss > 0.0 and self._rng.random() < self._loss:
                    link.lost += 1
                    link.lost_bytes += len(datagram)
                else:
                    link.delivered += 1
                    link.delivered_bytes += len(datagram)
                    deliveries.append(Delivery(receiver, sender, datagram))
        return deliveries

    def in_reach(self, positions: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Tell which stations hear each other, `[stations, stations]`; the ground stands at the map's origin.

        Nobody hears itself. Walls do not count between a drone and the ground, whose antenna is its operator's choice.
        """
        places = np.ascontiguousarray(positions[:, :2], np.float64)
        between_drones = np.empty((len(places), len(places)), np.uint8)
        fill_reach(between_drones, places, self._walls, self._propagation)
        reach = np.zeros((self.stations, self.stations), np.bool_)
        reach[1:, 1:] = between_drones
        ground_range = self.settings.ground_range_m
        near = True if ground_range is None else np.linalg.norm(places, axis=1) <= ground_range
        reach[GROUND, 1:] = reach[1:, GROUND] = near
        return reach
