"""An exploration in the twin with real mesh nodes and the real radio medium, recorded: what the batched air is held to.

Nothing here is fast. The coefficients of `sim.air_costs` are fitted on such flights, and tests compare the two.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from imagine.core.evidence import EvidenceMap
from imagine.core.frames import Pose, rotate
from imagine.core.frontier import frontier_field
from imagine.core.lidar import LD19, LidarSpec, Scan, mask_near
from imagine.core.planner import plan_velocity
from imagine.core.shield import shield_velocity
from imagine.mesh_comm import messages
from imagine.mesh_comm.codec import pack_ranges, unpack_ranges
from imagine.mesh_comm.node import MeshNode, MeshSettings
from imagine.mesh_comm.seal import KEY_BYTES, Sealer
from imagine.sim.level import Level
from imagine.sim.radio import RadioMedium, RadioSettings
from imagine.sim.twin import TICK_S, Twin

RANGE_CAP_M = 4.0
BOOT = 200_000_000
"""A boot number as flown ones are, seconds since 2020, and as many bytes on the wire."""
_KEY = bytes(KEY_BYTES)  # of no mission: nothing of these flights leaves the process


@dataclass(frozen=True)
class Flown:
    """One tick as it was flown; arrays by drone.

    `poses` `[drones, 3]`, `velocities` `[drones, 3]`, `ranges` `[drones, beams]` as mapped (to the centimetre, without
    teammates); `known` how many cells each belief knows after the tick, `bytes_sent` `[drones, 4]` what each has sent
    by then (scan, tile, digest, status).
    """

    poses: NDArray[np.float64]
    velocities: NDArray[np.float64]
    ranges: NDArray[np.float32]
    known: NDArray[np.int64]
    bytes_sent: NDArray[np.int64]


@dataclass(frozen=True)
class Said:
    """A message that went out, with its sealed size in bytes."""

    tick: int
    sender: int
    message: messages.Message
    sealed_bytes: int


@dataclass
class MeshFlight:
    """A team of real nodes exploring a level; `fly` adds ticks. Drones are numbered from 1 on the mesh."""

    level: Level
    drones: int
    radio_settings: RadioSettings
    mesh_settings: MeshSettings
    seed: int = 0
    lidar: LidarSpec = LD19
    parked_from: int | None = None
    """From this tick on nobody moves and nobody scans, so that the exchange can settle."""
    ticks: list[Flown] = field(default_factory=list)
    said: list[Said] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.twin = Twin([self.level], self.drones, self.lidar, seed=self.seed)
        rng = np.random.default_rng([self.seed, 1])
        self.radio = RadioMedium(self.drones, self.radio_settings, rng, self.level.segments)
        self.maps = [EvidenceMap(number) for number in range(1, self.drones + 1)]
        self.nodes = [
            MeshNode(evidence, self.lidar, RANGE_CAP_M, self.mesh_settings, Sealer(_KEY, evidence.own, BOOT))
            for evidence in self.maps
        ]
        self._reader = Sealer(_KEY, 254, 1)

    def fly(self, ticks: int, each: Callable[[MeshFlight], None] | None = None) -> MeshFlight:
        """Fly so many more ticks, calling `each` after every one; return the flight itself."""
        for _ in range(ticks):
            self._tick()
            if each is not None:
                each(self)
        return self

    def _tick(self) -> None:
        """One tick in the order of the served twin and the runner: hear, map, speak, move."""
        tick = len(self.ticks) + 1
        now = round(tick * TICK_S, 9)
        poses, velocities = self.twin.poses[0].copy(), self.twin.velocity[0].copy()
        scans, mapped = self.twin.scan()[0], np.full((self.drones, self.lidar.beams), np.nan, np.float32)
        for delivery in self.radio.deliver(now, poses[:, :2]):
            if delivery.receiver > 0:
                self.nodes[delivery.receiver - 1].receive(delivery.datagram, now)
        parked = self.parked_from is not None and tick >= self.parked_from
        setpoints = np.zeros((1, self.drones, 3))
        for index, (node, evidence) in enumerate(zip(self.nodes, self.maps, strict=True)):
            pose = Pose(*poses[index].tolist())
            if not parked:
                ranges = _to_centimetres(scans[index], self.lidar)
                mapped[index] = mask_near(
                    ranges, self.lidar, pose, node.teammates(now), self.mesh_settings.mask_radius_m
                )
                scan = Scan(now, mapped[index])
                evidence.integrate(pose, scan, self.lidar, RANGE_CAP_M)
                node.offer_scan(scan, pose, now)
                setpoints[0, index, :2] = self._plan(evidence, pose, Scan(now, scans[index]))
            node.set_status(_status(node.id, now, pose, velocities[index]))
        for node in self.nodes:
            for datagram in node.poll(now):
                self.radio.send(node.id, datagram, now)
                message = messages.decode(self._reader.open(datagram, now).payload)
                self.said.append(Said(tick, node.id, message, len(datagram)))
        self.twin.step(setpoints)
        known = np.array([np.count_nonzero(evidence.belief()) for evidence in self.maps])
        sent = np.array([list(node.bytes_sent.values()) for node in self.nodes])
        self.ticks.append(Flown(poses, velocities, mapped, known, sent))

    def _plan(self, evidence: EvidenceMap, pose: Pose, scan: Scan) -> tuple[float, float]:
        """Return the planner's shielded velocity, body frame, m/s."""
        speed = self.twin.limits.speed_mps
        field_ = frontier_field(evidence.belief())
        wanted = plan_velocity(field_, evidence.origin_cells, pose, scan, self.lidar, speed)
        if wanted is None:
            return 0.0, 0.0
        return shield_velocity(*rotate(-pose.yaw, *wanted), scan, self.lidar, self.twin.limits)


def _to_centimetres(ranges: NDArray[np.float32], lidar: LidarSpec) -> NDArray[np.float32]:
    """Return ranges as a peer reads them, so that source and peer draw the same cells."""
    return unpack_ranges(pack_ranges(ranges, lidar.range_min, RANGE_CAP_M), lidar.beams, RANGE_CAP_M)


def _status(number: int, now: float, pose: Pose, velocity: NDArray[np.float64]) -> messages.Status:
    """Return a status as long as that of a drone that explores by its policy."""
    return messages.Status(
        id=number,
        stamp=now,
        pose=pose,
        velocity=(float(velocity[0]), float(velocity[1])),
        height_m=1.0,
        battery=0.9,
        mode="OFFBOARD",
        armed=True,
        ladder="policy",
        reason="exploring",
    )
