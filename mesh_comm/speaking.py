"""What a node says, and when: its turns, its periods, and what a tight byte budget leaves out."""

from __future__ import annotations

from collections import deque

import msgspec
import numpy as np

from imagine.core.errors import InputError
from imagine.core.frames import Pose
from imagine.core.lidar import LidarSpec, Scan, mask_near
from imagine.mesh_comm import messages
from imagine.mesh_comm.budget import TokenBucket
from imagine.mesh_comm.digest import Held, digests
from imagine.mesh_comm.information import NO_NEWS_S
from imagine.mesh_comm.messages import GROUND, MAX_DATAGRAM, Digest, Here, Message, Status
from imagine.mesh_comm.node_state import NodeState
from imagine.mesh_comm.receipts import Bought
from imagine.mesh_comm.scan_exchange import scan_message
from imagine.mesh_comm.wanted import Wanted

_PLAN_PERIOD_S = 0.2
_DIGEST_DATAGRAMS = 4  # of a longer digest, this many go out per period, in turn
_DIGEST_SHARE, _MOST_DIGEST_S = 0.125, 1.5  # where bytes are short, digests take so much of them, or come so late
_MOST_DIGEST_SHARE = 0.5  # but never more than this: digests of a large team would leave nothing for maps
_STATUS_SHARE, _MOST_STATUS_S = 0.125, 2.0  # so do statuses
_HERE_SHARE, _MOST_HERE_S = 0.2, 1.0  # and poses between them, well within a peer's timeout
_SCANS_BEFORE_NEWS, _SCANS_BEFORE_REPEATS = 1, 4  # where bytes are short, so many scans go before a message of tiles
_TOLD: tuple[Bought, ...] = ("scan", "tile")
_EPSILON_S = 1e-6  # periods are whole ticks: rounding of their sum must not cost a tick


