"""Peers' scans and tiles on their way into the evidence map, with a count of who first made which cell known."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from imagine.core.errors import InputError
from imagine.core.evidence import EvidenceMap
from imagine.core.frames import Pose
from imagine.core.raster import CELL
from imagine.mesh_comm import messages
from imagine.mesh_comm.codec import unpack_tile
from imagine.mesh_comm.messages import Tiles, tile_key
from imagine.mesh_comm.provenance import KnownCells
from imagine.mesh_comm.scan_exchange import draw_peer_scan
from imagine.mesh_comm.settings import MeshSettings
from imagine.mesh_comm.tile_exchange import TileExchange


class MapInbox:
    """Writes what peers send into `evidence`, and counts cells first known by own scans, peers' scans, and tiles."""

    def __init__(self, evidence: EvidenceMap, exchange: TileExchange, settings: MeshSettings) -> None:
        """Start with all counts at zero."""
        self.own_cells = self.scan_cells = self.map_cells = 0
        self._evidence = evidence
        self._exchange = exchange
        self._settings = settings
        self._known = KnownCells(evidence)

    def count_own(self, pose: Pose, range_cap_m: float) -> None:
        """Count the cells that own scans have made known within a scan's reach of `pose`."""
        self.own_cells += self._known.claim_around(pose.x, pose.y, range_cap_m + 2 * CELL)

    def take_scan(self, scan: messages.Scan, teammates: NDArray[np.float64]) -> None:
        """Draw a peer's scan, leaving out what lands on `teammates` (`[n, 2]` metres). Raises InputError."""
        self._check_source(scan.sender)
        self.count_own(scan.pose, scan.range_cap_m)
        draw_peer_scan(self._evidence, scan, teammates, self._settings.mask_radius_m)
        self.scan_cells += self._known.claim_around(scan.pose.x, scan.pose.y, scan.range_cap_m + 2 * CELL)

    def take_tiles(self, message: Tiles, is_source_near: bool) -> None:
        """Merge tiles of another source. Raises InputError on a bad one; those before it are taken.

        `is_source_near`: these are copies passed on by a third node while the source itself is in reach. Then tiles
        that hold the source's scans are left alone: they show more than the copy, and the source will send its own.
        """
        self._check_source(message.source)
        for tile in message.tiles:
            key, cells = tile_key(tile), unpack_tile(tile.packed)
            if is_source_near and self._evidence.is_provisional(message.source, key):
                continue
            self.own_cells += self._known.claim_tile(key)
            if self._exchange.merge(message.source, tile, cells):
                self.map_cells += self._known.claim_tile(key)

    def outgrow(self, version: int) -> None:
        """After a restart, lift own tile versions above `version`, the greatest that a peer still holds."""
        layer = self._evidence.layers[self._evidence.own]
        if layer.clock < version < 2**30:  # a thousand days of scans: beyond it, nothing but damage
            layer.clock = version + 1
            layer.versions[layer.versions > 0] = layer.clock

    def _check_source(self, source: int) -> None:
        layers = self._evidence.layers
        if source not in layers and len(layers) > self._settings.max_sources:
            raise InputError(f"map of source {source}, but {self._settings.max_sources} sources are held already")
