"""What a node does with a datagram: opens it, reads it, and sorts what it says into map, peers and orders."""

from __future__ import annotations

import logging

from imagine.core.errors import InputError
from imagine.mesh_comm import messages
from imagine.mesh_comm.codec import unpack_tiles
from imagine.mesh_comm.messages import GROUND, Command, Digest, Here, Message, Sketch, Status, Tiles
from imagine.mesh_comm.node_state import NodeState
from imagine.mesh_comm.peers import PeerRecord
from imagine.mesh_comm.seal import Opened, Rejected

_log = logging.getLogger(__name__)


class Hearing:
    """The listening half of a node. Nothing that is received raises: what is wrong is counted."""

    def __init__(self, state: NodeState) -> None:
        """Write what is heard into `state`."""
        self._state = state

    def receive(self, datagram: bytes, now: float) -> None:
        """Take in whatever the radio heard at `now`, seconds."""
        state = self._state
        try:
            opened = state.sealer.open(datagram, now)
        except Rejected:
            return  # counted by the sealer
        try:
            message, newer = messages.read(opened.payload)
        except messages.Unreadable as error:
            self._drop(error.reason, opened.sender, error)
            return
        if newer:
            state.newer += 1
        try:
            self._take(message, opened, datagram, now)
        except InputError as error:
            self._drop("content", opened.sender, error)

    def _take(self, message: Message, opened: Opened, datagram: bytes, now: float) -> None:
        state, sender = self._state, opened.sender
        if isinstance(message, Command):
            if state.orders.take(message, sender, datagram):
                state.dropped["old-life"] += 1
            return
        if sender == GROUND and not isinstance(message, Digest):
            raise InputError("the ground sends digests and commands only")
        if isinstance(message, messages.Scan | Status | Here):
            named = message.sender if isinstance(message, messages.Scan) else message.id
            if named != sender:
                raise InputError(f"a message of {named}")
        takes_maps = state.id == GROUND or state.settings.protocol != "off"
        if opened.boot < state.boot(sender):
            state.dropped["old-life"] += 1  # held up on the way; a relay was faster with the news of the restart
            return
        peer = state.peers.hear(opened, now)
        if peer.met is None:
            peer.met = state.evidence.versions(state.id)
            state.exchange.note_met(sender)
        if sender in state.evidence.layers:  # what an earlier start saw, from where it was, counts no more
            state.maps.renew(sender, opened.boot)
        match message:
            case Status():
                peer.note_status(message, now)
            case Here():
                peer.note_here(message, now)
            case Digest():
                peer.note_digest(message, now, state.settings.max_sources, state.evidence)
                state.exchange.receipts.settle(sender, peer.holds, now)
            case messages.Scan():
                peer.note_pose(message.pose, message.stamp, now)
                if takes_maps:
                    state.maps.take_scan(message, opened.boot, state.not_walls(sender, now), now)
            case Tiles():
                if takes_maps:
                    self._take_tiles(message, peer, now)
            case Sketch():
                if takes_maps:
                    self._take_sketch(message, sender, now)

    def _take_tiles(self, message: Tiles, peer: PeerRecord, now: float) -> None:
        state, source = self._state, message.source
        is_relayed = source != peer.id
        if message.boot < state.boot(source) or (source == state.id and message.boot != state.sealer.boot):
            state.dropped["old-life"] += 1
            return
        if source == state.id:
            unpack_tiles([tile.packed for tile in message.tiles])
        elif is_relayed and state.settings.protocol == "one-hop" and state.id != GROUND:
            return
        else:
            state.maps.take_tiles(message, is_relayed and state.peers.is_live(source, now), peer.id, now)
        # only now that all of it has proved sound: what is noted is kept
        peer.note_held(source, message.boot, message.tiles)

    def _take_sketch(self, message: Sketch, via: int, now: float) -> None:
        state, source = self._state, message.source
        if message.boot < state.boot(source) or (source == state.id and message.boot != state.sealer.boot):
            state.dropped["old-life"] += 1
        elif source == state.id or state.peers.is_live(source, now):
            return  # nobody knows it better than the source, which is heard here
        elif state.id == GROUND or state.settings.protocol == "multi-hop":
            state.maps.take_sketch(message, via, now)

    def _drop(self, reason: str, sender: int, error: InputError) -> None:
        self._state.dropped[reason] += 1
        _log.debug("node %d: dropped a datagram of %d: %s", self._state.id, sender, error)
