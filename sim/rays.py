"""Exact LiDAR rays against edges and discs, in numba.

What a beam meets first is kept as the *inverse* of its range. Along a straight edge the inverse range is linear in
the beam's direction: 1/r = (ux ey − uy ex) / (a × e) for a unit direction u, an edge e and its begin a, seen from the
sensor. So an edge costs a beam two multiplications and a maximum and no division, and a buffer that starts at one over
the reach needs no test of ranges. The beams that an edge fills follow from the angles of its ends.

A scan is: `add_edge` and `add_disc` for whatever may be in sight, into a `sight` of `new_sight`; then `draw`.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

_TWO_PI, _HALF_PI = 2.0 * math.pi, 0.5 * math.pi
_ANGLE_SLACK = 1e-7
"""Radians; `angle_of` errs by less, and a beam so near to the end of an edge is told apart by a cross product."""
_SEAM_SLACK = 1e-12
"""Radians by which edges are wider than they are, so that no beam slips through where two of them meet."""
_TOUCH_M = 1e-7
"""A sensor so near to the line of an edge touches the edge, or sees it edge-on: its inverse ranges are rounding."""
_ROWS = 9
_AX, _AY, _BX, _BY, _FROM, _TO, _GX, _GY, _DISC = range(_ROWS)

# atan(z) / z in powers of z² for z in [0, 1], equal ripples of 6e-9 rad (a least-squares fit at 4001 Chebyshev nodes,
# reweighted until even)
_ATAN = (
    0.999999886385, -0.333325970349, 0.199859068318, -0.141612294938, 0.104989468165, -0.0723485839762,
    0.0397812315544, -0.0144013610494, 0.00245672504325,
)  # fmt: skip


def beam_table(beams: int, increment: float) -> NDArray[np.float64]:
    """Return cosine and sine of every beam's angle from beam 0, `[2, beams]`."""
    angles = np.arange(beams) * increment
    return np.stack((np.cos(angles), np.sin(angles)))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def new_sight(capacity):  # type: ignore[no-untyped-def]
    """Return room for what may be in sight of a sensor: at most `capacity` edges and discs."""
    return np.empty((_ROWS, capacity))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def add_edge(sight, count, ax, ay, bx, by, cosine, sine):  # type: ignore[no-untyped-def]
    """Put an edge in sight if the sensor is in front of it; return the new count.

    Its ends are metres from the sensor along the map's axes; seen from the front, b lies counter-clockwise of a.
    `cosine` and `sine` are of the heading of beam 0.
    """
    ex, ey = bx - ax, by - ay
    cross = ax * ey - ay * ex
    length_squared = ex * ex + ey * ey
    if cross * cross <= _TOUCH_M * _TOUCH_M * length_squared:
        return _add_touched(sight, count, ax, ay, ex, ey, length_squared, cosine, sine)
    if cross < 0.0:
        return count
    scale = 1.0 / cross
    sight[_AX, count], sight[_AY, count] = cosine * ax + sine * ay, cosine * ay - sine * ax
    sight[_BX, count], sight[_BY, count] = cosine * bx + sine * by, cosine * by - sine * bx
    sight[_GX, count], sight[_GY, count] = (cosine * ey - sine * ex) * scale, -(cosine * ex + sine * ey) * scale
    sight[_DISC, count] = 0.0
    return count + 1


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add_touched(sight, count, ax, ay, ex, ey, length_squared, cosine, sine):  # type: ignore[no-untyped-def]
    """Put an edge in sight whose line runs through the sensor: at no distance if touched, else by its nearer end."""
    if length_squared == 0.0:
        return count
    along = -(ax * ex + ay * ey) / length_squared
    slack = _TOUCH_M / math.sqrt(length_squared)
    if -slack <= along <= 1.0 + slack:
        ax, ay, bx, by = -ex, -ey, ex, ey
        scale = 1.0 / (_TOUCH_M * math.sqrt(length_squared))
        gx, gy = ey * scale, -ex * scale
    else:
        bx, by = ax + ex, ay + ey
        nearer_x, nearer_y = (ax, ay) if along < 0.0 else (bx, by)
        scale = 1.0 / (nearer_x * nearer_x + nearer_y * nearer_y)
        gx, gy = nearer_x * scale, nearer_y * scale
        if ax * by - ay * bx < 0.0:
            ax, ay, bx, by = bx, by, ax, ay
    sight[_AX, count], sight[_AY, count] = cosine * ax + sine * ay, cosine * ay - sine * ax
    sight[_BX, count], sight[_BY, count] = cosine * bx + sine * by, cosine * by - sine * bx
    sight[_GX, count], sight[_GY, count] = cosine * gx + sine * gy, cosine * gy - sine * gx
    sight[_DISC, count] = 0.0
    return count + 1


