"""A mesh node without I/O: hears datagrams, decides what to send, and keeps the evidence map in step with its peers."""

from __future__ import annotations

import logging
from collections import Counter, deque

import msgspec
import numpy as np
from numpy.typing import NDArray

from imagine.core.errors import InputError
from imagine.core.evidence import EvidenceMap
from imagine.core.frames import IDENTITY, Pose, inverse, transform_points
from imagine.core.lidar import LidarSpec, Scan, mask_near
from imagine.mesh_comm import messages
from imagine.mesh_comm.budget import TokenBucket
from imagine.mesh_comm.codec import unpack_tile
from imagine.mesh_comm.digest import Held, digests
from imagine.mesh_comm.information import FEW_NEWS_S, NO_NEWS_S, SCAN_NEWS_CELLS
from imagine.mesh_comm.map_inbox import MapInbox
from imagine.mesh_comm.messages import GROUND, MAX_DATAGRAM, Command, Digest, Message, Status, Tiles, tile_key
from imagine.mesh_comm.orders import Orders
from imagine.mesh_comm.peer_book import PeerBook
from imagine.mesh_comm.peers import Peer, PeerRecord
from imagine.mesh_comm.placement import Place, Placements
from imagine.mesh_comm.provenance import CellProvenance
from imagine.mesh_comm.receipts import Bought, Receipt
from imagine.mesh_comm.scan_exchange import scan_message
from imagine.mesh_comm.seal import Opened, Rejected, Sealer
from imagine.mesh_comm.settings import MeshSettings
from imagine.mesh_comm.tile_exchange import TileExchange, Wanted

__all__ = ["MeshNode", "MeshSettings", "Peer"]

_PLAN_PERIOD_S = 0.2
_DIGEST_DATAGRAMS = 4  # of a longer digest, this many go out per period, in turn
_DIGEST_SHARE, _MOST_DIGEST_S = 0.125, 1.5  # where bytes are short, digests take so much of them, or come so late
_SCANS_BEFORE_NEWS, _SCANS_BEFORE_REPEATS = 1, 4  # where bytes are short, so many scans go before a message of tiles
_TOLD: tuple[Bought, ...] = ("scan", "tile")
_EPSILON_S = 1e-6  # periods are whole ticks: rounding of their sum must not cost a tick
_log = logging.getLogger(__name__)


