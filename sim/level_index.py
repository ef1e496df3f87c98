"""Which edges and posts of a level a LiDAR can meet from where: a list for each square of floor, built once a level.

Outline and obstacles are closed loops, so only edges that face the sensor can be what a beam meets first. A square's
list holds whatever faces any point of it within reach, nearest first; it may hold too much, never too little.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numba
import numpy as np
from numpy.typing import NDArray

from imagine.sim.level import Level

_SQUARE_M = 1.0
_MOST_ITEMS = 2_000_000
"""Lists of more entries are made for larger squares: 16 MB a level."""
_built: WeakKeyDictionary[Level, dict[float, LevelIndex]] = WeakKeyDictionary()


@dataclass(frozen=True, eq=False)
class LevelIndex:
    """A level as the LiDAR sees it: `edges` `[n, 4]` with free space on the left, `circles` `[m, 3]`, and the lists.

    Square (row, column) covers `side_m` metres from `corner`; items `starts[k]` to `starts[k + 1]` belong to square
    k = row * columns + column, the list behind the last square to all places outside. An item is an edge, or past
    those a circle; `nearest` is the least distance in metres at which it can lie.
    """

    edges: NDArray[np.float64]
    circles: NDArray[np.float64]
    corner: tuple[float, float]
    side_m: float
    shape: tuple[int, int]
    starts: NDArray[np.int32]
    items: NDArray[np.int32]
    nearest: NDArray[np.float32]

    @property
    def longest(self) -> int:
        """Items in the longest list."""
        return int(np.diff(self.starts).max())


def level_index(level: Level, reach_m: float) -> LevelIndex:
    """Return the lists for sensors that reach so far, metres; a level's are built once and go with it."""
    known = _built.setdefault(level, {})
    if reach_m not in known:
        known[reach_m] = _build(facing_edges(level), np.ascontiguousarray(level.circles, np.float64), reach_m)
    return known[reach_m]


def facing_edges(level: Level) -> NDArray[np.float64]:
    """Return a level's edges `[n, 4]`, begin to end with free space on the left, where they can be seen from.

    A loop that crosses itself has no inside; its edges are given once in each direction.
    """
    loops = [(level.outline, True), *((loop, False) for loop in (*level.polygons, *level.solids))]
    if sum(len(loop) for loop, _ in loops) != len(level.segments):  # edges of no loop that is known here
        both = np.concatenate((level.segments, level.segments[:, [2, 3, 0, 1]]))
        return np.ascontiguousarray(both, np.float64)
    edges = []
    for loop, free_inside in loops:
        onward = np.hstack((loop, np.roll(loop, -1, axis=0)))
        backward = onward[:, [2, 3, 0, 1]]
        if _crosses_itself(np.ascontiguousarray(loop, np.float64)):
            edges += [onward, backward]
        else:
            x, y = loop.T
            turns_left = float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) > 0.0
            edges.append(onward if turns_left == free_inside else backward)
    return np.ascontiguousarray(np.concatenate(edges), np.float64)


def _build(edges: NDArray[np.float64], circles: NDArray[np.float64], reach_m: float) -> LevelIndex:
    points = np.concatenate((edges[:, :2], edges[:, 2:]))
    low, high = points.min(axis=0), points.max(axis=0)
    side = _SQUARE_M
    while True:
        columns, rows = (max(1, math.ceil(extent / side)) for extent in high - low)
        starts = _count_items(edges, circles, low[0], low[1], side, rows, columns, reach_m)
        if starts[-1] <= _MOST_ITEMS or rows * columns == 1:
            break
        side *= 2.0
    items, nearest = _list_items(edges, circles, low[0], low[1], side, rows, columns, reach_m, starts)
    corner = float(low[0]), float(low[1])
    return LevelIndex(edges, circles, corner, side, (rows, columns), starts.astype(np.int32), items, nearest)


