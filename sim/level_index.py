"""Which edges and posts of a level a LiDAR can meet from where: a list for each square of floor, built once a level.

Outline and obstacles are closed loops, so only edges that face the sensor can be what a beam meets first. A square's
list holds whatever faces any point of it within reach, nearest first; it may hold too much, never too little.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple
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
    side, total = _SQUARE_M, len(edges) + len(circles)
    nothing = np.empty(0, np.int64), np.empty(0)
    while True:
        columns, rows = (max(1, math.ceil(extent / side)) for extent in high - low)
        floor = (low[0], low[1], side, rows, columns)
        counts = np.zeros(rows * columns, np.int64)
        _visit(counts, *nothing, edges, circles, floor, reach_m, False)
        if counts.sum() <= _MOST_ITEMS or rows * columns == 1:
            break
        side *= 2.0
    starts = np.concatenate(([0], np.cumsum(counts), [counts.sum() + total]))
    items, distances = np.arange(starts[-1]) - starts[-2], np.zeros(starts[-1])  # the last list holds everything
    _visit(starts[:-2].copy(), items, distances, edges, circles, floor, reach_m, True)
    order = np.lexsort((distances, np.repeat(np.arange(rows * columns + 1), np.diff(starts))))
    nearest = np.maximum(distances[order] - 1e-5, 0.0).astype(np.float32)  # so that rounding does not raise it
    corner = float(low[0]), float(low[1])
    return LevelIndex(
        edges, circles, corner, side, (rows, columns), starts.astype(np.int32), items[order].astype(np.int32), nearest
    )


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
def _visit(ends, items, distances, edges, circles, floor, reach, listing):  # type: ignore[no-untyped-def]
    """Raise `ends` of each square for every item in reach of it; when `listing`, also write the item there."""
    x0, y0, side, rows, columns = floor
    half = 0.5 * side * (1.0 + 1e-9)  # a hair more, for rounding
    for item in range(len(edges) + len(circles)):
        if item < len(edges):
            ax, ay, bx, by = edges[item]
            radius = 0.0
        else:
            ax, ay, radius = circles[item - len(edges)]
            bx, by = ax, ay
        ex, ey = bx - ax, by - ay
        length_squared = ex * ex + ey * ey
        grow = reach + radius
        low_row, low_column = (min(ay, by) - grow - y0) / side, (min(ax, bx) - grow - x0) / side
        high_row, high_column = (max(ay, by) + grow - y0) / side, (max(ax, bx) + grow - x0) / side
        for row in range(max(0, math.floor(low_row)), min(rows, math.floor(high_row) + 1)):
            for column in range(max(0, math.floor(low_column)), min(columns, math.floor(high_column) + 1)):
                px, py = ax - x0 - (column + 0.5) * side, ay - y0 - (row + 0.5) * side
                if px * ey - py * ex + half * (abs(ex) + abs(ey)) < 0.0:  # greatest at one of the square's corners
                    continue
                t = min(max(-(px * ex + py * ey) / length_squared, 0.0), 1.0) if length_squared > 0.0 else 0.0
                px, py = px + t * ex, py + t * ey
                distance = max(0.0, math.sqrt(px * px + py * py) - radius - half * math.sqrt(2.0))
                if distance <= reach:
                    square = row * columns + column
                    if listing:
                        items[ends[square]], distances[ends[square]] = item, distance
                    ends[square] += 1


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
    longest = index.longest if arrays is None else max(index.longest, arrays.longest)
    grown: dict[str, NDArray[Any]] = {}
    for name, part in _row_of(index).items():
        array = np.zeros((0, *part.shape), part.dtype) if arrays is None else getattr(arrays, name)
        length = array.shape[1]
        if len(array) < rows or length < len(part):
            longer = length if length >= len(part) else len(part) + len(part) // 4
            larger = np.zeros((max(rows, len(array)), longer, *array.shape[2:]), array.dtype)
            larger[: len(array), :length] = array
            array = larger
        grown[name] = array
    return LevelArrays(longest=longest, **grown)


def write_row(arrays: LevelArrays, row: int, index: LevelIndex) -> None:
    """Put an index into a row; there must be room."""
    for name, part in _row_of(index).items():
        getattr(arrays, name)[row, : len(part)] = part


def _row_of(index: LevelIndex) -> dict[str, NDArray[Any]]:
    return {
        "edges": index.edges,
        "circles": index.circles,
        "place": np.array((*index.corner, 1.0 / index.side_m)),
        "shape": np.array((*index.shape, len(index.edges))),
        "starts": index.starts,
        "items": index.items,
        "nearest": index.nearest,
    }


@numba.njit(cache=True, nogil=True)
def square_of(levels, row, x, y):  # type: ignore[no-untyped-def]
    """Return which list of a row of LevelArrays is for a sensor at (x, y), metres."""
    rows, columns = levels.shape[row, 0], levels.shape[row, 1]
    i = math.floor((y - levels.place[row, 1]) * levels.place[row, 2])
    j = math.floor((x - levels.place[row, 0]) * levels.place[row, 2])
    return i * columns + j if 0 <= i < rows and 0 <= j < columns else rows * columns
