"""Exact LiDAR rays against line segments and circles, in numba."""

from __future__ import annotations

import math

import numba
import numpy as np

_TWO_PI = 2.0 * math.pi


@numba.njit(cache=True, nogil=True, error_model="numpy")
def cast_rays(ranges, segments, circles, x, y, heading, increment, range_max):  # type: ignore[no-untyped-def]
    """Fill `ranges` (float64 `[beams]`) with the distance to the first hit, inf beyond `range_max`.

    `segments` `[n, 4]`, `circles` `[m, 3]` in metres; beam i looks along `heading + i * increment`. Each obstacle is
    tested only against the beams within the angle it fills, so the cost follows what is in sight.
    """
    beams = len(ranges)
    ranges[:] = np.inf
    for k in range(len(segments)):
        ax, ay = segments[k, 0] - x, segments[k, 1] - y
        ex, ey = segments[k, 2] - segments[k, 0], segments[k, 3] - segments[k, 1]
        length_squared = ex * ex + ey * ey
        along = -(ax * ex + ay * ey)
        t = min(max(along / length_squared, 0.0), 1.0) if length_squared > 0.0 else 0.0
        nearest_x, nearest_y = ax + t * ex, ay + t * ey
        if nearest_x * nearest_x + nearest_y * nearest_y > range_max * range_max:
            continue
        cross = ax * ey - ay * ex
        if cross == 0.0:
            continue  # seen edge-on
        first = math.atan2(ay, ax)
        span = math.atan2(ay + ey, ax + ex) - first
        if span > math.pi:
            span -= _TWO_PI
        elif span < -math.pi:
            span += _TWO_PI
        low = first if span >= 0.0 else first + span
        offset = (low - heading) % _TWO_PI
        for _ in range(2):  # what reaches past a full turn comes round again from the first beam
            begin = max(0, math.ceil(offset / increment - 1e-9))
            end = min(beams - 1, math.floor((offset + abs(span)) / increment + 1e-9))
            for beam in range(begin, end + 1):
                bearing = heading + beam * increment
                facing = math.cos(bearing) * ey - math.sin(bearing) * ex
                if facing == 0.0:
                    continue
                distance = cross / facing
                if 0.0 <= distance < ranges[beam]:
                    ranges[beam] = distance
            offset -= _TWO_PI
    for k in range(len(circles)):
        cx, cy, radius = circles[k, 0] - x, circles[k, 1] - y, circles[k, 2]
        distance_squared = cx * cx + cy * cy
        centre = math.sqrt(distance_squared)
        if centre - radius > range_max or centre <= radius:
            continue
        half = math.asin(radius / centre)
        offset = (math.atan2(cy, cx) - half - heading) % _TWO_PI
        for _ in range(2):
            begin = max(0, math.ceil(offset / increment))
            end = min(beams - 1, math.floor((offset + 2.0 * half) / increment))
            for beam in range(begin, end + 1):
                bearing = heading + beam * increment
                along = cx * math.cos(bearing) + cy * math.sin(bearing)
                root = radius * radius - (distance_squared - along * along)
                if root >= 0.0:
                    distance = along - math.sqrt(root)
                    if 0.0 <= distance < ranges[beam]:
                        ranges[beam] = distance
            offset -= _TWO_PI
    for beam in range(beams):
        if ranges[beam] > range_max:
            ranges[beam] = np.inf


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _mix(value):  # type: ignore[no-untyped-def]
    """Scramble 64 bits (the finaliser of splitmix64, Steele et al. 2014)."""
    value = (value ^ (value >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    value = (value ^ (value >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return value ^ (value >> np.uint64(31))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def add_noise(ranges, key, noise_std, range_min, range_max):  # type: ignore[no-untyped-def]
    """Add Gaussian noise to finite ranges (metres), in place; what falls below `range_min` turns invalid (nan).

    The noise is a function of `key` (uint64) and the beam alone, so a world's scans do not depend on what else runs.
    """
    golden = np.uint64(0x9E3779B97F4A7C15)
    for beam in range(len(ranges)):
        r = ranges[beam]
        if r == np.inf:
            continue
        a = _mix(key + golden * np.uint64(2 * beam + 1))
        b = _mix(key + golden * np.uint64(2 * beam + 2))
        u = (np.float64(a >> np.uint64(11)) + 1.0) / 9007199254740993.0
        v = np.float64(b >> np.uint64(11)) / 9007199254740992.0
        r += noise_std * math.sqrt(-2.0 * math.log(u)) * math.cos(_TWO_PI * v)  # Box and Muller 1958
        if r < range_min:
            r = np.nan
        elif r > range_max:
            r = np.inf
        ranges[beam] = r
