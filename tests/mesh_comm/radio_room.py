"""A small swarm in one room, in memory: drones that scan a rectangle and talk through a medium that the test drives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from imagine.core.evidence import EvidenceMap
from imagine.core.frames import Pose
from imagine.core.lidar import LidarSpec, Scan
from imagine.mesh_comm import messages
from imagine.mesh_comm.messages import Status
from imagine.mesh_comm.node import MeshNode, MeshSettings
from imagine.mesh_comm.seal import Sealer

KEY = bytes(range(32))
LIDAR = LidarSpec(beams=90)
CAP_M = 4.0
ROOM = (-5.0, -4.0, 6.0, 3.0)


def room_scan(pose: Pose, stamp: float, spec: LidarSpec = LIDAR) -> Scan:
    """Return the scan of an empty rectangular room from inside it."""
    bearing = spec.bearings + pose.yaw
    x_min, y_min, x_max, y_max = ROOM
    with np.errstate(divide="ignore"):
        to_x = np.where(np.cos(bearing) > 0, x_max - pose.x, x_min - pose.x) / np.cos(bearing)
        to_y = np.where(np.sin(bearing) > 0, y_max - pose.y, y_min - pose.y) / np.sin(bearing)
    return Scan(stamp, np.minimum(np.abs(to_x), np.abs(to_y)).astype(np.float32))


@dataclass
class Drone:
    """A node with its map; `fly` scans and offers the scan."""

    node: MeshNode
    evidence: EvidenceMap
    sent: list[tuple[float, bytes]] = field(default_factory=list)

    def fly(self, pose: Pose, now: float) -> None:
        """Scan the room from `pose`, map it, and offer scan and status to the mesh."""
        scan = room_scan(pose, now)
        self.evidence.integrate(pose, scan, LIDAR, CAP_M)
        self.node.set_status(Status(self.node.id, now, pose, mode="OFFBOARD", ladder="policy"))
        self.node.offer_scan(scan, pose, now)

    def poll(self, now: float) -> list[bytes]:
        """Return what the node sends now, and keep it for checks."""
        out = self.node.poll(now)
        self.sent += [(now, datagram) for datagram in out]
        return out


def make_drone(id_: int, boot: int = 1, key: bytes = KEY, **settings: object) -> Drone:
    """Return a drone (id 0: the ground station) with an empty map."""
    evidence = EvidenceMap(id_, half_extent_m=6.4)
    node = MeshNode(evidence, LIDAR, CAP_M, MeshSettings.model_validate(settings), Sealer(key, id_, boot))
    return Drone(node, evidence)


def contents(datagrams: list[bytes]) -> list[messages.Message]:
    """Return the messages of datagrams, as an eavesdropper with the key reads them."""
    eavesdropper = Sealer(KEY, 254, 1)
    return [messages.decode(eavesdropper.open(datagram, 0.0).payload) for datagram in datagrams]


def carrying(datagrams: list[bytes], kind: type) -> list[bytes]:
    """Return those of the datagrams that carry a message of `kind`, still sealed."""
    return [d for d, message in zip(datagrams, contents(datagrams), strict=True) if isinstance(message, kind)]


def exchange(
    drones: list[Drone], times: NDArray[np.float64], hears: Callable[[int, int], bool] = lambda a, b: True
) -> None:
    """Poll all nodes at each time and hand every datagram to all others that hear its sender."""
    for now in times:
        for sender, datagrams in [(drone, drone.poll(float(now))) for drone in drones]:
            for other in drones:
                if other is not sender and hears(sender.node.id, other.node.id):
                    for datagram in datagrams:
                        other.node.receive(datagram, float(now))


def same_layers(drones: list[Drone]) -> bool:
    """Tell whether every map holds, of every drone's own layer, exactly what that drone holds, all of it confirmed."""
    for writer in drones:
        source = writer.node.id
        truth = writer.evidence.versions(source)
        for reader in drones:
            if reader is writer:
                continue
            if reader.evidence.versions(source) != truth or source not in reader.evidence.layers:
                return False
            if reader.evidence.layers[source].provisional.any():
                return False
            for key in truth:
                if not np.array_equal(reader.evidence.tile(source, key), writer.evidence.tile(source, key)):
                    return False
    return True
