"""Under which name the episodes of a level are counted: few names, however many levels there are."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

from imagine.sim.generator import is_generated
from imagine.sim.level import BUILT_IN
from imagine.sim.map_image import IMAGE_SUFFIXES

MOST_FILES = 12
"""Files that keep names of their own; a run on more of them counts all files as one group."""
HOUSES, FILES = "house", "files"
_SUFFIXES = (".yaml", ".yml", ".json", *IMAGE_SUFFIXES)


class LevelGroups:
    """Built-in levels are counted by their number, generated houses as `house`, files by their stem.

    `levels` are the names of all levels of the run, as settings give them: with more than MOST_FILES files among them
    every file is counted as `files`, so that a run on hundreds of floor plans has few groups too.
    """

    def __init__(self, levels: Iterable[str] = ()) -> None:
        self._together = len({level for level in levels if _is_file(level)}) > MOST_FILES

    def __call__(self, level: str) -> str:
        """Return the group of a level, by its name in the settings or, where files are stems, in an episode."""
        if is_generated(level):
            return HOUSES
        if level in BUILT_IN:
            return level
        return FILES if self._together else re.sub(r"[^\w.-]", "_", _stem(level))


def _is_file(level: str) -> bool:
    return not is_generated(level) and _stem(level) != level


def _stem(level: str) -> str:
    """Return a file's name without folder, suffix and scale; any other name as it is."""
    file, at, _ = level.rpartition("@")
    path = Path(file if at else level)
    return path.stem if path.suffix.lower() in _SUFFIXES else level
