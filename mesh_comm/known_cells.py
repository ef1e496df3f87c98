"""Who first made a cell known: the drone itself, a peer's scan, or a peer's tile."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numba
import numpy as np
from numpy.typing import NDArray

from imagine.core.evidence import EvidenceMap, TileKey
from imagine.core.frames import IDENTITY, Pose, placed_bounds
from imagine.core.raster import CELL, TILE

_KNOWN, _CANDIDATE = 1, 2
NOBODY_COUNTS = np.zeros((0, 0), np.uint8)
"""A grid of no cells, for kernels that would find what becomes known."""


@numba.njit(cache=True, nogil=True)
def _find(cells, known, places, rows, columns, found, count):  # type: ignore[no-untyped-def]
    """Add to `found` (int32, flat) the cells of rectangles that have evidence in `cells` (int8) and are not known.

    They become candidates in `known` (uint8 `[rows, columns]`, zero where nothing is known), so that each is found
    once. `places` int64 `[n, 2]`: row and column of the first cell of each rectangle of `rows` by `columns` cells.
    Return how many there are in `found`, of which `count` were there before.
    """
    width = known.shape[1]
    for k in range(len(places)):
        column0 = places[k, 1]
        for i in range(rows):
            row = places[k, 0] + i
            line, known_line = cells[np.uintp(row)], known[np.uintp(row)]
            is_any = np.int8(0)
            for j in range(columns):  # bytes and no branches: this compiles to vector instructions
                column = np.uintp(column0 + j)
                is_any |= np.int8(line[column] != 0) & np.int8(known_line[column] == 0)
            if is_any:
                for j in range(columns):
                    if line[column0 + j] != 0 and known_line[column0 + j] == 0:
                        known_line[column0 + j] = _CANDIDATE
                        found[count] = row * width + column0 + j
                        count += 1
    return count


@numba.njit(cache=True, nogil=True)
def find_marked(marks, row0, column0, known, found):  # type: ignore[no-untyped-def]
    """Write into `found` (int32, flat) the cells that a sheet of marks touches and that are not known; count them.

    `marks` int8, whole tiles wide, its first cell at (row0, column0) of the grid, the column a tile's first; `known`
    uint8 `[rows, columns]`, zero where nothing is known, or empty: then nothing is found.
    """
    rows, columns = known.shape
    count = 0
    for i in range(max(0, -row0), min(marks.shape[0], rows - row0)):
        line, known_line = marks[np.uintp(i)], known[np.uintp(row0 + i)]
        for first in range(max(0, -column0), min(marks.shape[1], columns - column0), TILE):
            is_any = np.int8(0)
            for j in range(TILE):  # as in `_find`
                mark, was_known = line[np.uintp(first + j)], known_line[np.uintp(column0 + first + j)]
                is_any |= np.int8(mark != 0) & np.int8(was_known == 0)
            if is_any:
                for j in range(first, first + TILE):
                    if line[j] != 0 and known_line[column0 + j] == 0:
                        found[count] = (row0 + i) * columns + column0 + j
                        count += 1
    return count


@numba.njit(cache=True, nogil=True)
def find_changes(cells, tile, row0, column0, known, found, count):  # type: ignore[no-untyped-def]
    """Add to `found` the cells that are not known and that `tile` (int8 `[TILE, TILE]`) would change; count all.

    The tile's first cell is (row0, column0) of `cells` and `known`, which may be empty as in `find_marked`. What is
    found becomes a candidate in `known`, so that each is found once.
    """
    if known.shape[0] == 0:
        return count
    for i in range(TILE):
        line, known_line = cells[np.uintp(row0 + i)], known[np.uintp(row0 + i)]
        is_any = np.int8(0)
        for j in range(TILE):
            column = np.uintp(column0 + j)
            is_any |= np.int8(line[column] != tile[i, j]) & np.int8(known_line[column] == 0)
        if is_any:
            for j in range(TILE):
                if line[column0 + j] != tile[i, j] and known_line[column0 + j] == 0:
                    known_line[column0 + j] = _CANDIDATE
                    found[count] = (row0 + i) * known.shape[1] + column0 + j
                    count += 1
    return count


@numba.njit(cache=True, nogil=True)
def _add(total, cells, found, count):  # type: ignore[no-untyped-def]
    """Add to `total` (int16) the evidence of `cells` on each of the first `count` cells found."""
    flat = cells.ravel()
    for k in range(count):
        total[k] += np.int16(flat[found[k]])


@numba.njit(cache=True, nogil=True)
def _claim_found(total, known, found, count):  # type: ignore[no-untyped-def]
    """Make candidates known where `total` is not zero, and unknown again where it is; return how many are known now."""
    flat = known.ravel()
    fresh = 0
    for k in range(count):
        flat[found[k]] = _KNOWN if total[k] != 0 else 0
        fresh += 1 if total[k] != 0 else 0
    return fresh


class KnownCells:
    """The cells of a map that have been known at least once, so that each is claimed only once.

    A cell is known when the sum of its evidence over the placed sources is not zero.
    """

    def __init__(self, evidence: EvidenceMap) -> None:
        """Start with nothing known."""
        self._evidence = evidence
        self._corner = evidence.corner
        self._origin = evidence.origin_cells
        self._known = np.zeros(evidence.shape, np.uint8)

    def claim_around(self, x: float, y: float, reach_m: float) -> int:
        """Return how many cells of a square around (x, y), metres, have become known since the last claim on them."""
        column0, column1 = math.floor((x - reach_m) / CELL), math.floor((x + reach_m) / CELL) + 1
        row0, row1 = math.floor((y - reach_m) / CELL), math.floor((y + reach_m) / CELL) + 1
        return self._claim(column0, row0, column1, row1)

    def claim_tiles(self, source: int, keys: Sequence[TileKey]) -> int:
        """Return how many cells where a source's tiles lie have become known since the last claim on them."""
        pose = self._evidence.placement(source)
        if pose is None:
            return 0  # it is no part of the belief
        if pose != IDENTITY:
            return sum(self._claim_placed(pose, key) for key in keys)
        layers = self._evidence.placed()
        self._follow_growth()
        corner, rows, columns = self._corner, self._evidence.tile_rows, self._evidence.tile_columns
        places = [
            (row * TILE, column * TILE)
            for row, column in ((key.row - corner.row, key.column - corner.column) for key in keys)
            if 0 <= row < rows and 0 <= column < columns
        ]
        return self._claim_places(layers, np.array(places, np.int64).reshape(-1, 2), TILE, TILE)

    def not_yet(self, source: int) -> NDArray[np.uint8]:
        """Return the grid in which cells that were never known are 0, for a kernel that finds what it changes of them.

        Good until the map grows. Empty where a source's cells are not cells of the own frame: then what it changed has
        to be looked for afterwards, by `claim_around` or `claim_tiles`.
        """
        if self._evidence.placement(source) != IDENTITY:
            return NOBODY_COUNTS
        self._evidence.placed()  # the grid may grow first
        self._follow_growth()
        return self._known

    def claim_found(self, found: NDArray[np.int32], count: int) -> int:
        """Return how many of the first `count` cells found, flat in the grid of `not_yet`, are known by now."""
        return 0 if count == 0 else self._claim_cells(self._evidence.placed(), found, count)

    def _claim_placed(self, pose: Pose, key: TileKey) -> int:
        column, row = key.column * TILE, key.row * TILE
        x, y = (column * CELL, (column + TILE) * CELL), (row * CELL, (row + TILE) * CELL)
        least, most = placed_bounds(pose, x, y)
        low, high = np.floor(least / CELL - 1.0).astype(int), np.ceil(most / CELL + 1.0).astype(int)
        return self._claim(int(low[0]), int(low[1]), int(high[0]), int(high[1]))

    def claim_all(self) -> int:
        """Return how many cells of the whole map have become known since the last claim on them."""
        self._evidence.placed()  # the grid may grow first
        column, row = self._evidence.origin_cells
        rows, columns = self._evidence.shape
        return self._claim(column, row, column + columns, row + rows)

    def _claim(self, column0: int, row0: int, column1: int, row1: int) -> int:
        """Claim the cells of a rectangle of the map frame, its upper ends excluded; what lies off the grid is not."""
        layers = self._evidence.placed()
        self._follow_growth()
        column, row = self._origin
        rows, columns = self._known.shape
        first_row, last_row = max(row0 - row, 0), min(max(row1 - row, 0), rows)
        first_column, last_column = max(column0 - column, 0), min(max(column1 - column, 0), columns)
        if first_row >= last_row or first_column >= last_column:
            return 0
        place = np.array([[first_row, first_column]], np.int64)
        return self._claim_places(layers, place, last_row - first_row, last_column - first_column)

    def _claim_places(
        self, layers: Mapping[int, NDArray[np.int8]], places: NDArray[np.int64], rows: int, columns: int
    ) -> int:
        """Claim rectangles of the grid that do not overlap, each with its first cell at one of `places`."""
        # few cells become known by a message: only on those is the evidence of all sources added up
        found = np.empty(len(places) * rows * columns, np.int32)
        count = 0
        for cells in layers.values():
            count = _find(cells, self._known, places, rows, columns, found, count)
        return 0 if count == 0 else self._claim_cells(layers, found, count)

    def _claim_cells(self, layers: Mapping[int, NDArray[np.int8]], found: NDArray[np.int32], count: int) -> int:
        total = np.zeros(count, np.int16)
        for cells in layers.values():
            _add(total, cells, found, count)
        return int(_claim_found(total, self._known, found, count))

    def _follow_growth(self) -> None:
        corner = self._evidence.corner
        if corner is self._corner:  # the map makes a new one when it grows
            return
        self._corner = corner
        origin, shape = self._evidence.origin_cells, self._evidence.shape
        grown = np.zeros(shape, np.uint8)
        column, row = self._origin[0] - origin[0], self._origin[1] - origin[1]
        rows, columns = self._known.shape
        grown[row : row + rows, column : column + columns] = self._known
        self._origin, self._known = origin, grown
