"""What a policy is shown of the frontiers that it can choose from: the best few, with the way to each as numbers.

They are what the coordinated planner decides by (`frontier_targets`, `dealing`): a policy that sees them can follow
that planner, and learn where it is worth while not to.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from imagine.core.dealing import deal, worth_of
from imagine.core.frontier import PAD, PLAN_CELL, UNIT_M
from imagine.core.frontier_gaps import fill_flyable
from imagine.core.frontier_paths import FAR, search_scratch
from imagine.core.frontier_targets import (
    MOST_TARGETS,
    expected_gain,
    fill_ways,
    find_targets,
    gain_canvas,
    gain_rays,
    nearest_open,
)
from imagine.core.frontier_ways import follow, trace_back

FRONTIER_NUMBERS = 14
"""Numbers for each frontier shown, see `fill_frontiers`."""
OFFSET_M, OFFSETS = 10.0, 8
"""Metres that read as 1 in the offset to a frontier, and the first of its two numbers."""
_WAY_M, _MOST = 10.0, 3.0
_CLUSTER_CELLS = 6  # 1.2 m
_NEAR_CELLS, _FAR_CELLS = 20, 30  # what may be seen: at a target, 4 m around it, and where it leads, 6 m
_COST_PER_M = 0.1  # of the logarithm of what is seen, as the coordinated planner weighs a way
_STRIDE = 2  # cells between two looks for what a target leads to
_OWN_RINGS, _PEER_RINGS = 4, 12
_PATH_CELLS = 512


class ChoiceScratch(NamedTuple):
    """What a thread works with on padded planning grids of one size."""

    kinds: NDArray[np.uint8]
    own: NDArray[np.int16]
    other: NDArray[np.int16]
    marks: NDArray[np.uint8]
    queue: NDArray[np.int32]
    search: tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32]]
    targets: NDArray[np.int32]
    path: NDArray[np.int32]
    left: NDArray[np.float32]
    rays: NDArray[np.float64]
    nobody: NDArray[np.int32]


def choice_scratch(rows: int, columns: int) -> ChoiceScratch:
    """Return scratch for padded planning grids of `rows` by `columns`."""
    cells = rows * columns
    return ChoiceScratch(
        np.empty((rows, columns), np.uint8), np.empty((rows, columns), np.int16), np.empty((rows, columns), np.int16),
        np.zeros(cells, np.uint8),
        np.empty(cells, np.int32), search_scratch(cells), np.empty(MOST_TARGETS, np.int32),
        np.empty(_PATH_CELLS, np.int32), gain_canvas(rows, columns), gain_rays(),
        np.full(1, -1, np.int32),
    )  # fmt: skip


@numba.njit(cache=True, nogil=True)
def fill_frontiers(  # type: ignore[no-untyped-def]
    frontiers, closed, states, belief, column0, row0, x, y, turn, positions, ages, memory_s, scratch
):
    """Fill `frontiers` (float32 `[n, FRONTIER_NUMBERS]`) with the n best targets of a drone at (x, y), best first.

    Numbers of each: 1; the direction to fly in, a unit vector; the way there; what it may show within 4 m and within
    6 m, as shares of these discs; the ways of the nearest two peers; the offset from the drone; whether the dealing
    gives it to this drone, to a peer; what it may show once the peers have seen theirs; how fresh the nearest peer's
    report is. Metres are over 10,
    ways at most 3, and 3 where nobody gets there; vectors are along axes turned by `turn`. Rows beyond the targets
    there are stay 0. `closed` (kinds, with narrow gaps still closed) and `states` are padded planning grids of
    `belief` (int8 `[rows, columns]`), whose first cell is map cell (column0, row0);
    `positions`, `ages` as in `PeerPoses`, of peers heard within `memory_s`.
    """
    frontiers[:] = 0.0
    kinds = scratch.kinds
    fill_flyable(kinds, closed, states, belief)
    columns = kinds.shape[1]
    at_row, at_column = y / PLAN_CELL - row0 // 2 + PAD, x / PLAN_CELL - column0 // 2 + PAD
    start = nearest_open(kinds, math.floor(at_row), math.floor(at_column), _OWN_RINGS)
    if start < 0:
        return
    fill_ways(scratch.own, kinds, start, scratch.search)
    targets = scratch.targets
    count = find_targets(targets, kinds, scratch.own, scratch.nobody, _CLUSTER_CELLS, scratch.marks, scratch.queue)
    if count == 0:
        return
    own = scratch.own.ravel()
    peers = len(ages)
    ways, fresh = np.empty((peers + 1, count)), np.zeros(peers + 1)
    near, far, utility = np.empty(count), np.empty(count), np.empty(count)
    left, few = scratch.left, scratch.rays[::2]
    left[:] = np.float32(1.0)
    for k in range(count):
        ways[0, k] = own[targets[k]] * UNIT_M
        near[k] = expected_gain(states, left, targets[k], _NEAR_CELLS, few, 1)
        far[k] = utility[k] = expected_gain(states, left, targets[k], _FAR_CELLS, few, _STRIDE)
    robots = 1
    for peer in range(peers):
        if not ages[peer] < memory_s:
            continue
        row = math.floor(positions[peer, 1] / PLAN_CELL - row0 // 2 + PAD)
        column = math.floor(positions[peer, 0] / PLAN_CELL - column0 // 2 + PAD)
        begin = nearest_open(kinds, row, column, _PEER_RINGS)
        if begin < 0:
            continue
        fill_ways(scratch.other, kinds, begin, scratch.search)
        other = scratch.other.ravel()
        for k in range(count):
            cost = other[targets[k]]
            ways[robots, k] = cost * UNIT_M if 0 <= cost < FAR else np.inf
        fresh[robots] = 1.0 - max(ages[peer], 0.0) / memory_s
        robots += 1
    dealt = np.full(robots, -1)
    options = (_COST_PER_M, 1, 1.0, _FAR_CELLS, 1.0)
    deal(dealt, ways[:robots], utility, targets[:count], states, left, scratch.rays, options, few, _STRIDE)
    cos_turn, sin_turn = math.cos(turn), math.sin(turn)
    taken = np.zeros(count, np.bool_)
    for shown in range(min(len(frontiers), count)):
        best, best_worth = -1, -np.inf
        for k in range(count):
            worth = worth_of(utility[k], _COST_PER_M * ways[0, k], 1) + (1e6 if dealt[0] == k else 0.0)
            if not taken[k] and worth > best_worth:
                best, best_worth = k, worth
        taken[best] = True
        cell = targets[best]
        length = trace_back(scratch.path, scratch.own, kinds, cell)
        d_row, d_column, _, _ = follow(scratch.path, length, 0, kinds, states, at_row, at_column)
        norm = max(math.sqrt(d_row * d_row + d_column * d_column), 1e-6)
        nearest, second, freshness, to_peer = np.inf, np.inf, 0.0, 0.0
        for robot in range(1, robots):
            if ways[robot, best] < nearest:
                second = nearest
                nearest, freshness = ways[robot, best], fresh[robot]
            else:
                second = min(second, ways[robot, best])
            if dealt[robot] == best:
                to_peer = 1.0
        dx = (cell % columns + 0.5 - at_column) * (PLAN_CELL / OFFSET_M)
        dy = (cell // columns + 0.5 - at_row) * (PLAN_CELL / OFFSET_M)
        row_out = frontiers[shown]
        row_out[0] = 1.0
        row_out[1] = (cos_turn * d_column + sin_turn * d_row) / norm
        row_out[2] = (cos_turn * d_row - sin_turn * d_column) / norm
        row_out[3] = min(ways[0, best] / _WAY_M, _MOST)
        row_out[4] = near[best]
        row_out[5] = far[best]
        row_out[6] = min(nearest / _WAY_M, _MOST)
        row_out[7] = min(second / _WAY_M, _MOST)
        row_out[8] = min(max(cos_turn * dx + sin_turn * dy, -_MOST), _MOST)
        row_out[9] = min(max(cos_turn * dy - sin_turn * dx, -_MOST), _MOST)
        row_out[10] = 1.0 if dealt[0] == best else 0.0
        row_out[11] = to_peer
        row_out[12] = utility[best]
        row_out[13] = freshness
