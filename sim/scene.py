"""One moment of one world, copied out of a batch so that it can be drawn later: a film is drawn after its episode."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imagine.core.raster import LIMIT
from imagine.sim.exploration import Exploration
from imagine.sim.level import Level

Trail = NDArray[np.float64]
"""Where a drone has been: points `[n, 2]` in metres of the map frame."""


@dataclass(frozen=True)
class Scene:
    """What there is to draw. Metres and radians in the map frame; grids `[rows, columns]` as `Level.grid` lays them."""

    level: Level
    tick: int
    coverage: float
    seen: NDArray[np.bool_]
    """Cells the team has ever known."""
    belief: NDArray[np.int8]
    """Log-odds summed over what every drone saw itself, clamped."""
    poses: NDArray[np.float64]
    """`[drones, 3]`: x, y, yaw."""
    alive: NDArray[np.bool_]
    linked: NDArray[np.bool_]
    """Who reaches whom, `[drones, drones]`."""
    drone_radius_m: float
    people: NDArray[np.float64]
    """`[n, 3]`: x, y, radius."""
    crates: tuple[NDArray[np.float64], ...]
    """The corners of each, `[4, 2]`."""
    trails: tuple[Trail, ...] = ()
    scans: tuple[NDArray[np.float64], ...] = ()
    """Where each drone's beams end, `[beams, 2]` in order of bearing; cut to the range that is mapped."""


def take_scene(exploration: Exploration, world: int, trails: Sequence[Trail] = (), scans: bool = False) -> Scene:
    """Return a world as it is now; `trails` come from whoever kept them, `scans` asks for what the LiDARs see.

    Nothing in the scene changes when the batch flies on.
    """
    maps, level = exploration.maps, exploration.twin.levels[world]
    rows, columns = level.coverable.shape
    own = range(exploration.drones)
    evidence = maps.layers[world, own, own, :rows, :columns].sum(axis=0, dtype=np.int16)
    poses = exploration.twin.poses[world].copy()
    return Scene(
        level=level,
        tick=int(exploration.ticks[world]),
        coverage=float(maps.coverage()[world]),
        seen=maps.seen[world, :rows, :columns].copy(),
        belief=np.clip(evidence, -LIMIT, LIMIT).astype(np.int8),
        poses=poses,
        alive=exploration.alive[world].copy(),
        linked=exploration.links()[world].copy(),
        drone_radius_m=exploration.settings.limits.radius_m,
        people=_people(exploration, world),
        crates=_crates(exploration, world),
        trails=tuple(trails),
        scans=_scan_ends(exploration, world, poses) if scans else (),
    )


def _people(exploration: Exploration, world: int) -> NDArray[np.float64]:
    discs = exploration.twin.mover_discs[world]
    there: NDArray[np.float64] = discs[discs[:, 2] > 0.0]
    return there


def _crates(exploration: Exploration, world: int) -> tuple[NDArray[np.float64], ...]:
    corners = exploration.twin.mover_edges[world].reshape(-1, 4, 4)[:, :, :2]  # each edge begins at a corner
    return tuple(crate.copy() for crate in corners if crate.any())


def _scan_ends(exploration: Exploration, world: int, poses: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    lidar, cap = exploration.lidar, exploration.settings.map.range_cap_m
    ends = []
    for (x, y, yaw), ranges in zip(poses, exploration.ranges[world], strict=True):
        valid = ~np.isnan(ranges)
        bearings = yaw + lidar.start + lidar.increment * np.flatnonzero(valid)
        reach = np.minimum(ranges[valid], cap)
        ends.append(np.column_stack((x + reach * np.cos(bearings), y + reach * np.sin(bearings))))
    return tuple(ends)


class Trails:
    """Keeps where the drones of one world have been, a point a tick."""

    def __init__(self) -> None:
        """Start with nobody anywhere."""
        self._ways = np.empty((0, 0, 2))
        self._count = 0
        self._tick = -1

    def add(self, exploration: Exploration, world: int) -> tuple[Trail, ...]:
        """Take a world's poses, once a tick, and return the way of each drone; another episode starts anew.

        What was returned never changes: points are only added behind it.
        """
        tick = int(exploration.ticks[world])
        if tick < self._tick or self._tick < 0:
            self._ways, self._count = np.empty((1024, exploration.drones, 2)), 0
        if tick != self._tick:
            if self._count == len(self._ways):
                self._ways = np.concatenate((self._ways, np.empty_like(self._ways)))
            self._ways[self._count] = exploration.twin.poses[world, :, :2]
            self._count += 1
        self._tick = tick
        return self.ways

    @property
    def ways(self) -> tuple[Trail, ...]:
        """The way of each drone so far."""
        return tuple(self._ways[: self._count, drone] for drone in range(self._ways.shape[1]))