@numba.njit(cache=True, nogil=True, error_model="numpy")
def add_disc(sight, count, x, y, radius, cosine, sine):  # type: ignore[no-untyped-def]
    """Put a disc, centre in metres from the sensor along the map's axes, in sight; return the new count.

    A disc without radius, or around the sensor, is not seen.
    """
    power = x * x + y * y - radius * radius
    if radius <= 0.0 or power <= 0.0:
        return count
    tangent = math.sqrt(power)
    cx, cy = cosine * x + sine * y, cosine * y - sine * x
    sight[_AX, count], sight[_AY, count] = cx * tangent + cy * radius, cy * tangent - cx * radius
    sight[_BX, count], sight[_BY, count] = cx * tangent - cy * radius, cy * tangent + cx * radius
    sight[_GX, count], sight[_GY, count] = cx, cy
    sight[_DISC, count] = power
    return count + 1


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def angle_of(x, y):  # type: ignore[no-untyped-def]
    """Return the angle of (x, y) in [0, 2 pi], to 1e-8 rad."""
    width, height = abs(x), abs(y)
    z = min(width, height) / max(width, height)
    q = z * z
    p = _ATAN[8]
    p = p * q + _ATAN[7]
    p = p * q + _ATAN[6]
    p = p * q + _ATAN[5]
    p = p * q + _ATAN[4]
    p = p * q + _ATAN[3]
    p = p * q + _ATAN[2]
    p = p * q + _ATAN[1]
    p = (p * q + _ATAN[0]) * z
    p = _HALF_PI - p if height > width else p
    p = math.pi - p if x < 0.0 else p
    return _TWO_PI - p if y < 0.0 else p


@numba.njit(cache=True, nogil=True, error_model="numpy")
def draw(inverse, sight, count, table, increment):  # type: ignore[no-untyped-def]
    """Raise `inverse` (float64 `[beams]`, 1/m) to the inverse range of the nearest thing in sight of each beam."""
    beams = len(inverse)
    for k in range(count):
        sight[_FROM, k] = angle_of(sight[_AX, k], sight[_AY, k])
    for k in range(count):
        sight[_TO, k] = angle_of(sight[_BX, k], sight[_BY, k])
    per_radian = 1.0 / increment
    slack = _ANGLE_SLACK * per_radian
    turn = _TWO_PI * per_radian
    for k in range(count):
        low, high = sight[_FROM, k] * per_radian, sight[_TO, k] * per_radian
        if high - low < -0.25 * turn:
            high += turn
        elif high - low > 0.75 * turn:  # a sliver across beam 0, its ends swapped by rounding
            high -= turn
        gx, gy, power = sight[_GX, k], sight[_GY, k], sight[_DISC, k]
        while True:  # what reaches past a full turn comes round again from the first beam
            begin, end = math.ceil(low - slack), math.floor(high + slack)
            if 0 <= begin < beams and begin - low <= slack:
                begin += _is_before(sight[_AX, k], sight[_AY, k], table[0, begin], table[1, begin])
            if 0 <= end < beams and high - end <= slack:
                end -= _is_before(table[0, end], table[1, end], sight[_BX, k], sight[_BY, k])
            begin, end = max(begin, 0), min(end, beams - 1)
            if power == 0.0:
                for beam in range(begin, end + 1):
                    inverse[beam] = max(inverse[beam], table[0, beam] * gx + table[1, beam] * gy)
            else:
                scale = 1.0 / power
                for beam in range(begin, end + 1):
                    along = table[0, beam] * gx + table[1, beam] * gy
                    root = math.sqrt(max(along * along - power, 0.0))
                    inverse[beam] = max(inverse[beam], (along + root) * scale)
            if high < turn - slack:
                break
            low, high = low - turn, high - turn


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _is_before(ax, ay, bx, by):  # type: ignore[no-untyped-def]
    """Return 1 if b lies clockwise of a by more than rounding, else 0; one of the two is a unit vector."""
    return 1 if ax * by - ay * bx < -_SEAM_SLACK * (abs(ax) + abs(ay)) * (abs(bx) + abs(by)) else 0


@numba.njit(cache=True, nogil=True, error_model="numpy")
def cast_rays(ranges, segments, circles, x, y, heading, increment, range_max):  # type: ignore[no-untyped-def]
    """Fill `ranges` (float64 `[beams]`) with the distance to the first hit, inf beyond `range_max`.

    `segments` `[n, 4]`, seen from both sides, and `circles` `[m, 3]` in metres; beam i looks along
    `heading + i * increment`. For a handful of rays or obstacles: `Sensing` knows beforehand what is in reach.
    """
    beams = len(ranges)
    table = np.empty((2, beams))
    for beam in range(beams):
        table[0, beam], table[1, beam] = math.cos(beam * increment), math.sin(beam * increment)
        ranges[beam] = 1.0 / range_max
    cosine, sine = math.cos(heading), math.sin(heading)
    sight = new_sight(len(segments) + len(circles))
    count = 0
    for k in range(len(segments)):
        ax, ay, bx, by = segments[k, 0] - x, segments[k, 1] - y, segments[k, 2] - x, segments[k, 3] - y
        if ax * by - ay * bx < 0.0:
            ax, ay, bx, by = bx, by, ax, ay
        count = add_edge(sight, count, ax, ay, bx, by, cosine, sine)
    for k in range(len(circles)):
        count = add_disc(sight, count, circles[k, 0] - x, circles[k, 1] - y, circles[k, 2], cosine, sine)
    draw(ranges, sight, count, table, increment)
    for beam in range(beams):
        ranges[beam] = 1.0 / ranges[beam] if ranges[beam] > 1.0 / range_max else np.inf
