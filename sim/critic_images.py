"""What a centralised critic sees in training: the whole level, what of it is explored, and where everyone is.

From decision to decision the team sees little that is new, so the shares of a level's pixels are kept, and counted
again only where it did; nobody pays who does not ask.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from imagine.core.errors import InputError
from imagine.core.raster import CELL, TILE
from imagine.sim.team_maps import MapArrays
from imagine.sim.workers import Workers

CRITIC_CHANNELS, CRITIC_CELLS = 5, 32
_GROUND = 3  # the channels that are everybody's
_CELLS_A_PIXEL = 8  # along a side, at least


class CriticImages:
    """Images of every drone's world, float32 `[worlds, drones, channels, n, n]`, in shares of a pixel from 0 to 1.

    Channels: coverable and unexplored, coverable and explored, neither; the drone itself; the others. A pixel is 0.8 m,
    or more where the largest level would not fit.
    """

    def __init__(self, maps: MapArrays, workers: Workers) -> None:
        """Show the worlds of `maps`, all of them to be looked at for the first time."""
        worlds, drones = maps.gained.shape
        self.shape = (worlds, drones, CRITIC_CHANNELS, CRITIC_CELLS, CRITIC_CELLS)
        self._maps, self._workers = maps, workers
        self._block = max(_CELLS_A_PIXEL, math.ceil(max(maps.seen.shape[1:]) / CRITIC_CELLS))
        self._ground = np.zeros((worlds, _GROUND, CRITIC_CELLS, CRITIC_CELLS), np.float32)
        self._new = np.ones(worlds, np.bool_)

    def clear(self, world: int) -> None:
        """Look at all of a world when images are next asked for: call it when its maps were cleared."""
        self._new[world] = True

    def fill(self, poses: NDArray[np.float64], out: NDArray[np.float32] | None = None) -> NDArray[np.float32]:
        """Return the images with drones at `poses` `[worlds, drones, 3]`: written into `out` where it is given.

        `out` has the images' shape, or `[worlds * drones, channels, n, n]`, and is contiguous; whatever it held is
        overwritten. Raises InputError where it is no such array.
        """
        images = np.empty(self.shape, np.float32) if out is None else out
        flat = (self.shape[0] * self.shape[1], *self.shape[2:])
        if images.shape not in (self.shape, flat) or images.dtype != np.float32 or not images.flags.c_contiguous:
            raise InputError(
                f"critic images: cannot be written into {images.dtype} {images.shape}: give a contiguous float32 array "
                f"of {self.shape} or {flat}"
            )
        maps, whole = self._maps, images.reshape(self.shape)
        self._workers.over(
            self.shape[0], fill_critic, whole, self._ground, self._new, self._block, maps.fresh, maps.seen,
            maps.coverable, maps.origins, poses,
        )  # fmt: skip
        return images


@numba.njit(cache=True, nogil=True)
def fill_critic(first, last, critic, ground, new, block, fresh, seen, coverable, origins, poses):  # type: ignore[no-untyped-def]
    """Fill the images of worlds first to last, once their `ground` is up to date where `fresh` tiles want it."""
    _, drones, _, side, _ = critic.shape
    shown, whole = np.uint64(_GROUND * side * side), np.uint64(CRITIC_CHANNELS * side * side)
    counts = np.empty((2, seen.shape[2]), np.uint8)
    for world in range(first, last):
        _refresh(world, ground, new, block, fresh, seen, coverable, counts)
        source, images = ground[world].ravel(), critic[world].ravel()
        for viewer in range(drones):
            at = np.uint64(viewer) * whole
            for k in range(shown):
                images[at + np.uint64(k)] = source[np.uint64(k)]
            for k in range(shown, whole):
                images[at + np.uint64(k)] = np.float32(0.0)
        for drone in range(drones):
            i = (math.floor(poses[world, drone, 1] / CELL) - origins[world, 1]) // block
            j = (math.floor(poses[world, drone, 0] / CELL) - origins[world, 0]) // block
            if 0 <= i < side and 0 <= j < side:
                for viewer in range(drones):
                    critic[world, viewer, 3 if viewer == drone else 4, i, j] = 1.0


@numba.njit(cache=True, nogil=True)
def _refresh(world, ground, new, block, fresh, seen, coverable, counts):  # type: ignore[no-untyped-def]
    """Count the pixels of a world again that lie on fresh tiles, or all of them where the world is `new`."""
    side = ground.shape[2]
    if new[world]:
        new[world] = False
        ground[world] = 0.0
        ground[world, 2] = 1.0  # also off the grid, where nothing is
        fresh[world] = 1
    for row in range(fresh.shape[1]):
        for column in range(fresh.shape[2]):
            if fresh[world, row, column] == 0:
                continue
            fresh[world, row, column] = 0
            left, right = column * TILE // block, ((column + 1) * TILE - 1) // block + 1
            for i in range(row * TILE // block, ((row + 1) * TILE - 1) // block + 1):
                _count(world, ground, i, left, min(right, side), block, seen, coverable, counts)


@numba.njit(cache=True, nogil=True)
def _count(world, ground, i, left, right, block, seen, coverable, counts):  # type: ignore[no-untyped-def]
    """Write the shares of the pixels `left` to `right` of pixel row `i`; cells off the grid are not coverable.

    `counts` uint8 `[2, columns]` is scratch: the cells of each column, of which a pixel has fewer than 256.
    """
    rows, columns = seen.shape[1], seen.shape[2]
    start, end = np.uint64(left * block), np.uint64(min(right * block, columns))
    explored, wanted = counts[0], counts[1]
    explored[start:end] = 0
    wanted[start:end] = 0
    for row in range(i * block, min((i + 1) * block, rows)):
        seen_line, coverable_line = seen[world, row], coverable[world, row]
        for k in range(start, end):  # without branches: compiles to vector instructions
            at = np.uint64(k)
            wanted[at] = np.uint8(wanted[at] + np.uint8(coverable_line[at]))
            explored[at] = np.uint8(explored[at] + np.uint8(coverable_line[at] & seen_line[at]))
    cells = block * block
    for j in range(left, right):
        known = total = np.int64(0)
        for k in range(j * block, min((j + 1) * block, columns)):
            known += np.int64(explored[np.uint64(k)])
            total += np.int64(wanted[np.uint64(k)])
        ground[world, 0, i, j], ground[world, 1, i, j] = (total - known) / cells, known / cells
        ground[world, 2, i, j] = 1.0 - ground[world, 0, i, j] - ground[world, 1, i, j]
