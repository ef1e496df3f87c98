"""Numba kernels that lay a level's geometry on lattices: inside or out, clearance, what can be reached.

The lattice has a point every half cell, `[2 rows + 1, 2 columns + 1]`: point (i, j) of a grid with origin (column0,
row0) lies at x = (2 column0 + j) CELL / 2, y = (2 row0 + i) CELL / 2. Odd indices are the centres of cells.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from imagine.core.raster import CELL


@numba.njit(cache=True, nogil=True)
def fill_loop(mask, loop, column0, row0, value):  # type: ignore[no-untyped-def]
    """Set the lattice points (uint8) inside a closed loop `[n, 2]`, by the crossing number, to `value`."""
    height, width = mask.shape
    count = len(loop)
    low, high = np.inf, -np.inf
    for k in range(count):
        low, high = min(low, loop[k, 1]), max(high, loop[k, 1])
    first = max(0, math.floor(low / CELL * 2.0) - 2 * row0)
    last = min(height - 1, math.ceil(high / CELL * 2.0) - 2 * row0)
    if last < first:
        return
    flips = np.zeros((last - first + 1, width + 1), np.bool_)
    for k in range(count):
        x0, y0 = loop[k]
        x1, y1 = loop[(k + 1) % count]
        if y0 == y1:
            continue
        begin = max(first, math.floor(min(y0, y1) / CELL * 2.0) - 2 * row0)
        end = min(last, math.ceil(max(y0, y1) / CELL * 2.0) - 2 * row0)
        for i in range(begin, end + 1):
            y = (2 * row0 + i) * 0.5 * CELL
            if (y0 > y) == (y1 > y):
                continue
            crossing = (x1 - x0) * (y - y0) / (y1 - y0) + x0
            j = min(max(math.floor(crossing / CELL * 2.0) - 2 * column0, 0), width)
            while j > 0 and (2 * column0 + j - 1) * 0.5 * CELL >= crossing:
                j -= 1
            while j < width and (2 * column0 + j) * 0.5 * CELL < crossing:
                j += 1
            flips[i - first, j] = not flips[i - first, j]  # every point before j has this crossing to its right
    for i in range(first, last + 1):
        inside = False
        for j in range(width, 0, -1):
            if flips[i - first, j]:
                inside = not inside
            if inside:
                mask[i, j - 1] = value


@numba.njit(cache=True, nogil=True)
def _segment_distance(px, py, x0, y0, x1, y1):  # type: ignore[no-untyped-def]
    dx, dy = x1 - x0, y1 - y0
    t = ((px - x0) * dx + (py - y0) * dy) / max(dx * dx + dy * dy, 1e-12)
    t = min(max(t, 0.0), 1.0)
    ex, ey = px - x0 - t * dx, py - y0 - t * dy
    return math.sqrt(ex * ex + ey * ey)


@numba.njit(cache=True, nogil=True)
def lay_out(inside, clearance, outline, loops, starts, segments, circles, column0, row0):  # type: ignore[no-untyped-def]
    """Fill `inside` (uint8 lattice) with the free points and `clearance` (float64 lattice) with their distances.

    `loops` `[n, 2]` holds the solid loops one after the other, loop k from `starts[k]` to `starts[k + 1]`. Distances
    are to the nearest segment or circle, metres, cut at what `clearance` holds when called.
    """
    height, width = inside.shape
    fill_loop(inside, outline, column0, row0, 1)
    for k in range(len(starts) - 1):
        fill_loop(inside, loops[starts[k] : starts[k + 1]], column0, row0, 0)
    cap = clearance[0, 0]
    half = 0.5 * CELL
    for k in range(len(segments)):
        x0, y0, x1, y1 = segments[k]
        top = min(height - 1, math.ceil((max(y0, y1) + cap) / half) - 2 * row0)
        right = min(width - 1, math.ceil((max(x0, x1) + cap) / half) - 2 * column0)
        for i in range(max(0, math.floor((min(y0, y1) - cap) / half) - 2 * row0), top + 1):
            for j in range(max(0, math.floor((min(x0, x1) - cap) / half) - 2 * column0), right + 1):
                if inside[i, j]:
                    x, y = (2 * column0 + j) * 0.5 * CELL, (2 * row0 + i) * 0.5 * CELL
                    clearance[i, j] = min(clearance[i, j], _segment_distance(x, y, x0, y0, x1, y1))
    for k in range(len(circles)):
        cx, cy, radius = circles[k]
        reach = radius + cap
        top = min(height - 1, math.ceil((cy + reach) / half) - 2 * row0)
        right = min(width - 1, math.ceil((cx + reach) / half) - 2 * column0)
        for i in range(max(0, math.floor((cy - reach) / half) - 2 * row0), top + 1):
            for j in range(max(0, math.floor((cx - reach) / half) - 2 * column0), right + 1):
                x, y = (2 * column0 + j) * 0.5 * CELL, (2 * row0 + i) * 0.5 * CELL
                distance = math.sqrt((x - cx) ** 2 + (y - cy) ** 2) - radius
                if distance <= 0.0:
                    inside[i, j] = 0
                clearance[i, j] = min(clearance[i, j], max(distance, 0.0))
    for i in range(height):
        for j in range(width):
            if not inside[i, j]:
                clearance[i, j] = 0.0


@numba.njit(cache=True, nogil=True)
def flood(open_points, reached, row, column):  # type: ignore[no-untyped-def]
    """Set in `reached` (bool) the points of `open_points` (bool) that hang together with one of them, eight ways."""
    height, width = open_points.shape
    stack = np.empty(height * width, np.int64)
    count = 0
    if open_points[row, column]:
        reached[row, column] = True
        stack[0] = row * width + column
        count = 1
    while count > 0:
        count -= 1
        i, j = stack[count] // width, stack[count] % width
        for di in range(max(0, i - 1), min(height, i + 2)):
            for dj in range(max(0, j - 1), min(width, j + 2)):
                if open_points[di, dj] and not reached[di, dj]:
                    reached[di, dj] = True
                    stack[count] = di * width + dj
                    count += 1


@numba.njit(cache=True, nogil=True)
def choose_apart(spots, x, y, wanted, spacing, chosen):  # type: ignore[no-untyped-def]
    """Fill `chosen` (int64 `[wanted]`) with the spots `[n, 2]` nearest to (x, y), each `spacing` from all before it.

    Returns how many there are.
    """
    count = len(spots)
    distance = np.empty(count)
    for k in range(count):
        distance[k] = (spots[k, 0] - x) ** 2 + (spots[k, 1] - y) ** 2
    for found in range(wanted):
        best, nearest = np.inf, -1
        for k in range(count):
            if distance[k] < best:
                best, nearest = distance[k], k
        if nearest < 0:
            return found
        chosen[found] = nearest
        for k in range(count):
            if (spots[k, 0] - spots[nearest, 0]) ** 2 + (spots[k, 1] - spots[nearest, 1]) ** 2 < spacing * spacing:
                distance[k] = np.inf
    return wanted


@numba.njit(cache=True, nogil=True)
def free_points(free, points, clearance, outline, loops, starts, segments, circles):  # type: ignore[no-untyped-def]
    """Set in `free` (bool `[n]`) which points `[n, 2]` lie inside, outside all solids, and clear of every edge."""
    for k in range(len(points)):
        x, y = points[k]
        ok = _in_loop(outline, x, y)
        for loop in range(len(starts) - 1):
            ok = ok and not _in_loop(loops[starts[loop] : starts[loop + 1]], x, y)
        for post in range(len(circles)):
            cx, cy, radius = circles[post]
            ok = ok and math.sqrt((x - cx) ** 2 + (y - cy) ** 2) > radius + clearance
        if ok and clearance > 0.0:
            for s in range(len(segments)):
                if _segment_distance(x, y, segments[s, 0], segments[s, 1], segments[s, 2], segments[s, 3]) <= clearance:
                    ok = False
                    break
        free[k] = ok


@numba.njit(cache=True, nogil=True)
def _in_loop(loop, x, y):  # type: ignore[no-untyped-def]
    inside = False
    count = len(loop)
    for k in range(count):
        x0, y0 = loop[k]
        x1, y1 = loop[(k + 1) % count]
        if (y0 > y) != (y1 > y) and x < (x1 - x0) * (y - y0) / (y1 - y0) + x0:
            inside = not inside
    return inside
