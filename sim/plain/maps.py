"""What every drone of one world knows, in numpy: layers per source, exchange, belief, coverage, frontier field."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from imagine.core.lidar import LidarSpec
from imagine.core.observation_spec import ObservationSpec
from imagine.core.raster import CELL, LIMIT, TILE
from imagine.sim.level import Level
from imagine.sim.plain.evidence import integrate_scan, without_teammates
from imagine.sim.plain.field import Ways, frontier_distances, plan_states
from imagine.sim.plain.views import motion, sectors, views

Pose3 = tuple[float, float, float]


class WorldMaps(Protocol):
    """The maps of one world's team, in stages of a tick; arrays are `[drone, ...]`, grids those of the level."""

    coverable: NDArray[np.bool_]
    coverable_cells: int
    seen: NDArray[np.bool_]
    discovered: NDArray[np.int64]
    tiles_sent: NDArray[np.int64]

    @property
    def distance(self) -> Sequence[NDArray[np.float32]]:
        """Everyone's frontier distances."""

    @property
    def states(self) -> Sequence[NDArray[np.uint8]]:
        """Everyone's planning cells."""

    @property
    def origins(self) -> Sequence[tuple[int, int]]:
        """Column and row of the first cell of everyone's map."""

    def integrate(self, ranges: NDArray[np.float32], poses: NDArray[np.float64], connected: NDArray[np.bool_]) -> None:
        """Add every drone's scan to its own layer, and what that newly covers to its account."""

    def exchange(self, connected: NDArray[np.bool_], relays: bool, tiles_a_tick: int) -> None:
        """Copy newer tiles along the links, each sender within its budget."""

    def derive(self) -> None:
        """Bring beliefs up to date."""

    def plan(self) -> None:
        """Bring frontier fields up to date."""

    def observe(
        self, drone: int, spec: ObservationSpec, pose: Pose3, velocity: NDArray[np.float64], ranges: NDArray[np.float32]
    ) -> dict[str, NDArray[np.float32]]:
        """Return what one drone's policy sees."""

    def take_over(self, layers: NDArray[np.int8], versions: NDArray[np.uint32], clocks: NDArray[np.uint32]) -> None:
        """Hold these layers `[drones, sources, rows, columns]`, tile versions and clocks from now on."""


class CoverageAccount:
    """Which coverable cells a team has seen, who saw them first, and who sent what.

    `discovered` counts cells, `tiles_sent` tiles, `[drones]`.
    """

    def __init__(self, level: Level, drones: int, range_cap_m: float) -> None:
        """Start with nothing seen of a level."""
        self.coverable = level.coverable
        self.coverable_cells = max(1, int(self.coverable.sum()))
        self.seen = np.zeros(self.coverable.shape, np.bool_)
        self.discovered = np.zeros(drones, np.int64)
        self.tiles_sent = np.zeros(drones, np.int64)
        self._origin = level.grid[:2]
        self._reach = math.ceil(range_cap_m / CELL) + 1

    def count(self, drone: int, cells: NDArray[np.int8], x: float, y: float) -> None:
        """Mark as seen what a drone at (x, y) knows around itself; `cells` is its layer on the level's grid."""
        column, row = math.floor(x / CELL) - self._origin[0], math.floor(y / CELL) - self._origin[1]
        window = (
            slice(max(0, row - self._reach), max(0, row + self._reach + 1)),
            slice(max(0, column - self._reach), max(0, column + self._reach + 1)),
        )
        fresh = (cells[window] != 0) & ~self.seen[window]
        self.seen[window] |= fresh
        self.discovered[drone] += np.count_nonzero(fresh & self.coverable[window])


