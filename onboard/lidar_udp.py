"""Scans by UDP: from the twin, or from a small driver beside a real sensor (wire format in core/lidar_wire.py)."""

from __future__ import annotations

import logging
import select
import socket
import time

from imagine.core.errors import InputError
from imagine.core.lidar import LidarSpec, Scan
from imagine.core.lidar_wire import decode_scan

logger = logging.getLogger(__name__)

_SCHEME = "udpin://"
_LARGEST_DATAGRAM = 65535
_RECEIVE_BUFFER_BYTES = 1 << 20


class UdpLidarSource:
    """A `LidarSource` that listens on a UDP port.

    Scans come out in order of their stamps: one not newer than the last is dropped and counted in `stale`. Datagrams
    that are no scan of this sensor are dropped and counted in `malformed`. With `latest`, scans that queued up while
    the reader was busy are skipped (`skipped`) and the newest is given: for real time, never for lockstep.
    """

    def __init__(self, url: str, spec: LidarSpec, latest: bool = False) -> None:
        """Bind `udpin://host:port` (port 0: any free one). Raises InputError: bad URL, or the port cannot be bound."""
        host, port = parse_udpin(url)
        self.spec = spec
        self.latest = latest
        self.malformed = self.stale = self.skipped = 0
        self._stamp: float | None = None
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER_BYTES)
            self._socket.bind((host, port))
        except OSError as error:
            self._socket.close()
            raise InputError(
                f"--lidar {url}: cannot listen on UDP port {port}: {error.strerror or error}; "
                "stop the program that holds it, or give another port here and at the sender"
            ) from error
        self._socket.setblocking(False)

    @property
    def port(self) -> int:
        """The UDP port that scans are expected on."""
        return int(self._socket.getsockname()[1])

    def fileno(self) -> int:
        """The socket's descriptor, for select."""
        return self._socket.fileno()

    def read(self, timeout_s: float) -> Scan | None:
        """Return the next scan, waiting at most `timeout_s` seconds; None when none came."""
        deadline = time.monotonic() + timeout_s
        scan = self._next_queued()
        while scan is None:
            left = deadline - time.monotonic()
            if left <= 0.0 or not select.select([self._socket], [], [], left)[0]:
                return None
            scan = self._next_queued()
        while self.latest and (newer := self._next_queued()) is not None:
            self.skipped += 1
            scan = newer
        return scan

    def _next_queued(self) -> Scan | None:
        """Return the first good scan already received, dropping what is none; None when nothing is left."""
        while True:
            try:
                datagram = self._socket.recv(_LARGEST_DATAGRAM)
            except BlockingIOError:
                return None
            scan = self._accept(datagram)
            if scan is not None:
                return scan

    def _accept(self, datagram: bytes) -> Scan | None:
        try:
            scan = decode_scan(datagram, self.spec)
        except InputError as error:
            self.malformed += 1
            if self.malformed == 1:
                logger.warning("dropped: %s (further ones are counted, not logged)", error)
            return None
        if self._stamp is not None and scan.stamp <= self._stamp:
            self.stale += 1
            return None
        self._stamp = scan.stamp
        return scan

    def close(self) -> None:
        """Release the port."""
        self._socket.close()


def parse_udpin(url: str) -> tuple[str, int]:
    """Read `udpin://host:port`. Raises InputError with an example."""
    host, colon, port = url.removeprefix(_SCHEME).rpartition(":")
    if not url.startswith(_SCHEME) or not colon or not host or not port.isdecimal() or int(port) > 65535:
        raise InputError(f"--lidar {url}: expected {_SCHEME}host:port, for example {_SCHEME}127.0.0.1:15541")
    return host, int(port)
