"""What every drone of every world knows: evidence layers per source, beliefs and frontier fields, in numba.

The kernels are those that fly (`imagine.core`). From tick to tick little of a map changes, so everything derived from
it is brought up to date only where tiles of it changed. Worlds share one grid size, that of the largest level; arrays
are `[world, drone, source, row, column]`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from imagine.core.frontier import PAD, has_frontier, refresh_kinds, refresh_states
from imagine.core.frontier_paths import BLOCKED, search_scratch, update_costs
from imagine.core.lidar import TEAMMATE_RADIUS_M, LidarSpec
from imagine.core.raster import LIMIT, TILE, apply_marks, beam_directions, mark_scan, ray_table
from imagine.sim.workers import Workers

_ROUNDING_M = 1e-6


class MapArrays(NamedTuple):
    """The maps of all worlds, as kernels take them.

    `layers` int8 `[worlds, drones, sources, rows, columns]` is what a drone holds of each source, `versions` uint32
    the version of each tile, `clocks` uint32 the greatest version a drone has given, `changed` int64 how many cells of
    its own layer the newest scan changed. `belief` int8, `states`, `kinds` and `cost` (padded planning grids, see
    `imagine.core.frontier`) are derived; `dirty` uint8 tells the tiles of a drone whose layers changed since.
    `seen` bool `[worlds, rows, columns]` is what the team has ever known, `fresh` uint8 `[worlds, tile rows, tile
    columns]` tells where it saw coverable cells since `CriticImages` last looked. `discovered` counts the cells each
    drone saw first, `frontiers` whether it knows of any. `origins` int64 are the grid's first column and row in cells.
    """

    layers: NDArray[np.int8]
    versions: NDArray[np.uint32]
    clocks: NDArray[np.uint32]
    changed: NDArray[np.int64]
    belief: NDArray[np.int8]
    states: NDArray[np.uint8]
    kinds: NDArray[np.uint8]
    cost: NDArray[np.int16]
    dirty: NDArray[np.uint8]
    seen: NDArray[np.bool_]
    fresh: NDArray[np.uint8]
    coverable: NDArray[np.bool_]
    discovered: NDArray[np.int64]
    gained: NDArray[np.int64]
    frontiers: NDArray[np.bool_]
    origins: NDArray[np.int64]


class Pens(NamedTuple):
    """How scans are drawn: the beams' directions, the ray table, and (least range, range cap) in metres."""

    directions: NDArray[np.float64]
    starts: NDArray[np.int32]
    offsets: NDArray[np.int16]
    range_min: float
    range_cap: float


class Scratch(NamedTuple):
    """What one thread works with, one drone after another, so that it stays in the cache."""

    dirty: NDArray[np.int32]
    is_dirty: NDArray[np.uint8]
    heads: NDArray[np.int32]
    entry_cell: NDArray[np.int32]
    entry_next: NDArray[np.int32]
    boxes: NDArray[np.int64]
    kept: NDArray[np.float32]


