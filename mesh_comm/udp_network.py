"""A shared IP network as the radio: broadcast, multicast, or a list of peers that are spoken to one by one."""

from __future__ import annotations

import logging
import socket

from imagine.core.errors import InputError
from imagine.mesh_comm.link_url import parse_link_url
from imagine.mesh_comm.messages import MAX_DATAGRAM
from imagine.mesh_comm.udp_sockets import is_multicast, join_group, open_socket, resolve

_MOST_READS = 2048  # in one go: bounds memory, and a flood cannot hold the loop
_log = logging.getLogger(__name__)


class UdpNetworkLink:
    """`udpbcast://ADDRESS:PORT[?interface=NAME]`, or `udppeers://HOST:PORT,...[?listen=PORT&interface=NAME]`.

    An ADDRESS of a multicast group is joined, any other is a broadcast address. Peers' hosts are looked up once. Own
    datagrams may come back, and anybody's may come: a mesh node counts and drops what is not its swarm's.
    """

    def __init__(self, url: str) -> None:
        """Bind the port and join the group. Raises InputError naming the URL and what it lacks."""
        parts = parse_link_url(url)
        if parts.scheme == "udpout" or parts.listen is None:
            raise InputError(f"{url}: expected udpbcast:// or udppeers://")
        found = [resolve(parts, host, port) for host, port in parts.targets]
        self._targets = [address for _, address in found]
        self._url = url
        self.lost = 0
        """Datagrams that the system refused to take: no network, or its queue is full."""
        self.oversize = 0
        """Datagrams received that are longer than any mesh message: dropped."""
        family = found[0][0]
        if any(each is not family for each, _ in found):
            raise InputError(f"{url}: some peers have IPv4 addresses and some IPv6: name all by one of the two")
        is_group = parts.scheme == "udpbcast" and is_multicast(self._targets[0])
        if parts.scheme == "udpbcast" and family is socket.AF_INET6 and not is_group:
            raise InputError(f"{url}: IPv6 has no broadcast: name a multicast group, such as ff02::4d:31")
        self._socket = open_socket(parts, family)
        try:
            if is_group:
                join_group(self._socket, parts, self._targets[0])
            if parts.scheme == "udpbcast":  # several drones on one machine share the port; peers each have theirs
                self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
            self._socket.bind(self._targets[0] if is_group else ("", parts.listen))
        except InputError:
            self._socket.close()
            raise
        except OSError as error:
            self._socket.close()
            raise InputError(f"{url}: cannot listen on port {parts.listen}: {error.strerror or error}") from error

    def send(self, datagram: bytes) -> None:
        """Send one datagram to all; one the system refuses is counted as lost."""
        for target in self._targets:
            try:
                self._socket.sendto(datagram, target)
            except OSError as error:  # a network comes and goes in flight: losing a datagram must not end the runner
                if self.lost == 0:
                    _log.warning("%s: cannot send: %s", self._url, error)
                self.lost += 1

    def receive(self) -> list[bytes]:
        """Return the datagrams that have arrived, at most 2048 at a time; the system keeps what it can of the rest."""
        arrived: list[bytes] = []
        for _ in range(_MOST_READS):
            try:
                datagram = self._socket.recv(MAX_DATAGRAM + 1)
            except BlockingIOError:
                break
            except OSError as error:  # the interface is down
                _log.debug("%s: cannot receive: %s", self._url, error)
                break
            if len(datagram) > MAX_DATAGRAM:
                self.oversize += 1
            else:
                arrived.append(datagram)
        return arrived

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def fileno(self) -> int:
        """Return the socket's descriptor, to wait on."""
        return self._socket.fileno()
