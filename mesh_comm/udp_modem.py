"""A radio modem reached by UDP, such as the twin's, with the markers of lockstep."""

from __future__ import annotations

import math
import select
import time
from collections import deque

from imagine.core.errors import InputError
from imagine.mesh_comm.link_url import parse_link_url
from imagine.mesh_comm.markers import decode_marker, encode_marker
from imagine.mesh_comm.messages import MAX_DATAGRAM
from imagine.mesh_comm.udp_sockets import open_socket, resolve

HELLO = b"IMHI"
"""Sent to a radio modem so that it learns the node's address; carries nothing."""
INBOX = 2048
"""Datagrams kept while nobody reads: the oldest go first."""
_MOST_READS = 1000  # in one go, so that a flood cannot hold the loop
_HELLO_PERIOD_S = 0.5
_TICK_TOLERANCE_S = 1e-6


class UdpModemLink:
    """A radio reached by unicast UDP, such as the twin's: `udpout://HOST:PORT[?interface=NAME]`.

    Also speaks the lockstep markers of the twin: `send_marker` after a tick's datagrams, `wait_marker` for the twin's.
    From the first `wait_marker` on, `receive` gives only what came before the markers waited for.
    """

    def __init__(self, url: str) -> None:
        """Open the socket and greet the modem. Raises InputError on a wrong address."""
        parts = parse_link_url(url)
        if parts.scheme != "udpout":
            raise InputError(f"{url}: expected udpout://HOST:PORT")
        family, address = resolve(parts, *parts.targets[0])
        self._socket = open_socket(parts, family)
        try:
            self._socket.connect(address)
        except OSError as error:
            self._socket.close()
            raise InputError(f"{url}: the radio cannot be reached: {error.strerror or error}") from error
        self._inbox: deque[bytes] = deque(maxlen=INBOX)
        self._marker = -math.inf
        self._is_lockstep = False
        self._is_heard = False
        self._greeted_at = -math.inf
        self.lost = 0
        """Datagrams that the system refused to take: the radio is gone or its queue is full."""
        self.oversize = 0
        """Datagrams received that are longer than any mesh message: dropped."""
        self._greet()

    def send(self, datagram: bytes) -> None:
        """Send one datagram to the modem; one the system refuses is counted as lost."""
        try:
            self._socket.send(datagram)
        except OSError:  # as with a broadcast radio: losing a datagram must not end the runner
            self.lost += 1

    def receive(self) -> list[bytes]:
        """Return the datagrams that have arrived, markers left out."""
        if not self._is_lockstep:
            for _ in range(_MOST_READS):
                if not self._read():
                    break
        self._greet()
        arrived = list(self._inbox)
        self._inbox.clear()
        return arrived

    def send_marker(self, stamp: float) -> None:
        """Tell the twin that everything of the tick `stamp` (seconds) has been sent."""
        self.send(encode_marker(stamp))

    def wait_marker(self, stamp: float, timeout_s: float) -> bool:
        """Wait until the twin's marker of tick `stamp` or a later one has come; tell whether it came in time."""
        self._is_lockstep = True
        deadline = time.monotonic() + timeout_s
        while self._marker < stamp - _TICK_TOLERANCE_S:
            if self._read() and time.monotonic() < deadline:
                continue
            self._greet()
            left = deadline - time.monotonic()
            if left <= 0.0:
                return False
            select.select([self._socket], [], [], min(left, _HELLO_PERIOD_S))
        return True

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def fileno(self) -> int:
        """Return the socket's descriptor, to wait on."""
        return self._socket.fileno()

    def _read(self) -> bool:
        """Take one datagram off the socket; tell whether there was one."""
        try:
            datagram = self._socket.recv(MAX_DATAGRAM + 1)
        except BlockingIOError:
            return False
        except OSError:  # nobody at the modem's port yet, or no longer, or no network
            self.lost += 1
            return True
        self._is_heard = True
        if len(datagram) > MAX_DATAGRAM:
            self.oversize += 1
            return True
        stamp = decode_marker(datagram)
        if stamp is not None:
            if math.isfinite(stamp):
                self._marker = max(self._marker, stamp)
        elif datagram and datagram != HELLO:
            self._inbox.append(datagram)
        return True

    def _greet(self) -> None:
        """Say hello until the modem has answered: it may start later than this node."""
        now = time.monotonic()
        if not self._is_heard and now - self._greeted_at >= _HELLO_PERIOD_S:
            self._greeted_at = now
            self.send(HELLO)
