"""What every drone of every world knows: evidence layers per source, beliefs and frontier fields, in numba.

The kernels are those that fly (`imagine.core`), called in a loop over worlds that runs on all cores. Worlds share one
grid size, that of the largest level; arrays are `[world, drone, source, row, column]`.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from imagine.core.frontier import frontier_distances, plan_states
from imagine.core.lidar import TEAMMATE_RADIUS_M
from imagine.core.raster import CELL, TILE, integrate_scan, sum_layers
from imagine.sim.workers import Workers


class TeamMaps:
    """Evidence, belief and coverage of a batch of worlds on grids of `rows` by `columns` cells.

    `layers` int8 `[worlds, drones, sources, rows, columns]` is what a drone holds of each source, `versions` uint32
    the version of each tile; `belief` int8, `distance` float32 and `states` uint8 are derived. `seen` bool
    `[worlds, rows, columns]` is what the team has ever known, `discovered` counts the cells each drone saw first.
    """

    def __init__(self, worlds: int, drones: int, rows: int, columns: int, workers: Workers | None = None) -> None:
        """Make empty maps; rows and columns are whole tiles."""
        self._workers = workers or Workers()
        tiles = rows // TILE, columns // TILE
        self.layers = np.zeros((worlds, drones, drones, rows, columns), np.int8)
        self.versions = np.zeros((worlds, drones, drones, *tiles), np.uint32)
        self.clocks = np.zeros((worlds, drones), np.uint32)
        self.belief = np.zeros((worlds, drones, rows, columns), np.int8)
        self.distance = np.full((worlds, drones, rows // 2, columns // 2), np.inf, np.float32)
        self.states = np.zeros((worlds, drones, rows // 2, columns // 2), np.uint8)
        self.seen = np.zeros((worlds, rows, columns), np.bool_)
        self.coverable = np.zeros((worlds, rows, columns), np.bool_)
        self.coverable_cells = np.ones(worlds, np.int64)
        self.discovered = np.zeros((worlds, drones), np.int64)
        self.tiles_sent = np.zeros((worlds, drones), np.int64)
        self.origins = np.zeros((worlds, 2), np.int64)
        self.extents = np.zeros((worlds, 2), np.int64)

    def clear(self, world: int, coverable: NDArray[np.bool_], origin_cells: tuple[int, int]) -> None:
        """Forget everything of a world and give it the cells that can be covered, on its level's own grid."""
        for array in (self.layers, self.versions, self.clocks, self.belief, self.states, self.seen, self.coverable):
            array[world] = 0
        self.distance[world] = np.inf
        self.discovered[world] = 0
        self.tiles_sent[world] = 0
        self.coverable[world, : coverable.shape[0], : coverable.shape[1]] = coverable
        self.coverable_cells[world] = max(1, int(coverable.sum()))
        self.origins[world] = origin_cells
        self.extents[world] = coverable.shape

    def update(
        self,
        ranges: NDArray[np.float32],
        poses: NDArray[np.float64],
        lidar: tuple[float, float, float, float],
        connected: NDArray[np.bool_],
        relays: bool,
        tiles_a_tick: int,
        active: NDArray[np.bool_] | None = None,
    ) -> NDArray[np.int64]:
        """Integrate every drone's scan, exchange tiles over the links, and bring beliefs and fields up to date.

        `ranges` `[worlds, drones, beams]`, `poses` `[worlds, drones, 3]`, `lidar` (start, increment, range_min,
        range cap), `connected` bool `[worlds, drones, drones]`; worlds not `active`
        (`[worlds]`) are left alone. Returns the newly seen coverable cells per drone,
        `[worlds, drones]`.
        """
        gained = np.zeros(self.discovered.shape, np.int64)
        if active is None:
            active = np.ones(len(gained), np.bool_)
        self._workers.over(
            len(gained), _update, self.layers, self.versions, self.clocks, self.belief, self.distance, self.states,
            self.seen, self.coverable, self.origins, self.extents, self.tiles_sent, gained, ranges, poses, lidar,
            connected, relays, tiles_a_tick, active,
        )  # fmt: skip
        self.discovered += gained
        return gained

    def coverage(self) -> NDArray[np.float64]:
        """Return the share of the coverable cells that the team has seen, `[worlds]`."""
        share: NDArray[np.float64] = self.discovered.sum(axis=1) / self.coverable_cells
        return share


