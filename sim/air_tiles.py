"""Kernels on the cells of a single tile, in 8 bits and without branches, so that a row of a tile is one vector."""

from __future__ import annotations

import numba
import numpy as np

from imagine.core.raster import LIMIT, TILE

_LOWEST, _HIGHEST = np.int8(-LIMIT), np.int8(LIMIT)


@numba.njit(cache=True, nogil=True)
def draw_marks(cells, known, marks, row0, rows, column0, mark_row0, mark_column0):  # type: ignore[no-untyped-def]
    """Add marks (int8) to one tile's width of cells, as many rows as given, in place.

    Returns whether any cell changed, and how many are known for the first time: those that are marked for the first
    time, since until then no source has evidence of them. `known` int8 is 1 where a cell is known.
    """
    changed = np.int8(0)
    fresh = 0
    for i in range(rows):
        row, mark_row = np.uintp(row0 + i), np.uintp(mark_row0 + i)
        row_fresh = np.int8(0)
        for k in range(TILE):
            column = np.uintp(column0 + k)
            mark = marks[mark_row, np.uintp(mark_column0 + k)]
            old, was_known = cells[row, column], known[row, column]
            new = np.int8(max(np.int8(min(np.int8(old + mark), _HIGHEST)), _LOWEST))
            marked = np.int8(mark != 0)
            changed = np.int8(changed | np.int8(new ^ old))
            row_fresh = np.int8(row_fresh + np.int8(marked & ~was_known))
            cells[row, column] = new
            known[row, column] = np.int8(was_known | marked)
        fresh += row_fresh
    return changed != 0, fresh


@numba.njit(cache=True, nogil=True)
def claim_tile(cells, known, i, j):  # type: ignore[no-untyped-def]
    """Mark the cells with evidence in tile (i, j) of a layer as known; return how many were not before."""
    fresh = 0
    for k in range(TILE):
        row = np.uintp(i * TILE + k)
        row_fresh = np.int8(0)
        for m in range(TILE):
            column = np.uintp(j * TILE + m)
            has_evidence, was_known = np.int8(cells[row, column] != 0), known[row, column]
            row_fresh = np.int8(row_fresh + np.int8(has_evidence & ~was_known))
            known[row, column] = np.int8(was_known | has_evidence)
        fresh += row_fresh
    return fresh


@numba.njit(cache=True, nogil=True)
def copy_tile(source, row0, column0, target, target_row0, target_column0):  # type: ignore[no-untyped-def]
    """Copy a tile of cells from one place to another."""
    for k in range(TILE):
        row, target_row = np.uintp(row0 + k), np.uintp(target_row0 + k)
        for m in range(TILE):
            target[target_row, np.uintp(target_column0 + m)] = source[row, np.uintp(column0 + m)]


@numba.njit(cache=True, nogil=True)
def align_marks(marks, aligned, offset):  # type: ignore[no-untyped-def]
    """Copy `marks` (int8 `[rows, n]`) to `aligned` (`[rows, whole tiles]`) from column `offset` on, zeros around.

    Three copies of a fixed length that may overlap are faster than one of any length.
    """
    rows, width = marks.shape
    for i in range(rows):
        row = np.uintp(i)
        for k in range(aligned.shape[1]):
            aligned[row, np.uintp(k)] = 0
        if width < TILE:
            for k in range(width):
                aligned[row, np.uintp(offset + k)] = marks[row, np.uintp(k)]
        else:
            for first in range(0, width, TILE):
                begin = min(first, width - TILE)
                for k in range(TILE):
                    aligned[row, np.uintp(offset + begin + k)] = marks[row, np.uintp(begin + k)]
