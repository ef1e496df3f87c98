"""Images as levels: floor plans drawn or scanned, and the maps of ROS map_server.

Pixels become solid or free; what is solid becomes closed loops along the pixels' edges.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from pydantic import Field
from scipy import ndimage

from imagine.core.config import KeyPath, Settings, check_settings
from imagine.core.errors import InputError
from imagine.sim.level import Crate, Level, Person, Point
from imagine.sim.level_check import HIDDEN_AREA_M2, LARGEST_M, Place, check_extent, check_level
from imagine.sim.level_survey import LAUNCH_CLEARANCE_M
from imagine.sim.pixel_loops import boundary_loops, simplified, without_pinches
from imagine.sim.polygon import signed_area

IMAGE_SUFFIXES = (".png", ".pgm", ".bmp")
_MOST_PIXELS = 16_000_000
_OPAQUE = 128


class MapFile(Settings):
    """A map's YAML: the keys of ROS map_server, and those that a level adds."""

    image: str = Field(min_length=1, description="the image's path, from the folder of this file")
    resolution: float = Field(gt=0.0, le=10.0, description="metres a pixel")
    origin: tuple[float, float, float] | tuple[float, float] = Field(
        default=(0.0, 0.0, 0.0), description="the lower left corner: x, y in metres, and yaw in radians"
    )
    negate: Literal[0, 1] | bool = Field(default=0, description="1: white is occupied")
    occupied_thresh: float = Field(default=0.65, ge=0.0, le=1.0)
    free_thresh: float = Field(default=0.196, ge=0.0, le=1.0)
    mode: Literal["trinary"] = "trinary"
    title: str = ""
    launch: Point | None = None
    simplify: bool = Field(default=True, description="straighten stairs of pixels, within half a pixel")
    people: list[Person] = Field(default_factory=list)
    crates: list[Crate] = Field(default_factory=list)


def load_map(path: Path, data: dict[str, Any], lines: dict[KeyPath, int]) -> Level:
    """Return a map's YAML as a level. Raises InputError naming file and line."""
    file = check_settings(MapFile, data, str(path), lines)
    if file.occupied_thresh < file.free_thresh:
        line = lines.get(("occupied_thresh",)) or lines.get(("free_thresh",), 1)
        raise InputError(
            f"{path}:{line}: occupied_thresh: {file.occupied_thresh:g} is below free_thresh, {file.free_thresh:g}: "
            "a pixel is free below the one and occupied above the other; raise it, or lower free_thresh"
        )
    image = Path(file.image)
    where = f"{path}:{lines.get(('image',), 1)}"
    return _level_of(path.stem, path.parent / image, file, where, lines, str(path))


def load_image(name: str) -> Level:
    """Return an image as a level, its lower left corner at (0, 0).

    The name, such as "plan.png@0.05", says the metres a pixel. Raises InputError quoting it.
    """
    file_name, _, scale = name.rpartition("@")
    path = Path(file_name)
    try:
        resolution = float(scale)
    except ValueError:
        resolution = math.nan
    if not 0.0 < resolution <= 10.0:
        raise InputError(f"level {name}: after the @ come metres a pixel, above 0 and at most 10, such as 0.05")
    file = MapFile(image=path.name, resolution=resolution)
    return _level_of(path.stem, path, file, f"level {name}", {}, f"level {name}")


def _level_of(name: str, image: Path, file: MapFile, where: str, lines: dict[KeyPath, int], whole: str) -> Level:
    def place(*keys: str | KeyPath) -> str:
        for key in keys:
            path = key if isinstance(key, tuple) else (key,)
            if path in lines:
                return f"{whole}:{lines[path]}"
        return where

    shades = read_shades(image, where)
    height, width = shades.shape
    if max(height, width) * file.resolution > LARGEST_M:
        raise InputError(
            f"{place('resolution')}: {width} × {height} pixels of {file.resolution:g} m are more than {LARGEST_M:g} m: "
            "check the resolution"
        )
    free = free_pixels(shades, bool(file.negate), file.occupied_thresh, file.free_thresh)[::-1]
    frame = _Frame(file.resolution, file.origin)
    region, launch = _region(without_pinches(free), file.launch, frame, place)
    loops = boundary_loops(region)
    if file.simplify:
        loops = [simplified(loop) for loop in loops]
    shapes = [frame.to_map(loop) for loop in loops]
    outline, *solids = sorted(shapes, key=lambda loop: -abs(signed_area(loop)))
    check_extent(outline, f"{place('origin')}: origin")
    title = file.title or image.stem
    level = Level(
        name, title, outline, (), np.empty((0, 3)), launch, tuple(solids), tuple(file.people), tuple(file.crates)
    )
    return check_level(level, place)


