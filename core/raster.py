"""Numba kernels that write LiDAR evidence into an int8 log-odds grid.

One set of kernels serves a single drone on board and, called in a loop over worlds and drones, thousands in the twin.
Grids are row-major `[row = y, column = x]`; cell (row, column) of a grid with origin (column0, row0) covers
`[(column + column0) * CELL, ...)` metres of the map frame.

A scan becomes evidence in two steps: `mark_scan` draws it into a sheet of marks around the drone, one mark a cell, and
`apply_marks` adds the marks to a layer. The twin applies the same marks to the layers of those who hear the scan. A
sheet is some whole tiles wide, since loops over 32 bytes at an even address compile to a few vector instructions.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

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
RANGE_STEP_M = 0.01
"""Ranges are mapped, and sent, to the centimetre: half the reference sensor's noise, and what a peer draws from a
scan it heard is then what the scan's source drew."""

_LARGEST_TABLE_REACH = 64  # cells; beyond it the lines are traced anew, for a table would no longer fit a cache


class RayTable(NamedTuple):
    """The Bresenham lines from one cell to all cells at most `reach` away, as offsets in a sheet of marks.

    `width` is that of the sheet, in cells: whole tiles that hold the reach wherever in a tile the drone is; its rows
    are the `2 reach + 1` around the drone. The line to (row, column) from the drone runs through the drone's own flat
    cell plus `offsets[starts[k] : starts[k + 1]]` (int16), k = (row + reach) (2 reach + 1) + column + reach, its last
    cell left out. Both are empty where the reach is too long for a table.
    """

    reach: int
    width: int
    starts: NDArray[np.int32]
    offsets: NDArray[np.int16]

    @property
    def sheet(self) -> tuple[int, int]:
        """Rows and columns of a sheet of marks."""
        return 2 * self.reach + 1, self.width


@lru_cache(maxsize=8)
def ray_table(range_cap: float) -> RayTable:
    """Return the lines that scans cut at `range_cap` metres are drawn along."""
    reach = math.ceil(range_cap / CELL) + 1
    width = TILE * math.ceil((2 * reach + TILE) / TILE)
    if reach > _LARGEST_TABLE_REACH:
        return RayTable(reach, width, np.empty(0, np.int32), np.empty(0, np.int16))
    return RayTable(reach, width, *_trace_all(reach, width))


@lru_cache(maxsize=32)
def beam_directions(start: float, increment: float, beams: int) -> NDArray[np.float64]:
    """Return cosine and sine of each beam's bearing in the body frame, float64 `[beams, 2]`; read-only."""
    bearing = start + np.arange(beams, dtype=np.float64) * increment
    directions = np.column_stack((np.cos(bearing), np.sin(bearing)))
    directions.flags.writeable = False
    return directions


@numba.njit(cache=True, nogil=True)
def _trace(line, width, row, column):  # type: ignore[no-untyped-def]
    """Write the offsets of the Bresenham line to the cell `row`, `column` away, without the last; count them.

    Bresenham 1965, in its form for all octants.
    """
    d_row, d_column = abs(row), abs(column)
    step_row = 1 if row > 0 else -1
    step_column = 1 if column > 0 else -1
    error = d_column - d_row
    at_row, at_column = 0, 0
    count = 0
    while at_row != row or at_column != column:
        line[count] = at_row * width + at_column
        count += 1
        doubled = 2 * error
        if doubled > -d_row:
            error -= d_row
            at_column += step_column
        if doubled < d_column:
            error += d_column
            at_row += step_row
    return count


@numba.njit(cache=True, nogil=True)
def _trace_all(reach, width):  # type: ignore[no-untyped-def]
    """Return the `starts` and `offsets` of a ray table."""
    ends = 2 * reach + 1
    starts = np.zeros(ends * ends + 1, np.int32)
    offsets = np.empty(ends * ends * reach, np.int16)
    line = np.empty(reach, np.int32)
    total = 0
    for row in range(ends):
        for column in range(ends):
            count = _trace(line, width, row - reach, column - reach)
            for k in range(count):
                offsets[total + k] = line[k]
            total += count
            starts[row * ends + column + 1] = total
    return starts, offsets[:total].copy()


