"""Numba kernels that write LiDAR evidence into an int8 log-odds grid.

One kernel serves a single drone on board and, called in a loop over worlds and drones, thousands in the twin.
Grids are row-major `[row = y, column = x]`; cell (row, column) of a grid with origin (column0, row0) covers
`[(column + column0) * CELL, ...)` metres of the map frame.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

CELL = 0.1
"""Side of a cell, metres."""
TILE = 32
"""Side of a tile, cells. Versions are kept, and evidence is exchanged, by tile."""
UNIT_LOG_ODDS = 0.4
"""Log-odds of one int8 unit."""
HIT = 2
MISS = -1
LIMIT = 8
"""Evidence of a hit, of a miss, and the clamp (p = 0.96): cells saturate within a second and follow moving things."""

_UNTOUCHED, _FREE, _HIT = 0, 1, 2


@numba.njit(cache=True, nogil=True)
def _trace(marks, row0, column0, row1, column1):  # type: ignore[no-untyped-def]
    """Mark the cells of a Bresenham line free, its last cell excluded, hits kept."""
    d_row, d_column = abs(row1 - row0), abs(column1 - column0)
    step_row = 1 if row0 < row1 else -1
    step_column = 1 if column0 < column1 else -1
    error = d_column - d_row
    row, column = row0, column0
    while row != row1 or column != column1:
        if marks[row, column] == _UNTOUCHED:
            marks[row, column] = _FREE
        doubled = 2 * error
        if doubled > -d_row:
            error -= d_row
            column += step_column
        if doubled < d_column:
            error += d_column
            row += step_row


@numba.njit(cache=True, nogil=True)
def integrate_scan(  # type: ignore[no-untyped-def]
    cells, touched, column0, row0, x, y, yaw, start, increment, ranges, range_min, range_cap
):
    """Add one scan's evidence to `cells` (int8 `[rows, columns]`), in place; return the number of changed cells.

    Each cell takes at most one update a scan, a hit before a miss, so near cells crossed by many beams are not
    counted many times. Beams run along Bresenham lines and are cut at `range_cap` metres; inf frees the whole
    length, nan is skipped. `touched` (bool `[rows // TILE, columns // TILE]`) is set for tiles where a cell changed.
    Cells outside the grid are left out. Pose in metres and radians; (column0, row0) is the grid's origin in cells.
    """
    rows, columns = cells.shape
    reach = math.ceil(range_cap / CELL) + 1
    side = 2 * reach + 1
    marks = np.zeros((side, side), dtype=np.uint8)
    own_column = math.floor(x / CELL)
    own_row = math.floor(y / CELL)
    corner_column, corner_row = own_column - reach, own_row - reach

    for beam in range(ranges.shape[0]):  # hits first: they win over misses of the same scan
        r = ranges[beam]
        if range_min <= r <= range_cap:
            bearing = yaw + start + beam * increment
            column = math.floor((x + r * math.cos(bearing)) / CELL) - corner_column
            row = math.floor((y + r * math.sin(bearing)) / CELL) - corner_row
            marks[row, column] = _HIT
    for beam in range(ranges.shape[0]):
        r = ranges[beam]
        if not r >= range_min:  # nan, and returns too close to be trusted
            continue
        length = min(r, range_cap)
        bearing = yaw + start + beam * increment
        column = math.floor((x + length * math.cos(bearing)) / CELL) - corner_column
        row = math.floor((y + length * math.sin(bearing)) / CELL) - corner_row
        _trace(marks, reach, reach, row, column)

    changed = 0
    for i in range(max(0, -(corner_row - row0)), min(side, rows - (corner_row - row0))):
        row = i + corner_row - row0
        for j in range(max(0, -(corner_column - column0)), min(side, columns - (corner_column - column0))):
            mark = marks[i, j]
            if mark == _UNTOUCHED:
                continue
            column = j + corner_column - column0
            old = cells[row, column]
            new = min(old + HIT, LIMIT) if mark == _HIT else max(old + MISS, -LIMIT)
            if new != old:
                cells[row, column] = new
                touched[row // TILE, column // TILE] = True
                changed += 1
    return changed


@numba.njit(cache=True, nogil=True)
def sum_layers(layers, out):  # type: ignore[no-untyped-def]
    """Write the clamped sum over sources of `layers` (int8 `[sources, rows, columns]`) into `out` (int8)."""
    sources, rows, columns = layers.shape
    total = np.empty(columns, dtype=np.int16)
    for row in range(rows):  # row by row in int16, which compiles to vector instructions
        for column in range(columns):
            total[column] = layers[0, row, column]
        for source in range(1, sources):
            for column in range(columns):
                total[column] += np.int16(layers[source, row, column])
        for column in range(columns):
            out[row, column] = np.int8(min(max(total[column], np.int16(-LIMIT)), np.int16(LIMIT)))


def probability(log_odds_units: NDArray[np.int8]) -> NDArray[np.float64]:
    """Return the occupancy probability of evidence given in int8 units."""
    return 1.0 / (1.0 + np.exp(-UNIT_LOG_ODDS * log_odds_units.astype(np.float64)))
