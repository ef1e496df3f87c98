"""UDP sockets of the twin: bound with a clear error, drained without blocking."""

from __future__ import annotations

import errno
import itertools
import os
import socket

from imagine.core.errors import InputError

Address = tuple[str, int]

_RECEIVE_BUFFER = 1 << 20
_LARGEST_DATAGRAM = 65535
_MOST_AT_ONCE = 512  # a flood must not hold up the tick
_FIRST_LISTEN_PORT, _LISTEN_PORTS = 20000, 12000  # below Linux's ephemeral range, so that nobody is given one by chance
_offset = itertools.count(os.getpid() * 61)


def bind_udp(host: str, port: int, owner: str) -> socket.socket:
    """Return a non-blocking UDP socket bound to `port`, 0 for any. Raises InputError naming the port and what to do."""
    link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    link.setblocking(False)
    link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
    try:
        link.bind((host, port))
    except OSError as error:
        link.close()
        if error.errno == errno.EADDRINUSE:
            raise InputError(
                f"{owner}: UDP port {port} on {host} is in use: end the other program, or choose other ports"
            ) from error
        raise InputError(f"{owner}: cannot listen on {host}:{port}: {error.strerror}") from error
    return link


def drain(link: socket.socket) -> list[tuple[bytes, Address]]:
    """Return the datagrams that wait in a socket, with their sources, in order of arrival."""
    received: list[tuple[bytes, Address]] = []
    while len(received) < _MOST_AT_ONCE:
        try:
            datagram, source = link.recvfrom(_LARGEST_DATAGRAM)
        except BlockingIOError:
            break
        except ConnectionError:  # an earlier datagram found nobody at its port
            continue
        received.append((datagram, (source[0], source[1])))
    return received


def free_listen_port(host: str) -> int:
    """Return a UDP port that another process can bind in a moment. Raises InputError when none is free."""
    for _ in range(_LISTEN_PORTS):
        port = _FIRST_LISTEN_PORT + next(_offset) % _LISTEN_PORTS
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind((host, port))
            except OSError:
                continue
        return port
    raise InputError(f"no free UDP port between {_FIRST_LISTEN_PORT} and {_FIRST_LISTEN_PORT + _LISTEN_PORTS}")
