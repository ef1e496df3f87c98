"""What the drones' LiDARs see, for all worlds at once: walls, posts, moving things and other drones, with faults."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from imagine.core.errors import InputError
from imagine.core.lidar import LidarSpec
from imagine.sim.keyed_noise import normal_table, root_keys
from imagine.sim.level import Level
from imagine.sim.level_index import LevelArrays, level_index, make_room, write_row
from imagine.sim.lidar_model import LidarModel, cast_limit, sensor_numbers
from imagine.sim.rays import beam_table
from imagine.sim.scan_world import Sensors, scan_worlds
from imagine.sim.workers import Workers

_FASTEST_MPS = 10.0
"""As fast as a drone may be set to fly: what can come into reach while a skewed scan is taken."""


class Sensing:
    """The LiDARs of `drones` drones in each of `worlds` worlds; every world shows a level."""

    def __init__(
        self,
        worlds: int,
        drones: int,
        lidar: LidarSpec,
        seed: int,
        workers: Workers,
        world_keys: Sequence[int] | NDArray[np.int64] | None = None,
        model: LidarModel | None = None,
    ) -> None:
        """Prepare the sensors; give each world its level before the first scan.

        `world_keys` are the worlds' numbers, by default 0, 1, 2 ...: with `seed` they decide a world's noise, whatever
        other worlds there are.
        """
        self.worlds, self.drones, self.lidar, self.seed = worlds, drones, lidar, seed
        self.model = model or LidarModel()
        self._workers = workers
        numbers = np.arange(worlds) if world_keys is None else np.asarray(world_keys, np.int64)
        if numbers.shape != (worlds,):
            raise InputError(f"sensing: {len(numbers)} world keys for {worlds} worlds, give one for each")
        self._keys = root_keys(seed, numbers)
        self.numbers = np.tile(sensor_numbers(self.model, lidar), (worlds, 1))
        self._levels: list[Level | None] = [None] * worlds
        self._rows = np.full(worlds, -1)
        self._shown: list[Level] = []
        self._indexed_m = 0.0
        self._arrays: LevelArrays | None = None
        self._turn_s = lidar.fov / (2.0 * math.pi * lidar.rate_hz) if self.model.skew else 0.0
        self._table = beam_table(lidar.beams, lidar.increment)
        self._absent = np.ones((worlds, drones), np.bool_), np.zeros((worlds, 0, 3)), np.zeros((worlds, 0, 4))

    def set_level(self, world: int, level: Level) -> None:
        """Show a world another level."""
        self._levels[world] = level
        if self._indexed_m > 0.0:
            self._show(world, level)

    def randomise(self, world: int, generator: np.random.Generator) -> None:
        """Draw what the LiDAR model leaves open for a world's next episode."""
        self.numbers[world] = sensor_numbers(self.model, self.lidar, generator)

    def sensors(self, reach_m: float | None = None) -> Sensors:
        """Return what kernels scan by; good until the next level is set. Raises InputError while a level is missing."""
        reach = self.lidar.range_max if reach_m is None else min(reach_m, self.lidar.range_max)
        if not reach > 0.0:
            raise InputError(f"sensing: reach_m is {reach_m}, needs to be positive")
        travel = _FASTEST_MPS * self._turn_s
        limit = cast_limit(self.numbers.max(axis=0), reach) + travel  # it grows with every number that it looks at
        if limit > self._indexed_m:
            self._index(math.ceil(2.0 * limit) / 2.0)  # in steps, so that levels are not indexed again for each hair
        assert self._arrays is not None  # _index made them
        return Sensors(
            self._arrays, self._rows, self.numbers, self._keys, self._table, normal_table(), self.lidar.start,
            self.lidar.increment, reach, self._turn_s,
        )  # fmt: skip

    def scan(
        self,
        poses: NDArray[np.float64],
        velocity: NDArray[np.float64],
        drone_radius_m: float,
        tick: int,
        discs: NDArray[np.float64] | None = None,
        edges: NDArray[np.float64] | None = None,
        reach_m: float | None = None,
        alive: NDArray[np.bool_] | None = None,
    ) -> NDArray[np.float32]:
        """Return a turn of every drone's LiDAR, float32 `[worlds, drones, beams]`, ended at `poses` `[..., 3]`.

        Ranges in metres with the sensor's faults; inf no return, nan invalid or below the least range. `velocity`
        `[..., 3]` (m/s, m/s, rad/s, map frame) matters for skewed scans only. `discs` `[worlds, n, 3]` (x, y, radius;
        radius 0: absent) and `edges` `[worlds, m, 4]` (all zeros: absent) move, and stand where they are this tick.
        With `reach_m` returns past it read inf, and those within are as without. Drones not `alive`
        (`[worlds, drones]`) are not seen, and their own rows read nan.
        """
        ranges = np.empty((self.worlds, self.drones, self.lidar.beams), np.float32)
        everybody, no_discs, no_edges = self._absent
        parts = (
            poses, velocity, everybody if alive is None else alive, no_discs if discs is None else discs,
            no_edges if edges is None else edges,
        )  # fmt: skip
        whole = (np.ascontiguousarray(part) for part in parts)  # kernels are compiled for one layout
        self._workers.over(self.worlds, scan_worlds, ranges, self.sensors(reach_m), *whole, drone_radius_m, tick)
        return ranges

    def _index(self, limit_m: float) -> None:
        missing = [world for world, level in enumerate(self._levels) if level is None]
        if missing:
            raise InputError(f"sensing: world {missing[0]} has no level; set_level gives it one")
        self._indexed_m, self._arrays, self._shown = limit_m, None, []
        self._rows[:] = -1
        for world, level in enumerate(self._levels):
            assert level is not None  # looked at above
            self._show(world, level)

    def _show(self, world: int, level: Level) -> None:
        """Point a world at its level's row; one that no world shows any more gives way to a new level."""
        for row, shown in enumerate(self._shown):
            if shown is level:
                self._rows[world] = row
                return
        self._rows[world] = -1
        index = level_index(level, self._indexed_m)
        free = set(range(len(self._shown))) - set(self._rows.tolist())
        if free:
            row = min(free)
            self._shown[row] = level
        else:
            row = len(self._shown)
            self._shown.append(level)
        room = row + 1 if self._arrays is None or row < len(self._arrays.edges) else min(2 * row, self.worlds)
        self._arrays = make_room(self._arrays, room, index)
        write_row(self._arrays, row, index)
        self._rows[world] = row
