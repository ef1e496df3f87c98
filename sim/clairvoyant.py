"""How soon a level could be explored by drones that know it: the floor that no policy gets below.

Two numbers, for drones that fly at full speed from the first tick and share everything at once. The bound: when the
shortest flights have come to where enough can be seen, as if there were a drone for every place. The plan: the best
that annealing finds for this team, on the shortest ways between waypoints; a better one may exist. Who does not know
the level needs longer than either.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import dijkstra

from imagine.core.frames import Pose
from imagine.core.raster import CELL
from imagine.sim.clairvoyant_kernels import TICKS_PER_S, bits, improve, mark_seen
from imagine.sim.level import Level
from imagine.sim.level_survey import SIGHT_M, cell_centres

_EVERY = 2  # cells between points that are looked from
_BEAMS = 450
_WAYPOINTS, MOST_WAYPOINTS = 400, 14
MOST_TICKS = 1000
_HEAT = 12.0
_STEPS = ((0, 1), (1, 0), (1, 1), (1, -1), (1, 2), (2, 1), (1, -2), (2, -1))
_DETOUR = 1.0275
"""How much longer ways on a lattice with these steps may be than straight: 1 / cos(atan(1 / 2) / 2)."""


@dataclass(frozen=True)
class Floor:
    """Ticks of 0.1 s until the share is seen: the `bound` that nobody gets below, and the best `plan` found."""

    bound: float
    plan: float


class Clairvoyant:
    """A level with all that can be seen from every point of a 0.2 m lattice, and the shortest ways between them.

    `points` `[n, 2]` metres; `seen` uint64 `[n, words]`, which of the `cells` that count each sees; `nodes`
    `[waypoints]` the points that plans go through, `far` and `before` `[waypoints, n]` the ways there from everywhere;
    `clear` bool `[rows, columns]`, where all cells around can be flown in.
    """

    def __init__(
        self, level: Level, sight_m: float = SIGHT_M, every_cell: int = 1, near_factor: float = 1.0, seed: int = 0
    ) -> None:
        """Look from everywhere in `level`, as far as drones map, at every or every n-th cell along both axes.

        Ways beside obstacles count `near_factor` times: what is flown for real keeps to the middle of doors.
        """
        column0, row0, _, _ = level.grid
        rows, columns = np.nonzero(level.flyable[::_EVERY, ::_EVERY])
        self.points = cell_centres(rows * _EVERY, columns * _EVERY, level.grid)
        self.clear = minimum_filter(level.flyable, size=3, mode="constant")
        near = np.where(self.clear[rows * _EVERY, columns * _EVERY], 1.0, near_factor)
        self._ways = _ways(level.flyable, rows * _EVERY, columns * _EVERY, near)
        counted = np.zeros_like(level.coverable)
        counted[::every_cell, ::every_cell] = level.coverable[::every_cell, ::every_cell]
        ids = np.full(level.coverable.shape, -1, np.int32)
        self._counted, self.cells = np.nonzero(counted), int(counted.sum())
        ids[self._counted] = np.arange(self.cells)
        self.seen = np.zeros((len(self.points), (self.cells + 63) // 64), np.uint64)
        segments, circles = level.segments, level.geometry.circles
        mark_seen(self.seen, ids, self.points, segments, circles, sight_m, _BEAMS, column0, row0)
        self.nodes = np.random.default_rng(seed).permutation(len(self.points))[:_WAYPOINTS]
        far, before = dijkstra(self._ways, indices=self.nodes, return_predecessors=True)
        self.far, self.before = far.astype(np.float32), before

    def nearest(self, x: float, y: float) -> int:
        """Return the point nearest to (x, y)."""
        return int(np.hypot(*(self.points - (x, y)).T).argmin())

    def bits_of(self, seen: NDArray[np.bool_]) -> NDArray[np.uint64]:
        """Return, as in `self.seen`, which cells a grid says are seen; bool `[rows, columns]`, at least the level's."""
        packed = np.zeros(8 * self.seen.shape[1], np.uint8)
        bytes_ = np.packbits(seen[self._counted], bitorder="little")
        packed[: len(bytes_)] = bytes_
        return packed.view(np.uint64)

    def improve(
        self,
        way: NDArray[np.int64],
        lengths: NDArray[np.int64],
        starts: NDArray[np.int64],
        known: NDArray[np.uint64],
        needed: int,
        speed_mps: float,
        tries: int,
        heat: float,
        per_metre: float,
        generator: np.random.Generator,
    ) -> float:
        """Improve a plan, see `clairvoyant_kernels.improve`."""
        ticks: float = improve(
            way, lengths, starts, self.nodes, self.far, self.before, self.seen, known, needed, speed_mps, MOST_TICKS,
            tries, heat, per_metre, generator,
        )  # fmt: skip
        return ticks

    def floor(
        self, launch: list[Pose], speed_mps: float = 0.8, share: float = 0.9, tries: int = 60_000, seed: int = 0
    ) -> Floor:
        """Return the floor from `launch` poses, annealing for `tries` changes of the plan."""
        starts = np.array([self.nearest(pose.x, pose.y) for pose in launch])
        needed = math.ceil(share * self.cells)
        way, lengths = np.zeros((len(launch), MOST_WAYPOINTS), np.int64), np.zeros(len(launch), np.int64)
        nothing, generator = np.zeros(self.seen.shape[1], np.uint64), np.random.default_rng(seed)
        plan = self.improve(way, lengths, starts, nothing, needed, speed_mps, tries, _HEAT, 0.0, generator)
        return Floor(self._bound(starts, needed, speed_mps), float(plan))

    def _bound(self, starts: NDArray[np.int64], needed: int, speed_mps: float) -> float:
        metres = dijkstra(self._ways, indices=starts).min(axis=0)
        order = np.argsort(metres)
        low, high = 0, len(order)  # so many of the nearest points are enough
        while low < high:
            middle = (low + high) // 2
            enough = bits(np.bitwise_or.reduce(self.seen[order[: middle + 1]], axis=0)) >= needed
            low, high = (low, middle) if enough else (middle + 1, high)
        if low == len(order) or not np.isfinite(metres[order[low]]):
            return math.inf
        apart = math.sqrt(2.0) * _EVERY * CELL  # both ends may lie so far from the lattice, together
        return max(0.0, float(metres[order[low]]) / _DETOUR - apart) / speed_mps * TICKS_PER_S


