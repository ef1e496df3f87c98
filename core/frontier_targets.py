"""What a drone can choose from: its frontiers in clusters, the way to each, and what each may show.

All grids are padded planning grids as in `imagine.core.frontier`, of the drone's own belief; cells are flat indices.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from imagine.core.frontier import OCCUPIED, PAD, PLAN_CELL, UNKNOWN
from imagine.core.frontier_paths import BLOCKED, FAR, FRONTIER, OPEN, settle

MOST_TARGETS = 96
"""Clusters that are considered; what lies beyond, in the order of the grid, waits until others are gone."""
GAIN_RAYS = 64
GAIN_MARGIN = 40
"""Cells around a grid that gain reaches into at most."""


@numba.njit(cache=True, nogil=True)
def nearest_open(kinds, row, column, rings):  # type: ignore[no-untyped-def]
    """Return the flat cell that can be flown in nearest to (row, column), at most `rings` away; -1 where none is."""
    rows, columns = kinds.shape
    best, best_square = -1, 1 << 30
    for ring in range(rings + 1):
        if ring * ring > best_square:
            break
        for i in range(max(PAD, row - ring), min(rows - PAD, row + ring + 1)):
            on_edge = abs(i - row) == ring
            step = 1 if on_edge or ring == 0 else 2 * ring
            for j in range(column - ring, column + ring + 1, step):
                if PAD <= j < columns - PAD and kinds[i, j] & OPEN:
                    square = (i - row) * (i - row) + (j - column) * (j - column)
                    if square < best_square:
                        best, best_square = i * columns + j, square
    return best


@numba.njit(cache=True, nogil=True)
def fill_ways(cost, kinds, start, scratch):  # type: ignore[no-untyped-def]
    """Fill `cost` (int16, padded, see `FrontierField`) with the cheapest ways from the flat cell `start`."""
    flat, flat_kinds = cost.ravel(), kinds.ravel()
    for cell in range(flat.shape[0]):
        flat[cell] = FAR if flat_kinds[cell] & OPEN else BLOCKED
    heads, entry_cell, entry_next = scratch
    flat[start] = 0
    entry_cell[0], entry_next[0], heads[0] = start, -1, 0
    settle(flat, flat_kinds, np.uint32(cost.shape[1]), 0, 1, scratch)


@numba.njit(cache=True, nogil=True)
def find_targets(targets, kinds, cost, banned, radius, marks, queue):  # type: ignore[no-untyped-def]
    """Write the representative cells of frontier clusters to `targets` (int32 `[n]`); return how many there are.

    A cluster is connected (8 neighbours), reached by `cost`, and within `radius` cells of its first cell. Its
    representative is the member nearest to the mean of all. Cells within 2 of a `banned` one (flat, -1 for none) are
    left out. `marks` (uint8, flat) is all 0 and is left so; `queue` int32 `[cells]`.
    """
    rows, columns = kinds.shape
    found, listed = 0, 0
    for row in range(PAD, rows - PAD):
        for column in range(PAD, columns - PAD):
            cell = row * columns + column
            if not kinds[row, column] & FRONTIER or marks[cell] or not 0 <= cost[row, column] < FAR:
                continue
            if _is_banned(banned, row, column, columns):
                continue
            first = listed
            marks[cell] = 1
            queue[listed] = cell
            listed += 1
            at, sum_row, sum_column = first, 0, 0
            while at < listed:
                here = queue[at]
                at += 1
                i, j = here // columns, here % columns
                sum_row, sum_column = sum_row + i, sum_column + j
                for k in range(max(i - 1, row - radius), min(i + 2, row + radius + 1)):
                    for m in range(max(j - 1, column - radius), min(j + 2, column + radius + 1)):
                        other = k * columns + m
                        if (
                            kinds[k, m] & FRONTIER
                            and not marks[other]
                            and 0 <= cost[k, m] < FAR
                            and not _is_banned(banned, k, m, columns)
                        ):
                            marks[other] = 1
                            queue[listed] = other
                            listed += 1
            best, best_square, size = queue[first], np.int64(1) << 62, listed - first
            for k in range(first, listed):  # in whole numbers: a tie must not hang on where the grid begins
                d_row = size * (queue[k] // columns) - sum_row
                d_column = size * (queue[k] % columns) - sum_column
                square = d_row * d_row + d_column * d_column
                if square < best_square:
                    best, best_square = queue[k], square
            if found < targets.shape[0]:
                targets[found] = best
                found += 1
    for k in range(listed):
        marks[queue[k]] = 0
    return found


@numba.njit(cache=True, nogil=True)
def _is_banned(banned, row, column, columns):  # type: ignore[no-untyped-def]
    for k in range(banned.shape[0]):
        if banned[k] >= 0 and abs(banned[k] // columns - row) <= 2 and abs(banned[k] % columns - column) <= 2:
            return True
    return False


def gain_rays(count: int = GAIN_RAYS) -> NDArray[np.float64]:
    """Return the directions that gain is looked for in, float64 `[count, 2]` (rows, columns a planning cell)."""
    bearing = (np.arange(count) + 0.5) * (2.0 * math.pi / count)
    return np.column_stack((np.sin(bearing), np.cos(bearing)))


def gain_canvas(rows: int, columns: int) -> NDArray[np.float32]:
    """Return a canvas for how much of each cell nobody else is taken to see, GAIN_MARGIN wider than the padded grid."""
    return np.ones((rows + 2 * GAIN_MARGIN, columns + 2 * GAIN_MARGIN), np.float32)


@numba.njit(cache=True, nogil=True)
def expected_gain(states, left, cell, reach, rays, stride=1):  # type: ignore[no-untyped-def]
    """Return the unknown share of the disc of `reach` planning cells around a flat cell that no obstacle hides.

    Every `stride`-th cell of a ray is looked at. `left` is a `gain_canvas`. What is unknown hides nothing: an upper
    bound, as for a next best view (Gonzalez-Banos and Latombe 2002). Beyond the grid all is unknown, so that it does
    not matter how much of the world a grid holds.
    """
    rows, columns = states.shape
    row0, column0 = cell // columns + 0.5, cell % columns + 0.5
    unknown, total = 0.0, 0.0
    for step in range(stride, reach + 1, stride):
        total += step
    for ray in range(rays.shape[0]):
        for step in range(stride, reach + 1, stride):
            i, j = math.floor(row0 + step * rays[ray, 0]), math.floor(column0 + step * rays[ray, 1])
            state = states[i, j] if 0 <= i < rows and 0 <= j < columns else UNKNOWN
            if state == OCCUPIED:
                break
            if state == UNKNOWN:
                unknown += step * left[i + GAIN_MARGIN, j + GAIN_MARGIN]
    return unknown / (rays.shape[0] * total)


@numba.njit(cache=True, nogil=True)
def claim(left, states, cell, reach, rays, share):  # type: ignore[no-untyped-def]
    """Take off `left` what is expected to be seen from a flat cell: `share` of what is near, nothing at `reach`."""
    rows, columns = states.shape
    row0, column0 = cell // columns + 0.5, cell % columns + 0.5
    for ray in range(rays.shape[0]):
        for step in range(reach):
            i, j = math.floor(row0 + step * rays[ray, 0]), math.floor(column0 + step * rays[ray, 1])
            if 0 <= i < rows and 0 <= j < columns and states[i, j] == OCCUPIED:
                break
            at, kept = (i + GAIN_MARGIN, j + GAIN_MARGIN), np.float32(1.0 - share * (1.0 - step / reach))
            left[at] = min(left[at], kept)


@numba.njit(cache=True, nogil=True)
def distance_m(first, second, columns):  # type: ignore[no-untyped-def]
    """Return the straight distance between two flat cells, metres."""
    d_row, d_column = first // columns - second // columns, first % columns - second % columns
    return PLAN_CELL * math.sqrt(np.float64(d_row * d_row + d_column * d_column))
