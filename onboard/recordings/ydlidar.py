"""YDLIDAR X4 recordings of the Lidar-Dataset collection: a robot's pose change, the time since the last scan, a turn.

A line is comma-separated: two numbers of the robot's own pose change (units not documented, not used), seconds since
the previous scan, then the ranges of one turn in metres, 0 where invalid. The number of beams varies from scan to
scan, so every scan is put on a fixed grid of bearings, the nearest return of those that fall together.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from imagine.core.errors import InputError
from imagine.core.lidar import LidarSpec, Scan
from imagine.onboard.recordings.lines import Line, numbers, read_lines, require_whole
from imagine.onboard.recordings.record import Record, Recording, rate_hz

NAME = "YDLIDAR log"
_BEFORE_RANGES = 3
_BEAMS = 720


def recognise(head: list[Line]) -> bool:
    """Tell whether the first line is comma-separated numbers, at least a few of them."""
    if not head:
        return False
    tokens = head[0].text.split(",")
    try:
        [float(token) for token in tokens[:8]]
    except ValueError:
        return False
    return len(tokens) > 8


def load(path: Path) -> Recording:
    """Read a YDLIDAR log: scans only, each on the same 720 bearings."""
    records: list[Record] = []
    stamp = 0.0
    for line in read_lines(path):
        if not line.text.strip():
            continue
        require_whole(line)
        values = numbers(line.text.split(","), line)
        if len(values) <= _BEFORE_RANGES or (values[_BEFORE_RANGES:] < 0.0).any() or values[2] < 0.0:
            raise InputError(f"{line.where}: expected two numbers, seconds of 0 or more, then ranges of 0 or more")
        stamp += float(values[2]) if records else 0.0
        records.append(Record(Scan(stamp, on_grid(values[_BEFORE_RANGES:], _BEAMS))))
    rate = rate_hz([record.scan.stamp for record in records], str(path))
    return Recording(path, NAME, LidarSpec(_BEAMS, range_min=0.12, range_max=10.0, rate_hz=rate), tuple(records))


def on_grid(ranges: NDArray[np.float64], beams: int) -> NDArray[np.float32]:
    """Put one turn of any number of ranges (metres, 0 invalid) on `beams` bearings: float32 `[beams]`, nan invalid."""
    valid = ranges > 0.0
    bearing = np.flatnonzero(valid) * beams // len(ranges)
    grid = np.full(beams, np.inf)
    np.minimum.at(grid, bearing, ranges[valid])
    grid[np.isinf(grid)] = np.nan
    return grid.astype(np.float32)
