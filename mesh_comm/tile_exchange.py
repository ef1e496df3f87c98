"""Which tiles to send, in which order: whatever a peer's digest shows it lacks, most telling first, never too often."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from imagine.core.evidence import EvidenceMap, TileKey
from imagine.core.frames import IDENTITY
from imagine.core.raster import TILE
from imagine.mesh_comm.codec import pack_tile
from imagine.mesh_comm.information import (
    FRONTIER_WORTH,
    TYPICAL_TILE_BYTES,
    density,
    known_cells,
    tile_news,
    unsent_share,
)
from imagine.mesh_comm.messages import GROUND, Sketch, Tile, Tiles, tile_key
from imagine.mesh_comm.peers import PeerRecord
from imagine.mesh_comm.receipts import Receipts, shares
from imagine.mesh_comm.settings import MeshSettings
from imagine.mesh_comm.wanted import Wanted

_TILE_BYTES = 16  # a tile beside its packed cells: place, version and lengths, at their longest
_TILES_BYTES = 15
_MOST_WANTED = 512
_DIGEST_GRACE_S = 0.25  # a digest this soon after a tile was sent may have been written before the tile came
_EPSILON_S = 1e-6
_NOTHING = np.zeros((0, 0), np.int8)


class Content(NamedTuple):
    """A tile's content as its source confirmed it: what may be passed on."""

    version: int
    packed: bytes


class _Sent(NamedTuple):
    """When a tile was sent last, in which version, and how many cells it had evidence on."""

    version: int
    at: float
    known: int


