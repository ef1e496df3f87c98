"""The one place where observations are built, for a drone on board and for thousands in the twin."""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from imagine.core.errors import InputError
from imagine.core.frames import Pose
from imagine.core.frontier import PAD, UNIT_M, FrontierField, cost_at
from imagine.core.frontier_choice import choice_scratch, fill_frontiers
from imagine.core.frontier_paths import FAR
from imagine.core.lidar import LidarSpec, Scan
from imagine.core.observation_spec import ObservationSpec
from imagine.core.peer_poses import PeerPoses, fill_peer_distances, fill_peer_places
from imagine.core.raster import CELL, LIMIT
from imagine.core.visits import VisitMap, fill_visits, visit_levels

MOTION = 3
"""Numbers of `motion` that every specification has: velocity along two axes, and yaw rate."""


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
    """Fill a scale's two channels along the map's axes: row by row, for rows of pixels are rows of cells.

    Loops run over flat arrays without branches and with indices without a sign: these compile to vector instructions.
    """
    rows, columns = belief.shape
    n = occupancy.shape[0]
    block = round(scale / CELL)
    column = (math.floor(x / scale + 0.5) - n // 2) * block - column0
    row = (math.floor(y / scale + 0.5) - n // 2) * block - row0
    first, first_row = min(n, max(0, -(column // block))), min(n, max(0, -(row // block)))
    count = max(0, min(n, (columns - column) // block) - first)  # pixels within the grid, of which both are multiples
    last_row = min(n, (rows - row) // block)
    out, near = occupancy.ravel(), frontier.ravel()
    if count < n or last_row - first_row < n:
        out[:] = 0.0
    if count < n or last_row - first_row < n or own >= FAR:
        near[:] = 1.0
    if count == 0 or last_row <= first_row:
        return
    begin = column + first * block
    cells = belief.ravel()
    per_limit = np.float32(1.0 / (LIMIT * block * block))
    if block == 1:
        for i in range(first_row, last_row):
            line, target = (row + i) * columns + begin, i * n + first
            for j in range(count):
                out[np.uint64(target + j)] = np.float32(cells[np.uint64(line + j)]) * per_limit
    else:
        _fill_blocks(out, cells, columns, row, begin, first, count, first_row, last_row, block, per_limit, n)
    if own >= FAR:
        return
    plan_width, plan_block = cost.shape[1], max(1, block // 2)
    costs = cost.ravel()
    odd_row, odd = (row + first_row * block) & 1, begin & 1  # at the finest scale two pixels share a planning cell
    plan_rows = last_row - first_row if block > 1 else (last_row - first_row + odd_row + 1) // 2
    plan_count = count if block > 1 else (count + odd + 1) // 2
    corner = (((row + first_row * block) >> 1) + PAD) * plan_width + (begin >> 1) + PAD
    low = np.empty(plan_rows * plan_count * plan_block, np.int16)
    for i in range(plan_rows):
        target, line = i * plan_count * plan_block, corner + i * plan_block * plan_width
        for j in range(plan_count * plan_block):
            c = costs[np.uint64(line + j)]
            low[np.uint64(target + j)] = c if c >= 0 else np.int16(FAR)
        for _ in range(1, plan_block):
            line += plan_width
            for j in range(plan_count * plan_block):
                c, least = costs[np.uint64(line + j)], low[np.uint64(target + j)]
                c = c if c >= 0 else np.int16(FAR)
                low[np.uint64(target + j)] = c if c < least else least
    side = plan_block
    while side > 1:  # neighbours in pairs, until a block is one number
        half = np.empty(len(low) // 2, np.int16)
        for j in range(len(half)):
            a, b = low[np.uint64(2 * j)], low[np.uint64(2 * j + 1)]
            half[np.uint64(j)] = a if a < b else b
        low, side = half, side // 2
    relative = np.empty(len(low), np.float32)
    for j in range(len(low)):
        further = np.float32(np.int32(low[np.uint64(j)]) - np.int32(own)) * per_unit
        further = further if further < np.float32(1.0) else np.float32(1.0)
        relative[np.uint64(j)] = further if further > np.float32(-1.0) else np.float32(-1.0)
    for i in range(last_row - first_row):
        target = (first_row + i) * n + first
        line = i * count if block > 1 else ((i + odd_row) >> 1) * plan_count
        if block > 1:
            for j in range(count):
                near[np.uint64(target + j)] = relative[np.uint64(line + j)]
        else:
            for j in range(count):
                near[np.uint64(target + j)] = relative[np.uint64(line + ((j + odd) >> 1))]


@numba.njit(cache=True, nogil=True)
def _fill_blocks(  # type: ignore[no-untyped-def]
    out, cells, columns, row, begin, first, count, first_row, last_row, block, per_limit, n
):
    """Fill the occupancy of pixels that are blocks of cells: the strongest obstacle, or else the mean."""
    width = count * block
    high, sums = np.empty((last_row - first_row) * width, np.int8), np.empty((last_row - first_row) * width, np.int8)
    for i in range(last_row - first_row):
        target, line = i * width, (row + (first_row + i) * block) * columns + begin
        for j in range(width):
            high[np.uint64(target + j)] = cells[np.uint64(line + j)]
            sums[np.uint64(target + j)] = cells[np.uint64(line + j)]
        for _ in range(1, block):
            line += columns
            for j in range(width):
                c, strongest = cells[np.uint64(line + j)], high[np.uint64(target + j)]
                high[np.uint64(target + j)] = c if c > strongest else strongest
                sums[np.uint64(target + j)] = np.int8(sums[np.uint64(target + j)] + c)
    total = np.empty(len(sums) // 2, np.int16)
    for j in range(len(total)):
        total[np.uint64(j)] = np.int16(np.int16(sums[np.uint64(2 * j)]) + np.int16(sums[np.uint64(2 * j + 1)]))
    side = block // 2
    while side > 1:
        half = np.empty(len(total) // 2, np.int16)
        for j in range(len(half)):
            half[np.uint64(j)] = np.int16(total[np.uint64(2 * j)] + total[np.uint64(2 * j + 1)])
        total, side = half, side // 2
    side = block
    while side > 1:
        top = np.empty(len(high) // 2, np.int8)
        for j in range(len(top)):
            a, b = high[np.uint64(2 * j)], high[np.uint64(2 * j + 1)]
            top[np.uint64(j)] = a if a > b else b
        high, side = top, side // 2
    for i in range(last_row - first_row):
        target, line = (first_row + i) * n + first, i * count
        for j in range(count):
            strongest = np.int16(high[np.uint64(line + j)])
            value = np.int16(strongest * np.int16(block * block))
            value = value if strongest > 0 else total[np.uint64(line + j)]
            out[np.uint64(target + j)] = np.float32(value) * per_limit


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
            total, strongest = np.int64(0), np.int64(0)
            for r in range(row, row + block):
                for c in range(column, column + block):
                    total += belief[r, c]
                    strongest = max(strongest, np.int64(belief[r, c]))
            occupancy[i, j] = np.float32(strongest * block * block if strongest > 0 else total) * per_limit
            least = np.int64(FAR)
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
        sector = math.floor(bearing / (2.0 * math.pi) * count)
        while sector < 0:  # at most a turn or two, and far cheaper than a division
            sector += count
        while sector >= count:
            sector -= count
        sectors[sector] = min(sectors[sector], np.float32(min(r / range_m, 1.0)))


@numba.njit(cache=True, nogil=True)
def fill_motion(motion, vx, vy, yaw_rate, turn, speed, fastest_yaw):  # type: ignore[no-untyped-def]
    """Fill `motion` (float32 `[3]`) with the map-frame velocity seen along the observation's axes, and the yaw rate."""
    c, s = math.cos(turn), math.sin(turn)
    motion[0] = min(max((c * vx + s * vy) / speed, -2.0), 2.0)
    motion[1] = min(max((-s * vx + c * vy) / speed, -2.0), 2.0)
    motion[2] = min(max(yaw_rate / fastest_yaw, -2.0), 2.0)


@numba.njit(cache=True, nogil=True)
def fill_options(numbers, x, y, yaw, positions, ages, options):  # type: ignore[no-untyped-def]
    """Fill `numbers` (float32, `motion` beyond its first three) with what `options`, by `option_parameters`, ask for.

    `positions` and `ages` of the peers as in `PeerPoses`.
    """
    position, extent, heading, peers, range_m, places, places_range_m, memory_s, heading_axes = options
    at = 0
    if position:
        numbers[0] = min(max(x / extent, -2.0), 2.0)
        numbers[1] = min(max(y / extent, -2.0), 2.0)
        at = 2
    if heading:
        numbers[at], numbers[at + 1] = math.cos(yaw), math.sin(yaw)
        at += 2
    if peers > 0:
        fill_peer_distances(numbers[at : at + peers], x, y, positions, ages, range_m)
        at += peers
    if places > 0:
        turn = yaw if heading_axes else 0.0
        fill_peer_places(numbers[at : at + 3 * places], x, y, turn, positions, ages, places_range_m, memory_s)


def option_parameters(spec: ObservationSpec) -> tuple[bool, float, bool, int, float, int, float, float, bool]:
    """Return what `fill_options` needs to know of a specification, as plain numbers."""
    return (
        spec.position, spec.position_extent_m, spec.heading, spec.peers, spec.peers_range_m,
        spec.peer_places, spec.peer_places_range_m, spec.peer_memory_s, spec.axes == "heading",
    )  # fmt: skip


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
    peers: PeerPoses | None = None,
    visits: VisitMap | None = None,
) -> dict[str, NDArray[np.float32]]:
    """Return what a policy sees, arrays named and shaped as `spec.shapes`.

    `belief` int8 `[rows, columns]` with its first cell at `origin_cells` (column, row); `velocity` m/s in the map
    frame; `yaw_rate` rad/s; `peers` None: nobody is known. Raises InputError where the spec shows visits and none are
    given, or where they lie on another grid than the belief.
    """
    observation = {name: np.empty(shape, np.float32) for name, shape in spec.shapes.items()}
    turn = pose.yaw if spec.axes == "heading" else 0.0
    scales = np.array(spec.view_scales_m)
    maps = 2 * len(scales)
    fill_views(
        observation["views"][:maps], belief, field.cost, origin_cells[0], origin_cells[1], pose.x, pose.y, turn,
        scales, np.array(spec.frontier_ranges_m),
    )  # fmt: skip
    if spec.visits != "off":
        rows, columns = belief.shape
        if visits is None or visits.origin_cells != origin_cells or visits.own.shape != (rows // 2, columns // 2):
            raise InputError("the observation shows visits: give a visit map that is fitted to the belief's grid")
        fill_visits(
            observation["views"][maps:], visits.own, visits.peers, spec.visits == "team",
            origin_cells[0], origin_cells[1], pose.x, pose.y, turn, scales, visit_levels(spec.visits_full_ticks),
        )  # fmt: skip
    fill_sectors(
        observation["lidar"], scan.ranges, lidar.range_min, lidar.start, lidar.increment,
        pose.yaw - turn, spec.lidar_range_m,
    )  # fmt: skip
    fill_motion(observation["motion"], velocity[0], velocity[1], yaw_rate, turn, spec.speed_mps, spec.yaw_rate_rps)
    if len(observation["motion"]) > MOTION:
        known = peers or PeerPoses.none()
        fill_options(
            observation["motion"][MOTION:], pose.x, pose.y, pose.yaw, known.positions, known.ages_s,
            option_parameters(spec),
        )  # fmt: skip
    if spec.frontiers:
        known = peers or PeerPoses.none()
        rows, columns = field.kinds.shape
        fill_frontiers(
            observation["frontiers"], field.kinds, field.padded_states, belief, origin_cells[0], origin_cells[1],
            pose.x, pose.y, turn, known.positions, known.ages_s, spec.peer_memory_s, choice_scratch(rows, columns),
        )  # fmt: skip
    return observation
