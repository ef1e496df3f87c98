"""A drone's radio modem as a UDP socket: what a runner sends there goes on air, what it receives comes from the air.

In lockstep both sides also send markers on this link (`mesh_comm.markers`). Neither they nor greetings go on air.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable

from imagine.mesh_comm.udp_modem import HELLO
from imagine.sim.sockets import Address, bind_udp, drain

logger = logging.getLogger(__name__)


class Modem:
    """One UDP endpoint of the radio medium; it answers the address it last heard from."""

    def __init__(self, owner: str, host: str = "127.0.0.1", port: int = 0) -> None:
        """Bind `port` (0: any free one). Raises InputError naming a port in use."""
        self.socket = bind_udp(host, port, f"radio modem of {owner}")
        self.port: int = self.socket.getsockname()[1]
        self.peer: Address | None = None
        self.undelivered = 0

    def receive(self) -> list[bytes]:
        """Return the datagrams that have arrived, markers among them, in order; greetings are answered."""
        datagrams: list[bytes] = []
        for datagram, source in drain(self.socket):
            self.peer = source
            if datagram == HELLO:
                self.send([HELLO])
            elif datagram:
                datagrams.append(datagram)
        return datagrams

    def send(self, datagrams: Iterable[bytes]) -> None:
        """Hand datagrams to whoever uses the modem; before anyone has written to it they are lost, and counted."""
        for datagram in datagrams:
            if self.peer is None:
                self.undelivered += 1
                continue
            try:
                self.socket.sendto(datagram, self.peer)
            except OSError as error:
                self.undelivered += 1
                logger.debug("radio modem cannot reach %s:%d: %s", *self.peer, error)

    def close(self) -> None:
        """Release the port."""
        self.socket.close()
