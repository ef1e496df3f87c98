"""Distance to the nearest frontier through known free space: the field that planner and policy both read.

A frontier is known free space beside unknown space (Yamauchi 1997). The field lives on a 0.2 m planning grid, two
cells of the map to a side: a quarter of the work, and still two free cells in the narrowest passage a drone may use.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from imagine.core.raster import CELL

PLAN_CELL = 2 * CELL
"""Side of a planning cell, metres."""
UNKNOWN, FREE, OCCUPIED = 0, 1, 2

_STRAIGHT, _DIAGONAL = 10, 14  # edge lengths in fiftieths of a metre: 0.20 m and 0.28 m
_UNITS_PER_M = 50.0
_NEAR_WALL_COST = 3  # beside an obstacle a metre costs three: paths keep clear of walls where there is room
_BUCKETS = 64  # above the longest edge, 3 * 14
_FAR = 2**30
_GAP = 3  # free, but too narrow to fly through


@dataclass(frozen=True)
class FrontierField:
    """Frontier distances and cell states on the planning grid, `[rows, columns]`.

    `distance`: float32 metres along the cheapest known path, a metre beside obstacles counting threefold; inf where no
    frontier can be reached. `states`: uint8 UNKNOWN, FREE or OCCUPIED. Row 0, column 0 is the map grid's first cell.
    """

    distance: NDArray[np.float32]
    states: NDArray[np.uint8]


@numba.njit(cache=True, nogil=True)
def plan_states(belief, states):  # type: ignore[no-untyped-def]
    """Reduce a belief (int8 `[2 r, 2 c]`) to planning cells (uint8 `[r, c]`): occupied before free before unknown."""
    rows, columns = states.shape
    for row in range(rows):
        upper, lower = belief[2 * row], belief[2 * row + 1]
        for column in range(columns):
            a, b = upper[2 * column], upper[2 * column + 1]
            c, d = lower[2 * column], lower[2 * column + 1]
            occupied = (a > 0) | (b > 0) | (c > 0) | (d > 0)
            free = (a < 0) | (b < 0) | (c < 0) | (d < 0)
            states[row, column] = OCCUPIED if occupied else (FREE if free else UNKNOWN)


@numba.njit(cache=True, nogil=True)
def _squeezed(padded, cell, width):  # type: ignore[no-untyped-def]
    """Tell whether obstacles lie on two opposite sides of a cell, straight or diagonal."""
    return (
        (padded[cell - 1] == OCCUPIED and padded[cell + 1] == OCCUPIED)
        or (padded[cell - width] == OCCUPIED and padded[cell + width] == OCCUPIED)
        or (padded[cell - width - 1] == OCCUPIED and padded[cell + width + 1] == OCCUPIED)
        or (padded[cell - width + 1] == OCCUPIED and padded[cell + width - 1] == OCCUPIED)
    )


@numba.njit(cache=True, nogil=True)
def _opens(padded, cell, width):  # type: ignore[no-untyped-def]
    """Tell whether a cell is unknown, with unknown beside it and no obstacles on two sides.

    Lone unknown cells, and chinks in what is surely a wall, are not worth a flight.
    """
    if padded[cell] != UNKNOWN or _squeezed(padded, cell, width):
        return False
    return (
        padded[cell - 1] == UNKNOWN
        or padded[cell + 1] == UNKNOWN
        or padded[cell - width - 1] == UNKNOWN
        or padded[cell - width] == UNKNOWN
        or padded[cell - width + 1] == UNKNOWN
        or padded[cell + width - 1] == UNKNOWN
        or padded[cell + width] == UNKNOWN
        or padded[cell + width + 1] == UNKNOWN
    )


@numba.njit(cache=True, nogil=True)
def frontier_distances(states, distance):  # type: ignore[no-untyped-def]
    """Fill `distance` (float32, as `FrontierField.distance`) by Dial's bucket-queue Dijkstra from all frontiers."""
    rows, columns = states.shape
    width = columns + 4  # two cells of unknown all around spare the loops every test for the edge
    size = (rows + 4) * width
    padded = np.zeros(size, dtype=np.uint8)
    weight = np.ones(size, dtype=np.int32)
    cost = np.full(size, _FAR, dtype=np.int32)
    for row in range(rows):
        first = (row + 2) * width + 2
        for column in range(columns):
            state = states[row, column]
            padded[first + column] = state
            if state == OCCUPIED:
                for beside in (-width, 0, width):
                    cell = first + column + beside
                    weight[cell - 1] = weight[cell] = weight[cell + 1] = _NEAR_WALL_COST

    for row in range(rows):  # a cell squeezed between obstacles is a gap of 0.2 m: nothing flies through
        first = (row + 2) * width + 2
        for cell in range(first, first + columns):
            if weight[cell] > 1 and padded[cell] == FREE and _squeezed(padded, cell, width):
                padded[cell] = _GAP

    heads = np.full(_BUCKETS, -1, dtype=np.int32)
    entry_cell = np.empty(9 * size + 1, dtype=np.int32)  # each settled cell relaxes at most 8 edges
    entry_next = np.empty(9 * size + 1, dtype=np.int32)
    entries = 0
    for row in range(rows):
        first = (row + 2) * width + 2
        for cell in range(first, first + columns):
            if padded[cell] == FREE and (
                _opens(padded, cell - 1, width)
                or _opens(padded, cell + 1, width)
                or _opens(padded, cell - width, width)
                or _opens(padded, cell + width, width)
            ):
                cost[cell] = 0
                entry_cell[entries] = cell
                entry_next[entries] = heads[0]
                heads[0] = entries
                entries += 1

    level, queued = 0, entries
    while queued > 0:
        bucket = level % _BUCKETS
        while heads[bucket] >= 0:
            entry = heads[bucket]
            heads[bucket] = entry_next[entry]
            queued -= 1
            cell = entry_cell[entry]
            if cost[cell] != level:
                continue  # a shorter way was found since
            north, south = padded[cell + width] == FREE, padded[cell - width] == FREE
            east, west = padded[cell + 1] == FREE, padded[cell - 1] == FREE
            for way in range(8):
                if way < 4:
                    step = _STRAIGHT
                    if way == 0:
                        other, passable = cell + width, north
                    elif way == 1:
                        other, passable = cell - width, south
                    elif way == 2:
                        other, passable = cell + 1, east
                    else:
                        other, passable = cell - 1, west
                else:  # a diagonal step cuts no corner: both cells beside it must be free
                    step = _DIAGONAL
                    if way == 4:
                        other, passable = cell + width + 1, north and east
                    elif way == 5:
                        other, passable = cell + width - 1, north and west
                    elif way == 6:
                        other, passable = cell - width + 1, south and east
                    else:
                        other, passable = cell - width - 1, south and west
                    passable = passable and padded[other] == FREE
                if not passable:
                    continue
                reached = level + step * max(weight[other], weight[cell])
                if reached < cost[other]:
                    cost[other] = reached
                    target = reached % _BUCKETS
                    entry_cell[entries] = other
                    entry_next[entries] = heads[target]
                    heads[target] = entries
                    entries += 1
                    queued += 1
        level += 1

    per_unit = np.float32(1.0 / _UNITS_PER_M)
    for row in range(rows):
        first = (row + 2) * width + 2
        for column in range(columns):
            c = cost[first + column]
            distance[row, column] = np.float32(np.inf) if c == _FAR else np.float32(c) * per_unit


