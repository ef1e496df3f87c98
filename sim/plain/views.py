"""What a policy and the critic see, with numpy: definitions are those of `core.observation` and `sim.exploration`."""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imagine.core.frontier import PAD, PLAN_CELL, UNIT_M
from imagine.core.frontier_paths import FAR
from imagine.core.lidar import LidarSpec
from imagine.core.observation_spec import ObservationSpec
from imagine.core.raster import CELL, LIMIT
from imagine.sim.plain.field import cost_at

_CRITIC_CHANNELS, _CRITIC_CELLS = 5, 32


def views(
    spec: ObservationSpec,
    belief: NDArray[np.int8],
    cost: NDArray[np.int16],
    origin: tuple[int, int],
    position: tuple[float, float],
    turn: float,
) -> NDArray[np.float32]:
    """Return occupancy and relative frontier distance around a position, float32 `[2 scales, n, n]`.

    `belief` has its first cell at `origin` (column, row), `cost` is `FrontierField.cost`. A pixel reads the cell, or
    the block of cells aligned with the map, that holds its centre; `turn` radians turn the views against the map.
    """
    x, y = position
    own = cost_at(cost, math.floor(x / PLAN_CELL) - origin[0] // 2, math.floor(y / PLAN_CELL) - origin[1] // 2)
    inner = cost[PAD:-PAD, PAD:-PAD].astype(np.int32)
    away = np.where(inner >= 0, inner, FAR)
    seen = np.empty((2 * len(spec.view_scales_m), spec.view_cells, spec.view_cells), np.float32)
    for k, (scale, frontier_range) in enumerate(zip(spec.view_scales_m, spec.frontier_ranges_m, strict=True)):
        block = round(scale / CELL)
        rows, columns = _blocks(spec.view_cells, scale, x, y, turn)
        rows, columns = rows - origin[1] // block, columns - origin[0] // block
        seen[2 * k] = _at(_pooled_occupancy(belief, block), rows, columns, 0.0)
        nearest = functools.reduce(np.minimum, _parts(away, max(1, block // 2)))
        if block == 1:  # planning cells are two cells wide
            rows, columns = rows >> 1, columns >> 1
        further = _at(nearest - own, rows, columns, FAR).astype(np.float32) * np.float32(UNIT_M / frontier_range)
        seen[2 * k + 1] = np.clip(further, -1.0, 1.0) if own < FAR else 1.0  # what leads nowhere reads 1
    return seen


def _blocks(n: int, scale: float, x: float, y: float, turn: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return rows and columns, in blocks of the map frame, of all pixels' centres."""
    if turn == 0.0:
        along = np.arange(n) - n // 2
        return math.floor(y / scale + 0.5) + along[:, None], math.floor(x / scale + 0.5) + along[None, :]
    cos_turn, sin_turn = math.cos(turn), math.sin(turn)
    centres = (np.arange(n) + 0.5 - 0.5 * n) * scale
    u, v = centres[None, :], centres[:, None]
    columns = np.floor((x + cos_turn * u - sin_turn * v) / scale).astype(int)
    rows = np.floor((y + sin_turn * u + cos_turn * v) / scale).astype(int)
    return rows, columns


def _pooled_occupancy(belief: NDArray[np.int8], block: int) -> NDArray[np.float32]:
    """Return the belief of every block of cells in [-1, 1]: its strongest obstacle, else its mean."""
    parts = [part.astype(np.int32) for part in _parts(belief, block)]
    strongest = functools.reduce(np.maximum, parts)
    pooled = np.where(strongest > 0, strongest * len(parts), functools.reduce(np.add, parts))
    return pooled.astype(np.float32) * np.float32(1.0 / (LIMIT * len(parts)))


def _parts(grid: NDArray[Any], block: int) -> list[NDArray[Any]]:
    """Return the grid of every block's first cell, of every block's second cell, and so on."""
    return [grid[i::block, j::block] for i in range(block) for j in range(block)]


def _at(grid: NDArray[Any], rows: NDArray[np.int64], columns: NDArray[np.int64], outside: float) -> NDArray[Any]:
    """Return the grid's values at rows and columns, which broadcast to one shape; `outside` where the grid has none."""
    inside = (rows >= 0) & (rows < grid.shape[0]) & (columns >= 0) & (columns < grid.shape[1])
    values = grid[np.clip(rows, 0, grid.shape[0] - 1), np.clip(columns, 0, grid.shape[1] - 1)]
    return np.where(inside, values, grid.dtype.type(outside))


def sectors(
    ranges: NDArray[np.float32], lidar: LidarSpec, turn: float, count: int, range_m: float
) -> NDArray[np.float32]:
    """Return the least range in each of `count` sectors over `range_m`, in [0, 1]; bearings are turned by `turn`."""
    found = ranges.astype(np.float64)
    usable = found >= lidar.range_min
    bearings = lidar.bearings[usable] + turn
    sector = np.floor(bearings / (2.0 * math.pi) * count).astype(int) % count
    least = np.ones(count, np.float32)
    np.minimum.at(least, sector, np.minimum(found[usable] / range_m, 1.0).astype(np.float32))
    return least


def motion(spec: ObservationSpec, velocity: NDArray[np.float64], turn: float) -> NDArray[np.float32]:
    """Return (vx, vy, yaw rate) along the observation's axes over the spec's scales, float32 `[3]`, within ±2."""
    vx, vy, rate = velocity
    c, s = math.cos(turn), math.sin(turn)
    scaled = (c * vx + s * vy) / spec.speed_mps, (-s * vx + c * vy) / spec.speed_mps, rate / spec.yaw_rate_rps
    seen: NDArray[np.float32] = np.clip(np.array(scaled), -2.0, 2.0).astype(np.float32)
    return seen


def critic_images(
    seen: NDArray[np.bool_],
    coverable: NDArray[np.bool_],
    origin: tuple[int, int],
    poses: NDArray[np.float64],
) -> NDArray[np.float32]:
    """Return the critic's images, float32 `[drones, 5, 32, 32]`: unexplored, explored, not free, own and others.

    The first three are shares of each pixel's square of cells.
    """
    block = max(8, math.ceil(max(seen.shape) / _CRITIC_CELLS))
    images = np.zeros((len(poses), _CRITIC_CHANNELS, _CRITIC_CELLS, _CRITIC_CELLS), np.float32)
    whole = np.zeros((2, _CRITIC_CELLS * block, _CRITIC_CELLS * block), np.float32)
    whole[0, : seen.shape[0], : seen.shape[1]] = coverable & ~seen
    whole[1, : seen.shape[0], : seen.shape[1]] = coverable & seen
    images[:, :2] = whole.reshape(2, _CRITIC_CELLS, block, _CRITIC_CELLS, block).mean(axis=(2, 4))
    images[:, 2] = 1.0 - images[:, 0] - images[:, 1]
    for drone, (x, y, _) in enumerate(poses.tolist()):
        i, j = (math.floor(y / CELL) - origin[1]) // block, (math.floor(x / CELL) - origin[0]) // block
        if 0 <= i < _CRITIC_CELLS and 0 <= j < _CRITIC_CELLS:
            images[np.arange(len(poses)) != drone, 4, i, j] = 1.0
            images[drone, 3, i, j] = 1.0
    return images
