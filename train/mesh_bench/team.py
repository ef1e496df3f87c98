"""A recorded exploration told by real mesh nodes: sealed datagrams through the twin's radio, tick by tick."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from imagine.core.evidence import EvidenceMap
from imagine.core.frames import Pose
from imagine.core.lidar import Scan, mask_near
from imagine.mesh_comm.messages import Status
from imagine.mesh_comm.node import MeshNode, MeshSettings
from imagine.mesh_comm.seal import KEY_BYTES, Sealer
from imagine.sim.mesh_flight import BOOT
from imagine.sim.radio import GROUND, RadioMedium, RadioSettings
from imagine.train.mesh_bench.flights import TICK_S, Flight

_KEY = bytes(KEY_BYTES)  # of no mission: nothing of it leaves the process
_APART_M = 1e6  # how far apart radios are that are cut off
HALF_EXTENT_M = 25.6


def _always(_: float) -> bool:
    return True


@dataclass
class Team:
    """The nodes of a flight's drones, numbered from 1, with maps that begin empty; `tick` flies on.

    `is_open` tells of a time, in seconds, whether radios reach anyone: else all are cut off from each other.
    """

    flight: Flight
    mesh: MeshSettings
    radio_settings: RadioSettings
    seed: int = 0
    is_open: Callable[[float], bool] = _always
    keeps: bool = False
    """Whether every datagram is kept, with its time and sender, in `said`."""
    said: list[tuple[float, int, bytes]] = field(default_factory=list)
    ticks: int = -10
    """How many ticks of the flight are over; they hover a second before it, as drones do that have just met."""

    def __post_init__(self) -> None:
        """Let everyone start."""
        rng = np.random.default_rng([self.seed, 2])
        self.radio = RadioMedium(self.flight.drones, self.radio_settings, rng, self.flight.level.segments)
        self.reach = np.zeros((self.flight.drones, self.flight.drones), np.bool_)
        """Who hears whom, as of the last tick."""
        self.maps = [EvidenceMap(number, HALF_EXTENT_M) for number in range(1, self.flight.drones + 1)]
        self.nodes = [
            MeshNode(evidence, self.flight.lidar, self.flight.range_cap_m, self.mesh, Sealer(_KEY, evidence.own, BOOT))
            for evidence in self.maps
        ]

    @property
    def now(self) -> float:
        """Seconds of the last tick."""
        return round(self.ticks * TICK_S, 9)

    @property
    def bytes_sent(self) -> dict[str, int]:
        """Sealed bytes of all, by kind."""
        return {kind: sum(node.bytes_sent[kind] for node in self.nodes) for kind in self.nodes[0].bytes_sent}

    def tick(self, scans: bool = True) -> None:
        """Hear, map and speak, at the poses of the flight's next tick; after its end, or without scans, they hover."""
        at = min(max(self.ticks, 0), len(self.flight.poses) - 1)
        scans = scans and 0 <= self.ticks < len(self.flight.poses)
        self._advance(1, at, 1.0 if scans else 0.0, scans)

    def to_and_fro(self, stride: int) -> None:
        """Fly the recording over and over, back and forth, and scan, `stride` ticks at a time."""
        count = len(self.flight.poses)
        phase = self.ticks % (2 * count)
        self._advance(stride, min(phase, 2 * count - 1 - phase), 1.0 if phase < count else -1.0, True)

    def _advance(self, stride: int, at: int, way: float, scans: bool) -> None:
        """Let `stride` ticks go by; everyone is then where the recording is at tick `at`, `way` times as fast."""
        self.ticks += stride
        now, poses = self.now, self.flight.poses[at]
        places = poses[:, :2]
        if not self.is_open(now):
            places = places + _APART_M * np.arange(1, len(poses) + 1)[:, None]
        self.reach = self.radio.in_reach(places)[1:, 1:]
        for delivery in self.radio.deliver(now, places):
            if delivery.receiver != GROUND:
                self.nodes[delivery.receiver - 1].receive(delivery.datagram, now)
        for index, node in enumerate(self.nodes):
            pose = Pose(*poses[index].tolist())
            if scans:
                self._map(index, pose, self.flight.ranges[at, index], now)
            velocity = way * self.flight.velocities[at, index]
            node.set_status(_status(node.id, now, pose, float(velocity[0]), float(velocity[1])))
        for node in self.nodes:
            for datagram in node.poll(now):
                self.radio.send(node.id, datagram, now)
                if self.keeps:
                    self.said.append((now, node.id, datagram))

    def meet(self) -> Team:
        """Let those in reach of each other hear of each other before the flight; return the team itself."""
        while self.ticks < 0:
            self.tick()
        return self

    def fly(self) -> Team:
        """Fly to the end of the recording; return the team itself."""
        while self.ticks < len(self.flight.poses):
            self.tick()
        return self

    def _map(self, index: int, pose: Pose, ranges: NDArray[np.float32], now: float) -> None:
        node, lidar = self.nodes[index], self.flight.lidar
        scan = Scan(now, mask_near(ranges, lidar, pose, node.teammates(now), self.mesh.mask_radius_m))
        self.maps[index].integrate(pose, scan, lidar, self.flight.range_cap_m)
        node.offer_scan(scan, pose, now)

    def known(self) -> NDArray[np.bool_]:
        """Tell of which cells each drone has any evidence, `[drones, rows, columns]`."""
        return np.array([has_evidence(evidence) for evidence in self.maps])

    def own(self) -> NDArray[np.bool_]:
        """Tell which cells each drone has seen by itself, `[drones, rows, columns]`."""
        return np.array([evidence.layers[evidence.own].cells != 0 for evidence in self.maps])

    def agrees(self) -> bool:
        """Tell whether every drone holds every other's layer exactly as it is, all of it confirmed."""
        for writer in self.maps:
            truth = writer.layers[writer.own]
            for reader in self.maps:
                held = reader.layers.get(writer.own)
                if reader is writer:
                    continue
                if held is None or held.provisional.any() or not np.array_equal(held.versions, truth.versions):
                    return False
                if not np.array_equal(held.cells, truth.cells):
                    return False
        return True


def has_evidence(evidence: EvidenceMap) -> NDArray[np.bool_]:
    """Tell of which cells a map has evidence of any source, `[rows, columns]`."""
    known = np.zeros(evidence.shape, np.bool_)
    for layer in evidence.layers.values():
        known |= layer.cells != 0
    return known


def _status(number: int, now: float, pose: Pose, vx: float, vy: float) -> Status:
    """Return what an exploring drone tells of itself."""
    return Status(
        number, now, pose, (vx, vy), height_m=1.0, battery=0.9, mode="OFFBOARD", armed=True, ladder="policy",
        reason="exploring",
    )  # fmt: skip
