"""The one place where observations are built, for a drone on board and for thousands in the twin."""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from imagine.core.errors import InputError
from imagine.core.frames import Pose
from imagine.core.frontier import FrontierField, distance_at
from imagine.core.lidar import LidarSpec, Scan
from imagine.core.observation_spec import ObservationSpec
from imagine.core.peer_poses import PeerPoses, fill_peer_distances
from imagine.core.raster import CELL, LIMIT
from imagine.core.visits import VisitMap, fill_visits, visit_levels

MOTION = 3
"""Numbers of `motion` that every specification has: velocity along two axes, and yaw rate."""


@numba.njit(cache=True, nogil=True)
def _pooled_occupancy(belief, row, column, block):  # type: ignore[no-untyped-def]
    """Return the belief of a block of cells in [-1, 1]: its strongest obstacle, else its mean."""
    rows, columns = belief.shape
    if row < 0 or column < 0 or row + block > rows or column + block > columns:
        return np.float32(0.0)
    if block == 1:
        return np.float32(belief[row, column]) * np.float32(1.0 / LIMIT)
    total, strongest = np.int32(0), np.int32(0)
    for i in range(row, row + block):
        for j in range(column, column + block):
            value = np.int32(belief[i, j])
            total += value
            strongest = max(strongest, value)
    if strongest > 0:
        return np.float32(strongest) * np.float32(1.0 / LIMIT)
    return np.float32(total) / np.float32(LIMIT * block * block)


@numba.njit(cache=True, nogil=True)
def _pooled_distance(distance, row, column, block):  # type: ignore[no-untyped-def]
    """Return the least frontier distance in a block of planning cells, inf outside the grid."""
    rows, columns = distance.shape
    best = np.float32(np.inf)
    for i in range(max(0, row), min(rows, row + block)):
        for j in range(max(0, column), min(columns, column + block)):
            best = min(best, distance[i, j])
    return best


@numba.njit(cache=True, nogil=True)
def fill_views(  # type: ignore[no-untyped-def]
    views, belief, distance, column0, row0, x, y, turn, scales, frontier_ranges
):
    """Fill `views` (float32 `[2 scales, n, n]`) with what the belief shows around (x, y), turned by `turn` radians.

    A pixel reads the map cell, or the block of cells aligned with the map, that holds its centre.
    """
    n = views.shape[1]
    own_column = math.floor(x / (2.0 * CELL)) - column0 // 2
    own_row = math.floor(y / (2.0 * CELL)) - row0 // 2
    own = distance_at(distance, own_column, own_row)
    cos_turn, sin_turn = math.cos(turn), math.sin(turn)
    columns_of = np.empty(n, dtype=np.int64)
    for k in range(len(scales)):
        scale = scales[k]
        block = round(scale / CELL)
        plan_block = max(1, block // 2)
        if turn == 0.0:
            for j in range(n):
                columns_of[j] = math.floor((x + (j + 0.5 - 0.5 * n) * scale) / scale) * block - column0
        for i in range(n):
            v = (i + 0.5 - 0.5 * n) * scale
            row = math.floor((y + v) / scale) * block - row0
            for j in range(n):
                column = columns_of[j]
                if turn != 0.0:
                    u = (j + 0.5 - 0.5 * n) * scale
                    column = math.floor((x + cos_turn * u - sin_turn * v) / scale) * block - column0
                    row = math.floor((y + sin_turn * u + cos_turn * v) / scale) * block - row0
                views[2 * k, i, j] = _pooled_occupancy(belief, row, column, block)
                here = _pooled_distance(distance, row >> 1, column >> 1, plan_block)
                if here < np.inf and own < np.inf:
                    relative = (here - own) / np.float32(frontier_ranges[k])
                    views[2 * k + 1, i, j] = min(max(relative, np.float32(-1.0)), np.float32(1.0))
                else:
                    views[2 * k + 1, i, j] = 1.0


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


@numba.njit(cache=True, nogil=True)
def fill_options(numbers, x, y, yaw, positions, ages, options):  # type: ignore[no-untyped-def]
    """Fill `numbers` (float32, `motion` beyond its first three) with what `options`, by `option_parameters`, ask for.

    `positions` and `ages` of the peers as in `PeerPoses`.
    """
    position, extent, heading, peers, range_m = options
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


def option_parameters(spec: ObservationSpec) -> tuple[bool, float, bool, int, float]:
    """Return what `fill_options` needs to know of a specification, as plain numbers."""
    return spec.position, spec.position_extent_m, spec.heading, spec.peers, spec.peers_range_m


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
        observation["views"][:maps], belief, field.distance, origin_cells[0], origin_cells[1], pose.x, pose.y, turn,
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
    return observation