@numba.njit(cache=True, nogil=True)
def _crosses_itself(loop):  # type: ignore[no-untyped-def]
    """Tell whether two edges of a loop `[n, 2]` cross, other than at a common end."""
    n = len(loop)
    for i in range(n):
        ax, ay, bx, by = loop[i, 0], loop[i, 1], loop[(i + 1) % n, 0], loop[(i + 1) % n, 1]
        for j in range(i + 2, n - (i == 0)):
            cx, cy, dx, dy = loop[j, 0], loop[j, 1], loop[(j + 1) % n, 0], loop[(j + 1) % n, 1]
            c_side = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
            d_side = (bx - ax) * (dy - ay) - (by - ay) * (dx - ax)
            a_side = (dx - cx) * (ay - cy) - (dy - cy) * (ax - cx)
            b_side = (dx - cx) * (by - cy) - (dy - cy) * (bx - cx)
            if c_side * d_side < 0.0 and a_side * b_side < 0.0:
                return True
    return False


@numba.njit(cache=True, nogil=True)
def _nearest_edge(edge, x, y, half):  # type: ignore[no-untyped-def]
    """Return how near an edge can be to a point of the square around (x, y), inf if it faces none; metres."""
    ax, ay, ex, ey = edge[0] - x, edge[1] - y, edge[2] - edge[0], edge[3] - edge[1]
    if ax * ey - ay * ex + half * (abs(ex) + abs(ey)) < 0.0:  # linear in the place: greatest at a corner
        return np.inf
    length_squared = ex * ex + ey * ey
    t = min(max(-(ax * ex + ay * ey) / length_squared, 0.0), 1.0) if length_squared > 0.0 else 0.0
    return max(0.0, math.hypot(ax + t * ex, ay + t * ey) - half * math.sqrt(2.0))


@numba.njit(cache=True, nogil=True)
def _nearest_item(edges, circles, item, x, y, half):  # type: ignore[no-untyped-def]
    if item < len(edges):
        return _nearest_edge(edges[item], x, y, half)
    circle = circles[item - len(edges)]
    return max(0.0, math.hypot(circle[0] - x, circle[1] - y) - circle[2] - half * math.sqrt(2.0))


@numba.njit(cache=True, nogil=True)
def _squares_around(edges, circles, item, x0, y0, side, rows, columns, reach):  # type: ignore[no-untyped-def]
    """Return first and last row and column of the squares that an item can be in reach of."""
    if item < len(edges):
        ax, ay, bx, by = edges[item]
        grow = reach
    else:
        ax, ay, grow = circles[item - len(edges)]
        bx, by = ax, ay
        grow += reach
    return (
        max(0, math.floor((min(ay, by) - grow - y0) / side)),
        min(rows - 1, math.floor((max(ay, by) + grow - y0) / side)),
        max(0, math.floor((min(ax, bx) - grow - x0) / side)),
        min(columns - 1, math.floor((max(ax, bx) + grow - x0) / side)),
    )


@numba.njit(cache=True, nogil=True)
def _count_items(edges, circles, x0, y0, side, rows, columns, reach):  # type: ignore[no-untyped-def]
    """Return the begins of the lists, int32 `[squares + 2]`."""
    squares, total = rows * columns, len(edges) + len(circles)
    counts = np.zeros(squares + 2, np.int64)
    half = 0.5 * side * (1.0 + 1e-9)  # a hair more, for rounding
    for item in range(total):
        row0, row1, column0, column1 = _squares_around(edges, circles, item, x0, y0, side, rows, columns, reach)
        for row in range(row0, row1 + 1):
            for column in range(column0, column1 + 1):
                x, y = x0 + (column + 0.5) * side, y0 + (row + 0.5) * side
                if _nearest_item(edges, circles, item, x, y, half) <= reach:
                    counts[row * columns + column + 1] += 1
    counts[squares + 1] = total
    return np.cumsum(counts)