class PlainMaps(CoverageAccount):
    """Maps in numpy: `layers` int8 `[drones, sources, rows, columns]`, `versions` uint32 of their tiles."""

    def __init__(self, level: Level, drones: int, lidar: LidarSpec, range_cap_m: float, ways: Ways) -> None:
        """Make empty maps of a level's size; `ways` finds the cheapest ways to frontiers."""
        super().__init__(level, drones, range_cap_m)
        column0, row0, columns, rows = level.grid
        self.drones, self.lidar, self.range_cap_m, self._ways = drones, lidar, range_cap_m, ways
        self.origins = [(column0, row0)] * drones
        self.layers = np.zeros((drones, drones, rows, columns), np.int8)
        self.versions = np.zeros((drones, drones, rows // TILE, columns // TILE), np.uint32)
        self.clocks = np.zeros(drones, np.uint32)
        self.belief = np.zeros((drones, rows, columns), np.int8)
        self.distance = [np.full((rows // 2, columns // 2), np.inf, np.float32) for _ in range(drones)]
        self.states = [np.zeros((rows // 2, columns // 2), np.uint8) for _ in range(drones)]

    def integrate(self, ranges: NDArray[np.float32], poses: NDArray[np.float64], connected: NDArray[np.bool_]) -> None:
        """Add every drone's scan to its own layer, returns on teammates it hears left out, and advance its tiles."""
        for drone, (x, y, yaw) in enumerate(poses.tolist()):
            heard = poses[connected[drone], :2] - (x, y)
            kept = without_teammates(ranges[drone], self.lidar.bearings + yaw, heard, self.range_cap_m)
            cells = self.layers[drone, drone]
            touched = integrate_scan(cells, self.origins[drone], (x, y, yaw), kept, self.lidar, self.range_cap_m)
            if touched.any():
                self.clocks[drone] += 1
                self.versions[drone, drone][touched] = self.clocks[drone]
            self.count(drone, cells, x, y)

    def exchange(self, connected: NDArray[np.bool_], relays: bool, tiles_a_tick: int) -> None:
        """Copy newer tiles along the links, each sender within its budget of tiles.

        One broadcast serves every neighbour that lacks the tile; what a drone first gets in this tick waits for the
        next.
        """
        held = self.versions > 0
        for sender in range(self.drones):
            budget = tiles_a_tick
            for source in range(self.drones) if relays else (sender,):
                receivers = [r for r in np.flatnonzero(connected[sender]).tolist() if r not in (sender, source)]
                versions = self.versions[sender, source]
                lacks = (self.versions[receivers, source] < versions) & held[sender, source]
                for row, column in np.argwhere(lacks.any(axis=0))[:budget].tolist():
                    budget -= 1
                    self.tiles_sent[sender] += 1
                    tile = np.s_[row * TILE : (row + 1) * TILE, column * TILE : (column + 1) * TILE]
                    for receiver, lacking in zip(receivers, lacks[:, row, column].tolist(), strict=True):
                        if lacking:
                            self.versions[receiver, source, row, column] = versions[row, column]
                            self.layers[receiver, source][tile] = self.layers[sender, source][tile]

    def derive(self) -> None:
        """Sum the layers of all sources into everyone's belief."""
        self.belief = np.clip(self.layers.sum(axis=1, dtype=np.int16), -LIMIT, LIMIT).astype(np.int8)

    def plan(self) -> None:
        """Compute everyone's frontier field."""
        for drone in range(self.drones):
            self.states[drone] = plan_states(self.belief[drone])
            self.distance[drone] = frontier_distances(self.states[drone], self._ways)

    def observe(
        self, drone: int, spec: ObservationSpec, pose: Pose3, velocity: NDArray[np.float64], ranges: NDArray[np.float32]
    ) -> dict[str, NDArray[np.float32]]:
        """Return what one drone's policy sees, named and shaped as `spec.shapes`."""
        x, y, yaw = pose
        turn = yaw if spec.axes == "heading" else 0.0
        return {
            "views": views(spec, self.belief[drone], self.distance[drone], self.origins[drone], (x, y), turn),
            "lidar": sectors(ranges, self.lidar, yaw - turn, spec.lidar_sectors, spec.lidar_range_m),
            "motion": motion(spec, velocity, turn),
        }

    def take_over(self, layers: NDArray[np.int8], versions: NDArray[np.uint32], clocks: NDArray[np.uint32]) -> None:
        """Hold these layers `[drones, sources, rows, columns]`, tile versions and clocks from now on."""
        self.layers[...], self.versions[...], self.clocks[...] = layers, versions, clocks
