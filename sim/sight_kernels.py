"""Numba kernels that tell which cells of a level are seen from where drones can fly, along straight lines.

Lattice points are those of `level_kernels`: one every half cell, odd indices at the centres of cells.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from imagine.core.raster import CELL

_NEAR_TARGET_M = 1e-3  # what lies this close to the cell looked at does not hide it: it may stand on a wall's face
_RAYS = 720  # that look for a way to see a cell from afar: half a degree, 3 cm at 4 m


@numba.njit(cache=True, nogil=True)
def _visit_segment(counts, entries, fill, index, segment, column0, row0):  # type: ignore[no-untyped-def]
    """Count, or with `fill` enter, a segment in the cells that it touches, and in those a hair's breadth away."""
    rows, columns = counts.shape
    x0, y0, x1, y1 = segment
    if y0 > y1:
        x0, y0, x1, y1 = x1, y1, x0, y0
    hair = 1e-7
    first = max(0, math.floor((y0 - hair) / CELL) - row0)
    last = min(rows - 1, math.floor((y1 + hair) / CELL) - row0)
    for i in range(first, last + 1):
        low, high = x0, x1
        if y1 - y0 > 1e-9:
            a = min(max(((i + row0) * CELL - hair - y0) / (y1 - y0), 0.0), 1.0)
            b = min(max(((i + row0 + 1) * CELL + hair - y0) / (y1 - y0), 0.0), 1.0)
            low, high = x0 + a * (x1 - x0), x0 + b * (x1 - x0)
        if low > high:
            low, high = high, low
        begin = max(0, math.floor((low - hair) / CELL) - column0)
        end = min(columns - 1, math.floor((high + hair) / CELL) - column0)
        for j in range(begin, end + 1):
            if fill:
                entries[counts[i, j]] = index
            counts[i, j] += 1


@numba.njit(cache=True, nogil=True)
def _visit_circle(counts, entries, fill, index, circle, column0, row0):  # type: ignore[no-untyped-def]
    rows, columns = counts.shape
    x, y, radius = circle
    for i in range(
        max(0, math.floor((y - radius) / CELL) - row0), min(rows - 1, math.floor((y + radius) / CELL) - row0) + 1
    ):
        for j in range(
            max(0, math.floor((x - radius) / CELL) - column0),
            min(columns - 1, math.floor((x + radius) / CELL) - column0) + 1,
        ):
            if fill:
                entries[counts[i, j]] = index
            counts[i, j] += 1


@numba.njit(cache=True, nogil=True)
def _hit(index, segments, circles, x, y, dx, dy, after):  # type: ignore[no-untyped-def]
    """Return where an obstacle first meets the way from (x, y) along (dx, dy), past the share `after` of it, or inf."""
    if index < len(segments):
        x0, y0, x1, y1 = segments[index]
        ex, ey = x1 - x0, y1 - y0
        cross = dx * ey - dy * ex
        if cross == 0.0:
            return np.inf  # along the wall: its neighbours stop what runs into it
        t = ((x0 - x) * ey - (y0 - y) * ex) / cross
        u = ((x0 - x) * dy - (y0 - y) * dx) / cross
        return t if t > after and 0.0 <= u <= 1.0 else np.inf
    cx, cy, radius = circles[index - len(segments)]
    fx, fy = x - cx, y - cy
    a, b = dx * dx + dy * dy, fx * dx + fy * dy
    root = b * b - a * (fx * fx + fy * fy - radius * radius)
    if root < 0.0:
        return np.inf
    root = math.sqrt(root)
    if (-b - root) / a > after:
        return (-b - root) / a
    return (-b + root) / a if (-b + root) / a > after else np.inf


@numba.njit(cache=True, nogil=True)
def _open_share(starts, entries, segments, circles, column0, row0, x, y, dx, dy):  # type: ignore[no-untyped-def]
    """Return how much of the way from (x, y) along (dx, dy) nothing stands in: 1 or more if it is open.

    (x, y) is the centre of a cell; cells are walked through one by one, and what each holds is tried.
    """
    rows, columns = starts.shape[0], starts.shape[1] - 1
    after = _NEAR_TARGET_M / math.sqrt(dx * dx + dy * dy)
    column, row = math.floor(x / CELL) - column0, math.floor(y / CELL) - row0
    step_column, step_row = (1 if dx > 0.0 else -1), (1 if dy > 0.0 else -1)
    per_column = CELL / abs(dx) if dx != 0.0 else np.inf
    per_row = CELL / abs(dy) if dy != 0.0 else np.inf
    next_column, next_row = 0.5 * per_column, 0.5 * per_row
    nearest = np.inf
    while 0 <= row < rows and 0 <= column < columns:
        for k in range(starts[row, column], starts[row, column + 1]):
            nearest = min(nearest, _hit(entries[k], segments, circles, x, y, dx, dy, after))
        leaves = min(next_column, next_row)
        if nearest <= leaves or leaves > 1.0:
            break
        if next_column < next_row:
            column += step_column
            next_column += per_column
        else:
            row += step_row
            next_row += per_row
    return nearest


