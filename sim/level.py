"""Levels: the rooms a team explores, in metres.

A level is an outline (free space inside) with solids and round posts in it, and a launch point. One set of edges
serves the LiDAR, the physics and the survey of what can be flown and seen.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from imagine.core.config import Settings
from imagine.core.errors import InputError
from imagine.core.frames import Pose
from imagine.core.raster import CELL, TILE
from imagine.sim.level_kernels import choose_apart, fill_loop, free_points
from imagine.sim.level_survey import LAUNCH_CLEARANCE_M, Geometry, Survey, survey

Point = tuple[float, float]
BUILT_IN = ("0", "1", "2", "3", "4", "5", "6")
_LAUNCH_SPACING_M = 0.7


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

    def corners(self) -> NDArray[np.float64]:
        """Return the corners `[4, 2]`, counter-clockwise, metres."""
        return rectangle(self.center, self.size, math.radians(self.yaw_deg))


class Person(Settings):
    """Someone who walks a closed loop of waypoints, again and again."""

    loop: list[Point] = Field(min_length=2)
    speed_mps: float = Field(default=0.8, gt=0.0, le=3.0)
    radius: float = Field(default=0.25, gt=0.0, le=1.0)


class Crate(Box):
    """A box that can be pushed; `mass_kg` says how hard it is."""

    mass_kg: float = Field(default=2.0, gt=0.0, le=100.0)


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

    @cached_property
    def geometry(self) -> Geometry:
        """What stands still, as the survey takes it."""
        loops = (*self.polygons, *self.solids)
        return Geometry(np.ascontiguousarray(self.outline), loops, self.segments, self.circles, self.grid)

    @cached_property
    def survey(self) -> Survey:
        """What can be flown and seen among all that stands still."""
        return survey(self.geometry, self.launch)

    @property
    def free(self) -> NDArray[np.bool_]:
        """The cells whose centres lie inside the outline and in no solid, bool `[rows, columns]`."""
        return self.survey.free

    @property
    def flyable(self) -> NDArray[np.bool_]:
        """The cells whose centres a drone's centre can get to from the launch, bool `[rows, columns]`.

        A passage of 0.5 m is open, one of 0.4 m is not. Crates, which give way, do not count.
        """
        return self.survey.flyable

    @cached_property
    def coverable(self) -> NDArray[np.bool_]:
        """The free cells that a drone can see from where it can fly, at most 4 m away, bool `[rows, columns]`.

        Cells under a crate are left out: nobody sees them while it stands there.
        """
        if not self.crates:
            return self.survey.seen
        column0, row0, columns, rows = self.grid
        under = np.zeros((2 * rows + 1, 2 * columns + 1), np.uint8)
        for crate in self.crates:
            fill_loop(under, crate.corners(), column0, row0, 1)
        open_cells: NDArray[np.bool_] = self.survey.seen & (under[1::2, 1::2] == 0)
        return open_cells

    @cached_property
    def launch_spots(self) -> NDArray[np.float64]:
        """The flyable cells' centres `[n, 2]` from which a drone may start: 0.25 m from walls, crates and people."""
        spots = self.survey.spots
        for crate in self.crates:
            spots = spots[_distance_to_box(spots, crate) > LAUNCH_CLEARANCE_M]
        for person in self.people:
            x, y = person.loop[0]
            spots = spots[np.hypot(spots[:, 0] - x, spots[:, 1] - y) > person.radius + LAUNCH_CLEARANCE_M]
        return np.ascontiguousarray(spots)

    def is_free(self, points: NDArray[np.float64], clearance_m: float = 0.0) -> NDArray[np.bool_]:
        """Tell which points `[n, 2]` lie inside the outline, outside all obstacles, and `clearance_m` off any edge."""
        free = np.empty(len(points), np.bool_)
        free_points(
            free, np.ascontiguousarray(points, np.float64), clearance_m, self.outline, *self.geometry.packed,
            self.segments, self.circles,
        )  # fmt: skip
        return free

    def launch_poses(self, drones: int, generator: np.random.Generator | None = None) -> list[Pose]:
        """Return launch poses 0.7 m apart, nearest to the launch point first, heading along x.

        With a generator the team starts around a random reachable point instead, with random headings. Raises
        InputError where there is no room for so many drones.
        """
        spots = self.launch_spots
        x, y = self.launch
        if generator is not None and len(spots):
            x, y = spots[generator.integers(len(spots))]
        chosen = np.empty(drones, np.int64)
        found = choose_apart(spots, x, y, drones, _LAUNCH_SPACING_M, chosen)
        if found < drones:
            room = "1 drone" if found == 1 else f"{found} drones"
            raise InputError(
                f"level {self.name}: room for {room} around ({x:g}, {y:g}), not {drones}: "
                "they start 0.7 m apart and 0.25 m from anything; take fewer, or a larger level"
            )
        headings = np.zeros(drones) if generator is None else generator.uniform(-math.pi, math.pi, drones)
        return [Pose(float(spots[k, 0]), float(spots[k, 1]), float(h)) for k, h in zip(chosen, headings, strict=True)]

    def fingerprint(self) -> str:
        """Return a hash of the geometry, people and crates: equal levels have equal ones, whatever they are called."""
        digest = hashlib.sha256(np.array(self.launch).tobytes())
        for array in (self.outline, self.circles, *self.polygons, *self.solids):
            digest.update(len(array).to_bytes(4, "little") + np.ascontiguousarray(array, np.float64).tobytes())
        for moving in (*self.people, *self.crates):
            digest.update(moving.model_dump_json().encode())
        return digest.hexdigest()


def load_level(name: str) -> Level:
    """Return a level by its name: built in ("0" to "6"), generated ("house:7", "house:7:120"), or from a file.

    Files are a level's YAML, a floor plan's JSON, a map's YAML with its image, or "plan.png@0.05", an image and its
    metres a pixel. Raises InputError naming the file, the line where it has lines, and the coordinates.
    """
    from imagine.sim.level_source import open_level  # which makes Levels, and so imports this file

    return open_level(name)


def rectangle(center: Point, size: Point, yaw: float) -> NDArray[np.float64]:
    """Return the corners `[4, 2]` of a rectangle turned counter-clockwise by `yaw` radians."""
    half = np.array(size) / 2.0
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half
    c, s = math.cos(yaw), math.sin(yaw)
    turned: NDArray[np.float64] = corners @ np.array([[c, s], [-s, c]]) + np.array(center)
    return turned


def _distance_to_box(points: NDArray[np.float64], box: Box) -> NDArray[np.float64]:
    yaw = math.radians(box.yaw_deg)
    c, s = math.cos(yaw), math.sin(yaw)
    local = np.abs((points - np.array(box.center)) @ np.array([[c, -s], [s, c]])) - np.array(box.size) / 2.0
    distance: NDArray[np.float64] = np.hypot(*np.maximum(local, 0.0).T)
    return distance


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