class MeshNode:
    """One participant of the mesh: a drone, or (id 0) the ground station, which listens and commands.

    All times are the caller's seconds and must not run backwards; nothing here reads a clock, waits, or draws random
    numbers, so the same calls give the same datagrams. `bytes_sent` counts sealed bytes by kind (scan, tile, digest,
    status; commands count as status), `newer` messages that were read and hold fields beyond those known here.
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
        self.bytes_sent = {"scan": 0, "tile": 0, "digest": 0, "status": 0}
        self.newer = 0
        self._evidence = evidence
        self._lidar = lidar
        self._range_cap_m = range_cap_m
        self._sealer = sealer
        self._max_payload = MAX_DATAGRAM - sealer.overhead
        self._bucket = TokenBucket(settings.rate_bytes_per_s, settings.burst_bytes)
        evidence.layers[self.id].boot = sealer.boot
        evidence.shares_frame = settings.frame == "shared"
        self._placements = (
            None if evidence.shares_frame else Placements(evidence, settings.alignment, settings.launches)
        )
        self._peers = PeerBook(settings, evidence.placement)
        self._exchange = TileExchange(evidence, settings)
        self._maps = MapInbox(evidence, self._exchange, settings)
        self._orders = Orders(self.id, sealer.boot, settings.command_repeat_s)
        self._dropped: Counter[str] = Counter()
        self._pose: Pose | None = None
        self._status: Status | None = None
        self._scan: messages.Scan | None = None
        self._scan_clock = 0
        self._digests: deque[Digest] = deque()
        self._digest_turn = 0
        self._digest_at, self._digest_bytes = -np.inf, 0
        self._next_status = self._next_digest = self._next_scan = self._next_plan = -np.inf
        self._scan_since = self._scan_sent_at = -np.inf
        self._scans_ahead = 1
        self._cells_told = 0

    # --- what comes in -----------------------------------------------------------------------------------------

    def receive(self, datagram: bytes, now: float) -> None:
        """Take in whatever the radio heard. Never raises on its content: what is wrong is counted in `stats`."""
        try:
            opened = self._sealer.open(datagram, now)
        except Rejected:
            return  # counted by the sealer
        try:
            message = messages.decode(opened.payload)
        except messages.Unreadable as error:
            self._drop(error.reason, opened.sender, error)
            return
        if messages.newer_fields(opened.payload):
            self.newer += 1
        try:
            self._take(message, opened, datagram, now)
        except InputError as error:
            self._drop("content", opened.sender, error)

    def _take(self, message: Message, opened: Opened, datagram: bytes, now: float) -> None:
        sender = opened.sender
        if isinstance(message, Command):
            self._orders.take(message, sender, datagram)
            return
        if sender == GROUND and not isinstance(message, Digest):
            raise InputError("the ground sends digests and commands only")
        if isinstance(message, messages.Scan | Status):
            named = message.sender if isinstance(message, messages.Scan) else message.id
            if named != sender:
                raise InputError(f"a message of {named}")
        takes_maps = self.id == GROUND or self.settings.protocol != "off"
        if opened.boot < self._boot(sender):
            self._dropped["old-life"] += 1  # held up on the way; a relay was faster with the news of the restart
            return
        peer = self._peers.hear(opened, now)
        if peer.met is None:
            peer.met = self._evidence.versions(self.id)
        if sender in self._evidence.layers:
            self._renew(sender, opened.boot)
        match message:
            case Status():
                peer.note_status(message, now)
            case Digest():
                peer.note_digest(message, now, self.settings.max_sources)
                self._exchange.receipts.settle(sender, peer.holds, now)
            case messages.Scan():
                peer.note_pose(message.pose, message.stamp, now)
                if takes_maps:
                    self._maps.take_scan(message, opened.boot, self._not_walls(sender, now), now)
            case Tiles():
                if takes_maps:
                    self._take_tiles(message, peer, now)

    def _take_tiles(self, message: Tiles, peer: PeerRecord, now: float) -> None:
        source = message.source
        is_relayed = source != peer.id
        if message.boot < self._boot(source) or (source == self.id and message.boot != self._sealer.boot):
            self._dropped["old-life"] += 1
            return
        if source == self.id:
            for tile in message.tiles:
                unpack_tile(tile.packed)
        elif is_relayed and self.settings.protocol == "one-hop" and self.id != GROUND:
            return
        else:
            self._maps.take_tiles(message, is_relayed and self._peers.is_live(source, now), peer.id, now)
        # only now that all of it has proved sound: what is noted is kept
        peer.note_held(source, message.boot, {tile_key(tile): tile.version for tile in message.tiles})
        if source != self.id:
            for tile in message.tiles:
                self._exchange.note_overheard(source, tile, now)

    def _boot(self, source: int) -> int:
        """Return the number of the latest start of a node that is known of, 0 where none is."""
        layer = self._evidence.layers.get(source)
        return max(self._peers.boot(source), 0 if layer is None else layer.boot)

    def _renew(self, source: int, boot: int) -> None:
        """Take it that a peer is in start number `boot`: what an earlier one saw, from where it was, counts no more."""
        layer = self._evidence.layers[source]
        if layer.boot >= boot:
            return
        self._maps.renew(source, boot)
        if self._placements is not None:
            self._placements.forget(source)

    def _drop(self, reason: str, sender: int, error: InputError) -> None:
        self._dropped[reason] += 1
        _log.debug("node %d: dropped a datagram of %d: %s", self.id, sender, error)

    # --- what the owner says and asks --------------------------------------------------------------------------

    def offer_scan(self, scan: Scan, pose: Pose, now: float) -> None:
        """Offer the node's own scan, taken at `pose`, for sending; call it after the scan was integrated into the map.

        A scan that changed nothing, or that nobody is near to hear, is not sent; nor, by the scheduler `information`,
        one that shows little or nothing new soon after the last. A newer scan replaces a waiting one.
        """
        if self.id == GROUND:
            raise InputError("the ground station has no scans to offer")
        self._pose = pose
        self._maps.note_own(pose, self._range_cap_m, scan.stamp, now)
        clock = self._evidence.layers[self.id].clock
        if now < self._next_scan - _EPSILON_S or clock == self._scan_clock or not self._peers.map_listeners(now):
            return
        if self._scan is None and not self._is_worth_telling(now):
            return
        masked = mask_near(scan.ranges, self._lidar, pose, self.teammates(now), self.settings.mask_radius_m)
        offered = Scan(scan.stamp, masked)
        if self._scan is None:
            self._scan_since = now
        self._scan = scan_message(self.id, clock, pose, offered, self._lidar, self._range_cap_m, self._max_payload)

    def _is_worth_telling(self, now: float) -> bool:
        """Tell whether what own scans have made known since the last one that was sent is worth another."""
        news = self._maps.own_cells - self._cells_told
        if self.settings.scheduler == "fifo" or news >= SCAN_NEWS_CELLS:
            return True
        return now >= self._scan_sent_at + (FEW_NEWS_S if news > 0 else NO_NEWS_S) - _EPSILON_S

    def set_status(self, status: Status) -> None:
        """Set what the next status message tells; cells, bytes, links, rejections and command are filled in."""
        if status.id != self.id or self.id == GROUND:
            raise InputError(f"status of {status.id} given to mesh node {self.id}")
        reason = messages.clip_text(status.reason, 160)
        mode, ladder = messages.clip_text(status.mode, 32), messages.clip_text(status.ladder, 32)
        self._status = msgspec.structs.replace(status, reason=reason, mode=mode, ladder=ladder)
        self._pose = status.pose

    def send_command(self, action: str, target: int, now: float) -> int:
        """Order drone `target` (0: all) to hold, land or resume; return the order's nonce.

        The order is repeated for a while, and drones pass it on. Only the ground may; raises InputError otherwise.
        """
        return self._orders.issue(action, target, now)

    def commands(self) -> list[Command]:
        """Return the orders to this node that came since the last call, oldest first; each comes once."""
        return self._orders.drain()

    def peers(self, now: float) -> dict[int, Peer]:
        """Return everyone ever heard, by id; `is_live` tells who was heard within the peer timeout."""
        return self._peers.view(now)

    def teammates(self, now: float, leave_out: int | None = None) -> NDArray[np.float64]:
        """Return where live peers are by now, `[n, 2]` metres, own frame: returns there are not walls."""
        return self._peers.positions(now, leave_out)

    def _not_walls(self, scanner: int, now: float) -> NDArray[np.float64]:
        """Return where a scan of peer `scanner` sees drones, in its frame: its teammates and this one."""
        frame = self._evidence.placement(scanner)
        if frame is None:
            return np.zeros((0, 2))
        others = self.teammates(now, leave_out=scanner)
        if self._pose is not None:
            others = np.vstack((others, [self._pose[:2]]))
        return others if frame == IDENTITY else transform_points(inverse(frame), others)

    def place(self, peer: int) -> Place:
        """Return what is known of where a peer's frame lies in the own."""
        if self._placements is None:
            return Place("given", IDENTITY, 0, None)
        return self._placements.place(peer)

    def provenance(self, x: float, y: float) -> CellProvenance:
        """Return who saw the cell at (x, y), metres of the own frame, when, and by which way that came here."""
        return self._maps.provenance(x, y)

    @property
    def own_cells(self) -> int:
        """How many cells the node's own scans made known first."""
        return self._maps.own_cells

    @property
    def scan_cells(self) -> int:
        """How many cells peers' scans made known first."""
        return self._maps.scan_cells

    @property
    def map_cells(self) -> int:
        """How many cells tiles made known first."""
        return self._maps.map_cells

    @property
    def receipts(self) -> dict[Bought, Receipt]:
        """What the bytes of scans and tiles have bought so far: cells that peers learned."""
        return self._exchange.receipts.by_kind

    @property
    def has_namesake(self) -> bool:
        """Whether another node is known to have used this node's id since this one started; neither may go on."""
        return self._sealer.has_namesake

    @property
    def stats(self) -> dict[str, int]:
        """How many datagrams were dropped, by reason."""
        return dict(sorted((self._sealer.rejected + self._dropped).items()))

    # --- what goes out -----------------------------------------------------------------------------------------

    def poll(self, now: float) -> list[bytes]:
        """Return the datagrams to send at `now`, most urgent first, as many as the byte budget allows."""
        out: list[bytes] = []
        if self._placements is not None and self._placements.advance(now):
            self._maps.note_placed()
        self._prepare(now)
        for step in (
            self._send_claim, self._send_commands, self._send_status, self._send_digests, self._send_maps,
        ):  # fmt: skip
            if not step(out, now):
                break  # out of bytes: what is left keeps its place
        return out

    def _prepare(self, now: float) -> None:
        # the ground's digest is its sign of life as well; a drone's is for drones, as the ground sends no tiles
        has_readers = self.id == GROUND or (self.settings.protocol != "off" and self._peers.has_drone(now))
        if has_readers and now >= self._next_digest - _EPSILON_S:
            self._next_digest = now + self.settings.digest_period_s
            self._digest_at, self._digest_bytes = now, 0
            held = {
                source: Held(layer.boot, self._evidence.versions(source))
                for source, layer in self._evidence.layers.items()
                if source != self.id
            }
            parts = digests(now, held, self._max_payload)
            turn = self._digest_turn % len(parts)
            self._digests = deque((parts[turn:] + parts[:turn])[:_DIGEST_DATAGRAMS])
            self._digest_turn = turn + _DIGEST_DATAGRAMS
        if self.id != GROUND and now >= self._next_plan - _EPSILON_S:
            self._next_plan = now + _PLAN_PERIOD_S
            self._exchange.plan([peer for peer in self._peers.map_listeners(now) if np.isfinite(peer.digest_at)], now)

    def _send_claim(self, out: list[bytes], now: float) -> bool:
        claim = self._sealer.claim(now)
        if claim is None:
            return True
        if not self._bucket.take(len(claim), now):  # lost: the next datagram of the namesake asks for another
            return False
        out.append(claim)
        self.bytes_sent["status"] += len(claim)
        return True

    def _send_commands(self, out: list[bytes], now: float) -> bool:
        relays = self._orders.relays
        while relays:
            if not self._bucket.take(len(relays[0]), now):
                return False
            out.append(relays.popleft())
            self.bytes_sent["status"] += len(out[-1])
        for repeat in self._orders.due(now):
            if not self._send(repeat.command, "status", out, now):
                return False
            self._orders.note_sent(repeat, now)
        return True

    def _send_status(self, out: list[bytes], now: float) -> bool:
        if self._status is None or now < self._next_status - _EPSILON_S:
            return True
        full = msgspec.structs.replace(
            self._status,
            own_cells=self._maps.own_cells,
            scan_cells=self._maps.scan_cells,
            map_cells=self._maps.map_cells,
            bytes_sent=dict(self.bytes_sent),
            links=self._peers.ages(now, most=32),
            rejected=sum(self.stats.values()),
            last_command=self._orders.last_nonce,
            taught={kind: self.receipts[kind].cells for kind in _TOLD},
        )
        if not self._send(full, "status", out, now):
            return False
        self._next_status = now + self.settings.status_period_s
        return True

    def _send_digests(self, out: list[bytes], now: float) -> bool:
        while self._digests:
            if not self._send(self._digests[0], "digest", out, now):
                return False
            self._digests.popleft()
            self._digest_bytes += len(out[-1])
            if self.settings.scheduler == "information":
                spread_s = self._digest_bytes / (_DIGEST_SHARE * self.settings.rate_bytes_per_s)
                self._next_digest = max(self._next_digest, self._digest_at + min(_MOST_DIGEST_S, spread_s))
        return True

    def _send_maps(self, out: list[bytes], now: float) -> bool:
        """Send scan and tiles by turns; tiles that tell something new begin, for they tell most a byte."""
        while True:
            head = self._exchange.head
            if head is not None and (self._scan is None or self._is_tiles_turn(head)):
                if not self._send_tiles(out, now):
                    return False
                self._scans_ahead = 0
            elif self._scan is not None:
                if not self._send_scan(out, now):
                    return False
                self._scans_ahead = 1 if head is None else self._scans_ahead + 1
            else:
                return True

    def _is_tiles_turn(self, head: Wanted) -> bool:
        if self.settings.scheduler == "fifo":
            return head.since <= self._scan_since
        return self._scans_ahead >= (_SCANS_BEFORE_NEWS if head.brings_news else _SCANS_BEFORE_REPEATS)

    def _send_scan(self, out: list[bytes], now: float) -> bool:
        if self._scan is None or not self._send(self._scan, "scan", out, now):
            return False
        listeners = len(self._peers.map_listeners(now))
        self._exchange.receipts.note_scan(len(out[-1]), (self._maps.own_cells - self._cells_told) * listeners)
        self._cells_told = self._maps.own_cells
        self._scan_clock = self._scan.clock
        self._scan = None
        self._scan_sent_at, self._next_scan = now, now + self.settings.scan_period_s
        return True

    def _send_tiles(self, out: list[bytes], now: float) -> bool:
        message = self._exchange.next_message(self._max_payload)
        if message is None or not self._send(message, "tile", out, now):
            return False
        self._exchange.note_sent(message, len(out[-1]), now)
        return True

    def _send(self, message: Message, kind: str, out: list[bytes], now: float) -> bool:
        """Seal a message and put it out if the budget allows; tell whether it did."""
        payload = messages.encode(message)
        size = len(payload) + self._sealer.overhead
        if not self._bucket.take(size, now):
            return False
        out.append(self._sealer.seal(payload, now))
        self.bytes_sent[kind] += size
        return True