@numba.njit(cache=True, nogil=True)
def _list_items(edges, circles, x0, y0, side, rows, columns, reach, starts):  # type: ignore[no-untyped-def]
    """Return the lists, nearest first, and the distances; the last list holds everything."""
    squares, total = rows * columns, len(edges) + len(circles)
    items, distances = np.zeros(starts[-1], np.int32), np.zeros(starts[-1], np.float64)
    ends = starts[:-1].copy()
    half = 0.5 * side * (1.0 + 1e-9)
    for item in range(total):
        row0, row1, column0, column1 = _squares_around(edges, circles, item, x0, y0, side, rows, columns, reach)
        for row in range(row0, row1 + 1):
            for column in range(column0, column1 + 1):
                x, y = x0 + (column + 0.5) * side, y0 + (row + 0.5) * side
                distance = _nearest_item(edges, circles, item, x, y, half)
                if distance <= reach:
                    at = ends[row * columns + column]
                    items[at], distances[at] = item, distance
                    ends[row * columns + column] += 1
        items[starts[squares] + item] = item
    nearest = np.zeros(starts[-1], np.float32)
    for k in range(squares):
        order = np.argsort(distances[starts[k] : starts[k + 1]])
        items[starts[k] : starts[k + 1]] = items[starts[k] : starts[k + 1]][order]
        for i in range(len(order)):
            nearest[starts[k] + i] = max(0.0, distances[starts[k] + order[i]] - 1e-5)  # rounding must not raise it
    return items, nearest


class LevelArrays(NamedTuple):
    """The indices of several levels in rows of equal length, for kernels; rows are `place` `[n, 3]`: corner and 1/side,
    `shape` `[n, 3]`: rows, columns and edges, and the arrays of LevelIndex. `longest` is that of any list."""

    edges: NDArray[np.float64]
    circles: NDArray[np.float64]
    place: NDArray[np.float64]
    shape: NDArray[np.int64]
    starts: NDArray[np.int32]
    items: NDArray[np.int32]
    nearest: NDArray[np.float32]
    longest: int


def make_room(arrays: LevelArrays | None, rows: int, index: LevelIndex) -> LevelArrays:
    """Return arrays of at least `rows` rows into which `index` fits; those given where they do already."""
    wanted = (index.edges, index.circles, np.zeros(3), np.zeros(3, np.int64), index.starts, index.items, index.nearest)
    if arrays is None:
        grown = [np.zeros((rows, *part.shape), part.dtype) for part in wanted]
        return LevelArrays(*grown, longest=index.longest)  # type: ignore[arg-type]
    old = arrays[:-1]
    if len(old[0]) >= rows and all(a.shape[1] >= len(part) for a, part in zip(old, wanted, strict=True)):
        return arrays._replace(longest=max(arrays.longest, index.longest))
    grown = []
    for array, part in zip(old, wanted, strict=True):
        length = array.shape[1] if array.shape[1] >= len(part) else len(part) + len(part) // 4
        larger = np.zeros((max(rows, len(array)), length, *array.shape[2:]), array.dtype)
        larger[: len(array), : array.shape[1]] = array
        grown.append(larger)
    return LevelArrays(*grown, longest=max(arrays.longest, index.longest))  # type: ignore[arg-type]


def write_row(arrays: LevelArrays, row: int, index: LevelIndex) -> None:
    """Put an index into a row; there must be room."""
    arrays.place[row] = (*index.corner, 1.0 / index.side_m)
    arrays.shape[row] = (*index.shape, len(index.edges))
    for name in ("edges", "circles", "starts", "items", "nearest"):
        part = getattr(index, name)
        getattr(arrays, name)[row, : len(part)] = part


@numba.njit(cache=True, nogil=True)
def square_of(levels, row, x, y):  # type: ignore[no-untyped-def]
    """Return which list of a row of LevelArrays is for a sensor at (x, y), metres."""
    rows, columns = levels.shape[row, 0], levels.shape[row, 1]
    i = math.floor((y - levels.place[row, 1]) * levels.place[row, 2])
    j = math.floor((x - levels.place[row, 0]) * levels.place[row, 2])
    return i * columns + j if 0 <= i < rows and 0 <= j < columns else rows * columns
