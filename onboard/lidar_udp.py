"""Scans by UDP: from the twin, or from a small driver beside a real sensor (wire format in core/lidar_wire.py)."""

from __future__ import annotations

import logging
import math
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
_MOST_DATAGRAMS = 1000  # in one reading, so that a flood cannot hold the loop
_AHEAD_S = 1.0
"""A stamp may run so far ahead of the wall clock since the last scan: farther, and one stray datagram would end all."""
_AHEAD_LOCKSTEP_S = 10.0
_NEW_EPOCH_SCANS = 10
"""So many refused scans in a row, each later than the one before: the driver was started anew."""


class UdpLidarSource:
    """A `LidarSource` that listens on a UDP port.

    Scans come out in order of their stamps: one not newer than the last is dropped and counted in `stale`. Datagrams
    that are no scan of this sensor are dropped and counted in `malformed`; stamps that leap ahead in `ahead`.
    With `latest`, scans that queued up while the reader was busy are skipped (`skipped`) and the newest is given: for
    real time, never for lockstep. In real time a driver that was started anew has its stamps carried on from before.
    """

    def __init__(self, url: str, spec: LidarSpec, latest: bool = False) -> None:
        """Bind `udpin://host:port` (port 0: any free one). Raises InputError: bad URL, or the port cannot be bound."""
        host, port = parse_udpin(url)
        self.spec = spec
        self.latest = latest
        self.malformed = self.stale = self.ahead = self.skipped = 0
        self._stamp: float | None = None
        self._stamped_at = -math.inf
        self._offset = 0.0
        self._refused_stamp, self._refused_in_a_row = -math.inf, 0
        self._budget = 0
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

    @property
    def dropped(self) -> dict[str, int]:
        """What was not given to the reader, by kind."""
        counts = {"malformed": self.malformed, "stale": self.stale, "ahead": self.ahead, "skipped": self.skipped}
        return {f"lidar_{kind}": count for kind, count in counts.items()}

    def read(self, timeout_s: float) -> Scan | None:
        """Return the next scan, waiting at most `timeout_s` seconds; None when none came."""
        deadline = time.monotonic() + timeout_s
        self._budget = _MOST_DATAGRAMS
        scan = self._next_queued()
        while scan is None:
            left = deadline - time.monotonic()
            if left <= 0.0 or self._budget <= 0 or not select.select([self._socket], [], [], left)[0]:
                return None
            scan = self._next_queued()
        while self.latest and (newer := self._next_queued()) is not None:
            self.skipped += 1
            scan = newer
        return scan

    def _next_queued(self) -> Scan | None:
        """Return the first good scan already received, dropping what is none; None when nothing is left."""
        while self._budget > 0:
            self._budget -= 1
            try:
                datagram = self._socket.recv(_LARGEST_DATAGRAM)
            except BlockingIOError:
                return None
            scan = self._accept(datagram)
            if scan is not None:
                return scan
        return None

    def _accept(self, datagram: bytes) -> Scan | None:
        try:
            scan = decode_scan(datagram, self.spec)
        except InputError as error:
            self.malformed += 1
            if self.malformed == 1:
                logger.warning("dropped: %s (further ones are counted, not logged)", error)
            return None
        now = time.monotonic()
        elapsed = now - self._stamped_at if self._stamp is not None else 0.0
        stamp = scan.stamp + self._offset
        if self._stamp is not None and not self._is_next(stamp, elapsed):
            if not self._is_new_epoch(scan.stamp):
                return None
            self._offset += self._stamp + elapsed - stamp
            stamp = self._stamp + elapsed
            logger.warning("the LiDAR's stamps began anew at %.3f s: carried on from %.3f s", scan.stamp, stamp)
        self._stamp, self._stamped_at = stamp, now
        self._refused_stamp, self._refused_in_a_row = -math.inf, 0
        return Scan(stamp, scan.ranges)

    def _is_next(self, stamp: float, elapsed_s: float) -> bool:
        """Tell whether a stamp is later than the last one, but not too much later; count it where it is not."""
        assert self._stamp is not None
        farthest = elapsed_s + _AHEAD_S if self.latest else _AHEAD_LOCKSTEP_S  # simulated time is not the wall's
        if stamp <= self._stamp:
            self.stale += 1
        elif stamp - self._stamp > farthest:
            self.ahead += 1
        else:
            return True
        return False

    def _is_new_epoch(self, stamp: float) -> bool:
        """Count a refused stamp; tell whether enough have gone on from each other to be a driver's new time."""
        goes_on = 0.0 < stamp - self._refused_stamp <= _AHEAD_S or self._refused_in_a_row == 0
        self._refused_in_a_row = self._refused_in_a_row + 1 if goes_on else 1
        self._refused_stamp = stamp
        return self.latest and self._refused_in_a_row >= _NEW_EPOCH_SCANS

    def close(self) -> None:
        """Release the port."""
        self._socket.close()


def parse_udpin(url: str) -> tuple[str, int]:
    """Read `udpin://host:port`. Raises InputError with an example."""
    host, colon, port = url.removeprefix(_SCHEME).rpartition(":")
    if not url.startswith(_SCHEME) or not colon or not host or not port.isdecimal() or int(port) > 65535:
        raise InputError(f"--lidar {url}: expected {_SCHEME}host:port, for example {_SCHEME}127.0.0.1:15541")
    return host, int(port)
