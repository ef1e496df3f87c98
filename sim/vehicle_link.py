"""The vehicle's UDP link: MAVLink datagrams in and out, never blocking."""

from __future__ import annotations

import logging
from collections import OrderedDict
from collections.abc import Iterable

from pymavlink.dialects.v20 import common as mavlink

from imagine.sim.sockets import Address, bind_udp, drain
from imagine.sim.vehicle_messages import Message

logger = logging.getLogger(__name__)

_OTHER_PEERS = 4


class VehicleLink:
    """MAVLink over UDP from one vehicle: to its companion's address, and to whoever else has written to it.

    `malformed` counts datagrams, or stretches of them, that are no message; `heard` the messages taken in.
    """

    def __init__(self, system_id: int, companion: Address, host: str = "127.0.0.1", port: int = 0) -> None:
        """Bind `port` (0: any free one). Raises InputError naming a port in use."""
        self.companion = companion
        self.malformed = 0
        self.heard = 0
        self.socket = bind_udp(host, port, f"vehicle {system_id}")
        self.port: int = self.socket.getsockname()[1]
        self._others: OrderedDict[Address, None] = OrderedDict()
        self._mav = mavlink.MAVLink(None, srcSystem=system_id, srcComponent=mavlink.MAV_COMP_ID_AUTOPILOT1)
        self._mav.robust_parsing = True

    def receive(self) -> list[Message]:
        """Return the messages that have arrived, in order; count what is malformed."""
        messages: list[Message] = []
        for datagram, source in drain(self.socket):
            parsed = self._parse(datagram)
            if parsed and source != self.companion:
                self._remember(source)
            messages += parsed
        self.heard += len(messages)
        return messages

    def _parse(self, datagram: bytes) -> list[Message]:
        good: list[Message] = []
        for message in self._mav.parse_buffer(datagram) or []:
            if message.get_type() == "BAD_DATA":
                self.malformed += 1
            elif not message.get_type().startswith("UNKNOWN"):
                good.append(message)
        if self._mav.buf_len() > 0:  # messages never span datagrams: a rest would swallow the next one
            self.malformed += 1
            self._mav.buf, self._mav.buf_index = bytearray(), 0
            self._mav.expected_length = mavlink.HEADER_LEN_V1 + 2
        return good

    def _remember(self, source: Address) -> None:
        if source not in self._others:
            logger.info("vehicle %d: also answering %s:%d", self._mav.srcSystem, *source)
        self._others[source] = None
        self._others.move_to_end(source)
        while len(self._others) > _OTHER_PEERS:
            self._others.popitem(last=False)

    def send(self, messages: Iterable[Message]) -> None:
        """Send each message, in a datagram of its own, to every peer."""
        peers = (self.companion, *self._others)
        for message in messages:
            datagram = message.pack(self._mav)
            self._mav.seq = (self._mav.seq + 1) % 256
            for peer in peers:
                try:
                    self.socket.sendto(datagram, peer)
                except OSError as error:
                    logger.debug("vehicle %d: cannot reach %s:%d: %s", self._mav.srcSystem, *peer, error)

    def close(self) -> None:
        """Release the port."""
        self.socket.close()
