"""Which format is this file?"""

from __future__ import annotations

from collections.abc import Callable
from itertools import islice
from pathlib import Path
from typing import NamedTuple

from imagine.core.errors import InputError
from imagine.onboard.recordings import breezyslam, carmen, csv_scans, ydlidar
from imagine.onboard.recordings.lines import Line, read_lines
from imagine.onboard.recordings.record import Recording

_HEAD_LINES = 20


class Format(NamedTuple):
    """A format's name, how to recognise it by a file's first lines, and how to read it."""

    name: str
    recognise: Callable[[list[Line]], bool]
    load: Callable[[Path], Recording]


FORMATS = tuple(
    Format(module.NAME, module.recognise, module.load) for module in (carmen, csv_scans, breezyslam, ydlidar)
)


def open_recording(path: Path) -> Recording:
    """Read a LiDAR recording of any known format, plain or gzip.

    Raises InputError: the file is missing, empty, cut short (naming the line), damaged, or of no known format.
    """
    head = list(islice(read_lines(path), _HEAD_LINES))
    if not any(line.text.strip() for line in head):
        raise InputError(f"{path}: the file is empty")
    for candidate in FORMATS:
        if candidate.recognise(head):
            return candidate.load(path)
    raise InputError(f"{path}: not a LiDAR recording; known formats: {', '.join(f.name for f in FORMATS)}")
