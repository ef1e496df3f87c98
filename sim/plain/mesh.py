"""Radio between the drones of one world: real mesh nodes, real sealed datagrams, and the radio of the served twin."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from imagine.core.evidence import EvidenceMap
from imagine.core.frames import Pose
from imagine.core.lidar import LidarSpec, Scan
from imagine.mesh_comm.messages import GROUND, Message, Status, encode
from imagine.mesh_comm.node import MeshNode
from imagine.mesh_comm.seal import KEY_BYTES, Sealer
from imagine.mesh_comm.settings import MeshSettings
from imagine.sim.mesh_flight import BOOT
from imagine.sim.radio import RadioMedium, RadioSettings

_KEY = bytes(KEY_BYTES)  # of no mission: no datagram leaves the process
_NOWHERE_M = 1e6  # where the radios of the fallen are, each so far from the next


class PlainMesh:
    """A mesh node for each of the maps, which have the numbers 1, 2, ... there. Times are seconds of the episode."""

    def __init__(
        self,
        maps: Sequence[EvidenceMap],
        lidar: LidarSpec,
        range_cap_m: float,
        mesh: MeshSettings,
        radio: RadioSettings,
        walls: NDArray[np.float64],
        rng: np.random.Generator,
    ) -> None:
        """Start with nobody heard; `walls` `[n, 4]` are faces, metres, and `rng` draws what the radio loses."""
        self._sealers = [Sealer(_KEY, evidence.own, BOOT) for evidence in maps]
        self.nodes = [
            MeshNode(evidence, lidar, range_cap_m, mesh, sealer)
            for evidence, sealer in zip(maps, self._sealers, strict=True)
        ]
        self.radio = RadioMedium(len(self.nodes), radio, rng, walls)

    def hear(self, now: float, poses: NDArray[np.float64], alive: NDArray[np.bool_]) -> None:
        """Deliver what has arrived by `now` to those that hear it at `poses` `[drones, 3]`; the fallen do not."""
        away = _NOWHERE_M * np.arange(1, len(poses) + 1)[:, None]
        for delivery in self.radio.deliver(now, np.where(alive[:, None], poses[:, :2], away)):
            if delivery.receiver != GROUND:
                self.nodes[delivery.receiver - 1].receive(delivery.datagram, now)

    def speak(
        self,
        now: float,
        scans: Sequence[Scan | None],
        poses: NDArray[np.float64],
        velocity: NDArray[np.float64],
    ) -> None:
        """Let everyone with a scan, as it was mapped, say what it has to say; poses and velocity `[drones, 3]`."""
        for node, scan, pose, (vx, vy, _) in zip(self.nodes, scans, poses.tolist(), velocity.tolist(), strict=True):
            if scan is None:
                continue
            node.offer_scan(scan, Pose(*pose), now)
            node.set_status(exploring(node.id, now, Pose(*pose), (vx, vy)))
            for datagram in node.poll(now):
                self.radio.send(node.id, datagram, now)

    def meet(self, now: float, poses: NDArray[np.float64]) -> None:
        """Let those that reach each other at `poses` `[drones, 3]` know it: before an episode they have told."""
        reach = self.radio.in_reach(poses)[1:, 1:]
        for sender, receiver in np.argwhere(reach).tolist():
            heard = {int(other) + 1: 0.0 for other in np.flatnonzero(reach[sender])}
            pose = Pose(*poses[sender].tolist())
            self.tell(sender, receiver, exploring(sender + 1, now, pose, (0.0, 0.0), heard), now)

    def tell(self, sender: int, receiver: int, message: Message, at: float) -> None:
        """Let drone `receiver` have heard a message of drone `sender` (both counted from 0) at a time."""
        self.nodes[receiver].receive(self._sealers[sender].seal(encode(message), at), at)

    def bytes_sent(self) -> NDArray[np.int64]:
        """Return the sealed bytes each has sent by kind (scan, tile, digest, status), `[drones, 4]`."""
        return np.array([list(node.bytes_sent.values()) for node in self.nodes])


def exploring(
    number: int, stamp: float, pose: Pose, velocity: tuple[float, float], links: dict[int, float] | None = None
) -> Status:
    """Return the status of a drone that explores by its policy."""
    return Status(
        id=number, stamp=stamp, pose=pose, velocity=velocity, height_m=1.0, battery=0.9, mode="OFFBOARD", armed=True,
        ladder="policy", reason="exploring", links=links or {},
    )  # fmt: skip