def _ways(
    flyable: NDArray[np.bool_], rows: NDArray[np.int64], columns: NDArray[np.int64], weights: NDArray[np.float64]
) -> csr_matrix:
    """Return the graph of steps between lattice points, metres, where the middle of a step can be flown as well.

    A step counts as much as its ends' mean weight says, `weights` `[points]`.
    """
    ids = np.full(flyable.shape, -1, np.int64)
    ids[rows, columns] = np.arange(len(rows))
    begins, ends, metres = [], [], []
    for d_row, d_column in _STEPS:
        to_row, to_column = rows + _EVERY * d_row, columns + _EVERY * d_column
        inside = (to_row < flyable.shape[0]) & (to_column >= 0) & (to_column < flyable.shape[1])
        begin = np.flatnonzero(inside)
        end = ids[to_row[begin], to_column[begin]]
        half = flyable[rows[begin] + _EVERY * d_row // 2, columns[begin] + _EVERY * d_column // 2]
        flown = (end >= 0) & half
        begins.append(begin[flown])
        ends.append(end[flown])
        metres.append(math.hypot(d_row, d_column) * _EVERY * CELL * (weights[begin[flown]] + weights[end[flown]]) / 2.0)
    i, j, length = np.concatenate(begins), np.concatenate(ends), np.concatenate(metres)
    size = len(rows)
    both = (np.concatenate((length, length)), (np.concatenate((i, j)), np.concatenate((j, i))))
    return coo_matrix(both, shape=(size, size)).tocsr()
