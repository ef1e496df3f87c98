"""Who first made a cell known: the drone itself, a peer's scan, or a peer's tile."""

from __future__ import annotations

import math

import numba
import numpy as np

from imagine.core.evidence import EvidenceMap, TileKey
from imagine.core.frames import IDENTITY, placed_bounds
from imagine.core.raster import CELL, TILE


@numba.njit(cache=True, nogil=True)
def _add(total, cells, row0, column0):  # type: ignore[no-untyped-def]
    """Add to `total` (int16 `[rows, columns]`) as many of `cells` (int8), from (row0, column0) on."""
    for i in range(total.shape[0]):
        for j in range(total.shape[1]):
            total[i, j] += np.int16(cells[np.uintp(row0 + i), np.uintp(column0 + j)])


@numba.njit(cache=True, nogil=True)
def _claim_known(total, known, row0, column0):  # type: ignore[no-untyped-def]
    """Mark what is not zero in `total` in `known`, from (row0, column0) on; return how many cells were not before."""
    fresh = np.int64(0)
    for i in range(total.shape[0]):
        row_fresh = np.int16(0)
        for j in range(total.shape[1]):
            row, column = np.uintp(row0 + i), np.uintp(column0 + j)
            is_fresh = (total[i, j] != 0) & ~known[row, column]
            row_fresh += np.int16(is_fresh)
            known[row, column] |= is_fresh
        fresh += np.int64(row_fresh)
    return fresh


class KnownCells:
    """The cells of a map that have been known at least once, so that each is claimed only once.

    A cell is known when the sum of its evidence over the placed sources is not zero.
    """

    def __init__(self, evidence: EvidenceMap) -> None:
        """Start with nothing known."""
        self._evidence = evidence
        self._origin = evidence.origin_cells
        self._known = np.zeros(evidence.shape, np.bool_)

    def claim_around(self, x: float, y: float, reach_m: float) -> int:
        """Return how many cells of a square around (x, y), metres, have become known since the last claim on them."""
        column0, column1 = math.floor((x - reach_m) / CELL), math.floor((x + reach_m) / CELL) + 1
        row0, row1 = math.floor((y - reach_m) / CELL), math.floor((y + reach_m) / CELL) + 1
        return self._claim(column0, row0, column1, row1)

    def claim_tile(self, source: int, key: TileKey) -> int:
        """Return how many cells where a source's tile lies have become known since the last claim on them."""
        pose = self._evidence.placement(source)
        if pose is None:
            return 0  # it is no part of the belief
        column, row = key.column * TILE, key.row * TILE
        if pose == IDENTITY:
            return self._claim(column, row, column + TILE, row + TILE)
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
        total = np.zeros((max(0, last_row - first_row), max(0, last_column - first_column)), np.int16)
        for cells in layers.values():
            _add(total, cells, first_row, first_column)
        return int(_claim_known(total, self._known, first_row, first_column))

    def _follow_growth(self) -> None:
        origin, shape = self._evidence.origin_cells, self._evidence.shape
        if origin == self._origin and shape == self._known.shape:
            return
        grown = np.zeros(shape, np.bool_)
        column, row = self._origin[0] - origin[0], self._origin[1] - origin[1]
        rows, columns = self._known.shape
        grown[row : row + rows, column : column + columns] = self._known
        self._origin, self._known = origin, grown
