"""The radio as a port: what a node's datagrams leave and arrive by, in memory and over UDP."""

from __future__ import annotations

from collections import deque
from typing import Protocol

from imagine.mesh_comm.link_url import parse_link_url
from imagine.mesh_comm.udp_modem import INBOX, UdpModemLink
from imagine.mesh_comm.udp_network import UdpNetworkLink


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
        self.inbox: deque[bytes] = deque(maxlen=INBOX)

    def send(self, datagram: bytes) -> None:
        """Put the datagram into the inbox of every other link in reach."""
        for other in self.air.links:
            if other is not self and frozenset((self.index, other.index)) not in self.air.cut:
                other.inbox.append(datagram)

    def receive(self) -> list[bytes]:
        """Return what has arrived."""
        arrived = list(self.inbox)
        self.inbox.clear()
        return arrived

    def close(self) -> None:
        """Leave the medium."""
        self.air.links = [link for link in self.air.links if link is not self]


def open_link(url: str) -> UdpModemLink | UdpNetworkLink:
    """Open the link that a URL names, see `link_url.FORMS`. Raises InputError where it is wrong or cannot be had."""
    return UdpModemLink(url) if parse_link_url(url).scheme == "udpout" else UdpNetworkLink(url)
