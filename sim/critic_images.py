"""What a centralised critic sees in training: the whole level, what of it is explored, and where everyone is."""

from __future__ import annotations

import math

import numba

from imagine.core.raster import CELL

CRITIC_CHANNELS, CRITIC_CELLS = 5, 32


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