@numba.njit(cache=True, nogil=True, error_model="numpy")
def mark_scan(  # type: ignore[no-untyped-def]
    marks, x, y, yaw, directions, ranges, range_min, range_cap, starts, offsets
):
    """Draw a scan into `marks` (int8, a `RayTable.sheet`): MISS, HIT, or 0 where no beam went.

    Return (row, column), in cells of the map frame, of its first cell; the column is a tile's first. A cell takes one
    mark, a hit before a miss, so near cells crossed by many beams are not counted many times. Beams run along
    Bresenham lines and are cut at `range_cap` metres; inf frees the whole length, nan and what is nearer than
    `range_min` say nothing. Ranges are rounded to RANGE_STEP_M. Pose in metres and radians; `directions` of
    `beam_directions`; `starts` and `offsets` are the ray table's.
    """
    ends, width = marks.shape
    reach = ends // 2
    flat = marks.ravel()
    flat[:] = 0
    own_column, own_row = math.floor(x / CELL), math.floor(y / CELL)
    first_column = (own_column - reach) // TILE * TILE
    first_row = own_row - reach
    own = reach * width + own_column - first_column
    beams = len(ranges)
    # Where the beams end, all at once and without branches, which compiles to vector instructions.
    rows, columns, are_hits = np.empty(beams, np.int32), np.empty(beams, np.int32), np.empty(beams, np.int8)
    cos_yaw, sin_yaw = math.cos(yaw), math.sin(yaw)
    last_step = np.float64(math.floor(range_cap / RANGE_STEP_M + 1e-9))
    for beam in range(beams):
        measured = np.float64(ranges[beam])
        # never rounded past the cap: a hit just inside it must not turn into free space
        step = np.rint(measured / RANGE_STEP_M)
        step = step if step < last_step else last_step
        step = step if step > 1.0 else 1.0
        length = np.float64(np.float32(step * RANGE_STEP_M)) if measured <= range_cap else range_cap
        length = length if measured >= range_min else 0.0  # nan and what is too near say nothing
        cos_beam, sin_beam = directions[beam, 0], directions[beam, 1]
        columns[beam] = np.int32(np.floor((x + length * (cos_yaw * cos_beam - sin_yaw * sin_beam)) / CELL))
        rows[beam] = np.int32(np.floor((y + length * (sin_yaw * cos_beam + cos_yaw * sin_beam)) / CELL))
        are_hits[beam] = np.int8(1 if measured <= range_cap else 0) if measured >= range_min else np.int8(-1)
    hits = np.empty(beams, np.int32)
    hit_count = 0
    line = np.empty(reach if len(starts) == 0 else 0, np.int32)
    last_end = -1
    for beam in range(beams):
        if are_hits[beam] < 0:
            continue
        row, column = rows[beam] - own_row, columns[beam] - own_column
        if are_hits[beam]:
            hits[hit_count] = own + row * width + column
            hit_count += 1
        end = (row + reach) * ends + column + reach
        if end == last_end:
            continue  # along the line of the beam before
        last_end = end
        if len(starts) > 0:
            for k in range(starts[end], starts[end + 1]):
                flat[np.uint32(own + offsets[k])] = MISS
        else:
            for k in range(_trace(line, width, row, column)):
                flat[np.uint32(own + line[k])] = MISS
    for k in range(hit_count):  # last, since they win over misses of the same scan
        flat[np.uint32(hits[k])] = HIT
    return first_row, first_column


@numba.njit(cache=True, nogil=True)
def apply_marks(cells, marks, row0, column0, touched):  # type: ignore[no-untyped-def]
    """Add marks to `cells` (int8 `[rows, columns]`, whole tiles), clamped; return how many cells changed.

    The marks' first cell is (row0, column0) of the grid, the column a tile's first; marks beyond the grid are left
    out. `touched` (bool `[rows // TILE, columns // TILE]`) is set for tiles where a cell changed.
    """
    tile_rows, tile_columns = touched.shape
    changed = 0
    for tile_row in range(max(0, row0 // TILE), min(tile_rows, (row0 + marks.shape[0] - 1) // TILE + 1)):
        first, last = max(row0, tile_row * TILE), min(row0 + marks.shape[0], (tile_row + 1) * TILE)
        for j in range(marks.shape[1] // TILE):
            tile_column = column0 // TILE + j
            if not 0 <= tile_column < tile_columns:
                continue
            differing = add_marks(cells, first, last, tile_column * TILE, marks, first - row0, j * TILE)
            if differing > 0:
                touched[tile_row, tile_column] = True
                changed += differing
    return changed


@numba.njit(cache=True, nogil=True)
def add_marks(cells, first, last, column, marks, mark_row, mark_column):  # type: ignore[no-untyped-def]
    """Add a tile's width of marks to rows first to last of the cells; return how many changed."""
    changed = np.int64(0)
    for i in range(last - first):
        line, mark_line = cells[first + i], marks[mark_row + i]
        differing = np.int8(0)
        # Bytes, conditional expressions and indices without a sign: this compiles to a few vector instructions.
        for j in range(TILE):
            old = line[np.uint64(column + j)]
            new = np.int8(old + mark_line[np.uint64(mark_column + j)])
            new = new if new < np.int8(LIMIT) else np.int8(LIMIT)
            new = new if new > np.int8(-LIMIT) else np.int8(-LIMIT)
            differing = np.int8(differing + np.int8(new != old))
            line[np.uint64(column + j)] = new
        changed += differing
    return changed


def integrate_scan(
    cells: NDArray[np.int8],
    touched: NDArray[np.bool_],
    column0: int,
    row0: int,
    x: float,
    y: float,
    yaw: float,
    start: float,
    increment: float,
    ranges: NDArray[np.float32],
    range_min: float,
    range_cap: float,
) -> int:
    """Add one scan's evidence to `cells` (int8 `[rows, columns]`), in place; return the number of changed cells.

    See `mark_scan` and `apply_marks`; (column0, row0) is the grid's origin in cells of the map frame.
    """
    table = ray_table(range_cap)
    marks = np.empty(table.sheet, np.int8)
    directions = beam_directions(start, increment, len(ranges))
    first_row, first_column = mark_scan(
        marks, x, y, yaw, directions, ranges, range_min, range_cap, table.starts, table.offsets
    )
    return int(apply_marks(cells, marks, first_row - row0, first_column - column0, touched))


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
