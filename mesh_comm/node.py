"""A mesh node without I/O: hears datagrams, decides what to send, and keeps the evidence map in step with its peers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from imagine.core.errors import InputError
from imagine.core.evidence import EvidenceMap
from imagine.core.frames import IDENTITY, Pose
from imagine.core.lidar import LidarSpec, Scan
from imagine.mesh_comm import messages
from imagine.mesh_comm.hearing import Hearing
from imagine.mesh_comm.messages import Command, Status
from imagine.mesh_comm.node_state import NodeState
from imagine.mesh_comm.peers import Peer
from imagine.mesh_comm.placement import Place
from imagine.mesh_comm.provenance import CellProvenance
from imagine.mesh_comm.receipts import Bought, Receipt
from imagine.mesh_comm.seal import Sealer
from imagine.mesh_comm.settings import MeshSettings
from imagine.mesh_comm.speaking import Speaking

__all__ = ["MeshNode", "MeshSettings", "Peer"]


class MeshNode:
    """One participant of the mesh: a drone, or (id 0) the ground station, which listens and commands.

    All times are the caller's seconds and must not run backwards; nothing here reads a clock, waits, or draws random
    numbers, so the same calls give the same datagrams.
    """

    def __init__(
        self, evidence: EvidenceMap, lidar: LidarSpec, range_cap_m: float, settings: MeshSettings, sealer: Sealer
    ) -> None:
        """Make the node `sealer.own` that keeps `evidence` in step; `lidar` and `range_cap_m` describe its own scans.

        Raises InputError if the map belongs to another id, or the range cap is beyond what a message may carry.
        """
        if evidence.own != sealer.own:
            raise InputError(f"mesh node {sealer.own} was given the map of {evidence.own}")
        if not 0.0 < range_cap_m <= messages.MAX_RANGE_CAP_M:
            raise InputError(f"range cap is {range_cap_m} m, needs to be in (0, {messages.MAX_RANGE_CAP_M:.0f}]")
        self.id = sealer.own
        self.settings = settings
        self._state = NodeState(evidence, settings, sealer)
        self._hearing = Hearing(self._state)
        self._speaking = Speaking(self._state, lidar, range_cap_m)

    # --- the radio ---------------------------------------------------------------------------------------------

    def receive(self, datagram: bytes, now: float) -> None:
        """Take in whatever the radio heard. Never raises on its content: what is wrong is counted in `stats`."""
        self._hearing.receive(datagram, now)

    def poll(self, now: float) -> list[bytes]:
        """Return the datagrams to send at `now`, most urgent first, as many as the byte budget allows."""
        return self._speaking.poll(now)

    # --- what the owner says -----------------------------------------------------------------------------------

    def offer_scan(self, scan: Scan, pose: Pose, now: float) -> None:
        """Offer the node's own scan, taken at `pose`, for sending; call it after the scan was integrated into the map.

        A scan that changed nothing, or that nobody is near to hear, is not sent; nor, by the scheduler `information`,
        one that shows little or nothing new soon after the last. A newer scan replaces a waiting one.
        """
        self._speaking.offer_scan(scan, pose, now)

    def set_status(self, status: Status) -> None:
        """Set what the next status message tells; cells, bytes, links, rejections and command are filled in."""
        self._speaking.set_status(status)

    def send_command(self, action: str, target: int, now: float) -> int:
        """Order drone `target` (0: all) to hold, land or resume; return the order's nonce.

        The order is repeated for a while, and drones pass it on. It names the present start of each drone that it is
        for, so drones that are not known of yet get it once they are, if it is still repeated then. Only the ground
        may; raises InputError otherwise.
        """
        return self._state.orders.issue(action, target, now)

    # --- what the owner asks -----------------------------------------------------------------------------------

    def commands(self) -> list[Command]:
        """Return the orders to this node that came since the last call, oldest first; each comes once."""
        return self._state.orders.drain()

    def peers(self, now: float) -> dict[int, Peer]:
        """Return everyone ever heard, by id; `is_live` tells who was heard within the peer timeout."""
        return self._state.peers.view(now)

    def teammates(self, now: float) -> NDArray[np.float64]:
        """Return where live peers are by now, `[n, 2]` metres, own frame: returns there are not walls."""
        return self._state.peers.positions(now)

    def place(self, peer: int) -> Place:
        """Return what is known of where a peer's frame lies in the own."""
        if self._state.placements is None:
            return Place("given", IDENTITY, 0, None)
        return self._state.placements.place(peer)

    def provenance(self, x: float, y: float) -> CellProvenance:
        """Return who saw the cell at (x, y), metres of the own frame, when, and by which way that came here."""
        return self._state.maps.provenance(x, y)

    @property
    def own_cells(self) -> int:
        """How many cells the node's own scans made known first."""
        return self._state.maps.own_cells

    @property
    def scan_cells(self) -> int:
        """How many cells peers' scans made known first."""
        return self._state.maps.scan_cells

    @property
    def map_cells(self) -> int:
        """How many cells tiles made known first."""
        return self._state.maps.map_cells

    @property
    def bytes_sent(self) -> dict[str, int]:
        """Sealed bytes by kind: scan, tile, digest, status; commands count as status."""
        return self._speaking.bytes_sent

    @property
    def receipts(self) -> dict[Bought, Receipt]:
        """What the bytes of scans and tiles have bought so far: cells that peers learned."""
        return self._state.exchange.receipts.by_kind

    @property
    def has_namesake(self) -> bool:
        """Whether another node is known to have used this node's id since this one started; neither may go on."""
        return self._state.sealer.has_namesake

    @property
    def newer(self) -> int:
        """How many messages were read that hold fields beyond those known here."""
        return self._state.newer

    @property
    def stats(self) -> dict[str, int]:
        """How many datagrams were dropped, by reason."""
        return self._state.stats
