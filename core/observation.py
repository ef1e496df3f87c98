"""The one place where observations are built, for a drone on board and for thousands in the twin."""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from imagine.core.frames import Pose
from imagine.core.frontier import FAR, PAD, UNIT_M, FrontierField, cost_at
from imagine.core.lidar import LidarSpec, Scan
from imagine.core.observation_spec import ObservationSpec
from imagine.core.raster import CELL, LIMIT


@numba.njit(cache=True, nogil=True)
def fill_views(  # type: ignore[no-untyped-def]
    views, belief, cost, column0, row0, x, y, turn, scales, frontier_ranges
):
    """Fill `views` (float32 `[2 scales, n, n]`) with what the belief shows around (x, y), turned by `turn` radians.

    A pixel reads the map cell, or the block of cells aligned with the map, that holds its centre: the belief in
    [-1, 1], a block's strongest obstacle or else its mean; and the least frontier distance in it less the drone's
    own, over the scale's frontier range, in [-1, 1]. `belief` int8 `[rows, columns]`, `cost` as `FrontierField.cost`.
    """
    own_column = math.floor(x / (2.0 * CELL)) - column0 // 2
    own_row = math.floor(y / (2.0 * CELL)) - row0 // 2
    own = cost_at(cost, own_column, own_row)
    for k in range(len(scales)):
        per_unit = np.float32(UNIT_M / frontier_ranges[k])
        if turn == 0.0:
            _fill_aligned(views[2 * k], views[2 * k + 1], belief, cost, column0, row0, x, y, scales[k], own, per_unit)
        else:
            _fill_turned(
                views[2 * k], views[2 * k + 1], belief, cost, column0, row0, x, y, turn, scales[k], own, per_unit
            )


