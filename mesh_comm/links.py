"""The radio as a port: what a node's datagrams leave and arrive by, in memory and over UDP."""

from __future__ import annotations

import logging
import math
import select
import socket
import time
from collections import deque
from typing import Protocol
from urllib.parse import urlsplit

from imagine.core.errors import InputError
from imagine.mesh_comm.markers import decode_marker, encode_marker

_log = logging.getLogger(__name__)

HELLO = b"IMHI"
"""Sent to a radio modem so that it learns the node's address; carries nothing."""
_INBOX = 2048  # datagrams kept while nobody reads: the oldest go first
_READ_BYTES = 65535
_MOST_READS = 1000  # in one go, so that a flood cannot hold the loop
_HELLO_PERIOD_S = 0.5
_TICK_TOLERANCE_S = 1e-6


class MeshLink(Protocol):
    """A datagram radio: everyone in reach may hear what is sent, and anything may be lost."""

    def send(self, datagram: bytes) -> None:
        """Send one datagram; it may get lost, silently."""

    def receive(self) -> list[bytes]:
        """Return the datagrams that have arrived, without waiting."""

    def close(self) -> None:
        """Release the link."""


class VirtualAir:
    """An in-memory radio medium: every link hears all others, unless `reach` says otherwise."""

    def __init__(self) -> None:
        """Start with nobody in the air."""
        self.links: list[VirtualLink] = []
        self.cut: set[frozenset[int]] = set()
        """Pairs of link indices that do not hear each other."""

    def link(self) -> VirtualLink:
        """Return a new link in this medium; its `index` is its number in order of making."""
        made = VirtualLink(self, len(self.links))
        self.links.append(made)
        return made


class VirtualLink:
    """One node's place in a VirtualAir."""

    def __init__(self, air: VirtualAir, index: int) -> None:
        """Join the medium; use `VirtualAir.link` instead."""
        self.air = air
        self.index = index
        self.inbox: list[bytes] = []

    def send(self, datagram: bytes) -> None:
        """Put the datagram into the inbox of every other link in reach."""
        for other in self.air.links:
            if other is not self and frozenset((self.index, other.index)) not in self.air.cut:
                other.inbox.append(datagram)

    def receive(self) -> list[bytes]:
        """Return what has arrived."""
        arrived, self.inbox = self.inbox, []
        return arrived

    def close(self) -> None:
        """Leave the medium."""
        self.air.links = [link for link in self.air.links if link is not self]


class UdpModemLink:
    """A radio reached by unicast UDP, such as the twin's: `udpout://host:port`.

    Also speaks the lockstep markers of the twin: `send_marker` after a tick's datagrams, `wait_marker` for the twin's.
    From the first `wait_marker` on, `receive` gives only what came before the markers waited for.
    """

    def __init__(self, url: str) -> None:
        """Open the socket and greet the modem. Raises InputError on a wrong address."""
        host, port = parse_udp_url(url, "udpout")
        self._socket = _open_socket(url)
        try:
            self._socket.connect((host, port))
        except OSError as error:
            self._socket.close()
            raise InputError(f"{url}: the radio cannot be reached: {error.strerror or error}") from error
        self._inbox: deque[bytes] = deque(maxlen=_INBOX)
        self._marker = -math.inf
        self._is_lockstep = False
        self._is_heard = False
        self._greeted_at = -math.inf
        self.lost = 0
        """Datagrams that the system refused to take: the radio is gone or its queue is full."""
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
            datagram = self._socket.recv(_READ_BYTES)
        except BlockingIOError:
            return False
        except OSError:  # nobody at the modem's port yet, or no longer, or no network
            self.lost += 1
            return True
        self._is_heard = True
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


class UdpBroadcastLink:
    """A radio network with broadcast or multicast, as in the field: `udpbcast://ADDRESS:PORT`.

    Its own datagrams may come back; a mesh node drops them.
    """

    def __init__(self, url: str) -> None:
        """Bind the port and, for a multicast address, join the group. Raises InputError naming the address."""
        host, port = parse_udp_url(url, "udpbcast")
        self._target = (host, port)
        self._url = url
        self._socket = _open_socket(url)
        self.lost = 0
        """Datagrams that the system refused to take: no network, or its queue is full."""
        try:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
            self._socket.bind(("", port))
            address = socket.inet_aton(socket.gethostbyname(host))
            if 224 <= address[0] <= 239:
                membership = address + socket.inet_aton("0.0.0.0")
                self._socket.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)
        except OSError as error:
            self._socket.close()
            raise InputError(f"{url}: cannot be opened: {error.strerror or error}") from error

    def send(self, datagram: bytes) -> None:
        """Broadcast one datagram; one the system refuses is counted as lost."""
        try:
            self._socket.sendto(datagram, self._target)
        except OSError as error:  # a radio network comes and goes in flight: losing a datagram must not end the runner
            if self.lost == 0:
                _log.warning("%s: cannot send: %s", self._url, error)
            self.lost += 1

    def receive(self) -> list[bytes]:
        """Return the datagrams that have arrived."""
        arrived: list[bytes] = []
        while len(arrived) < _INBOX:
            try:
                arrived.append(self._socket.recv(_READ_BYTES))
            except BlockingIOError:
                break
        return arrived

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def fileno(self) -> int:
        """Return the socket's descriptor, to wait on."""
        return self._socket.fileno()


def open_link(url: str) -> UdpModemLink | UdpBroadcastLink:
    """Open the link a URL names: `udpout://host:port` or `udpbcast://address:port`. Raises InputError otherwise."""
    match urlsplit(url).scheme:
        case "udpout":
            return UdpModemLink(url)
        case "udpbcast":
            return UdpBroadcastLink(url)
    raise InputError(f"{url}: a mesh link is udpout://host:port or udpbcast://address:port")


def parse_udp_url(url: str, scheme: str) -> tuple[str, int]:
    """Return host and port of `scheme://host:port`. Raises InputError naming the URL."""
    try:
        parts = urlsplit(url)
        host, port = parts.hostname, parts.port
    except ValueError as error:
        raise InputError(f"{url}: {error}; expected {scheme}://host:port") from error
    if parts.scheme != scheme or not host or not port or parts.path or parts.query:
        raise InputError(f"{url}: expected {scheme}://host:port with a port of 1 to 65535")
    return host, port


def _open_socket(url: str) -> socket.socket:
    try:
        opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    except OSError as error:
        raise InputError(f"{url}: no socket: {error.strerror or error}") from error
    opened.setblocking(False)
    return opened