class Speaking:
    """The sending half of a node: of what `state` holds it says the most urgent, as far as the byte rate allows.

    `bytes_sent` counts sealed bytes by kind (scan, tile, digest, status; commands count as status).
    """

    def __init__(self, state: NodeState, lidar: LidarSpec, range_cap_m: float) -> None:
        """Start with nothing to say; `lidar` and `range_cap_m` (metres) describe the own scans."""
        self.bytes_sent = {"scan": 0, "tile": 0, "digest": 0, "status": 0}
        self._state = state
        self._id, self._settings, self._evidence = state.id, state.settings, state.evidence
        self._peers, self._exchange, self._maps = state.peers, state.exchange, state.maps
        self._lidar = lidar
        self._range_cap_m = range_cap_m
        self._max_payload = MAX_DATAGRAM - state.sealer.overhead
        self._bucket = TokenBucket(state.settings.rate_bytes_per_s, state.settings.burst_bytes)
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
        self._pose_told_at, self._here_bytes = -np.inf, 0
        self._order_told = 0

    def offer_scan(self, scan: Scan, pose: Pose, now: float) -> None:
        """Offer the own scan, taken at `pose` and integrated before; see `MeshNode.offer_scan`."""
        if self._id == GROUND:
            raise InputError("the ground station has no scans to offer")
        self._state.pose = pose
        self._maps.note_own(pose, self._range_cap_m, scan.stamp, now)
        clock = self._evidence.layers[self._id].clock
        if now < self._next_scan - _EPSILON_S or clock == self._scan_clock or not self._peers.map_listeners(now):
            return
        if self._scan is None and not self._is_worth_telling(now):
            return
        masked = mask_near(scan.ranges, self._lidar, pose, self._peers.positions(now), self._settings.mask_radius_m)
        offered = Scan(scan.stamp, masked)
        if self._scan is None:
            self._scan_since = now
        self._scan = scan_message(self._id, clock, pose, offered, self._lidar, self._range_cap_m, self._max_payload)

    def _is_worth_telling(self, now: float) -> bool:
        """Tell whether what own scans have made known since the last one that was sent is worth another."""
        news = self._maps.own_cells - self._cells_told
        if self._settings.scheduler == "fifo" or news > 0:
            return True
        return now >= self._scan_sent_at + NO_NEWS_S - _EPSILON_S

    def set_status(self, status: Status) -> None:
        """Set what the next status message tells; cells, bytes, links, rejections and command are filled in."""
        if status.id != self._id or self._id == GROUND:
            raise InputError(f"status of {status.id} given to mesh node {self._id}")
        reason = messages.clip_text(status.reason, 160)
        mode, ladder = messages.clip_text(status.mode, 32), messages.clip_text(status.ladder, 32)
        self._status = msgspec.structs.replace(status, reason=reason, mode=mode, ladder=ladder)
        self._state.pose = status.pose

    def poll(self, now: float) -> list[bytes]:
        """Return the datagrams to send at `now`, most urgent first, as many as the byte budget allows."""
        out: list[bytes] = []
        if self._state.placements is not None and self._state.placements.advance(now):
            self._maps.note_placed()
        self._prepare(now)
        for step in (
            self._send_claim, self._send_commands, self._send_status, self._send_here, self._send_digests,
            self._send_maps,
        ):  # fmt: skip
            if not step(out, now):
                break  # out of bytes: what is left keeps its place
        return out

    def _prepare(self, now: float) -> None:
        # the ground's digest is its sign of life as well; a drone's is for drones, as the ground sends no tiles
        has_readers = self._id == GROUND or (self._settings.protocol != "off" and self._peers.has_drone(now))
        if has_readers and now >= self._next_digest - _EPSILON_S:
            self._next_digest = now + self._settings.digest_period_s
            self._digest_at, self._digest_bytes = now, 0
            held = {
                source: Held(layer.boot, self._evidence.versions(source))
                for source, layer in self._evidence.layers.items()
                if source != self._id
            }
            parts = digests(now, held, self._max_payload)
            turn = self._digest_turn % len(parts)
            self._digests = deque((parts[turn:] + parts[:turn])[:_DIGEST_DATAGRAMS])
            self._digest_turn = turn + _DIGEST_DATAGRAMS
        if self._id != GROUND and now >= self._next_plan - _EPSILON_S:
            self._next_plan = now + _PLAN_PERIOD_S
            self._exchange.plan([peer for peer in self._peers.map_listeners(now) if np.isfinite(peer.digest_at)], now)

    def _send_claim(self, out: list[bytes], now: float) -> bool:
        claim = self._state.sealer.claim(now)
        if claim is None:
            return True
        if not self._bucket.take(len(claim), now):  # lost: the next datagram of the namesake asks for another
            return False
        out.append(claim)
        self.bytes_sent["status"] += len(claim)
        return True

    def _send_commands(self, out: list[bytes], now: float) -> bool:
        relays = self._state.orders.relays
        while relays:
            if not self._bucket.take(len(relays[0]), now):
                return False
            out.append(relays.popleft())
            self.bytes_sent["status"] += len(out[-1])
        for repeat in self._state.orders.due(now):
            named = repeat.commands(self._state.starts())
            if not all(self._send(command, "status", out, now) for command in named):
                return False
            if named:  # else it waits until a target is heard of
                self._state.orders.note_sent(repeat, now)
        return True

    def _send_status(self, out: list[bytes], now: float) -> bool:
        order = self._state.orders.last_nonce
        if self._status is None or (now < self._next_status - _EPSILON_S and order == self._order_told):
            return True  # that an order came is told at once
        full = msgspec.structs.replace(
            self._status,
            own_cells=self._maps.own_cells,
            scan_cells=self._maps.scan_cells,
            map_cells=self._maps.map_cells,
            bytes_sent=dict(self.bytes_sent),
            links=self._peers.ages(now, most=32),
            rejected=sum(self._state.stats.values()),
            last_command=order,
            taught={kind: self._exchange.receipts.by_kind[kind].cells for kind in _TOLD},
        )
        if not self._send(full, "status", out, now):
            return False
        spread_s = self._spread_s(len(out[-1]), _STATUS_SHARE, _MOST_STATUS_S)
        self._next_status, self._pose_told_at = now + max(self._settings.status_period_s, spread_s), now
        self._order_told = order
        return True

    def _send_here(self, out: list[bytes], now: float) -> bool:
        """Tell the pose where no status or scan has told it lately, more often to peers that are near."""
        if self._status is None:
            return True
        settings, pose = self._settings, self._status.pose
        period_s = settings.pose_period_s
        if self._scan is None and self._is_near(pose, now):  # a scan that waits will tell it
            period_s = min(period_s, settings.near_pose_period_s)
        period_s = max(period_s, self._spread_s(self._here_bytes, _HERE_SHARE, _MOST_HERE_S))
        if now < self._pose_told_at + period_s - _EPSILON_S:
            return True
        if not self._send(Here(self._id, self._status.stamp, pose, self._status.velocity), "status", out, now):
            return False
        self._pose_told_at, self._here_bytes = now, len(out[-1])
        return True

    def _spread_s(self, size: int, share: float, most_s: float) -> float:
        """Return how long to wait after `size` bytes so that their kind takes `share` of the rate, at most `most_s`."""
        if self._settings.scheduler == "fifo":
            return 0.0
        return min(most_s, size / (share * self._settings.rate_bytes_per_s))

    def _is_near(self, pose: Pose, now: float) -> bool:
        away = self._peers.positions(now) - np.array(pose[:2])
        return bool((np.hypot(away[:, 0], away[:, 1]) <= self._settings.near_m).any())

    def _send_digests(self, out: list[bytes], now: float) -> bool:
        while self._digests:
            if not self._send(self._digests[0], "digest", out, now):
                return False
            self._digests.popleft()
            self._digest_bytes += len(out[-1])
            spread_s = max(
                self._spread_s(self._digest_bytes, _DIGEST_SHARE, _MOST_DIGEST_S),
                self._spread_s(self._digest_bytes, _MOST_DIGEST_SHARE, np.inf),
            )
            self._next_digest = max(self._next_digest, self._digest_at + spread_s)
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
        if self._settings.scheduler == "fifo":
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
        self._scan_sent_at, self._next_scan = now, now + self._settings.scan_period_s
        self._pose_told_at = now
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
        size = len(payload) + self._state.sealer.overhead
        if not self._bucket.take(size, now):
            return False
        out.append(self._state.sealer.seal(payload, now))
        self.bytes_sent[kind] += size
        return True
