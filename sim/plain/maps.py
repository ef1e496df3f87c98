"""What every drone of one world knows: an evidence map each, belief, frontier field, and the team's coverage."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from imagine.core.evidence import EvidenceMap, TileKey
from imagine.core.frames import Pose
from imagine.core.frontier import FrontierField
from imagine.core.lidar import LidarSpec, Scan
from imagine.core.raster import CELL, TILE
from imagine.sim.level import Level
from imagine.sim.plain.evidence import without_teammates
from imagine.sim.plain.means import Means

_MOST_EXTENT_M = 512.0


class PlainEvidence(EvidenceMap):
    """An evidence map that draws scans by given means; its mesh node draws those of peers by them, too."""

    def __init__(self, own: int, sources: int, level: Level, means: Means) -> None:
        """Make an empty map that holds a level, with a layer for each of the sources 1 to `sources`."""
        super().__init__(own, half_extent_m=CELL * TILE, max_extent_m=_MOST_EXTENT_M)
        self.means = means
        column0, row0, columns, rows = level.grid
        low_x, low_y, high_x, high_y = (
            (k + 0.5) * CELL for k in (column0, row0, column0 + columns - 1, row0 + rows - 1)
        )
        self.cover(low_x, low_y, high_x, high_y)
        for source in range(1, sources + 1):
            self.layer(source)

    def _draw(
        self, source: int, pose: Pose, scan: Scan, spec: LidarSpec, range_cap_m: float
    ) -> tuple[int, NDArray[np.bool_]]:
        self.cover(pose.x - range_cap_m, pose.y - range_cap_m, pose.x + range_cap_m, pose.y + range_cap_m)
        return self.means.draw(self.layer(source).cells, self.origin_cells, pose, scan.ranges, spec, range_cap_m)


class PlainMaps:
    """The maps of one world's team; `evidence[i]` is drone i's, which has number i + 1 in them, as on the mesh.

    `seen` and `coverable` bool `[rows, columns]` on the level's grid; `discovered` and `gained` count the coverable
    cells each drone was the first to see, in the episode and in this tick, int64 `[drones]`; `beliefs` and `fields`
    are each drone's, on the level's grid.
    """

    def __init__(self, level: Level, drones: int, lidar: LidarSpec, range_cap_m: float, means: Means) -> None:
        """Make empty maps."""
        column0, row0, columns, rows = level.grid
        self.lidar, self.range_cap_m, self._means = lidar, range_cap_m, means
        self.origin = column0, row0
        self.corner = TileKey(column0 // TILE, row0 // TILE)
        self.tiles = rows // TILE, columns // TILE
        self.evidence = [PlainEvidence(drone + 1, drones, level, means) for drone in range(drones)]
        self.coverable = level.coverable
        self.coverable_cells = max(1, int(self.coverable.sum()))
        self.seen = np.zeros(self.coverable.shape, np.bool_)
        self.discovered, self.gained = np.zeros(drones, np.int64), np.zeros(drones, np.int64)
        self.beliefs: list[NDArray[np.int8]] = []
        self.fields: list[FrontierField] = []
        self._reach = math.ceil(range_cap_m / CELL) + 1
        self.derive()

    def use(self, means: Means) -> None:
        """Compute by other means from now on."""
        self._means = means
        for own in self.evidence:
            own.means = means

    def layer(self, drone: int, source: int) -> NDArray[np.int8]:
        """Return what a drone holds of source (a drone, too), int8 `[rows, columns]` of the level's grid; a view."""
        own = self.evidence[drone]
        row, column = (self.corner.row - own.corner.row) * TILE, (self.corner.column - own.corner.column) * TILE
        cells = own.layers[source + 1].cells
        return cells[row : row + self.tiles[0] * TILE, column : column + self.tiles[1] * TILE]

    def versions(self, drone: int, source: int) -> NDArray[np.uint32]:
        """Return the versions of the tiles of `layer`, uint32 `[tile rows, tile columns]`; a view."""
        own = self.evidence[drone]
        row, column = self.corner.row - own.corner.row, self.corner.column - own.corner.column
        return own.layers[source + 1].versions[row : row + self.tiles[0], column : column + self.tiles[1]]

    def integrate(self, drone: int, pose: Pose, scan: Scan, places: NDArray[np.float64]) -> Scan:
        """Add a drone's scan to its own layer, and what that newly covers to its account.

        Returns the scan without what lies on teammates at `places` `[n, 2]`, as it was mapped.
        """
        kept = Scan(scan.stamp, without_teammates(scan.ranges, self.lidar, pose, places))
        self.evidence[drone].integrate(pose, kept, self.lidar, self.range_cap_m)
        self._count(drone, pose)
        return kept

    def _count(self, drone: int, pose: Pose) -> None:
        """Mark as seen what a drone knows around itself."""
        column, row = math.floor(pose.x / CELL) - self.origin[0], math.floor(pose.y / CELL) - self.origin[1]
        window = (
            slice(max(0, row - self._reach), max(0, row + self._reach + 1)),
            slice(max(0, column - self._reach), max(0, column + self._reach + 1)),
        )
        fresh = (self.layer(drone, drone)[window] != 0) & ~self.seen[window]
        self.seen[window] |= fresh
        self.gained[drone] = np.count_nonzero(fresh & self.coverable[window])
        self.discovered[drone] += self.gained[drone]

    def derive(self) -> None:
        """Bring everyone's belief and frontier field up to date."""
        drones = range(len(self.evidence))
        self.beliefs = [self._means.belief([self.layer(drone, source) for source in drones]) for drone in drones]
        self.fields = [self._means.field(belief) for belief in self.beliefs]
