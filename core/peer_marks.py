"""Numba kernels that write what peers send into their layers: scans without teammates, ahead of tiles, and tiles."""

from __future__ import annotations

import math

import numba
import numpy as np

from imagine.core.raster import LIMIT, TILE, add_marks


@numba.njit(cache=True, nogil=True)
def add_marks_ahead(cells, versions, provisional, clock, marks, row0, column0):  # type: ignore[no-untyped-def]
    """Add marks to `cells` as `raster.apply_marks` does, but on tiles of a version before `clock` only; count changes.

    `versions` (uint32) and `provisional` (bool) `[rows // TILE, columns // TILE]`; tiles that change turn provisional.
    """
    tile_rows, tile_columns = versions.shape
    changed = 0
    for tile_row in range(max(0, row0 // TILE), min(tile_rows, (row0 + marks.shape[0] - 1) // TILE + 1)):
        first, last = max(row0, tile_row * TILE), min(row0 + marks.shape[0], (tile_row + 1) * TILE)
        for j in range(marks.shape[1] // TILE):
            tile_column = column0 // TILE + j
            if not 0 <= tile_column < tile_columns or np.int64(versions[tile_row, tile_column]) >= clock:
                continue
            differing = add_marks(cells, first, last, tile_column * TILE, marks, first - row0, j * TILE)
            if differing > 0:
                provisional[tile_row, tile_column] = True
                changed += differing
    return changed


@numba.njit(cache=True, nogil=True)
def write_tile(cells, versions, provisional, row, column, version, tile):  # type: ignore[no-untyped-def]
    """Write `tile` (int8 `[TILE, TILE]`) at a tile's place if `version` is newer than what is held there.

    Return 1 if it was written, 0 if it is no news, -1 if it holds cells beyond +-LIMIT; then nothing is written.
    """
    beyond = False
    for i in range(TILE):
        for j in range(TILE):
            beyond |= (tile[i, j] > LIMIT) | (tile[i, j] < -LIMIT)
    if beyond:
        return -1
    if version <= np.int64(versions[row, column]):
        return 0
    for i in range(TILE):
        for j in range(TILE):
            cells[np.uint64(row * TILE + i), np.uint64(column * TILE + j)] = tile[i, j]
    versions[row, column] = version
    provisional[row, column] = False
    return 1


@numba.njit(cache=True, nogil=True)
def mask_targets(ranges, start, increment, range_max, pose, targets, radius):  # type: ignore[no-untyped-def]
    """Return `ranges` (float32 `[beams]`, metres) without returns on `targets`, as `lidar.mask_near` does, in one pass.

    Beam i looks along `start + i increment` off the heading of `pose` (metres, radians); `targets` float64 `[n, 2]`.
    """
    x, y, yaw = pose
    out = ranges.copy()
    for k in range(len(targets)):
        east, north = targets[k, 0] - x, targets[k, 1] - y
        away = math.hypot(east, north)
        if away > range_max + radius:
            continue
        for beam in range(len(ranges)):
            measured = np.float64(ranges[beam])
            if abs(measured - away) < radius + 1e-3:  # only a return about as far away can be on it
                bearing = start + yaw + beam * increment
                off_x, off_y = measured * math.cos(bearing) - east, measured * math.sin(bearing) - north
                if off_x * off_x + off_y * off_y < radius * radius:
                    out[beam] = np.nan
    return out
