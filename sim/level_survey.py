"""What of a level can be flown, seen and launched from, by the rule that a passage of 0.5 m is open and one of 0.4 m
is not.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from imagine.core.raster import CELL
from imagine.sim.level_kernels import flood, lay_out
from imagine.sim.sight_kernels import see

LAUNCH_CLEARANCE_M = 0.25
"""A drone starts no closer than this to anything."""
FLIGHT_CLEARANCE_M = 0.21
"""How far a drone's centre keeps from anything, by its planner's 0.2 m cells: 0.47 m is open, 0.42 m is not."""
SIGHT_M = 4.0
"""How far drones map. The last cell of a beam that ends in the air is not mapped: sight counts one cell less."""
_NEARBY_M = 1.0
_FAR_M = 0.6  # clearances beyond are cut

Point = tuple[float, float]
Grid = tuple[int, int, int, int]


@dataclass(frozen=True, eq=False)
class Geometry:
    """What stands still: `outline` `[n, 2]`, closed `loops` of solids, `segments` `[s, 4]`, `circles` `[m, 3]`, and the
    `grid` (first column, first row, columns, rows; in cells) that holds them.
    """

    outline: NDArray[np.float64]
    loops: Sequence[NDArray[np.float64]]
    segments: NDArray[np.float64]
    circles: NDArray[np.float64]
    grid: Grid

    @functools.cached_property
    def packed(self) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """All loops' points one after the other, and where each begins, with the end of the last."""
        starts = np.zeros(len(self.loops) + 1, np.int64)
        np.cumsum([len(loop) for loop in self.loops], out=starts[1:])
        return (np.concatenate(self.loops) if self.loops else np.empty((0, 2))), starts

    def lattice(self, cap_m: float = _FAR_M) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
        """Return which points of the half-cell lattice are free, and their clearances (metres, cut at `cap_m`)."""
        column0, row0, columns, rows = self.grid
        inside = np.zeros((2 * rows + 1, 2 * columns + 1), np.uint8)
        clearance = np.full(inside.shape, cap_m)
        lay_out(inside, clearance, self.outline, *self.packed, self.segments, self.circles, column0, row0)
        return inside.view(np.bool_), clearance


@dataclass(frozen=True, eq=False)
class Survey:
    """A level's cells, bool `[rows, columns]` of its grid, and where drones may start.

    `free`: the centre lies in no solid; `flyable`: a drone's centre can get there from the launch; `seen`: free, and
    seen within 4 m from where drones can fly. `spots` `[n, 2]`: flyable cells' centres, metres, with the
    clearance of a launch.
    """

    free: NDArray[np.bool_]
    flyable: NDArray[np.bool_]
    seen: NDArray[np.bool_]
    spots: NDArray[np.float64]


def survey(geometry: Geometry, launch: Point) -> Survey:
    """Survey a level from its launch point."""
    column0, row0, columns, rows = geometry.grid
    inside, clearance = geometry.lattice()
    reached = reachable(clearance, geometry.grid, launch)
    free = np.ascontiguousarray(inside[1::2, 1::2])
    flyable = np.ascontiguousarray(reached[1::2, 1::2])
    seen = np.zeros((rows, columns), np.bool_)
    see(seen, free, reached, _nearby(), SIGHT_M - CELL, geometry.segments, geometry.circles, column0, row0)
    spot_rows, spot_columns = np.nonzero(flyable & (clearance[1::2, 1::2] > LAUNCH_CLEARANCE_M))
    return Survey(free, flyable, seen, cell_centres(spot_rows, spot_columns, geometry.grid))


def reachable(
    clearance: NDArray[np.float64], grid: Grid, launch: Point, keep_m: float = FLIGHT_CLEARANCE_M
) -> NDArray[np.bool_]:
    """Return the lattice points that hang together with the launch, all `keep_m` clear; none where it has no room."""
    open_points = clearance >= keep_m
    reached = np.zeros(open_points.shape, np.bool_)
    row, column = lattice_index(launch, grid)
    best = math.inf
    start = (-1, -1)
    for i in range(max(0, row - 2), min(open_points.shape[0], row + 3)):
        for j in range(max(0, column - 2), min(open_points.shape[1], column + 3)):
            apart = math.dist(lattice_point((i, j), grid), launch)
            if open_points[i, j] and apart < best:
                best, start = apart, (i, j)
    if start[0] >= 0:
        flood(open_points, reached, *start)
    return reached


def roomiest_point(geometry: Geometry) -> Point:
    """Return the point of the half-cell lattice that is farthest from anything, the first of equals row by row."""
    inside, _ = geometry.lattice(CELL)
    far = ndimage.distance_transform_edt(inside)
    rows, columns = np.nonzero(far >= far.max() - 2.0)  # the transform is wrong by less than a step on either side
    column0, row0, _, _ = geometry.grid
    points = np.column_stack(((2 * column0 + columns) * 0.5 * CELL, (2 * row0 + rows) * 0.5 * CELL))
    exact = np.full(len(points), np.inf)
    for start, end in zip(geometry.segments[:, :2], geometry.segments[:, 2:], strict=True):
        edge = end - start
        t = np.clip((points - start) @ edge / max(float(edge @ edge), 1e-12), 0.0, 1.0)
        exact = np.minimum(exact, np.hypot(*(points - start - t[:, None] * edge).T))
    for x, y, radius in geometry.circles:
        exact = np.minimum(exact, np.hypot(points[:, 0] - x, points[:, 1] - y) - radius)
    best = int(np.argmax(np.round(exact, 6)))  # rounded: equals are equal on every machine
    return round(float(points[best, 0]), 6), round(float(points[best, 1]), 6)


def lattice_point(index: tuple[int, int], grid: Grid) -> Point:
    """Return where a lattice point (row, column) lies, metres."""
    return (2 * grid[0] + index[1]) * 0.5 * CELL, (2 * grid[1] + index[0]) * 0.5 * CELL


def lattice_index(point: Point, grid: Grid) -> tuple[int, int]:
    """Return the (row, column) of the lattice point nearest to a point."""
    return round(point[1] / CELL * 2.0) - 2 * grid[1], round(point[0] / CELL * 2.0) - 2 * grid[0]


def cell_centres(rows: NDArray[np.int64], columns: NDArray[np.int64], grid: Grid) -> NDArray[np.float64]:
    """Return the centres `[n, 2]` of cells, metres."""
    return np.column_stack(((columns + grid[0] + 0.5) * CELL, (rows + grid[1] + 0.5) * CELL))


@functools.cache
def _nearby() -> NDArray[np.int16]:
    """Return the lattice steps (row, column) to points within a metre of a cell's centre, nearest first."""
    reach = int(_NEARBY_M / CELL * 2.0)
    i, j = np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, -1)
    squared = i * i + j * j
    near = np.flatnonzero((squared > 0) & (squared <= reach * reach))
    order = near[np.lexsort((j[near], i[near], squared[near]))]
    return np.ascontiguousarray(np.column_stack((i, j))[order].astype(np.int16))
