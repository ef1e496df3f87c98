"""What the two halves of a node share: its map, who it knows, what it was ordered, and what it dropped."""

from __future__ import annotations

from collections import Counter

import numpy as np
from numpy.typing import NDArray

from imagine.core.evidence import EvidenceMap
from imagine.core.frames import IDENTITY, Pose, inverse, transform_points
from imagine.mesh_comm.map_inbox import MapInbox
from imagine.mesh_comm.messages import GROUND
from imagine.mesh_comm.orders import Orders
from imagine.mesh_comm.peer_book import PeerBook
from imagine.mesh_comm.placement import Placements
from imagine.mesh_comm.seal import Sealer
from imagine.mesh_comm.settings import MeshSettings
from imagine.mesh_comm.tile_exchange import TileExchange


class NodeState:
    """The parts of one node; `Hearing` writes into them what comes in, `Speaking` reads off them what goes out.

    `placements` is None where all frames are one; `pose` is the node's own, None until it is told; `dropped` counts
    true datagrams that were not taken, by reason; `newer` those with fields beyond the ones known here.
    """

    def __init__(self, evidence: EvidenceMap, settings: MeshSettings, sealer: Sealer) -> None:
        """Make the parts of node `sealer.own`, with nobody heard."""
        self.id = sealer.own
        self.settings = settings
        self.sealer = sealer
        self.evidence = evidence
        evidence.layers[self.id].boot = sealer.boot
        evidence.shares_frame = settings.frame == "shared"
        self.placements = None if evidence.shares_frame else Placements(evidence, settings.alignment, settings.launches)
        self.peers = PeerBook(settings, evidence.placement)
        self.exchange = TileExchange(evidence, settings)
        self.maps = MapInbox(evidence, self.exchange, settings, self.placements)
        self.orders = Orders(self.id, sealer.boot, settings.command_repeat_s)
        self.pose: Pose | None = None
        self.dropped: Counter[str] = Counter()
        self.newer = 0

    @property
    def stats(self) -> dict[str, int]:
        """How many datagrams were dropped, by reason."""
        return dict(sorted((self.sealer.rejected + self.dropped).items()))

    def boot(self, source: int) -> int:
        """Return the number of the latest start of a node that is known of, 0 where none is."""
        layer = self.evidence.layers.get(source)
        return max(self.peers.boot(source), 0 if layer is None else layer.boot)

    def starts(self) -> dict[int, int]:
        """Return the latest start of every drone that is known of, by id: heard itself, or its map is held.

        By this node, or by a peer as its digests tell: so also of drones that only drones in reach have heard.
        """
        latest = self.peers.starts()
        for source, layer in self.evidence.layers.items():
            if layer.boot > 0:
                latest[source] = max(latest.get(source, 0), layer.boot)
        return {id_: boot for id_, boot in latest.items() if id_ not in (GROUND, self.id)}

    def not_walls(self, scanner: int, now: float) -> NDArray[np.float64]:
        """Return where a scan of peer `scanner` sees drones, `[n, 2]` metres in its frame: teammates and this one."""
        frame = self.evidence.placement(scanner)
        if frame is None:
            return np.zeros((0, 2))
        others = self.peers.places(now, leave_out=scanner)
        if self.pose is not None:
            others.append((self.pose[0], self.pose[1]))
        places = np.array(others, np.float64).reshape(-1, 2)
        return places if frame == IDENTITY else transform_points(inverse(frame), places)
