"""The map a team has flown, drawn from what its drones left behind."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from imagine.core.errors import InputError, WorkError
from imagine.core.frames import IDENTITY, Pose, inverse, placed_bounds, transform_points
from imagine.core.raster import CELL, LIMIT
from imagine.onboard.map_image import draw_map
from imagine.runner_processes import RunnerProcesses


def draw_flown_map(processes: RunnerProcesses, frames: Mapping[int, Pose], path: Path) -> None:
    """Draw the team's map, the sum of what each drone saw itself, with the drones' tracks.

    `frames` says for each drone, by number, where its own frame lies in the picture's. Raises WorkError where no drone
    left a map, InputError where the file cannot be written.
    """
    layers: list[tuple[NDArray[np.int8], NDArray[np.int64], Pose]] = []
    for number, frame in frames.items():
        if (file := processes.map_file(number)) is not None:
            left = np.load(file)
            layers.append((left["own"], left["origin"], frame))
    if not layers:
        raise WorkError("no drone left a map to draw")
    belief, corner = sum_in_one_frame(layers)
    tracks = []
    for number, frame in frames.items():
        if (report := processes.report(number)) is not None:
            points = np.array([row[1:3] for row in report["trajectory"]], np.float64).reshape(-1, 2)
            tracks.append([(float(x), float(y)) for x, y in transform_points(frame, points)])
    image = draw_map(belief, corner, tracks)
    try:
        image.save(path)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: the map cannot be written: {error}") from error


def sum_in_one_frame(
    layers: list[tuple[NDArray[np.int8], NDArray[np.int64], Pose]],
) -> tuple[NDArray[np.int8], tuple[int, int]]:
    """Return the sum of layers as log-odds `[rows, columns]`, clipped, and its first cell (column, row).

    A layer is its cells, its first cell (column, row) in its own frame, and that frame's pose in the common one. Every
    cell takes the value of the one cell of each layer that its centre falls into, so nothing counts twice.
    """
    bounds = []
    for cells, origin, frame in layers:
        ends = (origin + np.array(cells.shape[::-1])) * CELL
        bounds.append(placed_bounds(frame, (origin[0] * CELL, ends[0]), (origin[1] * CELL, ends[1])))
    low = np.floor(np.min([b[0] for b in bounds], axis=0) / CELL + 1e-6).astype(int)
    high = np.ceil(np.max([b[1] for b in bounds], axis=0) / CELL - 1e-6).astype(int)
    columns, rows = np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]))
    centres = (np.stack((columns.ravel(), rows.ravel()), axis=1) + 0.5) * CELL
    total = np.zeros(columns.size, np.int16)
    for cells, origin, frame in layers:
        at = np.floor((centres if frame == IDENTITY else transform_points(inverse(frame), centres)) / CELL)
        column, row = (at.astype(int) - origin).T
        inside = (row >= 0) & (row < cells.shape[0]) & (column >= 0) & (column < cells.shape[1])
        total[inside] += cells[row[inside], column[inside]]
    belief = np.clip(total, -LIMIT, LIMIT).astype(np.int8).reshape(columns.shape)
    return belief, (int(low[0]), int(low[1]))
