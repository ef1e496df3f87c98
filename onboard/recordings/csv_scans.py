"""Scans as comma-separated values under a header line that describes the sensor.

`# angle_min A rad, angle_increment B rad, range_min C m, range_max D m; …`, then per line the stamp in seconds and the
ranges in metres. Ranges of 0 are invalid, ranges beyond range_max no return.
"""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np

from imagine.core.errors import InputError
from imagine.core.lidar import LidarSpec, Scan
from imagine.onboard.recordings.lines import Line, numbers, read_lines, require_whole
from imagine.onboard.recordings.record import Record, Recording, rate_hz

NAME = "scan CSV with an angle_min header"
_KEYS = ("angle_min", "angle_increment", "range_min", "range_max")


def recognise(head: list[Line]) -> bool:
    """Tell whether the first line is the header."""
    return bool(head) and head[0].text.startswith("#") and "angle_min" in head[0].text


def load(path: Path) -> Recording:
    """Read a scan CSV: scans only."""
    lines = read_lines(path)
    header = _header(next(lines))
    records: list[Record] = []
    for line in lines:
        if line.text.strip():
            record = _record(line, header["range_max"])
            if records and len(record.scan.ranges) != len(records[0].scan.ranges):
                raise InputError(
                    f"{line.where}: {len(record.scan.ranges)} ranges, but the first scan has "
                    f"{len(records[0].scan.ranges)}: cut short or damaged"
                )
            records.append(record)
    rate = rate_hz([record.scan.stamp for record in records], str(path))
    beams = len(records[0].scan.ranges)
    spec = LidarSpec(
        beams,
        fov=min(beams * header["angle_increment"], 2.0 * math.pi),
        range_min=header["range_min"],
        range_max=header["range_max"],
        rate_hz=rate,
        start=header["angle_min"],
    )
    return Recording(path, NAME, spec, tuple(records))


def _header(line: Line) -> dict[str, float]:
    require_whole(line)
    found: dict[str, float] = {}
    for key in _KEYS:
        match = re.search(rf"\b{key}\s*[=:]?\s*(-?[0-9.]+(?:[eE][-+]?[0-9]+)?)", line.text)
        if match is None:
            raise InputError(f"{line.where}: the header gives no {key}; it needs {', '.join(_KEYS)}")
        found[key] = float(numbers([match.group(1)], line)[0])
    return found


def _record(line: Line, range_max: float) -> Record:
    require_whole(line)
    values = numbers(line.text.split(","), line)
    if len(values) < 2 or (values[1:] < 0.0).any():
        raise InputError(f"{line.where}: expected a stamp and ranges of 0 or more")
    ranges = values[1:].astype(np.float32)
    ranges[values[1:] == 0.0] = np.nan
    ranges[values[1:] > range_max] = np.inf
    return Record(Scan(float(values[0]), ranges))
