"""What every recording becomes, whatever format it came in."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from imagine.core.errors import InputError
from imagine.core.frames import Pose
from imagine.core.lidar import LidarSpec, Scan


class Record(NamedTuple):
    """One scan, and what the file says beside it.

    `yaw_prior` is the yaw of wheels or gyro, radians counter-clockwise, from any origin, drifting; `reference` the pose
    somebody else worked out (metres, radians, any frame), only ever used to judge.
    """

    scan: Scan
    yaw_prior: float | None = None
    reference: Pose | None = None


@dataclass(frozen=True)
class Recording:
    """A recording read whole: the sensor as the file describes it, and its records in order of time."""

    path: Path
    format: str
    spec: LidarSpec
    records: tuple[Record, ...]


def rate_hz(stamps: list[float], where: str) -> float:
    """Return the scan rate, from the median time between stamps (seconds). Raises InputError without two scans."""
    if len(stamps) < 2:
        raise InputError(f"{where}: holds {len(stamps)} scan(s); odometry needs at least two")
    period = float(np.median(np.diff(stamps)))
    if not period > 0.0:
        raise InputError(f"{where}: the stamps of its scans do not advance")
    return 1.0 / period
