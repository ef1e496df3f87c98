"""Floor plans as JSON, in the manner of HouseExpo: `verts`, a polygon in metres that is free inside, and `bbox`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from imagine.core.errors import InputError
from imagine.sim.level import Level
from imagine.sim.level_check import check_extent, check_level
from imagine.sim.level_survey import roomiest_point
from imagine.sim.polygon import simple_loop, without_spikes

_SPIKE_M = 0.05  # as long as tracing a raster of centimetres leaves them


def load_floorplan(path: Path) -> Level:
    """Return a floor plan as a level, launched from where there is most room around.

    `verts` `[[x, y], ...]` is free inside, its first corner repeated at the end or not; `bbox`, if given, must hold
    it. Other keys are left alone. Raises InputError naming the file, what is wrong and where.
    """
    try:
        data: Any = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    except json.JSONDecodeError as error:
        raise InputError(f"{path}:{error.lineno}: not valid JSON: {error.msg}") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not valid JSON: {error}") from error
    if not isinstance(data, dict) or "verts" not in data:
        raise InputError(f"{path}: no floor plan: expected an object with 'verts', the outline's corners in metres")
    verts = data["verts"]
    for number, vertex in enumerate(verts if isinstance(verts, list) else ()):
        if not (isinstance(vertex, list) and len(vertex) == 2 and all(map(_is_number, vertex))):
            raise InputError(f"{path}: verts.{number}: expected [x, y] in metres, got {vertex!s:.60}")
    if not isinstance(verts, list) or not verts:
        raise InputError(f"{path}: verts: expected a list of corners [x, y] in metres")
    corners = np.array(verts, float)
    check_extent(corners, f"{path}: verts")
    outline = simple_loop(without_spikes(corners, _SPIKE_M), f"{path}: verts")
    _check_bbox(data.get("bbox"), outline, path)
    title = data.get("id") if isinstance(data.get("id"), str) else path.stem
    bare = Level(path.stem, str(title), outline, (), np.empty((0, 3)), (0.0, 0.0))
    launch = roomiest_point(bare.geometry)
    level = Level(path.stem, str(title), outline, (), np.empty((0, 3)), launch)
    return check_level(level, lambda *_: f"{path}")


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and bool(np.isfinite(value))


def _check_bbox(bbox: Any, outline: np.ndarray[Any, np.dtype[np.float64]], path: Path) -> None:
    """Refuse a box that the corners leave: their units or their order have been mixed up."""
    if bbox is None:
        return
    try:
        low, high = np.array(bbox["min"], float).reshape(2), np.array(bbox["max"], float).reshape(2)
    except (TypeError, KeyError, ValueError) as error:
        raise InputError(f"{path}: bbox: expected {{'min': [x, y], 'max': [x, y]}} in metres") from error
    tolerance_m = 0.1
    outside = ((outline < low - tolerance_m) | (outline > high + tolerance_m)).any(axis=1)
    if outside.any():
        x, y = outline[outside][0]
        raise InputError(f"{path}: verts: corner ({x:g}, {y:g}) lies outside bbox, {low.tolist()} to {high.tolist()}")
