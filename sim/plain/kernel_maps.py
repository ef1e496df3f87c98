"""The same maps out of the functions that fly on one drone: compiled, but called drone by drone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from imagine.core.evidence import EvidenceMap, TileKey
from imagine.core.frames import Pose
from imagine.core.frontier import FrontierField, frontier_field
from imagine.core.lidar import TEAMMATE_RADIUS_M, LidarSpec, Scan, mask_near
from imagine.core.observation import observe
from imagine.core.observation_spec import ObservationSpec
from imagine.core.raster import CELL, TILE
from imagine.sim.level import Level
from imagine.sim.plain.maps import CoverageAccount, Pose3


class KernelMaps(CoverageAccount):
    """An `EvidenceMap` for every drone, of the level's size."""

    def __init__(self, level: Level, drones: int, lidar: LidarSpec, range_cap_m: float) -> None:
        """Make empty maps."""
        super().__init__(level, drones, range_cap_m)
        self.drones, self.lidar, self.range_cap_m = drones, lidar, range_cap_m
        column0, row0, columns, rows = level.grid
        self._level_corner = TileKey(column0 // TILE, row0 // TILE)
        self._level_tiles = rows // TILE, columns // TILE
        self.maps = [EvidenceMap(drone, half_extent_m=CELL * TILE, max_extent_m=512.0) for drone in range(drones)]
        half = 0.5 * CELL
        for own in self.maps:
            own.cover(
                column0 * CELL + half,
                row0 * CELL + half,
                (column0 + columns) * CELL - half,
                (row0 + rows) * CELL - half,
            )
            for source in range(drones):
                own.layer(source)
        self._beliefs = [own.belief() for own in self.maps]
        self._fields = [frontier_field(belief) for belief in self._beliefs]

    @property
    def distance(self) -> list[NDArray[np.float32]]:
        """Everyone's frontier distances."""
        return [field.distance for field in self._fields]

    @property
    def states(self) -> list[NDArray[np.uint8]]:
        """Everyone's planning cells."""
        return [field.states for field in self._fields]

    @property
    def origins(self) -> list[tuple[int, int]]:
        """Column and row of the first cell of everyone's map."""
        return [own.origin_cells for own in self.maps]

    def on_level(self, drone: int, cells: NDArray[np.int8]) -> NDArray[np.int8]:
        """Return the part of a drone's map `[rows, columns]` that lies on the level's grid; a view."""
        corner = self.maps[drone].corner
        row, column = (self._level_corner.row - corner.row) * TILE, (self._level_corner.column - corner.column) * TILE
        rows, columns = self._level_tiles
        return cells[row : row + rows * TILE, column : column + columns * TILE]

    def integrate(self, ranges: NDArray[np.float32], poses: NDArray[np.float64], connected: NDArray[np.bool_]) -> None:
        """Add every drone's scan to its own layer, returns on teammates it hears left out."""
        for drone, own in enumerate(self.maps):
            pose = Pose(*poses[drone].tolist())
            kept = mask_near(ranges[drone], self.lidar, pose, poses[connected[drone], :2], TEAMMATE_RADIUS_M)
            own.integrate(pose, Scan(0.0, kept), self.lidar, self.range_cap_m)
            self.count(drone, self.on_level(drone, own.layer(drone).cells), pose.x, pose.y)

    def exchange(self, connected: NDArray[np.bool_], relays: bool, tiles_a_tick: int) -> None:
        """Merge newer tiles along the links, each sender within its budget of tiles."""
        held = [[own.versions(source) for source in range(self.drones)] for own in self.maps]
        for sender in range(self.drones):
            budget = tiles_a_tick
            for source in range(self.drones) if relays else (sender,):
                receivers = [r for r in np.flatnonzero(connected[sender]).tolist() if r not in (sender, source)]
                newest = self.maps[sender].versions(source) if relays else held[sender][source]
                for key in held[sender][source]:
                    version = newest[key]
                    lacking = [r for r in receivers if self._version(r, source, key) < version]
                    if not lacking or budget <= 0:
                        continue
                    budget -= 1
                    self.tiles_sent[sender] += 1
                    for receiver in lacking:
                        self.maps[receiver].merge_tile(source, key, version, self.maps[sender].tile(source, key))

    def _version(self, drone: int, source: int, key: TileKey) -> int:
        own = self.maps[drone]
        row, column = key.row - own.corner.row, key.column - own.corner.column
        if not (0 <= row < own.tile_rows and 0 <= column < own.tile_columns):
            return 0
        return int(own.layers[source].versions[row, column])

    def derive(self) -> None:
        """Sum the layers of all sources into everyone's belief."""
        self._beliefs = [own.belief() for own in self.maps]

    def plan(self) -> None:
        """Compute everyone's frontier field."""
        self._fields = [frontier_field(belief) for belief in self._beliefs]

    def observe(
        self, drone: int, spec: ObservationSpec, pose: Pose3, velocity: NDArray[np.float64], ranges: NDArray[np.float32]
    ) -> dict[str, NDArray[np.float32]]:
        """Return what one drone's policy sees, named and shaped as `spec.shapes`."""
        vx, vy, rate = velocity.tolist()
        field: FrontierField = self._fields[drone]
        return observe(
            spec, self._beliefs[drone], field, self.maps[drone].origin_cells, Pose(*pose), (vx, vy), rate,
            Scan(0.0, ranges), self.lidar,
        )  # fmt: skip

    def take_over(self, layers: NDArray[np.int8], versions: NDArray[np.uint32], clocks: NDArray[np.uint32]) -> None:
        """Hold these layers `[drones, sources, rows, columns]`, tile versions and clocks from now on."""
        rows, columns = self._level_tiles
        for drone, own in enumerate(self.maps):
            row, column = self._level_corner.row - own.corner.row, self._level_corner.column - own.corner.column
            for source in range(self.drones):
                layer = own.layer(source)
                self.on_level(drone, layer.cells)[...] = layers[drone, source]
                layer.versions[row : row + rows, column : column + columns] = versions[drone, source]
                layer.clock = int(clocks[source])