@numba.njit(cache=True, nogil=True)
def distance_at(distance, column, row):  # type: ignore[no-untyped-def]
    """Return the frontier distance at a planning cell, or the least one within two cells where it has none."""
    rows, columns = distance.shape
    best = np.float32(np.inf)
    for ring in range(3):
        for i in range(max(0, row - ring), min(rows, row + ring + 1)):
            for j in range(max(0, column - ring), min(columns, column + ring + 1)):
                best = min(best, distance[i, j])
        if best < np.inf:
            break
    return best


def frontier_field(belief: NDArray[np.int8]) -> FrontierField:
    """Return the frontier field of a belief (int8 `[rows, columns]`, both even)."""
    rows, columns = belief.shape[0] // 2, belief.shape[1] // 2
    states = np.empty((rows, columns), np.uint8)
    distance = np.empty((rows, columns), np.float32)
    plan_states(belief, states)
    frontier_distances(states, distance)
    return FrontierField(distance, states)


def plan_cell(x: float, y: float, origin_cells: tuple[int, int]) -> tuple[int, int]:
    """Return the planning column and row that hold a point of the map frame, on a grid with this origin in cells."""
    return (
        math.floor(x / PLAN_CELL) - origin_cells[0] // 2,
        math.floor(y / PLAN_CELL) - origin_cells[1] // 2,
    )


def own_distance(field: FrontierField, origin_cells: tuple[int, int], x: float, y: float) -> float:
    """Return the frontier distance of the drone at (x, y), metres; inf where nothing is left to explore."""
    column, row = plan_cell(x, y, origin_cells)
    return float(distance_at(field.distance, column, row))
