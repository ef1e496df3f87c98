"""Levels: the rooms a team explores, read from YAML, in metres.

A level is an outline (free space inside) with walls, boxes and round posts in it, and a launch point. All obstacles
become convex polygons or circles, and one set of edges serves both the LiDAR and the physics.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator, model_validator

from imagine.core.config import KeyPath, Settings, check_settings, parse_yaml, read_yaml
from imagine.core.errors import InputError
from imagine.core.frames import Pose
from imagine.core.raster import CELL, TILE

Point = tuple[float, float]
BUILT_IN = ("0", "1", "2", "3", "4", "5", "6")
_LAUNCH_SPACING_M = 0.7
_LAUNCH_CLEARANCE_M = 0.25
_LARGEST_M = 200.0
_MARGIN_M = 25.0  # the twin lays worlds 256 m apart, so nothing of a level may reach further out


class Box(Settings):
    """A rectangular obstacle: centre and size in metres, turned counter-clockwise by `yaw_deg`."""

    center: Point
    size: Point
    yaw_deg: float = 0.0

    @field_validator("size")
    @classmethod
    def _positive(cls, size: Point) -> Point:
        if min(size) <= 0.0:
            raise ValueError("a box needs a positive width and depth")
        return size


class Circle(Settings):
    """A round post."""

    center: Point
    radius: float = Field(gt=0.0)


class Person(Settings):
    """Someone who walks a closed loop of waypoints, again and again."""

    loop: list[Point] = Field(min_length=2)
    speed_mps: float = Field(default=0.8, gt=0.0, le=3.0)
    radius: float = Field(default=0.25, gt=0.0, le=1.0)


class Crate(Box):
    """A box that can be pushed; `mass_kg` says how hard it is."""

    mass_kg: float = Field(default=2.0, gt=0.0, le=100.0)


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
    people: list[Person] = Field(default_factory=list)
    crates: list[Crate] = Field(default_factory=list)

    @field_validator("size_m")
    @classmethod
    def _of_a_building(cls, size: Point | None) -> Point | None:
        if size is not None and not all(0.5 <= side <= _LARGEST_M for side in size):
            raise ValueError(f"each side must lie within 0.5 and {_LARGEST_M:g} m")
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


@dataclass(frozen=True, eq=False)
class Level:
    """A level's geometry: `outline` `[n, 2]`, convex `polygons` (each `[k, 2]`) and `circles` `[m, 3]` (x, y, radius).

    `solids` are closed loops of any simple shape, solid inside, such as the walls of a scanned map; `people` and
    `crates` move, and are no part of what has to be covered.

    Metres in the map frame, whose origin is the level's own.
    """

    name: str
    title: str
    outline: NDArray[np.float64]
    polygons: tuple[NDArray[np.float64], ...]
    circles: NDArray[np.float64]
    launch: Point
    solids: tuple[NDArray[np.float64], ...] = ()
    people: tuple[Person, ...] = ()
    crates: tuple[Crate, ...] = ()

    @cached_property
    def segments(self) -> NDArray[np.float64]:
        """All edges a ray can hit, `[segments, 4]` (x0, y0, x1, y1)."""
        loops = [self.outline, *self.polygons, *self.solids]
        return np.concatenate([np.hstack((loop, np.roll(loop, -1, axis=0))) for loop in loops])

    @cached_property
    def grid(self) -> tuple[int, int, int, int]:
        """First column, first row, columns and rows, in cells, of the tile-aligned grid that holds the level."""
        low = np.floor((self.outline.min(axis=0) - CELL) / (CELL * TILE)).astype(int)
        high = np.floor((self.outline.max(axis=0) + CELL) / (CELL * TILE)).astype(int) + 1
        columns, rows = (high - low) * TILE
        return int(low[0] * TILE), int(low[1] * TILE), int(columns), int(rows)

    def is_free(self, points: NDArray[np.float64], clearance_m: float = 0.0) -> NDArray[np.bool_]:
        """Tell which points `[n, 2]` lie inside the outline, outside all obstacles, and `clearance_m` off any edge."""
        free = _inside(self.outline, points)
        for polygon in (*self.polygons, *self.solids):
            free &= ~_inside(polygon, points)
        for x, y, radius in self.circles:
            free &= np.hypot(points[:, 0] - x, points[:, 1] - y) > radius + clearance_m
        if clearance_m > 0.0:
            free[free] = _distance_to_segments(points[free], self.segments) > clearance_m
        return free

    @cached_property
    def coverable(self) -> NDArray[np.bool_]:
        """The cells whose centres are free and connected to the launch point, bool `[rows, columns]` of `grid`."""
        free = self._free_cells(0.0)
        column0, row0, _, _ = self.grid
        seed = math.floor(self.launch[1] / CELL) - row0, math.floor(self.launch[0] / CELL) - column0
        return _flood(free, seed)

    @cached_property
    def flyable(self) -> NDArray[np.bool_]:
        """The cells a drone's centre can reach from the launch with room to spare, bool `[rows, columns]`."""
        free = self._free_cells(_LAUNCH_CLEARANCE_M)
        column0, row0, _, _ = self.grid
        seed = math.floor(self.launch[1] / CELL) - row0, math.floor(self.launch[0] / CELL) - column0
        return _flood(free, seed)

    def _free_cells(self, clearance_m: float) -> NDArray[np.bool_]:
        column0, row0, columns, rows = self.grid
        x = (np.arange(columns) + column0 + 0.5) * CELL
        y = (np.arange(rows) + row0 + 0.5) * CELL
        centres = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        return self.is_free(centres, clearance_m).reshape(rows, columns)

    def launch_poses(self, drones: int, generator: np.random.Generator | None = None) -> list[Pose]:
        """Return launch poses 0.7 m apart, nearest to the launch point first, heading along x.

        With a generator the team starts around a random reachable point instead, with random headings. Raises
        InputError where there is no room for so many drones.
        """
        column0, row0, _, _ = self.grid
        rows, columns = np.nonzero(self.flyable)
        centres = np.column_stack(((columns + column0 + 0.5) * CELL, (rows + row0 + 0.5) * CELL))
        around = np.array(self.launch)
        if generator is not None and len(centres):
            around = centres[generator.integers(len(centres))]
        order = np.argsort(np.hypot(*(centres - around).T), kind="stable")
        chosen: list[NDArray[np.float64]] = []
        for point in centres[order]:
            if all(math.dist(point, other) >= _LAUNCH_SPACING_M for other in chosen):
                chosen.append(point)
                if len(chosen) == drones:
                    break
        if len(chosen) < drones:
            raise InputError(
                f"level {self.name}: room for {len(chosen)} drones around ({around[0]:g}, {around[1]:g}), not {drones}"
            )
        headings = np.zeros(drones) if generator is None else generator.uniform(-math.pi, math.pi, drones)
        return [Pose(float(p[0]), float(p[1]), float(h)) for p, h in zip(chosen, headings, strict=True)]


