"""How much of a level a team has seen, measured with the truth: true poses, the scans that were served."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from imagine.core.lidar import LidarSpec
from imagine.core.raster import TILE, integrate_scan
from imagine.sim.level import Level


class Coverage:
    """Share of the free cells reachable from the launch point that have been in some drone's sight."""

    def __init__(self, level: Level, drones: int, lidar: LidarSpec, range_cap_m: float) -> None:
        """Start with nothing seen; `range_cap_m` is how far drones map."""
        self._column0, self._row0, columns, rows = level.grid
        self._coverable = level.coverable
        self._cells = int(self._coverable.sum())
        self._layers = np.zeros((drones, rows, columns), np.int8)
        self._touched = np.zeros((rows // TILE, columns // TILE), np.bool_)
        self._seen = np.zeros((rows, columns), np.bool_)
        self._lidar, self._range_cap_m = lidar, range_cap_m

    def update(self, poses: NDArray[np.float64], ranges: NDArray[np.float32]) -> float:
        """Take one scan of every drone (`[drones, beams]` at `[drones, 3]`); return the share seen so far, 0-1."""
        for layer, (x, y, yaw), scan in zip(self._layers, poses, ranges, strict=True):
            integrate_scan(
                layer, self._touched, self._column0, self._row0, x, y, yaw, self._lidar.start, self._lidar.increment,
                scan, self._lidar.range_min, self._range_cap_m,
            )  # fmt: skip
            self._seen |= layer != 0
        return float(np.count_nonzero(self._seen & self._coverable) / self._cells)
