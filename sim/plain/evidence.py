"""Scans into an int8 log-odds layer with numpy: the definition is that of `core.raster`."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from imagine.core.lidar import TEAMMATE_RADIUS_M, LidarSpec
from imagine.core.raster import CELL, HIT, LIMIT, MISS, RANGE_STEP_M, TILE

Cells = NDArray[np.int64]


def without_teammates(
    ranges: NDArray[np.float32],
    lidar: LidarSpec,
    pose: tuple[float, float, float],
    places: NDArray[np.float64],
) -> NDArray[np.float32]:
    """Return the ranges `[beams]` with returns on teammates at `places` `[n, 2]` (map frame) made invalid (nan)."""
    x, y, yaw = pose
    c, s = math.cos(yaw), math.sin(yaw)
    kept = ranges.copy()
    for dx, dy in places - (x, y):
        ahead, left = c * dx + s * dy, -s * dx + c * dy
        with np.errstate(invalid="ignore"):  # no return is infinitely far away
            ex, ey = kept * np.cos(lidar.bearings) - ahead, kept * np.sin(lidar.bearings) - left
            kept[ex * ex + ey * ey < TEAMMATE_RADIUS_M**2] = np.nan
    return kept


def line_cells(row: int, column: int, end_rows: Cells, end_columns: Cells) -> tuple[Cells, Cells]:
    """Return the cells of Bresenham lines from one cell to many ends, the ends left out, as rows and columns.

    All lines advance together, a cell a turn; cells that lie on several lines come several times.
    """
    d_row, d_column = np.abs(end_rows - row), np.abs(end_columns - column)
    step_row, step_column = np.sign(end_rows - row), np.sign(end_columns - column)
    rows, columns = np.full_like(end_rows, row), np.full_like(end_columns, column)
    error = d_column - d_row
    passed_rows, passed_columns = [rows[:0]], [columns[:0]]
    while len(rows):
        going = (rows != end_rows) | (columns != end_columns)
        if not going.all():
            d_row, d_column, step_row, step_column = (a[going] for a in (d_row, d_column, step_row, step_column))
            rows, columns, error = rows[going], columns[going], error[going]
            end_rows, end_columns = end_rows[going], end_columns[going]
        passed_rows.append(rows)
        passed_columns.append(columns)
        doubled = 2 * error
        along, across = doubled > -d_row, doubled < d_column
        error = error - np.where(along, d_row, 0) + np.where(across, d_column, 0)
        columns = columns + np.where(along, step_column, 0)
        rows = rows + np.where(across, step_row, 0)
    return np.concatenate(passed_rows), np.concatenate(passed_columns)


def integrate_scan(
    cells: NDArray[np.int8],
    origin: tuple[int, int],
    pose: tuple[float, float, float],
    ranges: NDArray[np.float32],
    lidar: LidarSpec,
    range_cap_m: float,
) -> tuple[int, NDArray[np.bool_]]:
    """Add one scan's evidence to `cells` (int8 `[rows, columns]`, first cell at `origin` (column, row)), in place.

    Each cell takes one update at most, a hit before a miss. Returns how many cells changed, and which tiles, bool
    `[rows // TILE, columns // TILE]`.
    """
    x, y, yaw = pose
    rows, columns = cells.shape
    measured = ranges.astype(np.float64)
    usable = measured >= lidar.range_min  # neither nan nor too close to be trusted
    measured = measured[usable]
    hit = measured <= range_cap_m
    steps = np.rint(np.where(hit, measured, range_cap_m) / RANGE_STEP_M)
    steps = np.clip(steps, 1.0, math.floor(range_cap_m / RANGE_STEP_M + 1e-9))  # a hit is never rounded past the cap
    rounded = (steps * RANGE_STEP_M).astype(np.float32).astype(np.float64)  # as a peer reads them
    lengths = np.where(hit, rounded, range_cap_m)
    c, s = math.cos(yaw), math.sin(yaw)
    cos_beam, sin_beam = np.cos(lidar.bearings[usable]), np.sin(lidar.bearings[usable])
    end_x, end_y = x + lengths * (c * cos_beam - s * sin_beam), y + lengths * (s * cos_beam + c * sin_beam)
    end_columns = np.floor(end_x / CELL).astype(np.int64) - origin[0]
    end_rows = np.floor(end_y / CELL).astype(np.int64) - origin[1]
    own_column, own_row = math.floor(x / CELL) - origin[0], math.floor(y / CELL) - origin[1]
    free_rows, free_columns = line_cells(own_row, own_column, end_rows, end_columns)

    evidence = np.zeros(cells.shape, np.int8)
    for at_rows, at_columns, value in (
        (free_rows, free_columns, MISS),
        (end_rows[hit], end_columns[hit], HIT),  # after the misses: a hit wins
    ):
        inside = (at_rows >= 0) & (at_rows < rows) & (at_columns >= 0) & (at_columns < columns)
        evidence[at_rows[inside], at_columns[inside]] = value
    updated = np.clip(cells + evidence, -LIMIT, LIMIT)
    changed_rows, changed_columns = np.nonzero(updated != cells)
    cells[...] = updated
    touched = np.zeros((rows // TILE, columns // TILE), np.bool_)
    touched[changed_rows // TILE, changed_columns // TILE] = True
    return len(changed_rows), touched
