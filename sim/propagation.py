"""Who can hear whom: a disc, or path loss that grows behind walls; one kernel for served flights and for training.

Log-distance path loss: received power = transmitted power - loss at 1 m - 10 n log10(d / 1 m), d at least 1 m, heard
from a threshold on. Free space has n = 2 (Friis 1946); behind walls n = 4 for the whole path is the usual figure for
buildings (Rappaport, Wireless Communications, 2nd ed., table 4.2). Instead of the larger exponent each wall between
may cost a fixed number of decibels (Motley and Keenan 1988).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba


class Propagation(NamedTuple):
    """What the kernels need of the radio's settings, in metres and decibels.

    `clear_m` is the reach in sight of each other, `walled_m` the reach whatever stands between. With `wall_db` above
    zero each wall between costs so much of `budget_db`, which is what distance may cost in all, at 10 x `exponent`
    decibels per decade.
    """

    clear_m: float
    walled_m: float
    budget_db: float
    exponent: float
    wall_db: float


def disc(range_m: float) -> Propagation:
    """Return the reach of a disc: `range_m` metres, through any wall."""
    return Propagation(range_m, range_m, 0.0, 2.0, 0.0)


def path_loss(budget_db: float, exponent_clear: float, exponent_walled: float, wall_db: float | None) -> Propagation:
    """Return the reach under path loss, where distance and walls may cost `budget_db` beyond the first metre.

    With `wall_db` walls cost decibels and `exponent_walled` is not used.
    """
    clear_m = reach_m(budget_db, exponent_clear)
    walled_m = reach_m(budget_db, exponent_walled) if wall_db is None else 0.0
    return Propagation(clear_m, min(clear_m, walled_m), budget_db, exponent_clear, wall_db or 0.0)


def reach_m(budget_db: float, exponent: float) -> float:
    """Return the distance, metres, at which path loss has used up `budget_db`; 0 where not even the first metre fits.

    Nearer than one metre nothing is gained, so a link without budget for that reaches nobody.
    """
    return 0.0 if budget_db < 0.0 else float(10.0 ** (budget_db / (10.0 * exponent)))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def crossings(ax, ay, bx, by, segments, most):  # type: ignore[no-untyped-def]
    """Count the segments (`[n, 4]`: x0, y0, x1, y1, metres) that the line from a to b crosses, up to `most` + 1.

    Ends that lie on a line count as above it, so a line through a shared corner of two segments crosses the closed
    loop they belong to once, and one that touches the corner crosses it twice or not at all. A segment that the line
    runs along is not crossed.
    """
    if bx < ax or (bx == ax and by < ay):  # which end comes first must not matter where a wall ends on the line
        ax, ay, bx, by = bx, by, ax, ay
    low_x, high_x = min(ax, bx), max(ax, bx)
    low_y, high_y = min(ay, by), max(ay, by)
    dx, dy = bx - ax, by - ay
    count = 0
    for k in range(segments.shape[0]):
        px, py, qx, qy = segments[k, 0], segments[k, 1], segments[k, 2], segments[k, 3]
        if max(px, qx) < low_x or min(px, qx) > high_x or max(py, qy) < low_y or min(py, qy) > high_y:
            continue
        if ((dx * (py - ay) - dy * (px - ax)) >= 0.0) == ((dx * (qy - ay) - dy * (qx - ax)) >= 0.0):
            continue
        ex, ey = qx - px, qy - py
        if ((ex * (ay - py) - ey * (ax - px)) >= 0.0) == ((ex * (by - py) - ey * (bx - px)) >= 0.0):
            continue
        count += 1
        if count > most:
            break
    return count


@numba.njit(cache=True, nogil=True, error_model="numpy")
def hear_each_other(ax, ay, bx, by, segments, propagation):  # type: ignore[no-untyped-def]
    """Tell whether radios at a and b (metres) hear each other past the faces `segments` (`[n, 4]`) of all walls.

    A wall has two faces, so an odd crossing (of a level's outline) counts as a whole wall.
    """
    squared = (bx - ax) * (bx - ax) + (by - ay) * (by - ay)
    if squared <= propagation.walled_m * propagation.walled_m:
        return True
    if squared > propagation.clear_m * propagation.clear_m:
        return False
    faces = 0
    if propagation.wall_db > 0.0:
        spare_db = propagation.budget_db - 5.0 * propagation.exponent * math.log10(max(squared, 1.0))
        faces = 2 * math.floor(spare_db / propagation.wall_db)
    return crossings(ax, ay, bx, by, segments, faces) <= faces


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fill_reach(reach, places, segments, propagation):  # type: ignore[no-untyped-def]
    """Fill `reach` (uint8 `[n, n]`): 1 where radios at `places` (`[n, 2 or more]`, x and y first) hear each other.

    Nobody hears itself. Symmetric, since each pair is tested once.
    """
    n = reach.shape[0]
    for a in range(n):
        reach[a, a] = 0
        for b in range(a + 1, n):
            heard = hear_each_other(places[a, 0], places[a, 1], places[b, 0], places[b, 1], segments, propagation)
            reach[a, b] = reach[b, a] = 1 if heard else 0
