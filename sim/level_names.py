"""Names of many levels in one: `0-6` are seven levels, `house:0-99:50-200` a hundred houses of different sizes.

Pure: nothing is loaded here. What is no range is passed on as it is, for `load_level` to judge.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from imagine.core.errors import InputError
from imagine.sim.generator import AREA_M2, PREFIX, is_generated
from imagine.sim.level_variants import level_shares
from imagine.sim.map_image import IMAGE_SUFFIXES

MOST_LEVELS = 1000
"""A range names at most so many levels: each is built when it is loaded, and kept."""
_MOST_SEED = 2**63 - 1
_FIBONACCI = (
    0x9E3779B97F4A7C15  # 2^64 over the golden ratio: multiples of it fill a range most evenly (Knuth 1973, 6.4)
)
_RANGE = re.compile(r"(\d+)-(\d+)", re.ASCII)
_AREAS = re.compile(r"(\d+(?:\.\d*)?)-(\d+(?:\.\d*)?)", re.ASCII)


def expand_level(name: str, where: str = "levels") -> tuple[str, ...]:
    """Return the names that `load_level` knows of a name that may be a range; of one that is none, itself.

    `FIRST-LAST` are built-in levels, `house:FIRST-LAST` the houses of these seeds, both ends included. Behind that may
    stand one floor area in m² for all, or LOW-HIGH: then each house has an area of its own, see `house_area`. Raises
    InputError, which begins with `where`, on an empty or a too long range and on areas that no house has.
    """
    if not is_generated(name):
        return tuple(map(str, _numbers(name, name, where, "", ""))) if _RANGE.fullmatch(name) else (name,)
    seeds, colon, area = name.removeprefix(PREFIX).partition(":")
    if "-" not in seeds + area:
        return (name,)
    areas = _AREAS.fullmatch(area)
    if not re.fullmatch(r"[0-9]+(-[0-9]+)?", seeds) or ("-" in area and not areas):
        raise InputError(
            f"{where} {name}: expected house:SEED or house:FIRST-LAST, and behind it an area or a range of areas, "
            "such as house:7:120 or house:0-99:50-200"
        )
    numbers = _numbers(seeds if "-" in seeds else f"{seeds}-{seeds}", name, where, PREFIX, colon + area)
    if not areas:
        return tuple(f"{PREFIX}{number}{colon}{area}" for number in numbers)
    low, high = float(areas[1]), float(areas[2])
    if not AREA_M2[0] <= low <= high <= AREA_M2[1]:
        raise InputError(
            f"{where} {name}: the areas {area} m² are not within {AREA_M2[0]:g} to {AREA_M2[1]:g}, smallest first"
        )
    return tuple(f"{PREFIX}{number}:{house_area(number, (low, high)):g}" for number in numbers)


def house_area(seed: int, area_m2: tuple[float, float]) -> float:
    """Return the floor area, m² to a decimetre², of the house of a seed where areas are spread over a range.

    It depends on seed and range alone, so a longer range of seeds begins with the same houses. Seeds in a row are
    spread evenly: any n of them leave no gap much wider than an nth of the range.
    """
    low, high = area_m2
    share = seed * _FIBONACCI % 2**64 / 2**64
    return round(low + (high - low) * share, 1)


def expand_levels(
    names: Sequence[str], weights: Sequence[float] | None = None, where: str = "levels"
) -> tuple[tuple[str, ...], tuple[float, ...]]:
    """Return the levels that names stand for, and each one's share of the episodes; the shares add up to 1.

    There is one weight for each of `names` (None: all alike), and what a range stands for shares its weight equally.
    Raises InputError where a name is wrong, or weights do not fit.
    """
    expanded: list[str] = []
    shares: list[float] = []
    for name, share in zip(names, level_shares(weights, len(names)).tolist(), strict=True):
        levels = expand_level(name, where)
        expanded += levels
        shares += [share / len(levels)] * len(levels)
    return tuple(expanded), tuple(shares)


def reported_name(name: str) -> str:
    """Return what a level of this name (no range) calls itself, as `EpisodeMetrics.level` has it.

    Built-in and generated levels are called as they are asked for, those of files by the file's name without suffix.
    """
    if is_generated(name):
        return name
    file, at, _ = name.rpartition("@")
    return Path(file if at and Path(file).suffix.lower() in IMAGE_SUFFIXES else name).stem


def level_family(name: str) -> str:
    """Return what a level is counted under where figures are told by level: itself, or `houses` for generated ones."""
    return "houses" if is_generated(name) else name


def _numbers(text: str, name: str, where: str, before: str, behind: str) -> range:
    """Return the numbers of FIRST-LAST, ends included."""
    first, last = map(int, text.split("-"))
    if last < first:
        raise InputError(f"{where} {name}: the range is empty; write {before}{last}-{first}{behind}")
    if last - first >= MOST_LEVELS:
        raise InputError(f"{where} {name}: more than {MOST_LEVELS} levels; take a shorter range")
    if last > _MOST_SEED:
        raise InputError(f"{where} {name}: numbers go to {_MOST_SEED}")
    return range(first, last + 1)