def load_level(name: str) -> Level:
    """Return a built-in level by its name ("0" to "6") or one from a YAML file.

    Raises InputError naming the file, line and key, or listing the built-in levels.
    """
    if name in BUILT_IN:
        text = resources.files("imagine.sim").joinpath(f"levels/{name}.yaml").read_text(encoding="utf-8")
        data, lines = parse_yaml(text, f"level {name}")
        return _build(name, f"level {name}", data, lines)
    path = Path(name)
    if path.suffix not in (".yaml", ".yml") or not path.exists():
        raise InputError(f"unknown level '{name}': give one of {', '.join(BUILT_IN)} or a YAML file that exists")
    data, lines = read_yaml(path)
    return _build(path.stem, str(path), data, lines)


def _build(name: str, where: str, data: dict[str, Any], lines: dict[KeyPath, int]) -> Level:
    file = check_settings(LevelFile, data, where, lines)
    base: Level | None = None
    if file.extends is not None:
        if file.extends not in BUILT_IN or file.extends == name:
            raise InputError(f"{where}:{lines.get(('extends',), 1)}: extends: give one of {', '.join(BUILT_IN)}")
        base = load_level(file.extends)
    outline = _outline(file, base)
    polygons = [p for wall in file.walls for p in _wall_boxes(wall, file.wall_thickness_m)]
    polygons += [_rectangle(b.center, b.size, math.radians(b.yaw_deg)) for b in file.boxes]
    circles = np.array([[*c.center, c.radius] for c in file.circles], float).reshape(-1, 3)
    launch = file.launch or (base.launch if base else None)
    if launch is None:
        raise InputError(f"{where}: key 'launch' is missing: the point where the team starts, [x, y] in metres")
    if base is not None:
        polygons = [*base.polygons, *polygons]
        circles = np.concatenate((base.circles, circles))
    _check_extent(file, where, lines)
    people, crates = tuple(file.people), tuple(file.crates)
    solids: tuple[NDArray[np.float64], ...] = ()
    if base is not None:
        people, crates, solids = (*base.people, *people), (*base.crates, *crates), base.solids
    level = Level(name, file.title, outline, tuple(polygons), circles, launch, solids, people, crates)
    if not level.is_free(np.array([launch]), _LAUNCH_CLEARANCE_M)[0]:
        raise InputError(
            f"{where}:{lines.get(('launch',), 1)}: launch {launch} is in or within {_LAUNCH_CLEARANCE_M} m of a wall"
        )
    return level


def _check_extent(file: LevelFile, where: str, lines: dict[KeyPath, int]) -> None:
    """Refuse geometry so far out that it would take all memory or reach into the world beside."""
    groups: dict[str, list[list[Point]]] = {
        "outline": [[point] for point in file.outline or ()],
        "walls": [list(wall) for wall in file.walls],
        "boxes": [[box.center, (box.center[0] + max(box.size), box.center[1] + max(box.size))] for box in file.boxes],
        "circles": [[post.center, (post.center[0] + post.radius, post.center[1])] for post in file.circles],
    }
    for key, items in groups.items():
        for index, points in enumerate(items):
            if not all(-_MARGIN_M <= c <= _LARGEST_M + _MARGIN_M for point in points for c in point):
                line = lines.get((key, index), lines.get((key,), 1))
                least, most = -_MARGIN_M, _LARGEST_M + _MARGIN_M
                raise InputError(f"{where}:{line}: {key}.{index}: a level lies within {least:g} and {most:g} m")


