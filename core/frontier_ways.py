"""Following a way on the planning grid smoothly: straight for the farthest point of it that is clear to fly to."""

from __future__ import annotations

import math

import numba

from imagine.core.frontier import PAD, UNKNOWN
from imagine.core.frontier_paths import FAR, NEAR, OPEN

_SAMPLE_CELLS = 0.5
_LOOKAHEAD_CELLS = 30
_STRAYED_CELLS = 2.0
_PATIENCE = 4  # points further on that are tried past one that is not clear


@numba.njit(cache=True, nogil=True)
def trace_back(path, cost, kinds, goal):  # type: ignore[no-untyped-def]
    """Write the cheapest way to the flat cell `goal` into `path` (int32 `[n]`), its start first; return its length.

    `cost` as of `fill_ways`. A way longer than n keeps its first n cells; 0 where there is none.
    """
    columns = cost.shape[1]
    flat, flat_kinds = cost.ravel(), kinds.ravel()
    if not 0 <= flat[goal] < FAR:
        return 0
    length, cell = 1, goal
    while flat[cell] > 0:
        cell = _step_back(flat, flat_kinds, cell, columns)
        length += 1
    cell = goal
    for k in range(length - 1, -1, -1):
        if k < path.shape[0]:
            path[k] = cell
        if k > 0:
            cell = _step_back(flat, flat_kinds, cell, columns)
    return min(length, path.shape[0])


@numba.njit(cache=True, nogil=True)
def _step_back(costs, kinds, cell, columns):  # type: ignore[no-untyped-def]
    """Return the neighbour that the cheapest way to `cell` comes from."""
    best, best_cost = cell, costs[cell]
    for d_row in range(-1, 2):
        for d_column in range(-1, 2):
            other = cell + d_row * columns + d_column
            cost = costs[other]
            if cost < 0 or cost >= best_cost:
                continue
            if d_row != 0 and d_column != 0 and (costs[cell + d_row * columns] < 0 or costs[cell + d_column] < 0):
                continue
            step = 7 if d_row != 0 and d_column != 0 else 5
            if (kinds[cell] | kinds[other]) & NEAR:
                step *= 3
            if cost + step == costs[cell]:
                best, best_cost = other, cost
    return best


@numba.njit(cache=True, nogil=True)
def near_on_line(kinds, row0, column0, row1, column1):  # type: ignore[no-untyped-def]
    """Return how many cells of a straight line between two points (in planning cells) lie beside obstacles.

    -1 where the line leaves the cells that can be flown in. What lies within a cell of the first point does not count:
    a drone that is beside a wall must be able to get away from it.
    """
    rows, columns = kinds.shape
    d_row, d_column = row1 - row0, column1 - column0
    length = math.sqrt(d_row * d_row + d_column * d_column)
    steps = math.ceil(length / _SAMPLE_CELLS)
    near = 0.0
    for k in range(1, steps + 1):
        share = k / steps
        row, column = math.floor(row0 + share * d_row), math.floor(column0 + share * d_column)
        if share * length <= 1.0:
            continue
        if not (0 <= row < rows and 0 <= column < columns) or not kinds[row, column] & OPEN:
            return -1.0
        if kinds[row, column] & NEAR:
            near += length / steps
    return near


@numba.njit(cache=True, nogil=True)
def follow(path, length, begin, kinds, states, row, column):  # type: ignore[no-untyped-def]
    """Return (d_row, d_column, at, lost): which way to fly from (row, column), in planning cells, along a path.

    `at` is the point of the path that the drone is nearest to, searched from `begin` on; `lost` whether it is off the
    path and no part of it can be flown to straight.
    """
    columns = kinds.shape[1]
    at, off = begin, 1e9
    for k in range(max(0, begin - 3), min(length, begin + 12)):
        d_row, d_column = path[k] // columns + 0.5 - row, path[k] % columns + 0.5 - column
        square = math.sqrt(d_row * d_row + d_column * d_column)
        if square < off:
            at, off = k, square
    target, misses, lost = min(at + 1, length - 1), 0, off > _STRAYED_CELLS
    near_on_path = 0.0
    for k in range(at + 1, min(length, at + _LOOKAHEAD_CELLS)):
        i, j = path[k] // columns, path[k] % columns
        if kinds[i, j] & NEAR:
            near_on_path += 1.0
        near = near_on_line(kinds, row, column, i + 0.5, j + 0.5)
        if 0.0 <= near <= near_on_path:  # no nearer to obstacles than the path itself
            target, misses, lost = k, 0, False
        else:
            misses += 1
            if misses > _PATIENCE:
                break
    cell = path[target]
    d_row, d_column = cell // columns + 0.5 - row, cell % columns + 0.5 - column
    if target == length - 1 and d_row * d_row + d_column * d_column < 2.25:
        # at the goal: on toward what is unknown beyond it
        i, j = cell // columns, cell % columns
        for k in range(max(PAD, i - 1), i + 2):
            for m in range(max(PAD, j - 1), j + 2):
                if states[k, m] == UNKNOWN:
                    d_row += k - i
                    d_column += m - j
    return d_row, d_column, at, lost
