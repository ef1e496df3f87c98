"""From pixels to polygons: the boundary of a region of pixels as closed loops, and stairs of pixels made straight."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from imagine.sim.polygon import first_crossing

_EAST, _NORTH, _WEST, _SOUTH = 0, 1, 2, 3
_COLUMN_STEPS = (1, 0, -1, 0)
_ROW_STEPS = (0, 1, 0, -1)


def without_pinches(free: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the free pixels less some, so that no two touch by a corner alone: boundaries then are simple loops."""
    kept = free.copy()
    while True:
        a, b, c, d = kept[:-1, :-1], kept[:-1, 1:], kept[1:, :-1], kept[1:, 1:]
        falling, rising = a & d & ~b & ~c, b & c & ~a & ~d
        if not (falling.any() or rising.any()):
            return kept
        c &= ~rising  # views of `kept`: in each pinch one of the two free pixels is given up
        d &= ~falling


def boundary_loops(free: NDArray[np.bool_]) -> list[NDArray[np.float64]]:
    """Return the boundary of free pixels `[rows, columns]` as loops of corners (x, y) in pixels, straight runs merged.

    Free space lies to the left: loops around it run counter-clockwise, loops around holes clockwise. Pixel (row,
    column) covers row to row + 1 in y and column to column + 1 in x. Pixels must not touch by a corner alone.
    """
    corners, starts = _trace_all(np.pad(free, 1))
    return [corners[starts[k] : starts[k + 1]] - 1.0 for k in range(len(starts) - 1)]


@numba.njit(cache=True, nogil=True)
def _trace_all(free):  # type: ignore[no-untyped-def]
    rows, columns = free.shape
    way = np.full((rows + 1, columns + 1), -1, np.int8)  # where the boundary goes on from each vertex
    edges = 0
    for i in range(1, rows - 1):
        for j in range(1, columns - 1):
            if free[i, j]:
                if not free[i - 1, j]:
                    way[i, j] = _EAST
                    edges += 1
                if not free[i, j + 1]:
                    way[i, j + 1] = _NORTH
                    edges += 1
                if not free[i + 1, j]:
                    way[i + 1, j + 1] = _WEST
                    edges += 1
                if not free[i, j - 1]:
                    way[i + 1, j] = _SOUTH
                    edges += 1
    corners = np.empty((edges, 2))
    starts = np.zeros(edges // 4 + 1, np.int64)
    count, loops = 0, 0
    for i in range(rows + 1):
        for j in range(columns + 1):
            if way[i, j] < 0:
                continue
            row, column, heading = i, j, -1  # the lowest vertex of a loop, the leftmost of these, is a corner
            while way[row, column] >= 0:
                turn = way[row, column]
                way[row, column] = -1
                if turn != heading:
                    corners[count, 0], corners[count, 1] = column, row
                    count += 1
                    heading = turn
                column += _COLUMN_STEPS[turn]
                row += _ROW_STEPS[turn]
            loops += 1
            starts[loops] = count
    return corners[:count], starts[: loops + 1]


def simplified(loop: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a loop of pixel edges with its stairs straightened, nowhere more than half a pixel off.

    A stair is a step of one pixel between opposite turns. Its corners give way to the middles of their edges, which
    lie on one line where the stair is regular; other corners stay. A loop that would touch itself is left as it is.
    """
    ahead = np.roll(loop, -1, axis=0) - loop  # the edge from each corner
    behind = np.roll(ahead, 1, axis=0)
    turn = np.sign(behind[:, 0] * ahead[:, 1] - behind[:, 1] * ahead[:, 0])
    unit = np.abs(ahead).sum(axis=1) == 1.0
    step = unit & (turn != np.roll(turn, -1))  # this edge is the rise of a stair
    on_stair = step | np.roll(step, 1)  # this corner is one of its two
    both = on_stair & np.roll(on_stair, -1)
    points = np.empty((2 * len(loop), 2))
    points[0::2], points[1::2] = loop, loop + ahead / 2.0
    kept = np.empty(len(points), bool)
    kept[0::2], kept[1::2] = ~on_stair, both
    straight = _without_collinear(points[kept])
    if len(straight) < 3 or first_crossing(straight)[0] >= 0:
        return loop
    return straight


def _without_collinear(loop: NDArray[np.float64]) -> NDArray[np.float64]:
    before, after = loop - np.roll(loop, 1, axis=0), np.roll(loop, -1, axis=0) - loop
    bends = np.abs(before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]) > 1e-9
    return np.ascontiguousarray(loop[bends])
