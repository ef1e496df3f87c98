"""A layer drawn in another frame, resampled onto the own grid by a planar pose, tile by tile where it changed.

Every own cell takes the value of the one cell of the other frame that its centre falls into, so nothing counts twice.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from imagine.core.frames import Pose, inverse, placed_bounds
from imagine.core.raster import CELL, TILE


class PlacedLayer:
    """A layer as it lies in the own frame: `cells` int8 on the own grid, kept in step by `refresh`."""

    def __init__(self, pose: Pose) -> None:
        """Place a layer whose frame lies at `pose` (metres, radians) in the own frame; nothing is drawn yet."""
        self.pose = pose
        self.cells = np.zeros((0, 0), np.int8)
        self._drawn = np.zeros((0, 0), np.int8)
        self._origin = (0, 0)

    def is_current(self, source: NDArray[np.int8], origin_cells: tuple[int, int]) -> bool:
        """Tell whether `source` is as it was drawn last, so that `refresh` would change nothing."""
        return origin_cells == self._origin and np.array_equal(source, self._drawn)

    def refresh(self, source: NDArray[np.int8], origin_cells: tuple[int, int]) -> None:
        """Redraw what changed of `source`, int8 `[rows, columns]` of whole tiles, its first cell at `origin_cells`.

        Changes are found by comparing with what was drawn last, whoever wrote them. The own grid has the same shape
        and origin; what falls off it is left out.
        """
        if source.shape != self._drawn.shape or origin_cells != self._origin:
            self.cells = np.zeros(source.shape, np.int8)
            self._drawn = np.zeros(source.shape, np.int8)
            self._origin = origin_cells
        rows, columns = source.shape[0] // TILE, source.shape[1] // TILE
        differs = (source != self._drawn).reshape(rows, TILE, columns, TILE).any(axis=(1, 3))
        if not differs.any():
            return
        touched = np.zeros((rows, columns), np.bool_)
        for row, column in np.argwhere(differs):
            self._touch(touched, int(row), int(column))
        np.copyto(self._drawn, source)
        back = inverse(self.pose)
        _resample(source, self.cells, touched, back.x, back.y, back.yaw, *origin_cells)

    def extent(
        self, source: NDArray[np.int8], origin_cells: tuple[int, int]
    ) -> tuple[float, float, float, float] | None:
        """Return x and y, least then greatest, metres, that what is known of `source` takes up in the own frame."""
        is_row, is_column = source.any(axis=1), source.any(axis=0)
        if not is_row.any():
            return None
        rows, columns = np.flatnonzero(is_row)[[0, -1]] + [0, 1], np.flatnonzero(is_column)[[0, -1]] + [0, 1]
        x, y = (columns + origin_cells[0]) * CELL, (rows + origin_cells[1]) * CELL
        low, high = placed_bounds(self.pose, (x[0], x[1]), (y[0], y[1]))
        return float(low[0]), float(low[1]), float(high[0]), float(high[1])

    def _touch(self, touched: NDArray[np.bool_], row: int, column: int) -> None:
        """Mark the own tiles that a tile of the source falls on."""
        x0, y0 = (self._origin[0] + column * TILE) * CELL, (self._origin[1] + row * TILE) * CELL
        side = TILE * CELL
        least, most = placed_bounds(self.pose, (x0, x0 + side), (y0, y0 + side))
        origin = np.array(self._origin)
        low = np.floor((least / CELL - origin - 1.0) / TILE).astype(int)
        high = np.floor((most / CELL - origin + 1.0) / TILE).astype(int) + 1
        touched[max(0, low[1]) : max(0, high[1]), max(0, low[0]) : max(0, high[0])] = True


@numba.njit(cache=True, nogil=True)
def _resample(source, out, touched, x, y, yaw, column0, row0):  # type: ignore[no-untyped-def]
    """Fill the `touched` tiles of `out` from `source`; (x, y, yaw) is the own frame's pose in the source's, metres."""
    rows, columns = source.shape
    c, s = math.cos(yaw), math.sin(yaw)
    for i in range(touched.shape[0]):
        for j in range(touched.shape[1]):
            if not touched[i, j]:
                continue
            for row in range(i * TILE, (i + 1) * TILE):
                own_y = (row + row0 + 0.5) * CELL
                for column in range(j * TILE, (j + 1) * TILE):
                    own_x = (column + column0 + 0.5) * CELL
                    at_column = math.floor((x + c * own_x - s * own_y) / CELL) - column0
                    at_row = math.floor((y + s * own_x + c * own_y) / CELL) - row0
                    if 0 <= at_row < rows and 0 <= at_column < columns:
                        out[row, column] = source[at_row, at_column]
                    else:
                        out[row, column] = 0
