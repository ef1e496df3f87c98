"""A team in one world of the batched air, driven tick by tick from poses and scans."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from imagine.core.lidar import LD19, LidarSpec
from imagine.core.raster import CELL, TILE, apply_marks, beam_directions, mark_scan, ray_table
from imagine.mesh_comm.settings import MeshSettings
from imagine.sim.air import Air
from imagine.sim.air_receive import claim_own, deliver
from imagine.sim.air_send import canvas, send
from imagine.sim.level import Level
from imagine.sim.mesh_flight import RANGE_CAP_M
from imagine.sim.radio import RadioSettings
from imagine.sim.twin import TICK_S, Twin


def new_air(level: Level, drones: int, radio: RadioSettings, mesh: MeshSettings, worlds: int = 1) -> Air:
    """Return the air of a level's grid."""
    _, _, columns, rows = level.grid
    return Air(worlds, drones, rows // TILE, columns // TILE, radio, mesh, LD19, RANGE_CAP_M, TICK_S)


class AirTeam:
    """What the drones of a world know; `layers`, `versions`, `dirty` and `clocks` as the kernels take them."""

    def __init__(self, air: Air, level: Level, world: int = 0, key: int = 7) -> None:
        self.air, self.level, self.world, self.key = air, level, world, np.uint64(key)
        drones = air.state.nodes.shape[1]
        _, _, columns, rows = level.grid
        self.layers = np.zeros((drones, drones, rows, columns), np.int8)
        self.versions = np.zeros((drones, drones, rows // TILE, columns // TILE), np.uint32)
        self.dirty = np.zeros((drones, rows // TILE, columns // TILE), np.uint8)
        self.clocks = np.zeros(drones, np.uint32)
        self.drones, self.ticks, self.alive = drones, 0, np.ones(drones, np.bool_)

    def tick(
        self,
        poses: NDArray[np.float64],
        ranges: NDArray[np.float32] | None,
        velocities: NDArray[np.float64] | None = None,
    ) -> None:
        """Hear, map the scans `ranges` (None: nobody scans) taken at `poses`, and speak."""
        self.ticks += 1
        still = np.zeros((self.drones, 3)) if velocities is None else velocities
        state = self.air.state
        deliver(
            state,
            self.world,
            self.ticks,
            self.key,
            poses,
            self.alive,
            self.level.segments,
            self.layers,
            self.versions,
            self.dirty,
        )
        if ranges is not None:
            for drone in range(self.drones):
                self._map(drone, poses[drone], ranges[drone])
        else:
            ranges = np.full((self.drones, LD19.beams), np.nan, np.float32)
        send(state, self.world, self.ticks, poses, still, self.alive, ranges, self.clocks, self.layers, self.versions)

    def _map(self, drone: int, pose: NDArray[np.float64], ranges: NDArray[np.float32]) -> None:
        """Draw the scan on the canvas, and from there into the own layer."""
        column0, row0, _, _ = self.level.grid
        x, y, yaw = pose.tolist()
        row, column = math.floor(y / CELL) - row0, math.floor(x / CELL) - column0
        slot, first_row, first_column = canvas(self.air.state, self.world, drone, row, column)
        marks = self.air.state.marks[self.world, drone, slot]
        table = ray_table(RANGE_CAP_M)
        directions = beam_directions(LD19.start, LD19.increment, LD19.beams)
        drawn = mark_scan(
            marks, x, y, yaw, directions, ranges, LD19.range_min, RANGE_CAP_M, table.starts, table.offsets
        )
        assert drawn == (first_row + row0, first_column + column0)
        touched = np.zeros(self.versions.shape[2:], np.bool_)
        if apply_marks(self.layers[drone, drone], marks, first_row, first_column, touched):
            self.clocks[drone] += 1
            self.versions[drone, drone][touched] = self.clocks[drone]

    @property
    def known(self) -> NDArray[np.int64]:
        """How many cells each drone's belief knows."""
        return np.array([np.count_nonzero(layers.astype(np.int16).sum(axis=0)) for layers in self.layers])

    @property
    def bytes_sent(self) -> NDArray[np.int64]:
        """Bytes by drone and kind."""
        return self.air.bytes_sent[self.world]

    def cells_known(self) -> NDArray[np.int64]:
        """Cells first known by own scans, peers' scans and tiles, by drone."""
        claim_own(self.air.state, self.world, self.layers)
        return self.air.cells_known[self.world]

    def holds_all_of(self, holder: int, source: int) -> bool:
        """Tell whether a drone holds another's layer exactly as it is now."""
        same_cells = np.array_equal(self.layers[holder, source], self.layers[source, source])
        return same_cells and np.array_equal(self.versions[holder, source], self.versions[source, source])


class Rooms:
    """Scans of a level from any poses, without noise, to the centimetre."""

    def __init__(self, level: Level, drones: int) -> None:
        self._twin = Twin([level], drones, LidarSpec(beams=LD19.beams, noise_std=0.0))

    def scan(self, poses: NDArray[np.float64]) -> NDArray[np.float32]:
        """Return the ranges seen from `poses` `[drones, 3]`; drones see each other, too."""
        self._twin.poses[0] = poses
        rounded = np.round(self._twin.scan()[0] * 100.0) / 100.0
        return np.where(rounded <= RANGE_CAP_M, rounded, np.inf).astype(np.float32)
