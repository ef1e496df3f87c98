"""The map a team has flown, drawn from what its drones left behind."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from imagine.core.errors import InputError, WorkError
from imagine.core.raster import LIMIT
from imagine.onboard.map_image import draw_map
from imagine.runner_processes import RunnerProcesses


def draw_flown_map(processes: RunnerProcesses, drones: int, path: Path) -> None:
    """Draw the team's map, the sum of what each drone saw itself, with the drones' tracks.

    Raises WorkError where no drone left a map, InputError where the file cannot be written.
    """
    layers = [np.load(file) for number in range(1, drones + 1) if (file := processes.map_file(number)) is not None]
    if not layers:
        raise WorkError("no drone left a map to draw")
    corners = np.array([layer["origin"] for layer in layers])
    ends = np.array([layer["origin"] + np.array(layer["own"].shape[::-1]) for layer in layers])
    low, high = corners.min(axis=0), ends.max(axis=0)
    total = np.zeros((high[1] - low[1], high[0] - low[0]), np.int16)
    for layer, corner in zip(layers, corners, strict=True):
        rows, columns = layer["own"].shape
        row, column = corner[1] - low[1], corner[0] - low[0]
        total[row : row + rows, column : column + columns] += layer["own"]
    belief = np.clip(total, -LIMIT, LIMIT).astype(np.int8)
    reports = [processes.report(number) for number in range(1, drones + 1)]
    tracks = [[(x, y) for _, x, y, _ in report["trajectory"]] for report in reports if report is not None]
    image = draw_map(belief, (int(low[0]), int(low[1])), tracks)
    try:
        image.save(path)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: the map cannot be written: {error}") from error
