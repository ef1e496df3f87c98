"""UDP sockets on a network interface of one's choice, for IPv4 and IPv6 (Linux)."""

from __future__ import annotations

import ipaddress
import socket
import struct
from typing import Any

from imagine.core.errors import InputError
from imagine.mesh_comm.link_url import LinkUrl

SocketAddress = tuple[Any, ...]
"""As the socket module has it: host and port, for IPv6 also flow and scope."""

_RECEIVE_BUFFER = 1 << 20  # the kernel gives less where its rmem_max says so
_IP_MULTICAST_ALL, _IPV6_MULTICAST_ALL = 49, 29  # linux/in.h, in6.h: not in Python's socket module


def interfaces() -> dict[str, int]:
    """Return the network interfaces of this machine by name, with their numbers."""
    return {name: index for index, name in sorted(socket.if_nameindex(), key=lambda pair: pair[1])}


def find_interface(url: LinkUrl) -> int:
    """Return the number of the URL's interface, 0 for any. Raises InputError that lists those there are."""
    if url.interface is None:
        return 0
    there = interfaces()
    if url.interface not in there:
        raise InputError(f"{url.text}: no interface '{url.interface}'; this machine has {', '.join(there) or 'none'}")
    return there[url.interface]


def resolve(url: LinkUrl, host: str, port: int) -> tuple[socket.AddressFamily, SocketAddress]:
    """Return family and address of a host, IPv4 where it has both; a link-local address gets the URL's interface.

    Raises InputError where the host is not known.
    """
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)
    except (OSError, UnicodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "no valid host name"
        raise InputError(f"{url.text}: {host}: {reason}") from error
    family, _, _, _, reached = min(found, key=lambda each: each[0] != socket.AF_INET)
    address: SocketAddress = reached
    if family == socket.AF_INET6:
        ip, scope = ipaddress.IPv6Address(str(address[0])), 0
        if ip.is_link_local or ip.is_multicast:
            scope = find_interface(url)
            if not scope and (ip.is_link_local or int(ip) >> 112 == 0xFF02):
                raise InputError(f"{url.text}: {host} exists on every interface: name one, ?interface=NAME; {_there()}")
        return socket.AF_INET6, (str(ip), port, 0, scope)
    return socket.AF_INET, (str(address[0]), port)


def is_multicast(address: SocketAddress) -> bool:
    """Tell whether an address is that of a multicast group."""
    return ipaddress.ip_address(address[0]).is_multicast


def open_socket(url: LinkUrl, family: socket.AddressFamily) -> socket.socket:
    """Return a non-blocking socket, tied to the URL's interface if it names one. Raises InputError otherwise."""
    index = find_interface(url)
    try:
        opened = socket.socket(family, socket.SOCK_DGRAM)
    except OSError as error:
        raise InputError(f"{url.text}: no socket: {error.strerror or error}") from error
    try:
        opened.setblocking(False)
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
        if family == socket.AF_INET6:
            opened.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
        if index and url.interface is not None:
            opened.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, url.interface.encode() + b"\0")
    except PermissionError as error:
        opened.close()
        raise InputError(f"{url.text}: choosing an interface needs Linux 5.7, or CAP_NET_RAW") from error
    except OSError as error:
        opened.close()
        raise InputError(f"{url.text}: cannot be opened: {error.strerror or error}") from error
    return opened


def join_group(opened: socket.socket, url: LinkUrl, group: SocketAddress) -> None:
    """Hear a multicast group and speak to it on the URL's interface, or the one that the system's routes choose.

    Raises InputError where the interface cannot, and where without a route none can be chosen.
    """
    index = find_interface(url)
    try:
        if opened.family == socket.AF_INET6:
            packed = socket.inet_pton(socket.AF_INET6, group[0])
            opened.setsockopt(socket.IPPROTO_IPV6, _IPV6_MULTICAST_ALL, 0)
            opened.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_JOIN_GROUP, packed + struct.pack("@I", index))
            if index:
                opened.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_MULTICAST_IF, index)
        else:
            membership = struct.pack("@4s4xi", socket.inet_aton(group[0]), index)  # struct ip_mreqn
            opened.setsockopt(socket.IPPROTO_IP, _IP_MULTICAST_ALL, 0)  # only what came by the interface joined on
            opened.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)
            if index:
                opened.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, membership)
    except OSError as error:
        remedy = "" if index else f"; name an interface, ?interface=NAME; {_there()}"
        raise InputError(f"{url.text}: the group cannot be joined: {error.strerror or error}{remedy}") from error


def _there() -> str:
    return f"this machine has {', '.join(interfaces()) or 'none'}"
