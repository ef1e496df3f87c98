"""Is a level fit to be explored: room to start, nothing hidden for good, people and crates where they can be."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from imagine.core.config import KeyPath
from imagine.core.errors import InputError
from imagine.core.raster import CELL
from imagine.sim.level import Level
from imagine.sim.level_survey import FLIGHT_CLEARANCE_M, LAUNCH_CLEARANCE_M, cell_centres, reachable

LARGEST_M = 200.0
"""The longest side of a level."""
MARGIN_M = 25.0
"""How far a level may reach past 0 and `LARGEST_M`: the twin lays worlds 256 m apart."""
HIDDEN_AREA_M2 = 0.25
"""Smaller free regions that nobody can see into are slivers, and ignored."""
MOST_DRONES = 16
_CORE_CLEARANCE_M = 0.5  # places wider than a metre are rooms, between which passages are measured

Place = Callable[..., str]
"""Names the place of a key, such as ("crates", 0), for an error: file and line, or the level."""


@dataclass(frozen=True)
class HiddenRegion:
    """A free region that drones can neither reach nor see: its area, and a point in it, metres."""

    area_m2: float
    point: tuple[float, float]


def places(where: str, lines: Mapping[KeyPath, int], otherwise: str | None = None) -> Place:
    """Return what names file and line of a key in a YAML file: of the first key given that is there, or else the file.

    A key is a name, or a path such as ("crates", 0), whose nearest line above will do. `otherwise` names the place
    where none of the keys is there.
    """

    def place(*keys: str | KeyPath) -> str:
        for key in keys:
            path = key if isinstance(key, tuple) else (key,)
            for end in range(len(path), 0, -1):
                if path[:end] in lines:
                    return f"{where}:{lines[path[:end]]}"
        return otherwise or where

    return place


def check_extent(points: NDArray[np.float64], where: str) -> None:
    """Raise InputError if points `[n, 2]` are not finite or so far out that they reach into the world beside."""
    wrong = ~((points >= -MARGIN_M) & (points <= LARGEST_M + MARGIN_M)).all(axis=1)
    if wrong.any():
        x, y = points[wrong][0]
        raise InputError(
            f"{where}: a level lies within {-MARGIN_M:g} and {LARGEST_M + MARGIN_M:g} m, not at ({x:g}, {y:g})"
        )


def check_level(level: Level, place: Place) -> Level:
    """Return a level that can be explored. Raises InputError naming place and coordinates of what prevents it."""
    x, y = level.launch
    if not level.is_free(np.array([level.launch]), LAUNCH_CLEARANCE_M)[0]:
        raise InputError(
            f"{place('launch')}: launch {level.launch} is in or within {LAUNCH_CLEARANCE_M} m of a wall: "
            "move it to where there is room"
        )
    hidden = hidden_regions(level)
    if hidden:
        region = hidden[0]
        raise InputError(
            f"{place('outline', 'size_m', 'extends', 'image')}: {region.area_m2:.2f} m² around "
            f"({region.point[0]:.2f}, {region.point[1]:.2f}) can neither be reached from the launch ({x:g}, {y:g}) "
            "nor seen from where drones can fly: open a passage of 0.5 m, or make it solid"
        )
    _check_people(level, place)
    _check_crates(level, place)
    if not len(level.launch_spots):
        raise InputError(
            f"{place('launch')}: no room for a drone around launch ({x:g}, {y:g}): it needs {LAUNCH_CLEARANCE_M} m to "
            "walls, crates and people"
        )
    return level


def hidden_regions(level: Level) -> list[HiddenRegion]:
    """Return the free regions of 0.25 m² or more that nobody can see from where drones can fly, the largest first."""
    labels, count = ndimage.label(level.free & ~level.survey.seen)
    if count == 0:
        return []
    sizes = np.bincount(labels.ravel())[1:]
    regions = []
    for number in np.flatnonzero(sizes * CELL * CELL >= HIDDEN_AREA_M2 - 1e-9) + 1:
        rows, columns = np.nonzero(labels == number)
        centres = cell_centres(rows, columns, level.grid)
        middle = centres[np.argmin(np.hypot(*(centres - centres.mean(axis=0)).T))]
        regions.append(HiddenRegion(float(sizes[number - 1] * CELL * CELL), (float(middle[0]), float(middle[1]))))
    return sorted(regions, key=lambda region: (-region.area_m2, region.point))


def _check_people(level: Level, place: Place) -> None:
    for number, person in enumerate(level.people):
        loop = np.array(person.loop)
        where = place(("people", number))
        check_extent(loop, where)
        for corner, free in zip(loop, level.is_free(loop), strict=True):
            if not free:
                raise InputError(
                    f"{where}: people.{number}: ({corner[0]:g}, {corner[1]:g}) is no place to walk to: "
                    "it lies in a wall or outside"
                )
        for start, end in zip(loop, np.roll(loop, -1, axis=0), strict=True):
            if _blocked(level, start, end):
                raise InputError(
                    f"{where}: people.{number}: there is a wall on the way from ({start[0]:g}, {start[1]:g}) "
                    f"to ({end[0]:g}, {end[1]:g})"
                )


def _blocked(level: Level, start: NDArray[np.float64], end: NDArray[np.float64]) -> bool:
    """Tell whether the straight way between two free points meets an edge or a post."""
    way = end - start
    if not way.any():
        return False
    a, b = level.segments[:, :2] - start, level.segments[:, 2:] - start
    side_a, side_b = way[0] * a[:, 1] - way[1] * a[:, 0], way[0] * b[:, 1] - way[1] * b[:, 0]
    edge = b - a
    side_start = edge[:, 1] * a[:, 0] - edge[:, 0] * a[:, 1]
    side_end = side_start - (edge[:, 1] * way[0] - edge[:, 0] * way[1])
    if ((side_a * side_b <= 0.0) & (side_start * side_end <= 0.0) & ((side_a != 0.0) | (side_b != 0.0))).any():
        return True
    to_posts = level.circles[:, :2] - start
    t = np.clip(to_posts @ way / (way @ way), 0.0, 1.0)
    return bool((np.hypot(*(to_posts - t[:, None] * way).T) < level.circles[:, 2]).any())


def _check_crates(level: Level, place: Place) -> None:
    for number, crate in enumerate(level.crates):
        where = place(("crates", number))
        corners = crate.corners()
        check_extent(corners, where)
        for point in (np.array(crate.center), *corners):
            if not level.is_free(point[None])[0]:
                raise InputError(
                    f"{where}: crates.{number}: ({point[0]:.2f}, {point[1]:.2f}) of the crate lies in a wall or outside"
                )


def room_for(level: Level, most: int = MOST_DRONES) -> int:
    """Return how many drones, `most` at the utmost, can start from a level's launch."""
    for drones in range(most, 0, -1):
        try:
            level.launch_poses(drones)
        except InputError:
            continue
        return drones
    return 0


def narrowest_passage_m(level: Level) -> float | None:
    """Return the width of the narrowest passage between places wider than a metre; None where they are all one.

    Widths are exact to about 0.03 m: they are measured on a lattice of 0.05 m.
    """
    _, clearance = level.geometry.lattice(_CORE_CLEARANCE_M + CELL)
    reached = reachable(clearance, level.grid, level.launch)
    wide = reached & (clearance >= _CORE_CLEARANCE_M)

    def one(keep_m: float) -> bool:
        labels, _ = ndimage.label(reached & (clearance >= keep_m), np.ones((3, 3)))
        return len(np.unique(labels[wide])) <= 1

    if one(_CORE_CLEARANCE_M):
        return None
    low, high = FLIGHT_CLEARANCE_M, _CORE_CLEARANCE_M
    while high - low > 0.002:
        middle = (low + high) / 2.0
        low, high = (middle, high) if one(middle) else (low, middle)
    return 2.0 * low
