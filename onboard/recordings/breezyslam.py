"""BreezySLAM's example logs: a Hokuyo URG-04LX on a wheeled robot of Mines ParisTech.

A line is blank-separated: stamp (microseconds), motor temperature, two wheel encoders, 20 fields not used here, then
682 ranges in millimetres, counter-clockwise over 240°. Values under 20 are the sensor's error codes. The encoders are
not used: without the robot's measured geometry they would be a guess, not a yaw prior.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from imagine.core.errors import InputError
from imagine.core.lidar import LidarSpec, Scan
from imagine.onboard.recordings.lines import Line, numbers, read_lines, require_whole
from imagine.onboard.recordings.record import Record, Recording, rate_hz

NAME = "BreezySLAM log"
_BEFORE_RANGES = 24
_BEAMS = 682
_FIELDS = _BEFORE_RANGES + _BEAMS
_INCREMENT = 2.0 * math.pi / 1024.0
"""The URG-04LX divides a turn into 1024 steps and looks ahead at step 384; its first range is step 44."""
_FIRST_ERROR_FREE_MM = 20.0


def recognise(head: list[Line]) -> bool:
    """Tell whether the first line is a BreezySLAM log's: hundreds of numbers between blanks."""
    if not head:
        return False
    tokens = head[0].text.split()
    return (
        len(tokens) > _BEFORE_RANGES and "," not in head[0].text and all(t.lstrip("-").isdecimal() for t in tokens[:4])
    )


def load(path: Path) -> Recording:
    """Read a BreezySLAM log: scans only."""
    records = tuple(_record(line) for line in read_lines(path) if line.text.strip())
    rate = rate_hz([record.scan.stamp for record in records], str(path))
    spec = LidarSpec(
        _BEAMS,
        fov=_BEAMS * _INCREMENT,
        range_min=0.02,
        range_max=5.6,
        rate_hz=rate,
        start=(44 - 384) * _INCREMENT,
    )
    return Recording(path, NAME, spec, records)


def _record(line: Line) -> Record:
    require_whole(line)
    tokens = line.text.split()
    if len(tokens) not in (_FIELDS, _FIELDS + 1):
        raise InputError(
            f"{line.where}: {len(tokens)} fields, expected {_FIELDS} (stamp, 23 fields, {_BEAMS} ranges): "
            "cut short or damaged"
        )
    values = numbers(tokens, line)
    millimetres = values[_BEFORE_RANGES:_FIELDS]
    if (millimetres < 0.0).any():
        raise InputError(f"{line.where}: a range is negative")
    ranges = (millimetres / 1000.0).astype(np.float32)
    ranges[millimetres < _FIRST_ERROR_FREE_MM] = np.nan
    return Record(Scan(float(values[0]) * 1e-6, ranges))
