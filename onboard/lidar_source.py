"""The port through which scans reach a runner, whatever sensor or twin they come from."""

from __future__ import annotations

from typing import Protocol

from imagine.core.lidar import LidarSpec, Scan


class LidarSource(Protocol):
    """Anything that gives scans in order of time: a UDP socket, a driver, a recording."""

    @property
    def spec(self) -> LidarSpec:
        """The sensor whose scans these are."""
        ...

    def read(self, timeout_s: float) -> Scan | None:
        """Return the next scan, waiting at most `timeout_s` seconds; None when none came."""
        ...

    def close(self) -> None:
        """Release the source; reading after it raises."""
        ...
