"""CARMEN logs (`FLASER`, `ODOM`), as the Radish data sets and gmapping's corrected logs have them.

Ranges in metres; beam i at -90° + i·(180°/n), counter-clockwise. A range of 80 m or more is no return, 0 is invalid.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from imagine.core.errors import InputError
from imagine.core.frames import Pose, wrap_angle
from imagine.core.lidar import LidarSpec, Scan
from imagine.onboard.recordings.lines import Line, numbers, read_lines
from imagine.onboard.recordings.record import Record, Recording, rate_hz

NAME = "CARMEN log"
_NO_RETURN_M = 80.0
_KEYWORDS = frozenset({"PARAM", "SYNC", "ODOM", "FLASER", "RLASER", "NEFF", "TRUEPOS"})
_AFTER_RANGES = 9
"""Fields after the ranges: x y theta, odom_x odom_y odom_theta, stamp, host, stamp."""


def recognise(head: list[Line]) -> bool:
    """Tell whether the first lines are a CARMEN log's."""
    for line in head:
        tokens = line.text.split()
        if tokens and not tokens[0].startswith("#"):
            return tokens[0] in _KEYWORDS
    return any("message formats defined" in line.text for line in head)


def load(path: Path) -> Recording:
    """Read a CARMEN log: scans, raw wheel-odometry yaw, and the corrected pose of each scan as the reference."""
    wheels = WheelYaw()
    records: list[Record] = []
    for line in read_lines(path):
        tokens = line.text.split()
        if not tokens:
            continue
        if tokens[0] == "ODOM":
            wheels.add(line, tokens)
        elif tokens[0] == "FLASER":
            record = _record(line, tokens, wheels.yaw)
            if records and len(record.scan.ranges) != len(records[0].scan.ranges):
                raise InputError(
                    f"{line.where}: {len(record.scan.ranges)} ranges, but the first scan has "
                    f"{len(records[0].scan.ranges)}"
                )
            records.append(record)
    rate = rate_hz([record.scan.stamp for record in records], str(path))
    beams = len(records[0].scan.ranges)
    spec = LidarSpec(beams, fov=math.pi, range_min=0.02, range_max=_NO_RETURN_M, rate_hz=rate, start=-math.pi / 2.0)
    return Recording(path, NAME, spec, tuple(records))


def _record(line: Line, tokens: list[str], yaw: float | None) -> Record:
    beams = int(tokens[1]) if len(tokens) > 1 and tokens[1].isdecimal() else 0
    if beams < 1 or len(tokens) != 2 + beams + _AFTER_RANGES:
        raise InputError(
            f"{line.where}: this FLASER line is cut short or damaged: {len(tokens)} fields, "
            f"expected {2 + beams + _AFTER_RANGES if beams else 'a number of ranges, then as many ranges'}"
        )
    metres = numbers(tokens[2 : 2 + beams], line)
    if (metres < 0.0).any():
        raise InputError(f"{line.where}: a range is negative")
    ranges = metres.astype(np.float32)
    ranges[metres == 0.0] = np.nan
    ranges[metres >= _NO_RETURN_M] = np.inf
    x, y, theta = numbers(tokens[2 + beams : 5 + beams], line)
    (stamp,) = numbers(tokens[8 + beams : 9 + beams], line)
    return Record(Scan(float(stamp), ranges), yaw, Pose(float(x), float(y), wrap_angle(float(theta))))


class WheelYaw:
    """The yaw of the wheels alone, summed from the increments between `ODOM` lines.

    gmapping's corrected logs restart the odometry at the corrected pose after each scan, by an `ODOM` line with stamp
    0. The step to such a line is the map builder's correction, not a motion: summing it would let the reference in.
    """

    def __init__(self) -> None:
        """Start without a yaw: the first line only sets the origin."""
        self.yaw: float | None = None
        self._last = 0.0

    def add(self, line: Line, tokens: list[str]) -> None:
        """Take one `ODOM x y theta v w accel stamp host stamp` line."""
        if len(tokens) != 10:
            raise InputError(f"{line.where}: this ODOM line has {len(tokens)} fields, expected 10")
        theta = float(numbers(tokens[3:4], line)[0])
        stamp = float(numbers(tokens[7:8], line)[0])
        if self.yaw is None:
            self.yaw = theta
        elif stamp != 0.0:
            self.yaw += wrap_angle(theta - self._last)
        self._last = theta
