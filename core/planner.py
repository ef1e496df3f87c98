"""The frontier planner: descend the frontier distance field to the nearest frontier, clear of walls.

It rescues a policy in flight, labels states for imitation, and is the baseline to beat.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from imagine.core.frames import Pose
from imagine.core.frontier import FREE, OCCUPIED, PAD, PLAN_CELL, UNKNOWN, FrontierField
from imagine.core.frontier_paths import FAR
from imagine.core.lidar import LidarSpec, Scan

_LOOKAHEAD_CELLS = 8
_REPULSION_RANGE_M = 0.4
_REPULSION_GAIN = 0.8


@numba.njit(cache=True, nogil=True)
def _clear(states, row0, column0, row1, column1):  # type: ignore[no-untyped-def]
    """Tell whether the straight way between two planning cells stays in free cells that no obstacle touches."""
    rows, columns = states.shape
    steps = 2 * max(abs(row1 - row0), abs(column1 - column0))
    for k in range(1, steps + 1):
        row = round(row0 + (row1 - row0) * k / steps)
        column = round(column0 + (column1 - column0) * k / steps)
        if states[row, column] != FREE:
            return False
        for i in range(max(0, row - 1), min(rows, row + 2)):
            for j in range(max(0, column - 1), min(columns, column + 2)):
                if states[i, j] == OCCUPIED and (abs(i - row0) > 1 or abs(j - column0) > 1):
                    return False
    return True


@numba.njit(cache=True, nogil=True)
def _nearest_valued(cost, row, column):  # type: ignore[no-untyped-def]
    """Return the planning cell to start from: the drone's own, or the one of least cost within two cells."""
    rows, columns = cost.shape
    for ring in range(3):
        best_row, best_column, best = -1, -1, np.int64(FAR)
        for i in range(max(0, row - ring), min(rows, row + ring + 1)):
            for j in range(max(0, column - ring), min(columns, column + ring + 1)):
                if 0 <= cost[i, j] < best:
                    best_row, best_column, best = i, j, np.int64(cost[i, j])
        if best_row >= 0:
            return best_row, best_column
    return -1, -1


@numba.njit(cache=True, nogil=True)
def plan_direction(cost, states, column, row, x, y):  # type: ignore[no-untyped-def]
    """Return (dx, dy, found): the unit vector from (x, y) toward the nearest frontier.

    (x, y) are in planning cells from the padded grid's first cell, (column, row) the cell that holds them.
    """
    rows, columns = cost.shape
    at_row, at_column = _nearest_valued(cost, row, column)
    if at_row < 0:
        return 0.0, 0.0, False
    goal_row, goal_column = at_row, at_column
    for _ in range(_LOOKAHEAD_CELLS):
        best_row, best_column, best = -1, -1, cost[at_row, at_column]
        for i in range(max(0, at_row - 1), min(rows, at_row + 2)):
            for j in range(max(0, at_column - 1), min(columns, at_column + 2)):
                if i != at_row and j != at_column and (states[i, at_column] != FREE or states[at_row, j] != FREE):
                    continue
                if 0 <= cost[i, j] < best:
                    best_row, best_column, best = i, j, cost[i, j]
        if best_row < 0:
            break
        at_row, at_column = best_row, best_column
        if (goal_row != row or goal_column != column) and not _clear(states, row, column, at_row, at_column):
            break
        goal_row, goal_column = at_row, at_column
    dx, dy = goal_column + 0.5 - x, goal_row + 0.5 - y
    if cost[goal_row, goal_column] == 0 and abs(goal_row - row) <= 1 and abs(goal_column - column) <= 1:
        # On the frontier itself: go on toward what is unknown beyond it.
        for i in range(max(0, goal_row - 1), min(rows, goal_row + 2)):
            for j in range(max(0, goal_column - 1), min(columns, goal_column + 2)):
                if states[i, j] == UNKNOWN:
                    dx += j - goal_column
                    dy += i - goal_row
    length = math.sqrt(dx * dx + dy * dy)
    if length < 1e-6:
        return 0.0, 0.0, True
    return dx / length, dy / length, True


@numba.njit(cache=True, nogil=True)
def wall_repulsion(ranges, range_min, start, increment, yaw):  # type: ignore[no-untyped-def]
    """Return a map-frame push away from near returns, at most about 1 long: the mean over the sectors they fill."""
    push_x, push_y = 0.0, 0.0
    for beam in range(ranges.shape[0]):
        r = ranges[beam]
        if range_min <= r < _REPULSION_RANGE_M:
            weight = (_REPULSION_RANGE_M - r) / _REPULSION_RANGE_M
            bearing = yaw + start + beam * increment
            push_x -= weight * math.cos(bearing)
            push_y -= weight * math.sin(bearing)
    share = increment * 2.0 / math.pi  # a wall that fills a quarter turn at zero range pushes with about 1
    return push_x * share, push_y * share


@numba.njit(cache=True, nogil=True)
def plan_kernel(cost, states, column0, row0, x, y, yaw, ranges, range_min, start, increment):  # type: ignore[no-untyped-def]
    """Return (ux, uy, found) in the map frame, length at most 1; (column0, row0) is the grid's origin in map cells.

    `cost` and `states` are padded as in `FrontierField`.
    """
    px, py = x / PLAN_CELL - column0 // 2 + PAD, y / PLAN_CELL - row0 // 2 + PAD
    column, row = math.floor(px), math.floor(py)
    dx, dy, found = plan_direction(cost, states, column, row, px, py)
    if not found:
        return 0.0, 0.0, False
    push_x, push_y = wall_repulsion(ranges, range_min, start, increment, yaw)
    ux, uy = dx + _REPULSION_GAIN * push_x, dy + _REPULSION_GAIN * push_y
    length = math.sqrt(ux * ux + uy * uy)
    if length > 1.0:
        ux, uy = ux / length, uy / length
    return ux, uy, True


def plan_velocity(
    field: FrontierField,
    origin_cells: tuple[int, int],
    pose: Pose,
    scan: Scan,
    lidar: LidarSpec,
    speed_mps: float,
) -> tuple[float, float] | None:
    """Return the map-frame velocity (m/s) toward the nearest frontier, or None where none can be reached."""
    ux, uy, found = plan_kernel(
        field.cost, field.padded_states, origin_cells[0], origin_cells[1], pose.x, pose.y, pose.yaw,
        scan.ranges, lidar.range_min, lidar.start, lidar.increment,
    )  # fmt: skip
    return (ux * speed_mps, uy * speed_mps) if found else None