class TeamMaps:
    """Evidence, belief, frontier fields and coverage of a batch of worlds on grids of `rows` by `columns` cells."""

    def __init__(
        self, worlds: int, drones: int, rows: int, columns: int, lidar: LidarSpec, range_cap_m: float, workers: Workers
    ) -> None:
        """Make empty maps; rows and columns are whole tiles, scans are mapped up to `range_cap_m`."""
        self._workers = workers
        table = ray_table(range_cap_m)
        tiles = rows // TILE, columns // TILE
        padded = rows // 2 + 2 * PAD, columns // 2 + 2 * PAD
        self.pens = Pens(
            beam_directions(lidar.start, lidar.increment, lidar.beams),
            table.starts, table.offsets, lidar.range_min, range_cap_m,
        )  # fmt: skip
        self.arrays = MapArrays(
            layers=np.zeros((worlds, drones, drones, rows, columns), np.int8),
            versions=np.zeros((worlds, drones, drones, *tiles), np.uint32),
            clocks=np.zeros((worlds, drones), np.uint32),
            changed=np.zeros((worlds, drones), np.int64),
            belief=np.zeros((worlds, drones, rows, columns), np.int8),
            states=np.zeros((worlds, drones, *padded), np.uint8),
            kinds=np.zeros((worlds, drones, *padded), np.uint8),
            cost=np.full((worlds, drones, *padded), BLOCKED, np.int16),
            dirty=np.zeros((worlds, drones, *tiles), np.uint8),
            seen=np.zeros((worlds, rows, columns), np.bool_),
            fresh=np.zeros((worlds, *tiles), np.uint8),
            coverable=np.zeros((worlds, rows, columns), np.bool_),
            discovered=np.zeros((worlds, drones), np.int64),
            gained=np.zeros((worlds, drones), np.int64),
            frontiers=np.zeros((worlds, drones), np.bool_),
            origins=np.zeros((worlds, 2), np.int64),
        )
        self.layers, self.versions, self.belief = self.arrays.layers, self.arrays.versions, self.arrays.belief
        self.seen, self.coverable = self.arrays.seen, self.arrays.coverable
        self.discovered, self.origins = self.arrays.discovered, self.arrays.origins
        self.coverable_cells = np.ones(worlds, np.int64)
        cells = padded[0] * padded[1]
        self.scratch = [
            Scratch(
                np.empty(cells, np.int32), np.zeros(cells, np.uint8), *search_scratch(cells),
                np.empty((tiles[0] * tiles[1], 4), np.int64), np.empty(lidar.beams, np.float32),
            )
            for _ in range(workers.threads)
        ]  # fmt: skip

    def clear(self, world: int, coverable: NDArray[np.bool_], origin_cells: tuple[int, int]) -> None:
        """Forget everything of a world and give it the cells that can be covered, on its level's own grid."""
        arrays = self.arrays
        for array in (
            arrays.layers, arrays.versions, arrays.clocks, arrays.belief, arrays.states, arrays.kinds, arrays.dirty,
            arrays.seen, arrays.fresh, arrays.coverable, arrays.discovered, arrays.gained, arrays.changed,
            arrays.frontiers,
        ):  # fmt: skip
            array[world] = 0
        arrays.cost[world] = BLOCKED
        arrays.coverable[world, : coverable.shape[0], : coverable.shape[1]] = coverable
        self.coverable_cells[world] = max(1, int(coverable.sum()))
        arrays.origins[world] = origin_cells

    def coverage(self) -> NDArray[np.float64]:
        """Return the share of the coverable cells that the team has seen, `[worlds]`."""
        share: NDArray[np.float64] = self.arrays.discovered.sum(axis=1) / self.coverable_cells
        return share


@numba.njit(cache=True, nogil=True)
def integrate_scan_of(world, drone, maps, pens, ranges, pose, places, marks, kept):  # type: ignore[no-untyped-def]
    """Add a drone's scan to its own layer, and count what nobody had seen before.

    `ranges` float32 `[beams]`, `pose` (x, y, yaw); `places` `[drones, 2]` are where it takes its teammates to be (nan:
    unknown), whose returns it leaves out. Draws into `marks`, a sheet as in `mark_scan`; `kept` is scratch for a scan.
    """
    _without_teammates(kept, ranges, pens.directions, pose, places)
    row, column = mark_scan(
        marks, pose[0], pose[1], pose[2], pens.directions, kept, pens.range_min, pens.range_cap, pens.starts,
        pens.offsets,
    )  # fmt: skip
    cells, dirty = maps.layers[world, drone, drone], maps.dirty[world, drone]
    versions = maps.versions[world, drone, drone]
    touched = np.zeros(dirty.shape, np.bool_)
    changed = apply_marks(cells, marks, row - maps.origins[world, 1], column - maps.origins[world, 0], touched)
    maps.changed[world, drone] = changed
    if changed == 0:
        return
    maps.clocks[world, drone] += np.uint32(1)
    for i in range(dirty.shape[0]):
        for j in range(dirty.shape[1]):
            if touched[i, j]:
                versions[i, j] = maps.clocks[world, drone]
                dirty[i, j] = 1
                gained = _see(cells, maps.seen[world], maps.coverable[world], i, j)
                if gained > 0:
                    maps.gained[world, drone] += gained
                    maps.fresh[world, i, j] = 1
    maps.discovered[world, drone] += maps.gained[world, drone]


@numba.njit(cache=True, nogil=True)
def _without_teammates(kept, ranges, directions, pose, places):  # type: ignore[no-untyped-def]
    """Copy a scan with its returns on teammates at `places` made invalid (nan)."""
    for beam in range(len(ranges)):
        kept[beam] = ranges[beam]
    c, s = math.cos(pose[2]), math.sin(pose[2])
    for peer in range(len(places)):
        dx, dy = places[peer, 0] - pose[0], places[peer, 1] - pose[1]
        apart = math.sqrt(dx * dx + dy * dy)
        if not apart < np.inf:
            continue  # nobody knows where it is
        ahead, left = c * dx + s * dy, -s * dx + c * dy
        nearest, furthest = apart - TEAMMATE_RADIUS_M - _ROUNDING_M, apart + TEAMMATE_RADIUS_M + _ROUNDING_M
        for beam in range(len(kept)):  # returns beyond the range cap too, as on board: they free nothing either
            r = np.float64(kept[beam])
            if nearest < r < furthest:
                ex, ey = r * directions[beam, 0] - ahead, r * directions[beam, 1] - left
                if ex * ex + ey * ey < TEAMMATE_RADIUS_M * TEAMMATE_RADIUS_M:
                    kept[beam] = np.nan


