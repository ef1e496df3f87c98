"""Kernels on the cells of a single tile, in 8 bits and without branches, so that a row of a tile is one vector."""

from __future__ import annotations

import numba
import numpy as np

from imagine.core.raster import LIMIT, TILE

_TILE_WORDS = TILE // 8
_LOWEST, _HIGHEST = np.int8(-LIMIT), np.int8(LIMIT)


@numba.njit(cache=True, nogil=True)
def draw_marks(cells, marks, row0, rows, column0, mark_row0, mark_column0):  # type: ignore[no-untyped-def]
    """Add marks (int8) to one tile's width of cells, as many rows as given, in place.

    Returns how many cells changed, and how many of them had no evidence before.
    """
    changed, first = np.int64(0), np.int64(0)
    for i in range(rows):
        row, mark_row = np.uintp(row0 + i), np.uintp(mark_row0 + i)
        row_changed, row_first = np.int8(0), np.int8(0)  # of its own, so that rows need not wait for each other
        for k in range(TILE):
            column = np.uintp(column0 + k)
            old = cells[row, column]
            new = np.int8(min(np.int8(old + marks[mark_row, np.uintp(mark_column0 + k)]), _HIGHEST))
            new = np.int8(max(new, _LOWEST))
            differs = np.int8(new != old)
            row_changed = np.int8(row_changed + differs)
            row_first = np.int8(row_first + np.int8(differs & np.int8(old == 0)))
            cells[row, column] = new
        changed += np.int64(row_changed)
        first += np.int64(row_first)
    return changed, first


@numba.njit(cache=True, nogil=True)
def claim(cells, known, row0, rows, column0):  # type: ignore[no-untyped-def]
    """Mark the cells with evidence in so many rows of one tile's width as known; return how many were not before."""
    fresh = np.int64(0)
    for i in range(rows):
        row = np.uintp(row0 + i)
        row_fresh = np.int8(0)
        for k in range(TILE):
            column = np.uintp(column0 + k)
            has_evidence, was_known = np.int8(cells[row, column] != 0), known[row, column]
            row_fresh = np.int8(row_fresh + np.int8(has_evidence & ~was_known))
            known[row, column] = np.int8(was_known | has_evidence)
        fresh += np.int64(row_fresh)
    return fresh


@numba.njit(cache=True, nogil=True)
def copy_tile(source, row0, column0, target, target_row0, target_column0):  # type: ignore[no-untyped-def]
    """Copy a tile of cells from one place to another, both columns a multiple of 8."""
    words, target_words = source.view(np.uint64), target.view(np.uint64)
    for k in range(TILE):
        row, target_row = np.uintp(row0 + k), np.uintp(target_row0 + k)
        for m in range(_TILE_WORDS):
            word = words[row, np.uintp(column0 // 8 + m)]
            target_words[target_row, np.uintp(target_column0 // 8 + m)] = word


@numba.njit(cache=True, nogil=True)
def find_spans(marks, spans):  # type: ignore[no-untyped-def]
    """Note in `spans` `[tiles, 2]`, for each tile's width of `marks`, the first row with any and one past the last.

    Most of a scan's square lies behind walls, and what need not be read need not be fetched.
    """
    words = marks.view(np.uint64)
    for block in range(spans.shape[0]):
        first = last = 0
        for i in range(marks.shape[0]):
            row, seen = np.uintp(i), np.uint64(0)
            for m in range(_TILE_WORDS):
                seen |= words[row, np.uintp(block * _TILE_WORDS + m)]
            if seen != 0:
                if last == 0:
                    first = i
                last = i + 1
        spans[block, 0], spans[block, 1] = first, last