def _outline(file: LevelFile, base: Level | None) -> NDArray[np.float64]:
    if file.outline is not None:
        return np.array(file.outline, float)
    if file.size_m is not None:
        width, depth = file.size_m
        return np.array([[0.0, 0.0], [width, 0.0], [width, depth], [0.0, depth]])
    assert base is not None  # LevelFile demands an outline of a level that extends none
    return base.outline


def _rectangle(center: Point, size: Point, yaw: float) -> NDArray[np.float64]:
    half = np.array(size) / 2.0
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half
    c, s = math.cos(yaw), math.sin(yaw)
    turned: NDArray[np.float64] = corners @ np.array([[c, s], [-s, c]]) + np.array(center)
    return turned


def _wall_boxes(points: Sequence[Point], thickness: float) -> list[NDArray[np.float64]]:
    """Return a box for every stretch of a wall, half a thickness longer at both ends so that corners close."""
    boxes = []
    for (x0, y0), (x1, y1) in itertools.pairwise(points):
        length = math.hypot(x1 - x0, y1 - y0)
        center = ((x0 + x1) / 2.0, (y0 + y1) / 2.0)
        boxes.append(_rectangle(center, (length + thickness, thickness), math.atan2(y1 - y0, x1 - x0)))
    return boxes


def _inside(polygon: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Tell which points lie in a simple polygon, by the crossing number."""
    inside = np.zeros(len(points), bool)
    x, y = points[:, 0], points[:, 1]
    for (x0, y0), (x1, y1) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        if y0 == y1:
            continue
        crosses = ((y0 > y) != (y1 > y)) & (x < (x1 - x0) * (y - y0) / (y1 - y0) + x0)
        inside ^= crosses
    return inside


def _distance_to_segments(points: NDArray[np.float64], segments: NDArray[np.float64]) -> NDArray[np.float64]:
    best = np.full(len(points), np.inf)
    for x0, y0, x1, y1 in segments:
        dx, dy = x1 - x0, y1 - y0
        t = np.clip(((points[:, 0] - x0) * dx + (points[:, 1] - y0) * dy) / max(dx * dx + dy * dy, 1e-12), 0.0, 1.0)
        best = np.minimum(best, np.hypot(points[:, 0] - x0 - t * dx, points[:, 1] - y0 - t * dy))
    return best


def _flood(free: NDArray[np.bool_], seed: tuple[int, int]) -> NDArray[np.bool_]:
    """Return the 4-connected region of `free` that holds `seed` (row, column)."""
    reached = np.zeros_like(free)
    if not free[seed]:
        return reached
    stack = [seed]
    reached[seed] = True
    rows, columns = free.shape
    while stack:
        row, column = stack.pop()
        for i, j in ((row + 1, column), (row - 1, column), (row, column + 1), (row, column - 1)):
            if 0 <= i < rows and 0 <= j < columns and free[i, j] and not reached[i, j]:
                reached[i, j] = True
                stack.append((i, j))
    return reached


def mirrored(level: Level, swap_axes: bool, flip_x: bool, flip_y: bool) -> Level:
    """Return the level seen in a mirror: axes swapped, then turned round along x, along y; the outline stays put."""
    low, high = level.outline.min(axis=0), level.outline.max(axis=0)
    if swap_axes:
        low, high = low[::-1], high[::-1]

    def move(points: NDArray[np.float64]) -> NDArray[np.float64]:
        moved = points[:, ::-1].copy() if swap_axes else points.copy()
        for axis, flip in ((0, flip_x), (1, flip_y)):
            if flip:
                moved[:, axis] = low[axis] + high[axis] - moved[:, axis]
        return moved

    launch = move(np.array([level.launch]))[0]
    return Level(
        level.name,
        level.title,
        move(level.outline),
        tuple(move(polygon) for polygon in level.polygons),
        np.hstack((move(level.circles[:, :2]), level.circles[:, 2:])),
        (float(launch[0]), float(launch[1])),
        tuple(move(solid) for solid in level.solids),
        tuple(
            p.model_copy(update={"loop": [(float(x), float(y)) for x, y in move(np.array(p.loop))]})
            for p in level.people
        ),
        tuple(_mirrored_crate(crate, move, swap_axes, flip_x != flip_y) for crate in level.crates),
    )


def _mirrored_crate(
    crate: Crate, move: Callable[[NDArray[np.float64]], NDArray[np.float64]], swap_axes: bool, flipped_once: bool
) -> Crate:
    x, y = move(np.array([crate.center]))[0]
    yaw_deg = 90.0 - crate.yaw_deg if swap_axes else crate.yaw_deg
    return crate.model_copy(update={"center": (float(x), float(y)), "yaw_deg": -yaw_deg if flipped_once else yaw_deg})