@numba.njit(cache=True, nogil=True)
def _see(cells, seen, coverable, tile_row, tile_column):  # type: ignore[no-untyped-def]
    """Mark what is known in a tile as seen; return how many coverable cells nobody had seen before."""
    fresh = np.int64(0)
    for i in range(TILE):
        line, seen_line = cells[tile_row * TILE + i], seen[tile_row * TILE + i]
        coverable_line = coverable[tile_row * TILE + i]
        count = np.int8(0)
        for j in range(TILE):  # without branches: compiles to vector instructions
            k = np.uint64(tile_column * TILE + j)
            known = line[k] != 0
            count = np.int8(count + np.int8(known & coverable_line[k] & (not seen_line[k])))
            seen_line[k] = seen_line[k] | known
        fresh += count
    return fresh


@numba.njit(cache=True, nogil=True)
def derive(first, last, maps, scratch):  # type: ignore[no-untyped-def]
    """Bring belief and frontier field of all drones of worlds first to last up to date where their layers changed."""
    _, drones, tile_rows, tile_columns = maps.dirty.shape
    for index in range(first * drones, last * drones):
        world, drone = index // drones, index % drones
        dirty, belief, states = maps.dirty[world, drone], maps.belief[world, drone], maps.states[world, drone]
        boxes = 0
        for i in range(tile_rows):
            for j in range(tile_columns):
                if dirty[i, j]:
                    dirty[i, j] = 0
                    _sum_tile(maps.layers[world, drone], belief, i, j)
                    box = refresh_states(belief, states, i, j)
                    if box[0] <= box[1]:
                        for k in range(4):
                            scratch.boxes[boxes, k] = box[k]
                        boxes += 1
        if boxes == 0:
            continue
        kinds, cost = maps.kinds[world, drone], maps.cost[world, drone]
        count = 0
        for k in range(boxes):
            box = (scratch.boxes[k, 0], scratch.boxes[k, 1], scratch.boxes[k, 2], scratch.boxes[k, 3])
            count = refresh_kinds(states, kinds, cost, box, scratch.dirty, count, scratch.is_dirty)
        if count > 0:
            update_costs(
                cost, kinds, scratch.dirty, count, scratch.is_dirty,
                (scratch.heads, scratch.entry_cell, scratch.entry_next),
            )  # fmt: skip
            maps.frontiers[world, drone] = has_frontier(kinds)


@numba.njit(cache=True, nogil=True)
def _sum_tile(layers, belief, tile_row, tile_column):  # type: ignore[no-untyped-def]
    """Write the clamped sum over sources of a tile of `layers` (int8 `[sources, rows, columns]`) into `belief`."""
    sources, rows, columns = layers.shape
    side = columns // (columns // TILE)  # TILE, but unknown to the compiler, which would unroll and not vectorise
    flat, out = layers.ravel(), belief.ravel()
    total = np.empty(0 if sources == 3 else TILE, np.int16)
    for i in range(tile_row * side, (tile_row + 1) * side):
        at = i * columns + tile_column * side
        second, third = at + rows * columns, at + 2 * rows * columns
        if sources == 3:  # the usual team, in one go
            for j in range(side):
                value = np.int16(flat[np.uint64(at + j)] + flat[np.uint64(second + j)] + flat[np.uint64(third + j)])
                value = value if value < np.int16(LIMIT) else np.int16(LIMIT)
                out[np.uint64(at + j)] = np.int8(value if value > np.int16(-LIMIT) else np.int16(-LIMIT))
            continue
        for j in range(side):
            total[np.uint64(j)] = np.int16(flat[np.uint64(at + j)])
        for source in range(1, sources):
            other = at + source * rows * columns
            for j in range(side):
                total[np.uint64(j)] = np.int16(total[np.uint64(j)] + flat[np.uint64(other + j)])
        for j in range(side):
            value = total[np.uint64(j)]
            value = value if value < np.int16(LIMIT) else np.int16(LIMIT)
            out[np.uint64(at + j)] = np.int8(value if value > np.int16(-LIMIT) else np.int16(-LIMIT))
