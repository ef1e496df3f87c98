"""The kernel that scans: every drone of a world, what is in its sight, and what the sensor makes of it."""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from imagine.sim.keyed_noise import key_of
from imagine.sim.level_index import LevelArrays, square_of
from imagine.sim.lidar_model import DARK_SHARE, DROPOUT, MISSES, cast_limit, darken, lose_beams, measure
from imagine.sim.rays import add_disc, add_edge, draw, new_sight
from imagine.sim.scan_skew import draw_moving, fill_rays


class Sensors(NamedTuple):
    """All that `scan_world` needs besides poses: the levels by row, each world's row, its sensor numbers and key."""

    levels: LevelArrays
    rows: NDArray[np.int64]
    numbers: NDArray[np.float64]
    keys: NDArray[np.uint64]
    table: NDArray[np.float64]
    normal: NDArray[np.float32]
    start: float
    increment: float
    reach: float
    turn_s: float
    """Seconds from the first beam to the last, if they are taken one after another; 0: all at once."""


@numba.njit(cache=True, nogil=True)
def scan_worlds(  # type: ignore[no-untyped-def]
    first, last, ranges, sensors, poses, velocity, alive, discs, edges, drone_radius, tick
):
    """Scan in worlds first to last, as `scan_world` does."""
    for world in range(first, last):
        scan_world(world, ranges, sensors, poses, velocity, alive, discs, edges, drone_radius, tick)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def scan_world(  # type: ignore[no-untyped-def]
    world, ranges, sensors, poses, velocity, alive, discs, edges, drone_radius, tick
):
    """Fill `ranges[world]` (float32 `[worlds, drones, beams]`) with a turn of each drone's LiDAR.

    Arguments as for `Sensing.scan`, `sensors` from `Sensing.sensors`; for kernels that loop over worlds themselves.
    """
    drones, beams = ranges.shape[1], ranges.shape[2]
    numbers, table = sensors.numbers[world], sensors.table
    limit = cast_limit(numbers, sensors.reach)
    key = key_of(sensors.keys[world], tick)
    inverse, rays = np.empty(beams), np.empty((4, beams))
    sight = new_sight(sensors.levels.longest + discs.shape[1] + edges.shape[1] + drones)
    for drone in range(drones):
        if not alive[world, drone]:
            ranges[world, drone] = np.nan
            continue
        inverse[:] = 1.0 / limit
        heading = poses[world, drone, 2] + sensors.start
        if sensors.turn_s > 0.0:
            fan = fill_rays(rays, heading, velocity[world, drone], sensors.increment, sensors.turn_s)
            draw_moving(
                inverse, rays, fan, sensors.levels, sensors.rows[world], poses[world], drone, alive[world],
                discs[world], edges[world], drone_radius, limit,
            )  # fmt: skip
        else:
            count = _look_around(
                sight, sensors.levels, sensors.rows[world], poses[world], drone, alive[world], discs[world],
                edges[world], drone_radius, limit, heading,
            )  # fmt: skip
            draw(inverse, sight, count, table, sensors.increment)
        own = key_of(key, drone)
        measure(ranges[world, drone], inverse, limit, sensors.reach, numbers, sensors.normal, own)
        if numbers[DROPOUT] > 0.0 or numbers[MISSES] > 0.0:
            lose_beams(ranges[world, drone], inverse, numbers, own)
        if numbers[DARK_SHARE] > 0.0:
            darken(ranges[world, drone], inverse, table, poses[world, drone], heading, numbers, sensors.keys[world])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _look_around(  # type: ignore[no-untyped-def]
    sight, levels, row, poses, drone, alive, discs, edges, drone_radius, limit, heading
):
    """Put all that is in a drone's sight up to `limit` metres into `sight`; return how much it is."""
    x, y = poses[drone, 0], poses[drone, 1]
    c, s = math.cos(heading), math.sin(heading)
    first_circle, square = levels.shape[row, 2], square_of(levels, row, x, y)
    count = np.int64(0)  # typed: a literal would have everything below compiled twice
    for at in range(levels.starts[row, square], levels.starts[row, square + 1]):
        if levels.nearest[row, at] > limit:
            break
        item = levels.items[row, at]
        if item < first_circle:
            count = add_edge(
                sight, count, levels.edges[row, item, 0] - x, levels.edges[row, item, 1] - y,
                levels.edges[row, item, 2] - x, levels.edges[row, item, 3] - y, c, s,
            )  # fmt: skip
        else:
            circle = levels.circles[row, item - first_circle]
            count = _add_near_disc(sight, count, circle[0] - x, circle[1] - y, circle[2], limit, c, s)
    for k in range(len(discs) + len(poses)):
        other = k - len(discs)
        if other < 0:
            cx, cy, radius = discs[k, 0], discs[k, 1], discs[k, 2]
        elif other != drone and alive[other]:
            cx, cy, radius = poses[other, 0], poses[other, 1], drone_radius
        else:
            continue
        count = _add_near_disc(sight, count, cx - x, cy - y, radius, limit, c, s)
    for k in range(len(edges)):  # of loops that turn either way, so they are seen from both sides
        ax, ay, bx, by = edges[k, 0] - x, edges[k, 1] - y, edges[k, 2] - x, edges[k, 3] - y
        if ax * by - ay * bx < 0.0:
            ax, ay, bx, by = bx, by, ax, ay
        count = add_edge(sight, count, ax, ay, bx, by, c, s)
    return count


@numba.njit(cache=True, nogil=True)
def _add_near_disc(sight, count, x, y, radius, limit, cosine, sine):  # type: ignore[no-untyped-def]
    if x * x + y * y > (limit + radius) * (limit + radius):
        return count
    return add_disc(sight, count, x, y, radius, cosine, sine)