class TileExchange:
    """The tiles a node can give to others, and the queue of those that others lack."""

    def __init__(self, evidence: EvidenceMap, settings: MeshSettings) -> None:
        """Serve the tiles of `evidence`."""
        self.receipts = Receipts()
        self._evidence = evidence
        self._settings = settings
        self._confirmed: dict[int, dict[TileKey, Content]] = {}
        self._packed: dict[TileKey, Content] = {}
        self._sent: dict[tuple[int, TileKey], _Sent] = {}
        self._since: dict[tuple[int, TileKey], float] = {}
        self._sketched: dict[tuple[int, int, TileKey], int] = {}
        self._queue: list[Wanted] = []
        self._next_repeats = -np.inf

    @property
    def head(self) -> Wanted | None:
        """The tile that goes out next, if any is wanted."""
        return self._queue[0] if self._queue else None

    def confirm(self, source: int, tiles: Iterable[Tile]) -> None:
        """Take it that the newest of a source's tiles that are held are these, as the source confirmed them."""
        # kept apart from the layer: scans drawn ahead of the next version must not be passed on
        confirmed = self._confirmed.setdefault(source, {})
        for tile in tiles:
            confirmed[tile_key(tile)] = Content(tile.version, tile.packed)

    def forget(self, source: int) -> None:
        """Drop the tiles of a source that has started anew."""
        self._confirmed.pop(source, None)
        self._sent = {of: sent for of, sent in self._sent.items() if of[0] != source}
        self._sketched = {of: known for of, known in self._sketched.items() if of[1] != source}
        self._queue = [wanted for wanted in self._queue if wanted.source != source]

    def note_met(self, peer: int) -> None:
        """Take it that a peer came into reach, or started anew: what it was sketched before may be gone."""
        self._sketched = {of: known for of, known in self._sketched.items() if of[0] != peer}

    def note_overheard(self, source: int, tiles: Sequence[Tile], known: Sequence[int], now: float) -> None:
        """Take it that those in reach have what another node just sent: no need to pass it on at once.

        `known`: how many cells have evidence on each of the tiles, as they are held here.
        """
        confirmed = self._confirmed.get(source, {})
        for tile, cells in zip(tiles, known, strict=True):
            key = tile_key(tile)
            held = confirmed.get(key)
            if held is None or held.version <= tile.version:
                self._sent[source, key] = _Sent(tile.version, now, cells)

    def plan(self, peers: Sequence[PeerRecord], now: float) -> None:
        """Make the queue anew: tiles that some of `peers`, by their digests, lack and that may be sent at `now`.

        By `information` those come first that tell most new cells a byte, with more for cells at a frontier; then those
        that only confirm what scans have told, lacking before outdated ones; they are gathered for a period, so that a
        datagram carries many. By `fifo` the longest wanted come first.
        """
        repeats = now >= self._next_repeats - _EPSILON_S or self._settings.scheduler == "fifo"
        if repeats:
            self._next_repeats = now + self._settings.tile_period_s
        repeats = repeats or any(not tile.brings_news for tile in self._queue)
        wanted: list[Wanted] = []
        by_id = {peer.id: peer for peer in peers}
        for source, key, version in self._available():
            last = self._sent.get((source, key))
            if last is not None and now - last.at < self._settings.tile_period_s - _EPSILON_S:
                continue
            missing = stale = 0
            lacking: list[tuple[PeerRecord, int]] = []
            boot = self._evidence.layers[source].boot
            for peer in peers:
                held = peer.holds(source, boot, key)
                if peer.id == source or held >= version:
                    continue
                if last is not None and last.version >= version and peer.digest_at < last.at + _DIGEST_GRACE_S:
                    continue  # sent since this peer last told what it holds
                if self._serves_itself(by_id.get(source), peer):
                    continue
                missing += held == 0
                stale += version - int(held)
                lacking.append((peer, int(held)))
            if stale:
                wanted.append(self._ranked(source, key, missing, stale, lacking, now))
        self._since = {(tile.source, tile.key): tile.since for tile in wanted}
        if not repeats:
            wanted = [tile for tile in wanted if tile.worth > 0]
        wanted += self._sketches(peers, now)
        wanted.sort(key=lambda tile: (tile.rank, tile.is_sketch, tile.source, tile.key))
        self._queue = wanted[:_MOST_WANTED]

    def next_message(self, max_bytes: int) -> Tiles | Sketch | None:
        """Return the most wanted tiles of one source, as many as fit, without taking them off the queue."""
        if not self._queue:
            return None
        source, is_sketch = self._queue[0].source, self._queue[0].is_sketch
        tiles: list[Tile] = []
        size = _TILES_BYTES
        for wanted in self._queue:
            if wanted.source != source or wanted.is_sketch != is_sketch:
                continue
            held = self._drawn(source, wanted.key) if is_sketch else self._content(source, wanted.key)
            size += len(held.packed) + _TILE_BYTES
            if size > max_bytes or len(tiles) == 256:
                break
            tiles.append(Tile(wanted.key.column, wanted.key.row, held.version, held.packed))
        boot = self._evidence.layers[source].boot
        return Sketch(source, tiles, boot) if is_sketch else Tiles(source, tiles, boot)

    def note_sent(self, message: Tiles | Sketch, size: int, now: float) -> None:
        """Take the tiles of a message that went out, in `size` sealed bytes, off the queue."""
        gone = {tile_key(tile): tile for tile in message.tiles}
        share = dict(zip(gone, shares(size, [len(tile.packed) for tile in message.tiles]), strict=True))
        left: list[Wanted] = []
        for wanted in self._queue:
            is_of = wanted.source == message.source and wanted.is_sketch == isinstance(message, Sketch)
            tile = gone.get(wanted.key) if is_of else None
            if tile is None:
                left.append(wanted)
                continue
            if wanted.is_sketch:
                self._sketched |= {(peer, wanted.source, wanted.key): wanted.known for peer in wanted.told}
                self.receipts.note_sketch(share[wanted.key], wanted.told)
                continue
            self._sent[message.source, wanted.key] = _Sent(tile.version, now, wanted.known)
            self._since.pop((wanted.source, wanted.key), None)
            self.receipts.note_tile(
                message.source, message.boot, wanted.key, tile.version, share[wanted.key], wanted.told, now
            )
        self._queue = left

    def _sketches(self, peers: Sequence[PeerRecord], now: float) -> list[Wanted]:
        """Return the tiles of sources out of reach that hold scans of theirs which some of `peers` may not have heard.

        What a source said last before it left is confirmed by nobody until it is met again. Each goes to a peer once
        as long as the two are in touch.
        """
        evidence, here = self._evidence, {peer.id for peer in peers}
        if self._settings.protocol != "multi-hop":
            return []
        self._sketched = {of: known for of, known in self._sketched.items() if of[0] in here}
        wanted: list[Wanted] = []
        for source, layer in evidence.layers.items():
            if source == evidence.own or source in here:
                continue
            for row, column in np.argwhere(layer.provisional).tolist():
                key = TileKey(column + evidence.corner.column, row + evidence.corner.row)
                told, worth, known = {}, 0, self._known(source, key)
                for peer in peers:
                    # a copy that the peer still lacks would overwrite the sketch: that goes first
                    holds_same = peer.holds(source, layer.boot, key) == layer.versions[row, column]
                    if not holds_same or self._sketched.get((peer.id, source, key), 0) >= known:
                        continue
                    fresh, edge, _ = self._unseen(source, key, peer)
                    told[peer.id] = fresh
                    worth += fresh + FRONTIER_WORTH * edge
                if worth > 0:
                    is_fifo = self._settings.scheduler == "fifo"
                    rank = (now,) if is_fifo else (0, -int(density(worth, TYPICAL_TILE_BYTES)), True)
                    wanted.append(Wanted(rank, source, key, now, told, worth, known, is_sketch=True))
        return wanted

    def _drawn(self, source: int, key: TileKey) -> Content:
        layer, corner = self._evidence.layers[source], self._evidence.corner
        version = int(layer.versions[key.row - corner.row, key.column - corner.column])
        return Content(version, pack_tile(self._evidence.tile(source, key)))

    def _ranked(
        self, source: int, key: TileKey, missing: int, stale: int, lacking: list[tuple[PeerRecord, int]], now: float
    ) -> Wanted:
        """Put a tile that `lacking` peers need, each with the version that it holds, in its place in the queue."""
        since = self._since.get((source, key), now)
        told: dict[int, int] = {}
        worth, known = 0, 0
        for peer, held in lacking:
            cells, peer_worth, known = self._news(source, key, peer, held)
            told[peer.id] = cells
            worth += peer_worth
        is_relay = source != self._evidence.own
        if self._settings.scheduler == "fifo":
            rank: tuple[float, ...] = (since,)
        elif worth > 0:
            rank = (0, -int(density(worth, self._packed_bytes(source, key))), is_relay)
        else:
            rank = (1, -missing, -stale, is_relay)
        return Wanted(rank, source, key, since, told, worth, known or self._known(source, key))

    def _news(self, source: int, key: TileKey, peer: PeerRecord, held: int) -> tuple[int, int, int]:
        """Return (cells, worth, known): what a tile would tell a peer that holds version `held`, and what it knows.

        What was seen since a peer came into reach, it has been told by scans.
        """
        own = self._evidence.own
        if source == own and held >= (peer.met or {}).get(key, 0):
            return 0, 0, 0
        fresh, edge, known = self._unseen(source, key, peer)
        last = self._sent.get((source, key))
        told, worth = unsent_share(fresh, edge, known, last.known if last is not None and held > 0 else 0)
        return int(told), int(worth), int(known)

    def _unseen(self, source: int, key: TileKey, peer: PeerRecord) -> tuple[int, int, int]:
        """Return (fresh, edge, known) of a tile, as `tile_news`: what a peer's own map does not show of it."""
        corner = self._evidence.corner
        cells = self._evidence.layers[source].cells
        theirs = self._evidence.layers.get(peer.id)
        sees = theirs is not None and self._evidence.placement(peer.id) == self._evidence.placement(source) == IDENTITY
        fresh, edge, known = tile_news(
            cells, (key.row - corner.row) * TILE, (key.column - corner.column) * TILE,
            theirs.cells if theirs is not None and sees else _NOTHING,
        )  # fmt: skip
        return int(fresh), int(edge), int(known)

    def _known(self, source: int, key: TileKey) -> int:
        return int(known_cells(self._evidence.tile(source, key), 0, 0))

    def _packed_bytes(self, source: int, key: TileKey) -> int:
        """Return how long a tile was when it was packed last."""
        held = self._packed.get(key) if source == self._evidence.own else self._confirmed[source][key]
        return TYPICAL_TILE_BYTES if held is None else len(held.packed)

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

    def _content(self, source: int, key: TileKey) -> Content:
        if source != self._evidence.own:
            return self._confirmed[source][key]
        corner = self._evidence.corner
        version = int(self._evidence.layers[source].versions[key.row - corner.row, key.column - corner.column])
        held = self._packed.get(key)
        if held is None or held.version != version:
            held = self._packed[key] = Content(version, pack_tile(self._evidence.tile(source, key)))
        return held
