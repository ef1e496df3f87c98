"""Levels as YAML: what a file may hold, how it becomes a level, and how one is written."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from pydantic import Field, field_validator, model_validator

from imagine.core.config import KeyPath, Settings, check_settings
from imagine.core.errors import InputError
from imagine.sim.level import BUILT_IN, Box, Crate, Level, Person, Point, load_level, rectangle
from imagine.sim.level_check import LARGEST_M, Place, check_extent, check_level
from imagine.sim.polygon import simple_loop


class Circle(Settings):
    """A round post."""

    center: Point
    radius: float = Field(gt=0.0)


class LevelFile(Settings):
    """What a level's YAML holds."""

    title: str = ""
    extends: str | None = Field(default=None, description="a built-in level that this one adds to")
    size_m: Point | None = Field(default=None, description="width and depth of a rectangular outline")
    outline: list[Point] | None = Field(default=None, min_length=3, description="or the outline itself")
    launch: Point | None = None
    wall_thickness_m: float = Field(default=0.1, gt=0.0, le=1.0)
    walls: list[list[Point]] = Field(default_factory=list, description="polylines")
    boxes: list[Box] = Field(default_factory=list)
    circles: list[Circle] = Field(default_factory=list)
    solids: list[list[Point]] = Field(default_factory=list, description="closed polygons of any simple shape")
    people: list[Person] = Field(default_factory=list)
    crates: list[Crate] = Field(default_factory=list)

    @field_validator("size_m")
    @classmethod
    def _of_a_building(cls, size: Point | None) -> Point | None:
        if size is not None and not all(0.5 <= side <= LARGEST_M for side in size):
            raise ValueError(f"each side must lie within 0.5 and {LARGEST_M:g} m")
        return size

    @field_validator("walls")
    @classmethod
    def _two_points(cls, walls: list[list[Point]]) -> list[list[Point]]:
        for wall in walls:
            if len(wall) < 2:
                raise ValueError("a wall is a line of at least two points")
        return walls

    @model_validator(mode="after")
    def _one_outline(self) -> LevelFile:
        if self.extends is None and (self.size_m is None) == (self.outline is None):
            raise ValueError("give either size_m or outline")
        return self


def read_level(name: str, where: str, data: dict[str, Any], lines: dict[KeyPath, int]) -> Level:
    """Return the level of a YAML mapping. Raises InputError naming `where`, line, key and coordinates."""
    file = check_settings(LevelFile, data, where, lines)

    def place(*keys: str | KeyPath) -> str:
        """Name the line of the first of these keys that is there."""
        for key in keys:
            path = key if isinstance(key, tuple) else (key,)
            for end in range(len(path), 0, -1):
                if path[:end] in lines:
                    return f"{where}:{lines[path[:end]]}"
        return where

    return check_level(build_level(name, file, place), place)


def build_level(name: str, file: LevelFile, place: Place) -> Level:
    """Return the level that a file describes, its shapes checked one by one; whether it can be explored is not."""
    base: Level | None = None
    if file.extends is not None:
        if file.extends not in BUILT_IN or file.extends == name:
            raise InputError(f"{place('extends')}: extends: give one of {', '.join(BUILT_IN)}")
        base = load_level(file.extends)
    launch = file.launch or (base.launch if base else None)
    if launch is None:
        raise InputError(f"{place()}: key 'launch' is missing: the point where the team starts, [x, y] in metres")
    _check_extents(file, place)
    outline = _outline(file, base, place)
    solids = [
        simple_loop(solid, f"{place(('solids', number))}: solids.{number}") for number, solid in enumerate(file.solids)
    ]
    polygons = [p for wall in file.walls for p in _wall_boxes(wall, file.wall_thickness_m)]
    polygons += [box.corners() for box in file.boxes]
    circles = np.array([[*c.center, c.radius] for c in file.circles], float).reshape(-1, 3)
    people, crates = tuple(file.people), tuple(file.crates)
    if base is not None:
        polygons, solids = [*base.polygons, *polygons], [*base.solids, *solids]
        circles = np.concatenate((base.circles, circles))
        people, crates = (*base.people, *people), (*base.crates, *crates)
    return Level(name, file.title, outline, tuple(polygons), circles, launch, tuple(solids), people, crates)


def level_text(file: LevelFile) -> str:
    """Return a level's YAML, from which reading makes the same level to the last bit."""
    given = file.model_dump(mode="json", exclude_defaults=True)
    parts = []
    for key, value in given.items():
        if isinstance(value, list) and value and isinstance(value[0], list | dict) and key != "outline":
            parts.append(f"{key}:")
            parts += [f"  - {_flow(item)}" for item in value]
        else:
            parts.append(f"{key}: {_flow(value)}")
    return "\n".join(parts) + "\n"


def _flow(value: Any) -> str:
    text = yaml.safe_dump(value, default_flow_style=True, sort_keys=False, width=10**9, allow_unicode=True)
    return text.removesuffix("\n").removesuffix("\n...")


def _check_extents(file: LevelFile, place: Place) -> None:
    """Refuse geometry so far out that it would take all memory or reach into the world beside."""
    groups: dict[str, list[Sequence[Point]]] = {
        "outline": [[point] for point in file.outline or ()],
        "walls": list(file.walls),
        "boxes": [_square(box.center, max(box.size)) for box in file.boxes],
        "circles": [_square(post.center, post.radius) for post in file.circles],
        "solids": list(file.solids),
    }
    for key, items in groups.items():
        for index, points in enumerate(items):
            check_extent(np.array(points, float).reshape(-1, 2), f"{place((key, index))}: {key}.{index}")


def _square(center: Point, reach: float) -> Sequence[Point]:
    return [center, (center[0] + reach, center[1] + reach)]


def _outline(file: LevelFile, base: Level | None, place: Place) -> NDArray[np.float64]:
    if file.outline is not None:
        return simple_loop(file.outline, f"{place('outline')}: outline")
    if file.size_m is not None:
        width, depth = file.size_m
        return np.array([[0.0, 0.0], [width, 0.0], [width, depth], [0.0, depth]])
    assert base is not None  # LevelFile demands an outline of a level that extends none
    return base.outline


def _wall_boxes(points: Sequence[Point], thickness: float) -> list[NDArray[np.float64]]:
    """Return a box for every stretch of a wall, half a thickness longer at both ends so that corners close."""
    boxes = []
    for (x0, y0), (x1, y1) in itertools.pairwise(points):
        length = math.hypot(x1 - x0, y1 - y0)
        center = ((x0 + x1) / 2.0, (y0 + y1) / 2.0)
        boxes.append(rectangle(center, (length + thickness, thickness), math.atan2(y1 - y0, x1 - x0)))
    return boxes