@numba.njit(cache=True, nogil=True)
def _viewpoint(starts, entries, segments, circles, column0, row0, i, j, flyable, offsets, reach, first):  # type: ignore[no-untyped-def]
    """Return a `flyable` lattice point within `reach` metres from which the centre of cell (i, j) is seen, or -1.

    Points are numbered row by row. The point `first` is tried, then those nearby, at `offsets`, one after the other;
    then those that rays from the cell come across.
    """
    height, width = flyable.shape
    x, y = (j + column0 + 0.5) * CELL, (i + row0 + 0.5) * CELL
    half = 0.5 * CELL
    dx, dy = half * (first % width - 2 * j - 1), half * (first // width - 2 * i - 1)
    if dx * dx + dy * dy <= reach * reach and (
        _open_share(starts, entries, segments, circles, column0, row0, x, y, dx, dy) > 1.0
    ):
        return first
    for k in range(len(offsets)):
        a, b = 2 * i + 1 + offsets[k, 0], 2 * j + 1 + offsets[k, 1]
        if 0 <= a < height and 0 <= b < width and flyable[a, b]:
            dx, dy = half * offsets[k, 1], half * offsets[k, 0]
            if _open_share(starts, entries, segments, circles, column0, row0, x, y, dx, dy) > 1.0:
                return a * width + b
    for ray in range(_RAYS):
        bearing = 2.0 * math.pi * (ray + 0.5) / _RAYS
        dx, dy = reach * math.cos(bearing), reach * math.sin(bearing)
        share = min(_open_share(starts, entries, segments, circles, column0, row0, x, y, dx, dy), 1.0)
        last_a, last_b = -1, -1
        for step in range(4, int(share * reach / half) + 1):
            t = step * half / reach
            a, b = 2 * i + 1 + round(t * dy / half), 2 * j + 1 + round(t * dx / half)
            if not (0 <= a < height and 0 <= b < width and flyable[a, b]) or (a == last_a and b == last_b):
                continue
            last_a, last_b = a, b
            to_x, to_y = half * (b - 2 * j - 1), half * (a - 2 * i - 1)
            if to_x * to_x + to_y * to_y <= reach * reach and (
                _open_share(starts, entries, segments, circles, column0, row0, x, y, to_x, to_y) > 1.0
            ):
                return a * width + b
    return -1


@numba.njit(cache=True, nogil=True)
def see(seen, free, flyable, offsets, reach, segments, circles, column0, row0):  # type: ignore[no-untyped-def]
    """Set in `seen` (bool `[rows, columns]`) the `free` cells whose centres are seen from a `flyable` lattice point.

    Sight reaches so many metres, and ends at segments and circles. `offsets` `[n, 2]` are the lattice steps (row,
    column) of the points near a cell, nearest first. What lies on the way to a cell that is seen is seen as well, so
    cells are tried from where drones fly outward, first from where their neighbour was seen; hidden rooms cost little.
    """
    rows, columns = free.shape
    starts = np.zeros((rows, columns + 1), np.int64)
    nothing = np.empty(0, np.int32)
    counts = starts[:, 1:]
    for k in range(len(segments)):
        _visit_segment(counts, nothing, False, k, segments[k], column0, row0)
    for k in range(len(circles)):
        _visit_circle(counts, nothing, False, len(segments) + k, circles[k], column0, row0)
    total = 0
    for i in range(rows):
        for j in range(columns):
            own = counts[i, j]
            counts[i, j] = total
            total += own
    entries = np.empty(total, np.int32)
    for k in range(len(segments)):
        _visit_segment(counts, entries, True, k, segments[k], column0, row0)
    for k in range(len(circles)):
        _visit_circle(counts, entries, True, len(segments) + k, circles[k], column0, row0)
    for i in range(rows):  # entering has moved each cell's start to its end, which is where the next one starts
        starts[i, 0] = counts[i - 1, columns - 1] if i > 0 else 0
    width = flyable.shape[1]
    views = np.empty((rows, columns), np.int64)
    queue = np.empty(rows * columns, np.int64)
    count = 0
    for i in range(rows):
        for j in range(columns):
            if free[i, j] and flyable[2 * i + 1, 2 * j + 1]:
                seen[i, j] = True
                views[i, j] = (2 * i + 1) * width + 2 * j + 1
                queue[count] = i * columns + j
                count += 1
    tried = seen.copy()
    done = 0
    while done < count:
        row, column = queue[done] // columns, queue[done] % columns
        done += 1
        for i in range(max(0, row - 2), min(rows, row + 3)):
            for j in range(max(0, column - 2), min(columns, column + 3)):
                if tried[i, j] or not free[i, j]:
                    continue
                tried[i, j] = True
                views[i, j] = _viewpoint(
                    starts, entries, segments, circles, column0, row0, i, j, flyable, offsets, reach, views[row, column]
                )
                if views[i, j] >= 0:
                    seen[i, j] = True
                    queue[count] = i * columns + j
                    count += 1
