"""What the lists of `imagine evaluate` mean: levels, team sizes, protocols, policies."""

from __future__ import annotations

import glob
import re
from collections.abc import Sequence
from pathlib import Path
from typing import cast, get_args

import numpy as np

from imagine.core.errors import InputError
from imagine.core.raster import CELL
from imagine.mesh_comm.settings import Protocol
from imagine.sim.level import load_level
from imagine.sim.level_names import expand_level

_PLANS = (".json", ".yaml", ".yml")
"""Files of a folder that are levels; an image needs its metres a pixel, and is named by itself."""


def level_list(text: str) -> list[str]:
    """Return the levels of a list such as 4, 0-6 or 1,3,house.yaml, each once; house:0-9:120 are ten houses.

    A folder stands for the level files in it, a pattern such as plans/*.json for the files it fits, in the order of
    their names. Raises InputError on an empty range, folder or pattern, and where a name is missing.
    """
    levels: list[str] = []
    for part in (part.strip() for part in text.split(",")):
        if not part:
            raise InputError(f"--levels {text!r}: a level is missing: give such as 4, 0-6 or 1,3,house.yaml")
        levels += _files_of(part) or expand_level(part, "--levels")
    return list(dict.fromkeys(levels))


def _files_of(part: str) -> list[str]:
    path = Path(part)
    if path.is_dir():
        found = sorted(str(file) for file in path.iterdir() if file.suffix.lower() in _PLANS)
        if not found:
            raise InputError(f"--levels {part}: the folder holds no levels: {', '.join(_PLANS)} files")
        return found
    if path.exists() or not re.search(r"[*?\[]", part):
        return []
    found = sorted(file for file in glob.glob(part, recursive=True) if Path(file).is_file())
    if not found:
        raise InputError(f"--levels {part}: no file fits this pattern")
    return found


def within_area(levels: Sequence[str], most_m2: float | None) -> list[str]:
    """Return the levels with at most so many square metres of free space; all of them where it is None.

    Raises InputError where a level cannot be loaded, or none is left.
    """
    if most_m2 is None:
        return list(levels)
    areas = [float(np.count_nonzero(load_level(name).free) * CELL**2) for name in levels]
    kept = [name for name, area in zip(levels, areas, strict=True) if area <= most_m2]
    if not kept:
        raise InputError(f"--max-area {most_m2:g}: all levels are larger; the smallest has {min(areas):.0f} m²")
    return kept


def team_sizes(text: str) -> list[int]:
    """Return the numbers of a list such as 3 or 1,2,3, each once. Raises InputError past 1 to 16."""
    try:
        numbers = [int(part) for part in text.split(",")]
    except ValueError as error:
        raise InputError(f"--drones {text}: expected whole numbers such as 3 or 1,2,3") from error
    if not all(1 <= number <= 16 for number in numbers):
        raise InputError(f"--drones {text}: from 1 to 16 drones")
    return list(dict.fromkeys(numbers))


def protocol_list(text: str) -> list[Protocol]:
    """Return the protocols of a list such as off,one-hop, each once. Raises InputError where one is unknown."""
    known = get_args(Protocol)
    names = [part.strip() for part in text.split(",")]
    for name in names:
        if name not in known:
            raise InputError(f"--protocol {name}: expected {', '.join(known)}")
    return [cast(Protocol, name) for name in dict.fromkeys(names)]


def policy_list(given: Sequence[str]) -> list[str]:
    """Return the policies of several flags, each of which may hold several with commas between.

    A file whose own name holds a comma is taken as one. Raises InputError where a name is missing.
    """
    names: list[str] = []
    for text in given:
        names += [text] if Path(text).exists() else [part.strip() for part in text.split(",")]
    if not all(names):
        raise InputError(f"--policy {','.join(given)!r}: a policy is missing: give a file, or a baseline's name")
    return names