@numba.njit(cache=True, nogil=True)
def _fill_aligned(  # type: ignore[no-untyped-def]
    occupancy, frontier, belief, cost, column0, row0, x, y, scale, own, per_unit
):
    """Fill a scale's two channels along the map's axes: row by row, for rows of pixels are rows of cells."""
    rows, columns = belief.shape
    n = occupancy.shape[0]
    block = round(scale / CELL)
    column = (math.floor(x / scale + 0.5) - n // 2) * block - column0
    row = (math.floor(y / scale + 0.5) - n // 2) * block - row0
    first = min(n, max(0, -(column // block)))  # pixels within the grid; both are multiples of the block
    last = max(first, min(n, (columns - column) // block))
    highest, total = np.empty(n * block, np.int8), np.empty(n * block, np.int16)
    least = np.empty(n * block, np.int16)
    per_limit = np.float32(1.0 / (LIMIT * block * block))
    for i in range(n):
        occupancy[i] = 0.0
        frontier[i] = 1.0
        at = row + i * block
        if at < 0 or at + block > rows:
            continue
        out, near = occupancy[i], frontier[i]
        begin = column + first * block
        width = (last - first) * block
        line = belief[at]
        if block == 1:
            for j in range(width):
                out[np.uint64(first + j)] = np.float32(line[np.uint64(begin + j)]) * per_limit
        else:
            for j in range(width):
                highest[j] = line[np.uint64(begin + j)]
                total[j] = line[np.uint64(begin + j)]
            for lower in range(1, block):
                line = belief[at + lower]
                for j in range(width):
                    c = line[np.uint64(begin + j)]
                    highest[j] = c if c > highest[j] else highest[j]
                    total[j] = np.int16(total[j] + c)
            for j in range(last - first):
                strongest, mean = np.int8(-LIMIT), np.int16(0)
                for k in range(j * block, (j + 1) * block):
                    strongest = highest[k] if highest[k] > strongest else strongest
                    mean = np.int16(mean + total[k])
                value = np.int16(strongest * block * block) if strongest > 0 else mean
                out[np.uint64(first + j)] = np.float32(value) * per_limit
        if own >= FAR:
            continue
        plan_first = (begin >> 1) + PAD
        plan_row = (at >> 1) + PAD
        if block == 1:
            line_cost = cost[plan_row]
            odd = begin & 1
            for j in range(width):
                c = line_cost[np.uint64(plan_first + ((j + odd) >> 1))]
                c = c if c >= 0 else np.int16(FAR)
                relative = np.float32(np.int32(c) - np.int32(own)) * per_unit
                relative = relative if relative < np.float32(1.0) else np.float32(1.0)
                near[np.uint64(first + j)] = relative if relative > np.float32(-1.0) else np.float32(-1.0)
        else:
            plan_block = block // 2
            plan_width = width // 2
            line_cost = cost[plan_row]
            for j in range(plan_width):
                c = line_cost[np.uint64(plan_first + j)]
                least[j] = c if c >= 0 else np.int16(FAR)
            for lower in range(1, plan_block):
                line_cost = cost[plan_row + lower]
                for j in range(plan_width):
                    c = line_cost[np.uint64(plan_first + j)]
                    c = c if c >= 0 else np.int16(FAR)
                    least[j] = c if c < least[j] else least[j]
            for j in range(last - first):
                c = np.int16(FAR)
                for k in range(j * plan_block, (j + 1) * plan_block):
                    c = least[k] if least[k] < c else c
                relative = np.float32(np.int32(c) - np.int32(own)) * per_unit
                relative = relative if relative < np.float32(1.0) else np.float32(1.0)
                near[np.uint64(first + j)] = relative if relative > np.float32(-1.0) else np.float32(-1.0)


@numba.njit(cache=True, nogil=True)
def _fill_turned(  # type: ignore[no-untyped-def]
    occupancy, frontier, belief, cost, column0, row0, x, y, turn, scale, own, per_unit
):
    """Fill a scale's two channels along axes turned by `turn` radians: pixel by pixel."""
    rows, columns = belief.shape
    n = occupancy.shape[0]
    block = round(scale / CELL)
    plan_block = max(1, block // 2)
    cos_turn, sin_turn = math.cos(turn), math.sin(turn)
    per_limit = np.float32(1.0 / (LIMIT * block * block))
    for i in range(n):
        v = (i + 0.5 - 0.5 * n) * scale
        for j in range(n):
            u = (j + 0.5 - 0.5 * n) * scale
            column = math.floor((x + cos_turn * u - sin_turn * v) / scale) * block - column0
            row = math.floor((y + sin_turn * u + cos_turn * v) / scale) * block - row0
            occupancy[i, j], frontier[i, j] = 0.0, 1.0
            if row < 0 or column < 0 or row + block > rows or column + block > columns:
                continue
            total, strongest = 0, 0
            for r in range(row, row + block):
                for c in range(column, column + block):
                    total += belief[r, c]
                    strongest = max(strongest, np.int64(belief[r, c]))
            occupancy[i, j] = np.float32(strongest * block * block if strongest > 0 else total) * per_limit
            least = FAR
            for r in range((row >> 1) + PAD, (row >> 1) + PAD + plan_block):
                for c in range((column >> 1) + PAD, (column >> 1) + PAD + plan_block):
                    if 0 <= cost[r, c] < least:
                        least = np.int64(cost[r, c])
            if own < FAR:
                relative = np.float32(least - own) * per_unit
                frontier[i, j] = min(max(relative, np.float32(-1.0)), np.float32(1.0))


@numba.njit(cache=True, nogil=True)
def fill_sectors(sectors, ranges, range_min, start, increment, turn, range_m):  # type: ignore[no-untyped-def]
    """Fill `sectors` (float32 `[n]`) with the least range in each, in [0, 1]; sector 0 begins at the zero direction.

    `turn` is added to the beams' bearings; invalid beams are skipped, and a sector nobody looked into reads 1.
    """
    count = len(sectors)
    sectors[:] = 1.0
    for beam in range(len(ranges)):
        r = ranges[beam]
        if not r >= range_min:
            continue
        bearing = start + beam * increment + turn
        sector = math.floor(bearing / (2.0 * math.pi) * count) % count
        sectors[sector] = min(sectors[sector], np.float32(min(r / range_m, 1.0)))


@numba.njit(cache=True, nogil=True)
def fill_motion(motion, vx, vy, yaw_rate, turn, speed, fastest_yaw):  # type: ignore[no-untyped-def]
    """Fill `motion` (float32 `[3]`) with the map-frame velocity seen along the observation's axes, and the yaw rate."""
    c, s = math.cos(turn), math.sin(turn)
    motion[0] = min(max((c * vx + s * vy) / speed, -2.0), 2.0)
    motion[1] = min(max((-s * vx + c * vy) / speed, -2.0), 2.0)
    motion[2] = min(max(yaw_rate / fastest_yaw, -2.0), 2.0)


def observe(
    spec: ObservationSpec,
    belief: NDArray[np.int8],
    field: FrontierField,
    origin_cells: tuple[int, int],
    pose: Pose,
    velocity: tuple[float, float],
    yaw_rate: float,
    scan: Scan,
    lidar: LidarSpec,
) -> dict[str, NDArray[np.float32]]:
    """Return what a policy sees, arrays named and shaped as `spec.shapes`.

    `belief` int8 `[rows, columns]` with its first cell at `origin_cells` (column, row); `velocity` m/s in the map
    frame; `yaw_rate` rad/s.
    """
    observation = {name: np.empty(shape, np.float32) for name, shape in spec.shapes.items()}
    turn = pose.yaw if spec.axes == "heading" else 0.0
    fill_views(
        observation["views"], belief, field.cost, origin_cells[0], origin_cells[1], pose.x, pose.y, turn,
        np.array(spec.view_scales_m), np.array(spec.frontier_ranges_m),
    )  # fmt: skip
    fill_sectors(
        observation["lidar"], scan.ranges, lidar.range_min, lidar.start, lidar.increment,
        pose.yaw - turn, spec.lidar_range_m,
    )  # fmt: skip
    fill_motion(observation["motion"], velocity[0], velocity[1], yaw_rate, turn, spec.speed_mps, spec.yaw_rate_rps)
    return observation