@numba.njit(cache=True, nogil=True)
def _update(  # type: ignore[no-untyped-def]
    first, last, layers, versions, clocks, belief, distance, states, seen, coverable, origins, extents, tiles_sent,
    gained, ranges, poses, lidar, connected, relays, tiles_a_tick, active,
):  # fmt: skip
    drones = clocks.shape[1]
    for world in range(first, last):
        if not active[world]:
            continue
        column0, row0 = origins[world]
        for drone in range(drones):
            _integrate_own(
                layers[world, drone, drone], versions[world, drone, drone], clocks[world], drone, column0, row0,
                ranges[world, drone], poses[world], lidar, connected[world, drone],
            )  # fmt: skip
            gained[world, drone] = _count_new(
                layers[world, drone, drone], seen[world], coverable[world], column0, row0, poses[world, drone], lidar[3]
            )
        _exchange(layers[world], versions[world], connected[world], relays, tiles_a_tick, tiles_sent[world])
        for drone in range(drones):
            rows, columns = extents[world]  # beyond the level's own grid everything stays unknown
            sum_layers(layers[world, drone, :, :rows, :columns], belief[world, drone, :rows, :columns])
            inner_states = states[world, drone, : rows // 2, : columns // 2]
            plan_states(belief[world, drone, :rows, :columns], inner_states)
            frontier_distances(inner_states, distance[world, drone, : rows // 2, : columns // 2])


@numba.njit(cache=True, nogil=True)
def _integrate_own(  # type: ignore[no-untyped-def]
    cells, versions, clocks, drone, column0, row0, ranges, poses, lidar, connected
):
    """Add a drone's scan to its own layer, returns on teammates it hears left out, and advance the touched tiles."""
    start, increment, range_min, range_cap = lidar
    x, y, yaw = poses[drone]
    kept = ranges.copy()
    for other in range(len(poses)):
        if other == drone or not connected[other]:
            continue
        dx, dy = poses[other, 0] - x, poses[other, 1] - y
        if dx * dx + dy * dy > (range_cap + TEAMMATE_RADIUS_M) ** 2:
            continue
        for beam in range(len(kept)):
            r = kept[beam]
            if r < np.inf:
                bearing = yaw + start + beam * increment
                ex, ey = r * math.cos(bearing) - dx, r * math.sin(bearing) - dy
                if ex * ex + ey * ey < TEAMMATE_RADIUS_M * TEAMMATE_RADIUS_M:
                    kept[beam] = np.nan
    touched = np.zeros(versions.shape, np.bool_)
    changed = integrate_scan(cells, touched, column0, row0, x, y, yaw, start, increment, kept, range_min, range_cap)
    if changed > 0:
        clocks[drone] += 1
        for i in range(versions.shape[0]):
            for j in range(versions.shape[1]):
                if touched[i, j]:
                    versions[i, j] = clocks[drone]


@numba.njit(cache=True, nogil=True)
def _count_new(cells, seen, coverable, column0, row0, pose, range_cap):  # type: ignore[no-untyped-def]
    """Mark what a drone knows around it as seen; return how many coverable cells nobody had seen before."""
    rows, columns = cells.shape
    reach = math.ceil(range_cap / CELL) + 1
    column = math.floor(pose[0] / CELL) - column0
    row = math.floor(pose[1] / CELL) - row0
    fresh = 0
    for i in range(max(0, row - reach), min(rows, row + reach + 1)):
        for j in range(max(0, column - reach), min(columns, column + reach + 1)):
            if cells[i, j] != 0 and not seen[i, j]:
                seen[i, j] = True
                if coverable[i, j]:
                    fresh += 1
    return fresh


@numba.njit(cache=True, nogil=True)
def _exchange(layers, versions, connected, relays, tiles_a_tick, tiles_sent):  # type: ignore[no-untyped-def]
    """Copy newer tiles along the links of one world, each sender within its budget for the tick.

    One broadcast serves every neighbour that lacks the tile. A sender offers its own layer and, when it relays, what
    it holds of others. A tile that a drone first gets in this tick is passed on in the next.
    """
    drones = len(connected)
    before = versions.copy()
    for sender in range(drones):
        budget = tiles_a_tick
        for source in range(drones):
            if source != sender and not relays:
                continue
            for i in range(versions.shape[2]):
                for j in range(versions.shape[3]):
                    if before[sender, source, i, j] == 0:
                        continue
                    version = versions[sender, source, i, j]
                    wanted = False
                    for receiver in range(drones):
                        if (
                            receiver != sender
                            and receiver != source
                            and connected[sender, receiver]
                            and versions[receiver, source, i, j] < version
                        ):
                            wanted = True
                    if not wanted or budget <= 0:
                        continue
                    budget -= 1
                    tiles_sent[sender] += 1
                    for receiver in range(drones):
                        if (
                            receiver != sender
                            and receiver != source
                            and connected[sender, receiver]
                            and versions[receiver, source, i, j] < version
                        ):
                            versions[receiver, source, i, j] = version
                            for row in range(i * TILE, (i + 1) * TILE):
                                for column in range(j * TILE, (j + 1) * TILE):
                                    layers[receiver, source, row, column] = layers[sender, source, row, column]
