"""Numba kernels that lay a level's geometry on lattices: inside or out, clearance, what can be reached, what is seen.

The lattice has a point every half cell, `[2 rows + 1, 2 columns + 1]`: point (i, j) of a grid with origin (column0,
row0) lies at x = (2 column0 + j) CELL / 2, y = (2 row0 + i) CELL / 2. Odd indices are the centres of cells.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from imagine.core.raster import CELL

_NEAR_TARGET_M = 1e-3  # what lies this close to the cell looked at does not hide it: it may stand on a wall's face
_RAYS = 720  # that look for a way to see a cell from afar: half a degree, 3 cm at 4 m


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
