"""What the drones' LiDARs see, for all worlds at once: walls, posts and other drones, with the sensor's noise."""

from __future__ import annotations

from collections.abc import Sequence

import numba
import numpy as np
from numpy.typing import NDArray

from imagine.core.lidar import LidarSpec
from imagine.sim.level import Level
from imagine.sim.rays import add_noise, cast_rays
from imagine.sim.workers import Workers

_Geometry = tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64], NDArray[np.int64]]


class Sensing:
    """The LiDARs of `drones` drones in each of `worlds` worlds; every world shows a level."""

    def __init__(
        self, worlds: int, drones: int, lidar: LidarSpec, seed: int, workers: Workers, world_keys: Sequence[int]
    ) -> None:
        """Prepare the sensors; give each world its level before the first scan. Noise follows the worlds' keys."""
        self._world_keys = world_keys
        self.worlds, self.drones, self.lidar, self.seed = worlds, drones, lidar, seed
        self._workers = workers
        self._levels: list[Level | None] = [None] * worlds
        self._geometry: _Geometry | None = None

    def set_level(self, world: int, level: Level) -> None:
        """Show a world another level."""
        self._levels[world] = level
        self._geometry = None

    def scan(
        self,
        poses: NDArray[np.float64],
        velocity: NDArray[np.float64],
        drone_radius_m: float,
        tick: int,
        discs: NDArray[np.float64],
        edges: NDArray[np.float64],
        alive: NDArray[np.bool_],
    ) -> NDArray[np.float32]:
        """Return a turn of every drone's LiDAR, float32 `[worlds, drones, beams]`, taken at `poses` `[..., 3]`.

        `discs` `[worlds, n, 3]` and `edges` `[worlds, m, 4]` are what moves; of radius 0, or all 0, is absent.
        Drones not `alive` `[worlds, drones]` are not seen, and their own rows are nan.
        Ranges in metres with the sensor's noise; inf no return, nan below the least range.
        """
        ranges = np.empty((self.worlds, self.drones, self.lidar.beams), np.float32)
        keys = np.array([self._noise_key(world, tick) for world in self._world_keys], np.uint64)
        if self._geometry is None:
            levels = [level for level in self._levels if level is not None]
            self._geometry = _stack([level.segments for level in levels], [level.circles for level in levels])
        lidar = self.lidar
        self._workers.over(
            self.worlds, _scan_worlds, ranges, *self._geometry, poses, drone_radius_m, discs, edges, alive,
            (lidar.start, lidar.increment, lidar.range_min, lidar.range_max, lidar.noise_std), keys,
        )  # fmt: skip
        return ranges

    def _noise_key(self, world: int, tick: int) -> int:
        """Return the number that this tick's sensor noise of a world is drawn from."""
        return ((self.seed * 1_000_003 + world) * 1_000_003 + tick) % 2**64


def _stack(segments: list[NDArray[np.float64]], circles: list[NDArray[np.float64]]) -> _Geometry:
    """Lay ragged geometry of all worlds into arrays `[worlds, most, 4]` and `[worlds, most, 3]` with their counts."""
    segment_counts = np.array([len(s) for s in segments])
    circle_counts = np.array([len(c) for c in circles])
    all_segments = np.zeros((len(segments), segment_counts.max(), 4))
    all_circles = np.zeros((len(circles), circle_counts.max(), 3))
    for world, (s, c) in enumerate(zip(segments, circles, strict=True)):
        all_segments[world, : len(s)], all_circles[world, : len(c)] = s, c
    return all_segments, segment_counts, all_circles, circle_counts


@numba.njit(cache=True, nogil=True)
def _scan_worlds(  # type: ignore[no-untyped-def]
    first, last, ranges, segments, segment_counts, circles, circle_counts, poses, drone_radius, discs, edges, alive,
    lidar, keys,
):  # fmt: skip
    """Fill `ranges` (float32 `[worlds, drones, beams]`) of worlds first to last.

    They see the level, the other drones, and noise drawn from the world's key.
    """
    start, increment, range_min, range_max, noise_std = lidar
    _, drones, beams = ranges.shape
    for index in range(first * drones, last * drones):
        world, drone = index // drones, index % drones
        posts = circle_counts[world]
        round_things = np.empty((posts + drones - 1 + discs.shape[1], 3))
        for post in range(posts):
            for k in range(3):
                round_things[post, k] = circles[world, post, k]
        count = posts
        for other in range(drones):
            if other != drone and alive[world, other]:
                round_things[count, 0], round_things[count, 1] = poses[world, other, 0], poses[world, other, 1]
                round_things[count, 2] = drone_radius
                count += 1
        for disc in range(discs.shape[1]):
            if discs[world, disc, 2] > 0.0:
                round_things[count, 0], round_things[count, 1] = discs[world, disc, 0], discs[world, disc, 1]
                round_things[count, 2] = discs[world, disc, 2]
                count += 1
        lines = np.empty((segment_counts[world] + edges.shape[1], 4))
        for k in range(len(lines)):
            for i in range(4):
                fixed = k < segment_counts[world]
                lines[k, i] = segments[world, k, i] if fixed else edges[world, k - segment_counts[world], i]
        exact = np.empty(beams)
        x, y, yaw = poses[world, drone]
        cast_rays(exact, lines, round_things[:count], x, y, yaw + start, increment, range_max)
        key = keys[world] * np.uint64(drones) + np.uint64(drone)
        add_noise(exact, key, noise_std, range_min, range_max)
        for beam in range(beams):
            ranges[world, drone, beam] = exact[beam] if alive[world, drone] else np.nan
