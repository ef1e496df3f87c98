"""Peers' scans and tiles on their way into the evidence map, with a count of who first made which cell known."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import compress

import numpy as np
from numpy.typing import NDArray

from imagine.core.errors import InputError
from imagine.core.evidence import EvidenceMap, TileKey
from imagine.core.frames import IDENTITY, Pose, compose
from imagine.core.raster import CELL
from imagine.mesh_comm import messages
from imagine.mesh_comm.codec import unpack_tiles
from imagine.mesh_comm.known_cells import KnownCells
from imagine.mesh_comm.messages import Sketch, Tile, Tiles, tile_key
from imagine.mesh_comm.placement import Placements
from imagine.mesh_comm.provenance import CellProvenance, Provenance
from imagine.mesh_comm.scan_exchange import draw_peer_scan
from imagine.mesh_comm.settings import MeshSettings
from imagine.mesh_comm.tile_arrival import write_tiles
from imagine.mesh_comm.tile_exchange import TileExchange


class MapInbox:
    """Writes what peers send into `evidence`, and counts cells first known by own scans, peers' scans, and tiles."""

    def __init__(
        self, evidence: EvidenceMap, exchange: TileExchange, settings: MeshSettings, placements: Placements | None
    ) -> None:
        """Start with all counts at zero; `placements` None where all frames are one."""
        self.own_cells = self.scan_cells = self.map_cells = 0
        self._evidence = evidence
        self._exchange = exchange
        self._placements = placements
        self._settings = settings
        self._known = KnownCells(evidence)
        self._provenance = Provenance(evidence)
        self._own_counted = 0  # the own clock up to which own cells are counted

    def note_own(self, pose: Pose, range_cap_m: float, stamp: float, now: float) -> None:
        """Note that an own scan of this stamp, taken at `pose`, was mapped, and count what own scans made known."""
        self._provenance.note_own(stamp, now)
        self._count_own(pose, range_cap_m)
        self._own_counted = self._own_clock

    def renew(self, source: int, boot: int) -> bool:
        """Tell whether what a source's start number `boot` says counts; what is held of earlier starts is dropped.

        Raises InputError on one source too many.
        """
        self._check_source(source)
        layer = self._evidence.layers.get(source)
        if layer is None or layer.boot >= boot:
            return self._evidence.renew(source, boot)
        self._exchange.forget(source)
        self._provenance.forget(source)
        if self._placements is not None:  # whoever told of the new start: its frame begins elsewhere
            self._placements.forget(source)
        counts = self._evidence.renew(source, boot)
        self.map_cells += self._known.claim_all()  # where the others' evidence shows without what was dropped
        return counts

    def take_scan(self, scan: messages.Scan, boot: int, teammates: NDArray[np.float64], now: float) -> None:
        """Draw a peer's scan, leaving out what lands on `teammates` (`[n, 2]` metres, the peer's frame).

        Raises InputError.
        """
        if not self.renew(scan.sender, boot):
            return
        frame = self._evidence.placement(scan.sender)
        where = None if frame is None else scan.pose if frame == IDENTITY else compose(frame, scan.pose)
        if where is not None and self._own_counted != self._own_clock:
            self._count_own(where, scan.range_cap_m)
        fresh = draw_peer_scan(self._evidence, scan, teammates, self._settings.mask_radius_m, self._known)
        reach_m = scan.range_cap_m + 2 * CELL
        self._provenance.note_scan(scan.sender, scan.pose.x, scan.pose.y, reach_m, scan.stamp, now)
        self.scan_cells += fresh
        if where is not None and frame != IDENTITY:
            self.scan_cells += self._known.claim_around(where.x, where.y, reach_m)

    def take_tiles(self, message: Tiles, is_source_near: bool, via: int, now: float) -> None:
        """Merge tiles of another source, heard from node `via`. Raises InputError if any is damaged, with none taken.

        `is_source_near`: these are copies passed on by a third node while the source itself is in reach. Then tiles
        that hold the source's scans are left alone: they show more than the copy, and the source will send its own.
        """
        source, tiles = message.source, message.tiles
        unpacked = unpack_tiles([tile.packed for tile in tiles])
        if source == self._evidence.own:
            raise InputError(f"tiles of source {source} came from outside, but only drone {source} writes them")
        if not tiles or not self.renew(source, message.boot):
            return
        if self._own_counted != self._own_clock:
            self.own_cells += self._known.claim_tiles(source, list({tile_key(tile) for tile in tiles}))
        too_far: InputError | None = None
        try:
            self._cover(tiles)
        except InputError as error:  # a tile too far away to hold ends a message, and those before it are taken
            too_far, tiles = error, self._within_reach(tiles)
        held = self._write(source, tiles, unpacked[: len(tiles)], is_source_near, via, now)
        if too_far is not None:
            raise too_far
        self._exchange.note_overheard(source, tiles, held, now)

    def _cover(self, tiles: Sequence[Tile]) -> None:
        columns, rows = [tile.column for tile in tiles], [tile.row for tile in tiles]
        self._evidence.cover_tiles(min(columns), min(rows), max(columns), max(rows), of_peer=True)

    def _within_reach(self, tiles: list[Tile]) -> list[Tile]:
        """Return the tiles before the first that no map can hold beside those before it; the grid grows for them."""
        for count in range(len(tiles)):
            try:
                self._cover(tiles[count : count + 1])
            except InputError:
                return tiles[:count]
        return tiles

    def _write(
        self, source: int, tiles: Sequence[Tile], unpacked: NDArray[np.int8], is_source_near: bool, via: int, now: float
    ) -> list[int]:
        """Write the newer ones of tiles that the grid holds; return how many cells have evidence on each then."""
        evidence, known = self._evidence, self._known.not_yet(source)
        layer, corner = evidence.layers[source], evidence.corner
        entries = np.array([(tile.column, tile.row, tile.version) for tile in tiles], np.int64).reshape(-1, 3)
        found = np.empty(unpacked.size, np.int32)
        taken, held = np.empty(len(tiles), np.bool_), np.empty(len(tiles), np.int64)
        count = write_tiles(
            unpacked, entries, is_source_near, layer.cells, layer.versions, layer.provisional,
            corner.row, corner.column, known, found, taken, held,
        )  # fmt: skip
        news = list(compress(tiles, taken.tolist()))
        if news:
            layer.clock = max(layer.clock, *(tile.version for tile in news))
            self._exchange.confirm(source, news)
            self._provenance.note_tiles(source, entries, taken, via, now)
            self.map_cells += self._known.claim_found(found, count)
            if evidence.placement(source) != IDENTITY:
                self.map_cells += self._known.claim_tiles(source, list(dict.fromkeys(map(tile_key, news))))
        return held.tolist()

    def take_sketch(self, message: Sketch, via: int, now: float) -> None:
        """Fill in what node `via` heard of a source that is out of reach here. Raises InputError with none taken."""
        unpacked = unpack_tiles([tile.packed for tile in message.tiles])
        if not self.renew(message.source, message.boot):
            return
        if self._own_counted != self._own_clock:
            self.own_cells += self._known.claim_tiles(message.source, list({tile_key(tile) for tile in message.tiles}))
        filled: dict[TileKey, None] = {}
        try:
            for tile, cells in zip(message.tiles, unpacked, strict=True):
                key = tile_key(tile)
                if self._evidence.sketch_tile(message.source, key, tile.version, cells):
                    self._provenance.note_sketch(message.source, key, via, now)
                    filled[key] = None
        finally:  # as with tiles
            if filled:
                self.scan_cells += self._known.claim_tiles(message.source, list(filled))

    def note_placed(self) -> None:
        """Count what became known because a peer's map found its place, as cells that its tiles made known."""
        self.map_cells += self._known.claim_all()

    def provenance(self, x: float, y: float) -> CellProvenance:
        """Return where the belief in the cell at (x, y), metres of the own frame, comes from."""
        return self._provenance.at(x, y)

    @property
    def _own_clock(self) -> int:
        return self._evidence.layers[self._evidence.own].clock

    def _count_own(self, pose: Pose, range_cap_m: float) -> None:
        """Count the cells that own scans have made known within a scan's reach of `pose`, own frame."""
        self.own_cells += self._known.claim_around(pose.x, pose.y, range_cap_m + 2 * CELL)

    def _check_source(self, source: int) -> None:
        layers = self._evidence.layers
        if source not in layers and len(layers) > self._settings.max_sources:
            raise InputError(f"map of source {source}, but {self._settings.max_sources} sources are held already")
