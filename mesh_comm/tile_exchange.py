"""Which tiles to send, in which order: whatever a peer's digest shows it lacks, most needed first, never too often."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from imagine.core.evidence import EvidenceMap, TileKey
from imagine.mesh_comm.codec import pack_tile
from imagine.mesh_comm.messages import GROUND, Tile, Tiles, tile_key
from imagine.mesh_comm.peers import PeerRecord
from imagine.mesh_comm.settings import MeshSettings

_TILE_BYTES = 16  # a tile beside its packed cells: place, version and lengths, at their longest
_TILES_BYTES = 10
_MOST_WANTED = 512
_DIGEST_GRACE_S = 0.25  # a digest this soon after a tile was sent may have been written before the tile came


class Held(NamedTuple):
    """A tile's content as its source confirmed it: what may be passed on."""

    version: int
    packed: bytes


class _Sent(NamedTuple):
    version: int
    at: float


class _Wanted(NamedTuple):
    rank: tuple[int, int, bool]
    source: int
    key: TileKey


class TileExchange:
    """The tiles a node can give to others, and the queue of those that others lack."""

    def __init__(self, evidence: EvidenceMap, settings: MeshSettings) -> None:
        """Serve the tiles of `evidence`."""
        self._evidence = evidence
        self._settings = settings
        self._confirmed: dict[int, dict[TileKey, Held]] = {}
        self._packed: dict[TileKey, Held] = {}
        self._sent: dict[tuple[int, TileKey], _Sent] = {}
        self._queue: list[_Wanted] = []

    def merge(self, source: int, tile: Tile, cells: NDArray[np.int8]) -> bool:
        """Take a tile heard from a peer if it is newer than what is held; tell whether it was taken.

        `cells` int8 `[TILE, TILE]`, unpacked from the tile. Raises InputError on a tile too far away to hold.
        """
        key = tile_key(tile)
        if not self._evidence.merge_tile(source, key, tile.version, cells):
            return False
        # kept apart from the layer: scans drawn ahead of the next version must not be passed on
        self._confirmed.setdefault(source, {})[key] = Held(tile.version, tile.packed)
        return True

    def note_overheard(self, source: int, tile: Tile, now: float) -> None:
        """Take it that those in reach have a tile another node just sent: no need to pass it on at once."""
        key = tile_key(tile)
        held = self._confirmed.get(source, {}).get(key)
        if held is None or held.version <= tile.version:
            self._sent[source, key] = _Sent(tile.version, now)

    def plan(self, peers: Sequence[PeerRecord], now: float) -> None:
        """Make the queue anew: tiles that some of `peers`, by their digests, lack and that may be sent at `now`."""
        wanted: list[_Wanted] = []
        by_id = {peer.id: peer for peer in peers}
        for source, key, version in self._available():
            last = self._sent.get((source, key))
            if last is not None and now - last.at < self._settings.tile_period_s:
                continue
            missing = stale = 0
            for peer in peers:
                held = peer.holds(source, key)
                if peer.id == source or held >= version:
                    continue
                if last is not None and last.version >= version and peer.digest_at < last.at + _DIGEST_GRACE_S:
                    continue  # sent since this peer last told what it holds
                if self._serves_itself(by_id.get(source), peer):
                    continue
                missing += held == 0
                stale += version - held
            if stale:
                wanted.append(_Wanted((-missing, -stale, source != self._evidence.own), source, key))
        wanted.sort()
        self._queue = wanted[:_MOST_WANTED]

    def next_message(self, max_bytes: int) -> Tiles | None:
        """Return the most wanted tiles of one source, as many as fit, without taking them off the queue."""
        if not self._queue:
            return None
        source = self._queue[0].source
        tiles: list[Tile] = []
        size = _TILES_BYTES
        for wanted in self._queue:
            if wanted.source != source:
                continue
            held = self._content(source, wanted.key)
            size += len(held.packed) + _TILE_BYTES
            if size > max_bytes or len(tiles) == 256:
                break
            tiles.append(Tile(wanted.key.column, wanted.key.row, held.version, held.packed))
        return Tiles(source, tiles)

    def note_sent(self, message: Tiles, now: float) -> None:
        """Take the tiles of a message that went out off the queue."""
        for tile in message.tiles:
            self._sent[message.source, tile_key(tile)] = _Sent(tile.version, now)
        gone = {(message.source, tile_key(tile)) for tile in message.tiles}
        self._queue = [wanted for wanted in self._queue if (wanted.source, wanted.key) not in gone]

    def _serves_itself(self, source: PeerRecord | None, peer: PeerRecord) -> bool:
        """Tell whether source and peer hear each other, so that the source sends the peer its newest tiles itself."""
        within_s = self._settings.peer_timeout_s
        return source is not None and peer.hears(source.id, within_s) and source.hears(peer.id, within_s)

    def _available(self) -> Iterator[tuple[int, TileKey, int]]:
        """Yield source, key and version of every tile that may be sent under the protocol."""
        own = self._evidence.own
        if own != GROUND:
            for key, version in self._evidence.versions(own).items():
                yield own, key, version
        if self._settings.protocol == "multi-hop":
            for source, tiles in self._confirmed.items():
                for key, held in tiles.items():
                    yield source, key, held.version

    def _content(self, source: int, key: TileKey) -> Held:
        if source != self._evidence.own:
            return self._confirmed[source][key]
        corner = self._evidence.corner
        version = int(self._evidence.layers[source].versions[key.row - corner.row, key.column - corner.column])
        held = self._packed.get(key)
        if held is None or held.version != version:
            held = self._packed[key] = Held(version, pack_tile(self._evidence.tile(source, key)))
        return held