def read_shades(path: Path, where: str) -> NDArray[np.float64]:
    """Return an image's lightness, 0 black to 1 white, `[rows, columns]` from the top; nan where it is transparent."""
    try:
        with Image.open(path) as picture:
            width, height = picture.size
            if width * height > _MOST_PIXELS:
                raise InputError(f"{where}: {path}: {width} × {height} pixels are too many: scale it down")
            transparent = "A" in picture.getbands() or "transparency" in picture.info
            wide = picture.mode in ("I", "F") or picture.mode.startswith("I;16")
            grey = picture.mode in ("1", "L") and not transparent
            mode = "L" if grey else "RGBA" if transparent else "RGB"
            pixels = np.asarray(picture if wide else picture.convert(mode))
    except Image.DecompressionBombError as error:
        raise InputError(f"{where}: {path}: too many pixels: scale it down") from error
    except (OSError, SyntaxError, ValueError) as error:
        reason = getattr(error, "strerror", None) or "it is not an image, or it is cut short"
        raise InputError(f"{where}: {path}: cannot be read: {reason}") from error
    if pixels.ndim == 2:
        return np.asarray(pixels / (65535.0 if pixels.max(initial=0) > 255 else 255.0), np.float64)
    shades: NDArray[np.float64] = pixels[..., :3].mean(axis=2, dtype=np.float64) / 255.0
    if transparent:
        shades[pixels[..., 3] < _OPAQUE] = np.nan
    return shades


def free_pixels(
    shades: NDArray[np.float64], negate: bool, occupied_thresh: float, free_thresh: float
) -> NDArray[np.bool_]:
    """Tell which pixels are free by map_server's rule: neither occupied nor unknown.

    The probability of being occupied is the darkness, or with `negate` the lightness; free is below `free_thresh`,
    unless `occupied_thresh` is lower still, which maps may not say. Transparent (nan) is unknown.
    """
    occupied = shades if negate else 1.0 - shades
    free: NDArray[np.bool_] = (occupied < free_thresh) & ~(occupied > occupied_thresh)
    return free


class _Frame:
    """Pixels to metres: rows counted from the bottom, the image's lower left corner at the origin."""

    def __init__(self, resolution: float, origin: tuple[float, ...]) -> None:
        self.resolution = resolution
        self._corner = np.array(origin[:2])
        yaw = origin[2] if len(origin) > 2 else 0.0
        c, s = math.cos(yaw), math.sin(yaw)
        self._turn = np.array([[c, s], [-s, c]])

    def to_map(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return points `[n, 2]` of the map, metres, for points (x, y) in pixels."""
        points: NDArray[np.float64] = (pixels * self.resolution) @ self._turn + self._corner
        return points

    def to_pixels(self, point: Point) -> tuple[int, int]:
        """Return the (row, column) that holds a point of the map."""
        x, y = (np.array(point) - self._corner) @ self._turn.T / self.resolution
        return math.floor(y), math.floor(x)


def _region(
    free: NDArray[np.bool_], launch: Point | None, frame: _Frame, place: Place
) -> tuple[NDArray[np.bool_], Point]:
    """Return the free pixels that hang together with the launch, and the launch, chosen if it is not given."""
    labels, count = ndimage.label(free)
    if count == 0:
        raise InputError(f"{place('image')}: no pixel is free: look at negate, free_thresh and occupied_thresh")
    if launch is not None:
        row, column = frame.to_pixels(launch)
        if not (0 <= row < free.shape[0] and 0 <= column < free.shape[1] and free[row, column]):
            raise InputError(
                f"{place('launch')}: launch ({launch[0]:g}, {launch[1]:g}) lies on no free pixel of the image"
            )
        return _checked(labels, int(labels[row, column]), frame, place), launch
    room = ndimage.distance_transform_edt(np.pad(free, 1))[1:-1, 1:-1]
    indoors = np.where(np.isin(labels, _outdoors(labels)), 0.0, room)
    if indoors.max() * frame.resolution >= LAUNCH_CLEARANCE_M + frame.resolution:
        room = indoors
    best = int(np.argmax(np.round(room, 6)))
    row, column = best // room.shape[1], best % room.shape[1]
    x, y = frame.to_map(np.array([[column + 0.5, row + 0.5]]))[0]
    return _checked(labels, int(labels[row, column]), frame, place), (float(x), float(y))


def _outdoors(labels: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return the numbers of the regions that reach the image's edge: these are outdoors. 0, not free, is among them."""
    return np.unique(np.concatenate((labels[0], labels[-1], labels[:, 0], labels[:, -1], [0])))


def _checked(labels: NDArray[np.int32], launched: int, frame: _Frame, place: Place) -> NDArray[np.bool_]:
    """Return the launch's region. Raises InputError where another of 0.25 m² or more is closed in, naming the largest.

    A closed room would otherwise be taken for solid without a word; the plan's author believes it can be explored.
    """
    outdoors = _outdoors(labels)
    areas = np.bincount(labels.ravel()) * frame.resolution**2
    areas[outdoors] = areas[launched] = 0.0
    closed = int(np.argmax(areas))
    if areas[closed] >= HIDDEN_AREA_M2 - 1e-9:
        depth = ndimage.distance_transform_edt(labels == closed)  # closed in: the image's edge is none of its own
        row, column = np.unravel_index(np.argmax(np.round(depth, 6)), labels.shape)
        x, y = frame.to_map(np.array([[column + 0.5, row + 0.5]]))[0]
        # From indoors another launch would leave this one's region closed in; from outdoors it would not.
        remedy = (
            "fill it in, open the wall, or give another launch"
            if launched in outdoors
            else ("fill it in, or open the wall")
        )
        raise InputError(
            f"{place('image')}: {areas[closed]:.2f} m² around ({x:.2f}, {y:.2f}) are closed in and cannot be reached "
            f"from the launch: {remedy}"
        )
    region: NDArray[np.bool_] = labels == launched
    return region
