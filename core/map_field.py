"""What an evidence grid says of walls and clear space near any point, and how well two grids agree under a pose."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from imagine.core.frames import Pose, inverse, transform_points
from imagine.core.raster import CELL

WALL_UNITS = 2
"""A cell is a wall from one hit on."""
FREE_UNITS = -2
"""A cell is clear from two misses on."""
MATCH_M = 0.15
"""A wall this near to the other map's is the same wall: a cell's diagonal, beside rounding in both grids."""
CLEAR_M = 0.35
"""A wall further than this from the other map's, on cells clear there, contradicts it; less may be drift."""
CONTRADICTION_WEIGHT = 3.0
"""How many cells of matching wall one of contradicting wall outweighs."""
_HOLD_M = 0.35  # twice what still matches, and a little
_HOLD_BEARINGS = 8
_MARGIN_M = 1.0  # around the known cells, where distances to walls are still told


@dataclass(frozen=True)
class Field:
    """What one evidence grid says at any point near it, in its own frame.

    `distance` float32 `[rows, columns]` to the nearest wall, metres; `clear`, `known` bool of the same shape;
    (`x0`, `y0`) metres of the first cell's corner; `walls` float64 `[n, 2]`, `frees` `[m, 2]` are cell centres, metres.
    """

    x0: float
    y0: float
    distance: NDArray[np.float32]
    clear: NDArray[np.bool_]
    known: NDArray[np.bool_]
    walls: NDArray[np.float64]
    frees: NDArray[np.float64]

    @cached_property
    def opens(self) -> NDArray[np.float64]:
        """Centres of the clear cells with no wall near, metres `[n, 2]`: where another map's wall contradicts."""
        row, column, _ = _cells(self, self.frees)
        far: NDArray[np.float64] = self.frees[self.distance[row, column] > CLEAR_M]
        return far

    @property
    def centre(self) -> NDArray[np.float64]:
        """Middle of the walls, metres `[2]`."""
        middle: NDArray[np.float64] = self.walls.mean(axis=0)
        return middle


def field_of(cells: NDArray[np.int8], origin_cells: tuple[int, int]) -> Field | None:
    """Return the field of a grid (int8 `[rows, columns]`, its first cell at `origin_cells`); None without a wall."""
    rows, columns = np.nonzero(cells)
    is_wall = cells >= WALL_UNITS
    if not is_wall.any():
        return None
    margin = round(_MARGIN_M / CELL)
    row0, row1, column0, column1 = int(rows.min()), int(rows.max()) + 1, int(columns.min()), int(columns.max()) + 1
    window = np.pad(cells[row0:row1, column0:column1], margin)
    wall, clear = window >= WALL_UNITS, window <= FREE_UNITS
    x0 = (origin_cells[0] + column0 - margin) * CELL
    y0 = (origin_cells[1] + row0 - margin) * CELL
    from scipy import ndimage  # here: a drone that shares its team's frame starts without it

    distance = (ndimage.distance_transform_edt(~wall) * CELL).astype(np.float32)

    def centres(mask: NDArray[np.bool_]) -> NDArray[np.float64]:
        at_row, at_column = np.nonzero(mask)
        return np.column_stack((x0 + (at_column + 0.5) * CELL, y0 + (at_row + 0.5) * CELL))

    return Field(x0, y0, distance, clear, window != 0, centres(wall), centres(clear))


class Fit(NamedTuple):
    """How well two maps agree under a pose, in cells: of wall where both know, both ways round, and in all.

    `matched` and `contradicted` walls; `overlap` cells known to both; `hold` the share of matched walls, 0 to 1, that a
    shift in the loosest direction would lose: little in a corridor, along which the pose is free.
    """

    matched: float
    contradicted: float
    overlap: int
    hold: float

    @property
    def score(self) -> float:
        """What hypotheses are compared by."""
        return self.matched - CONTRADICTION_WEIGHT * self.contradicted

    @property
    def contradiction(self) -> float:
        """Share of walls in the overlap that the other map contradicts, 0 to 1."""
        return self.contradicted / max(1.0, self.matched + self.contradicted)


def judge(reference: Field, peer: Field, pose: Pose) -> Fit:
    """Return how well `peer`, placed by `pose`, agrees with `reference`."""
    placed = transform_points(pose, peer.walls)
    forth = _compare(reference, placed)
    back = _compare(peer, transform_points(inverse(pose), reference.walls))
    row, column, inside = _cells(reference, transform_points(pose, np.concatenate((peer.frees, peer.walls))))
    overlap = int(np.count_nonzero(reference.known[row[inside], column[inside]]))
    return Fit(
        (forth.matched + back.matched) / 2.0, (forth.contradicted + back.contradicted) / 2.0, overlap,
        _hold(reference, placed),
    )  # fmt: skip


class _Compared(NamedTuple):
    matched: int
    contradicted: int


def _compare(field: Field, walls: NDArray[np.float64]) -> _Compared:
    row, column, inside = _cells(field, walls)
    row, column = row[inside], column[inside]
    distance = field.distance[row, column]
    contradicted = field.clear[row, column] & (distance > CLEAR_M)
    return _Compared(int(np.count_nonzero(distance <= MATCH_M)), int(np.count_nonzero(contradicted)))


def _cells(field: Field, points: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
    """Return row and column of points in a field, and whether they lie on it."""
    column = np.floor((points[:, 0] - field.x0) / CELL).astype(np.int64)
    row = np.floor((points[:, 1] - field.y0) / CELL).astype(np.int64)
    rows, columns = field.distance.shape
    return row, column, (row >= 0) & (row < rows) & (column >= 0) & (column < columns)


def _hold(field: Field, walls: NDArray[np.float64]) -> float:
    """Return the least share of matched walls that some shift by a few cells, either way along a line, would lose."""
    row, column, inside = _cells(field, walls)
    at = row[inside], column[inside]
    is_matched = field.distance[at] <= MATCH_M
    matched = walls[inside][is_matched]
    if len(matched) == 0:
        return 0.0
    lost = 1.0
    for bearing in np.arange(_HOLD_BEARINGS) * (np.pi / _HOLD_BEARINGS):
        shift = _HOLD_M * np.array([np.cos(bearing), np.sin(bearing)])
        kept = sum(_compare(field, matched + way * shift).matched for way in (-1.0, 1.0)) / 2.0
        lost = min(lost, 1.0 - kept / len(matched))
    return lost


def slopes(field: Field, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the slope of the distance at points `[n, 2]`, by differences a cell wide."""
    out = np.empty((len(points), 2))
    for axis in range(2):
        shift = np.zeros(2)
        shift[axis] = CELL / 2.0
        out[:, axis] = (distances(field, points + shift) - distances(field, points - shift)) / CELL
    return out


def distances(field: Field, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distance from points `[n, 2]` to the nearest wall, metres, between cells (bilinear)."""
    rows, columns = field.distance.shape
    u = np.clip((points[:, 0] - field.x0) / CELL - 0.5, 0.0, columns - 1.001)
    v = np.clip((points[:, 1] - field.y0) / CELL - 0.5, 0.0, rows - 1.001)
    column, row = u.astype(np.int64), v.astype(np.int64)
    fu, fv = u - column, v - row
    at = row * columns + column
    flat = field.distance.ravel()
    low = flat[at] + fu * (flat[at + 1] - flat[at])
    high = flat[at + columns] + fu * (flat[at + columns + 1] - flat[at + columns])
    out: NDArray[np.float64] = low + fv * (high - low)
    return out
