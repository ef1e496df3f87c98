"""Closed loops of corners: are they simple polygons, and if not, where do they go wrong."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numba
import numpy as np
from numpy.typing import NDArray

from imagine.core.errors import InputError

_LEAST_AREA_M2 = 1e-6


def simple_loop(points: Sequence[Sequence[float]] | NDArray[np.float64], where: str) -> NDArray[np.float64]:
    """Return a loop's corners `[n, 2]` in metres, without the first one repeated at the end.

    Raises InputError, which begins with `where` and names the coordinates, if they are no simple polygon: fewer than
    three corners, a corner that comes twice, no area, or edges that cross or touch.
    """
    loop = np.array(points, float).reshape(-1, 2)
    if len(loop) > 1 and (loop[0] == loop[-1]).all():
        loop = loop[:-1]
    if len(loop) < 3:
        raise InputError(f"{where}: {len(loop)} different corners enclose nothing: a polygon is closed and has three")
    order = np.lexsort((loop[:, 1], loop[:, 0]))
    same = np.flatnonzero((loop[order][1:] == loop[order][:-1]).all(axis=1))
    if len(same):
        first, second = sorted((int(order[same[0]]), int(order[same[0] + 1])))
        raise InputError(
            f"{where}: corner {first} at {_at(loop[first])} comes again as corner {second}: "
            "a polygon passes each corner once"
        )
    away = loop - loop[0]
    far = away[np.argmax(np.hypot(away[:, 0], away[:, 1]))]
    if np.abs(far[0] * away[:, 1] - far[1] * away[:, 0]).max() < _LEAST_AREA_M2:
        raise InputError(
            f"{where}: it encloses no area: an open line from {_at(loop[0])} to {_at(loop[-1])}, not a polygon"
        )
    first, second, x, y = first_crossing(loop)
    if first >= 0:
        a, b = sorted((first, second))
        raise InputError(
            f"{where}: it crosses or touches itself at {_at((x, y))}, where edge {a} from {_at(loop[a])} meets "
            f"edge {b} from {_at(loop[b])}: a polygon has no crossings"
        )
    return loop


def without_spikes(loop: NDArray[np.float64], longest_m: float) -> NDArray[np.float64]:
    """Return a loop's corners less those where it turns right round on itself, as traced rasters do.

    A spike has no width, and so no meaning; one longer than `longest_m` stays, since it may have been meant as a wall.
    """
    corners = [(float(x), float(y)) for x, y in loop]
    if len(corners) > 1 and corners[0] == corners[-1]:
        corners.pop()
    k = 0
    while k < len(corners) and len(corners) > 3:
        before, tip, after = corners[k - 1], corners[k], corners[(k + 1) % len(corners)]
        a, b = (tip[0] - before[0], tip[1] - before[1]), (after[0] - tip[0], after[1] - tip[1])
        along = a[0] * b[0] + a[1] * b[1]
        across = a[0] * b[1] - a[1] * b[0]
        if before == tip or (along < 0.0 and across == 0.0 and min(math.hypot(*a), math.hypot(*b)) <= longest_m):
            del corners[k]
            k = max(0, k - 2)  # what is left may be a spike in its turn
        else:
            k += 1
    return np.array(corners)


def signed_area(loop: NDArray[np.float64]) -> float:
    """Return a loop's area in square metres, positive where it runs counter-clockwise (the shoelace formula)."""
    x, y = loop[:, 0] - loop[0, 0], loop[:, 1] - loop[0, 1]
    return float(0.5 * np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))


def _at(point: Sequence[float] | NDArray[np.float64]) -> str:
    return f"({point[0]:g}, {point[1]:g})"


def first_crossing(loop: NDArray[np.float64]) -> tuple[int, int, float, float]:
    """Return two edges of a loop that meet where they should not, and where; (-1, -1, nan, nan) if there are none.

    Edge k runs from corner k to the next. Neighbours may share their corner, and nothing more.
    """
    ends = np.roll(loop, -1, axis=0)
    order = np.argsort(np.minimum(loop[:, 0], ends[:, 0]), kind="stable")
    found: tuple[int, int, float, float] = _first_crossing(np.ascontiguousarray(loop), order)
    return found


@numba.njit(cache=True, nogil=True)
def _first_crossing(loop, order):  # type: ignore[no-untyped-def]
    """Sweep along x: an edge is compared with those that begin before it ends."""
    count = len(loop)
    for a in range(count):
        i = order[a]
        right = max(loop[i, 0], loop[(i + 1) % count, 0])
        for b in range(a + 1, count):
            j = order[b]
            if min(loop[j, 0], loop[(j + 1) % count, 0]) > right:
                break
            met, x, y = _meet(loop, i, j)
            if met:
                return i, j, x, y
    return -1, -1, np.nan, np.nan


@numba.njit(cache=True, nogil=True)
def _meet(loop, i, j):  # type: ignore[no-untyped-def]
    """Tell whether edges i and j have a point in common, other than the corner that neighbours share."""
    count = len(loop)
    p, q = loop[i], loop[(i + 1) % count]
    r, s = loop[j], loop[(j + 1) % count]
    if max(p[1], q[1]) < min(r[1], s[1]) or max(r[1], s[1]) < min(p[1], q[1]):
        return False, 0.0, 0.0
    if (i + 1) % count == j or (j + 1) % count == i:
        if (j + 1) % count == i:
            p, q, r, s = r, s, p, q
        # q is r, the shared corner: wrong only where the second edge runs back over the first
        cross = (q[0] - p[0]) * (s[1] - r[1]) - (q[1] - p[1]) * (s[0] - r[0])
        back = (q[0] - p[0]) * (s[0] - r[0]) + (q[1] - p[1]) * (s[1] - r[1]) < 0.0
        return cross == 0.0 and back, q[0], q[1]
    d1, d2 = _side(p, q, r), _side(p, q, s)
    d3, d4 = _side(r, s, p), _side(r, s, q)
    if d1 * d2 < 0.0 and d3 * d4 < 0.0:
        t = d1 / (d1 - d2)
        return True, r[0] + t * (s[0] - r[0]), r[1] + t * (s[1] - r[1])
    if d1 == 0.0 and _between(p, q, r):
        return True, r[0], r[1]
    if d2 == 0.0 and _between(p, q, s):
        return True, s[0], s[1]
    if d3 == 0.0 and _between(r, s, p):
        return True, p[0], p[1]
    if d4 == 0.0 and _between(r, s, q):
        return True, q[0], q[1]
    return False, 0.0, 0.0


@numba.njit(cache=True, nogil=True)
def _side(a, b, point):  # type: ignore[no-untyped-def]
    return (b[0] - a[0]) * (point[1] - a[1]) - (b[1] - a[1]) * (point[0] - a[0])


@numba.njit(cache=True, nogil=True)
def _between(a, b, point):  # type: ignore[no-untyped-def]
    return min(a[0], b[0]) <= point[0] <= max(a[0], b[0]) and min(a[1], b[1]) <= point[1] <= max(a[1], b[1])
