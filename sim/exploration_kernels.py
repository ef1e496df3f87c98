"""The compiled loops of exploration over worlds and drones: setpoints, observations, and the critic's images."""

from __future__ import annotations

import math

import numba

from imagine.core.action import body_velocity_kernel
from imagine.core.observation import fill_motion, fill_sectors, fill_views
from imagine.core.raster import CELL
from imagine.core.shield import shield_kernel


@numba.njit(cache=True, nogil=True)
def shielded_setpoints(setpoints, intents, parameters, poses, ranges, lidar, limits):  # type: ignore[no-untyped-def]
    """Turn the decisions that stand into body velocities and pass them through the shield, both as in flight."""
    range_min, start, increment = lidar
    radius, lag, acceleration = limits
    for world in range(intents.shape[0]):
        for drone in range(intents.shape[1]):
            a, b, c = intents[world, drone]
            x, y, yaw = poses[world, drone]
            vx, vy, rate = body_velocity_kernel(a, b, c, parameters, x, y, yaw)
            vx, vy = shield_kernel(vx, vy, ranges[world, drone], range_min, start, increment, radius, lag, acceleration)
            setpoints[world, drone, 0], setpoints[world, drone, 1], setpoints[world, drone, 2] = vx, vy, rate


@numba.njit(cache=True, nogil=True)
def fill_observations(  # type: ignore[no-untyped-def]
    first, last, views, sectors, motion, belief, distance, origins, poses, velocity, ranges, lidar, scales,
    frontier_ranges, lidar_range, speed, fastest_yaw, heading_axes,
):  # fmt: skip
    """Fill what the policies of worlds `first` to `last` see, as `core.observation` does in flight."""
    range_min, start, increment = lidar
    drones = views.shape[1]
    for index in range(first * drones, last * drones):
        world, drone = index // drones, index % drones
        x, y, yaw = poses[world, drone]
        turn = yaw if heading_axes else 0.0
        fill_views(
            views[world, drone], belief[world, drone], distance[world, drone], origins[world, 0], origins[world, 1],
            x, y, turn, scales, frontier_ranges,
        )  # fmt: skip
        fill_sectors(sectors[world, drone], ranges[world, drone], range_min, start, increment, yaw - turn, lidar_range)
        fill_motion(
            motion[world, drone], velocity[world, drone, 0], velocity[world, drone, 1], velocity[world, drone, 2],
            turn, speed, fastest_yaw,
        )  # fmt: skip


@numba.njit(cache=True, nogil=True)
def fill_critic(first, last, critic, seen, coverable, origins, poses):  # type: ignore[no-untyped-def]
    """Fill the critic's images: share unexplored, explored and not free per 0.8 m pixel, own and other drones."""
    _, drones, _, side, _ = critic.shape
    rows, columns = seen.shape[1], seen.shape[2]
    block = max(8, math.ceil(max(rows, columns) / side))
    for world in range(first, last):
        for row in range(rows):
            for column in range(columns):
                if coverable[world, row, column]:
                    channel = 1 if seen[world, row, column] else 0
                    critic[world, 0, channel, row // block, column // block] += 1.0 / (block * block)
        for i in range(side):
            for j in range(side):
                critic[world, 0, 2, i, j] = 1.0 - critic[world, 0, 0, i, j] - critic[world, 0, 1, i, j]
        for drone in range(1, drones):
            critic[world, drone, :3] = critic[world, 0, :3]
        for drone in range(drones):
            i = (math.floor(poses[world, drone, 1] / CELL) - origins[world, 1]) // block
            j = (math.floor(poses[world, drone, 0] / CELL) - origins[world, 0]) // block
            if 0 <= i < side and 0 <= j < side:
                for viewer in range(drones):
                    critic[world, viewer, 3 if viewer == drone else 4, i, j] = 1.0
