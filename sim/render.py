"""A world as a picture: its level, what the team has seen of it, and the team itself."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from imagine.core.raster import CELL, LIMIT
from imagine.sim.exploration import Exploration
from imagine.sim.level import Level
from imagine.sim.scene import Scene, Trail, take_scene

Colour = tuple[int, int, int]
BACKDROP, UNSEEN_FLOOR, UNSEEN_SOLID = (11, 16, 22), (24, 33, 43), (43, 56, 70)
SEEN_FLOOR, SEEN_SOLID, OCCUPIED = (49, 66, 84), (78, 96, 114), (232, 240, 247)
GRID_UNSEEN, GRID_SEEN = (29, 40, 51), (56, 74, 93)
PERSON, CRATE, LINK, DEAD, LAUNCH = (214, 120, 200), (176, 124, 72), (140, 214, 255), (139, 152, 165), (120, 140, 160)
TEXT, SOFT_TEXT, BAR, BAR_GROUND = (230, 237, 243), (159, 176, 192), (61, 220, 151), (34, 48, 64)
DRONES: tuple[Colour, ...] = (
    (76, 194, 255), (255, 176, 46), (61, 220, 151), (255, 139, 209), (244, 224, 77), (255, 122, 69), (185, 165, 255),
    (127, 231, 224),
)  # fmt: skip
"""Drone i has colour i, over again from the ninth on: those of the ground station's page."""
SMALLEST_PX, LARGEST_PX = 160, 4096
_FINE = 2  # what moves is drawn at twice the size and averaged down, which smooths its edges
_FINER = 4  # the same for what stands still: it is drawn once a level
_MARGIN_M = 0.3


@dataclass(frozen=True)
class Frame:
    """Where the map lies in a picture: pixels a metre, and the size of map and header in pixels."""

    scale: float
    left_m: float
    top_m: float
    width: int
    height: int
    header: int

    def pixels(self, points: NDArray[np.float64], fine: int = 1) -> list[tuple[float, float]]:
        """Return map points `[n, 2]` (metres) as pixels (x right, y down) of the map enlarged `fine` times."""
        x = (points[:, 0] - self.left_m) * (self.scale * fine)
        y = (self.top_m - points[:, 1]) * (self.scale * fine)
        return list(zip(x.tolist(), y.tolist(), strict=True))

    def pixel(self, x: float, y: float) -> tuple[int, int]:
        """Return the pixel (row, column) of the whole picture that shows a point of the map, in metres."""
        return math.floor((self.top_m - y) * self.scale) + self.header, math.floor((x - self.left_m) * self.scale)


def frame_of(level: Level, size_px: int = 960) -> Frame:
    """Lay out a picture whose map is at most `size_px` wide and high; a cell takes whole pixels where it has two."""
    low, high = level.outline.min(axis=0) - _MARGIN_M, level.outline.max(axis=0) + _MARGIN_M
    size_px = min(max(size_px, SMALLEST_PX), LARGEST_PX)
    scale = size_px / float((high - low).max())
    if scale * CELL >= 2.0:
        scale = math.floor(scale * CELL) / CELL
    width, height = (max(2, round(float(side) * scale)) for side in high - low)
    return Frame(scale, float(low[0]), float(high[1]), width, height, max(22, round(0.04 * size_px)))


def render_world(
    exploration: Exploration,
    world: int,
    size_px: int = 960,
    trails: Sequence[Trail] = (),
    scans: bool = False,
    views: NDArray[np.float32] | None = None,
) -> NDArray[np.uint8]:
    """Draw a world as it is now, uint8 `[height, width, 3]`, with north up.

    `size_px`, 160 to 4096, bounds the map's longer side; a header stands above it. `trails` (one `[n, 2]` a drone,
    metres) and `scans` add what is wanted of them, `views` `[channels, n, n]` of one drone a panel on the right.
    """
    return draw_scene(take_scene(exploration, world, trails, scans), size_px, views)


def draw_scene(scene: Scene, size_px: int = 960, views: NDArray[np.float32] | None = None) -> NDArray[np.uint8]:
    """Draw a scene, uint8 `[height, width, 3]`; for the arguments see `render_world`."""
    frame = frame_of(scene.level, size_px)
    panel = None if views is None else draw_views(views, frame.height)
    width = frame.width + (0 if panel is None else panel.width)
    picture = Image.new("RGB", (width, frame.header + frame.height), BACKDROP)
    picture.paste(_draw_map(scene, frame), (0, frame.header))
    if panel is not None:
        picture.paste(panel, (frame.width, frame.header))
    _draw_header(picture, scene, frame, width)
    return np.asarray(picture)


def _draw_map(scene: Scene, frame: Frame) -> Image.Image:
    unseen, seen = _still_pictures(scene.level, frame)
    base = Image.composite(seen, unseen, _cells_as_mask(scene.seen * np.uint8(255), scene.level, frame))
    strength = np.clip(scene.belief, 0, LIMIT // 2).astype(np.float32) * (255.0 / (LIMIT // 2))
    base.paste(OCCUPIED, mask=_cells_as_mask(strength.astype(np.uint8), scene.level, frame))
    base = base.resize((frame.width * _FINE, frame.height * _FINE), Image.Resampling.NEAREST)
    draw = ImageDraw.Draw(base, "RGBA")
    _draw_scans(draw, scene, frame)
    _draw_movers(draw, scene, frame)
    _draw_trails(draw, scene, frame)
    _draw_links(draw, scene, frame)
    for drone in range(len(scene.poses)):
        _draw_drone(draw, scene, frame, drone)
    return base.reduce(_FINE)


@lru_cache(maxsize=8)
def _still_pictures(level: Level, frame: Frame) -> tuple[Image.Image, Image.Image]:
    """Return the level as nobody has seen it yet and as if all had been seen; kept, since it never changes."""
    return (
        _draw_level(level, frame, UNSEEN_FLOOR, GRID_UNSEEN, UNSEEN_SOLID),
        _draw_level(level, frame, SEEN_FLOOR, GRID_SEEN, SEEN_SOLID),
    )


def _draw_level(level: Level, frame: Frame, floor: Colour, grid: Colour, solid: Colour) -> Image.Image:
    fine = _FINER if max(frame.width, frame.height) <= 1500 else 2
    picture = Image.new("RGB", (frame.width * fine, frame.height * fine), BACKDROP)
    draw = ImageDraw.Draw(picture)
    outline = frame.pixels(level.outline, fine)
    draw.polygon(outline, fill=floor)
    low, high = level.outline.min(axis=0), level.outline.max(axis=0)
    mask = Image.new("1", picture.size)
    ImageDraw.Draw(mask).polygon(outline, fill=1)
    lines = Image.new("1", picture.size)
    pen = ImageDraw.Draw(lines)
    for axis in (0, 1):
        for metre in range(math.ceil(low[axis]), math.floor(high[axis]) + 1):
            ends = np.array([low, high])
            ends[:, axis] = metre
            pen.line(frame.pixels(ends, fine), fill=1, width=fine)
    picture.paste(grid, mask=Image.composite(lines, Image.new("1", picture.size), mask))
    for loop in (*level.polygons, *level.solids):
        draw.polygon(frame.pixels(loop, fine), fill=solid)
    for x, y, radius in level.circles:
        _disc(draw, frame, (x, y), radius, fine, solid)
    x, y = frame.pixels(np.array([level.launch]), fine)[0]
    arm, pen_width = 0.12 * frame.scale * fine, max(1, round(0.03 * frame.scale * fine))
    draw.line([(x - arm, y), (x + arm, y)], fill=LAUNCH, width=pen_width)
    draw.line([(x, y - arm), (x, y + arm)], fill=LAUNCH, width=pen_width)
    draw.line([*outline, outline[0]], fill=solid, width=max(fine, round(0.06 * frame.scale * fine)), joint="curve")
    return picture.reduce(fine)


def _cells_as_mask(cells: NDArray[np.uint8], level: Level, frame: Frame) -> Image.Image:
    """Return a value for each cell of the level's grid (`[rows, columns]`) as an image of the map's size."""
    column0, row0, _, _ = level.grid
    # the box, in cells of the image with row 0 on top, that the map shows
    left, rows = frame.left_m / CELL - column0, cells.shape[0]
    top = rows - (frame.top_m / CELL - row0)
    cell_px = frame.scale * CELL
    box = (left, top, left + frame.width / cell_px, top + frame.height / cell_px)
    image = Image.fromarray(np.ascontiguousarray(cells[::-1]))
    return image.transform(
        (frame.width, frame.height), Image.Transform.AFFINE,
        (1.0 / cell_px, 0.0, box[0], 0.0, 1.0 / cell_px, box[1]), Image.Resampling.NEAREST,
    )  # fmt: skip


def _draw_scans(draw: ImageDraw.ImageDraw, scene: Scene, frame: Frame) -> None:
    for drone, ends in enumerate(scene.scans):
        if scene.alive[drone] and len(ends) > 2:
            draw.polygon(frame.pixels(ends, _FINE), fill=(*_colour(drone), 34), outline=(*_colour(drone), 90))


def _draw_movers(draw: ImageDraw.ImageDraw, scene: Scene, frame: Frame) -> None:
    for corners in scene.crates:
        a, b, c, d = frame.pixels(corners, _FINE)
        width = max(_FINE, round(0.04 * frame.scale * _FINE))
        draw.polygon([a, b, c, d], fill=CRATE)
        for ends in ((a, b), (b, c), (c, d), (d, a), (a, c), (b, d)):
            draw.line(ends, fill=_darker(CRATE), width=width)
    for x, y, radius in scene.people:
        _disc(draw, frame, (x, y), radius, _FINE, _darker(PERSON))
        _disc(draw, frame, (x, y), 0.8 * radius, _FINE, PERSON)
        _disc(draw, frame, (x, y), 0.4 * radius, _FINE, _darker(PERSON))


def _draw_trails(draw: ImageDraw.ImageDraw, scene: Scene, frame: Frame) -> None:
    width = max(_FINE, round(0.05 * frame.scale * _FINE))
    for drone, trail in enumerate(scene.trails):
        if len(trail) > 1:
            draw.line(frame.pixels(trail, _FINE), fill=(*_colour(drone), 170), width=width, joint="curve")


def _draw_links(draw: ImageDraw.ImageDraw, scene: Scene, frame: Frame) -> None:
    """Draw dashes between drones that reach each other; sparser where only one reaches the other."""
    at = np.array(frame.pixels(scene.poses[:, :2], _FINE))
    dash = max(4.0, 0.12 * frame.scale) * _FINE
    width = max(_FINE, round(0.025 * frame.scale * _FINE))
    for a in range(len(at)):
        for b in range(a + 1, len(at)):
            ways = int(scene.linked[a, b]) + int(scene.linked[b, a])
            if ways == 0 or not (scene.alive[a] and scene.alive[b]):
                continue
            count = max(1, round(math.dist(at[a], at[b]) / dash))
            for k in range(0, count, 2 if ways == 2 else 4):
                ends = at[a] + (at[b] - at[a]) * np.array([[k / count], [min(k + 1, count) / count]])
                draw.line([tuple(ends[0]), tuple(ends[1])], fill=(*LINK, 210), width=width)


def _draw_drone(draw: ImageDraw.ImageDraw, scene: Scene, frame: Frame, drone: int) -> None:
    """Draw a drone in its size, but no smaller than can be seen: a disc with a nose, and its number beside it."""
    x, y, yaw = scene.poses[drone]
    colour = _colour(drone) if scene.alive[drone] else DEAD
    radius = max(scene.drone_radius_m, 0.011 * max(frame.width, frame.height) / frame.scale)
    nose = np.array([[1.75, 0.0], [0.55, 0.85], [0.55, -0.85]]) * radius
    c, s = math.cos(yaw), math.sin(yaw)
    turned = nose @ np.array([[c, s], [-s, c]]) + np.array([x, y])
    _disc(draw, frame, (x, y), 1.25 * radius, _FINE, BACKDROP)
    draw.polygon(frame.pixels(turned, _FINE), fill=colour)
    _disc(draw, frame, (x, y), radius, _FINE, colour)
    (px, py), size = frame.pixels(np.array([[x, y]]), _FINE)[0], radius * frame.scale * _FINE
    if scene.alive[drone]:
        draw.text((px, py), str(drone + 1), fill=BACKDROP, font=_font(round(1.6 * size)), anchor="mm")
    else:
        arm = 0.6 * size
        for sign in (1, -1):
            draw.line(
                [(px - arm, py - sign * arm), (px + arm, py + sign * arm)], fill=BACKDROP, width=round(0.3 * size)
            )


def _draw_header(picture: Image.Image, scene: Scene, frame: Frame, width: int) -> None:
    """Write level, tick and coverage above the map, and a bar that fills with the coverage."""
    draw = ImageDraw.Draw(picture)
    font, middle = _font(round(0.55 * frame.header)), 0.45 * frame.header
    pad = round(0.35 * frame.header)
    draw.text((pad, middle), f"level {scene.level.name}   tick {scene.tick}", fill=SOFT_TEXT, font=font, anchor="lm")
    draw.text((width - pad, middle), f"{scene.coverage:.1%} seen", fill=TEXT, font=font, anchor="rm")
    thick = max(2, frame.header // 10)
    draw.rectangle((0, frame.header - thick, width, frame.header - 1), fill=BAR_GROUND)
    filled = round(width * min(1.0, max(0.0, scene.coverage)))
    if filled:
        draw.rectangle((0, frame.header - thick, filled - 1, frame.header - 1), fill=BAR)


def draw_views(views: NDArray[np.float32], height: int) -> Image.Image:
    """Draw what a policy sees, `[channels, n, n]` in [-1, 1], as images that are `height` pixels high in all.

    Blue is -1 (free, or a frontier nearer than here), dark 0, amber 1; y goes up and the drone is in the middle. More
    channels than two stand in two columns: an ObservationSpec's occupancy on the left, its frontier distance on the
    right, a scale a row, and below them what options add.
    """
    channels, side = len(views), views.shape[1]
    columns = 1 if channels <= 2 else 2
    lines = -(-channels // columns)
    gap = 6
    size = max(side // 2, (height - gap * (lines + 1)) // lines)
    size = min(size, 320)
    panel = Image.new("RGB", (columns * (size + gap) + gap, height), BACKDROP)
    for channel, view in enumerate(views):
        value = np.clip(np.nan_to_num(view), -1.0, 1.0)[::-1, :, None]
        ground, low, high = (np.array(c, np.float32) for c in (UNSEEN_FLOOR, DRONES[0], DRONES[1]))
        shades = ground + np.maximum(-value, 0.0) * (low - ground) + np.maximum(value, 0.0) * (high - ground)
        image = Image.fromarray(np.rint(shades).astype(np.uint8)).resize((size, size), Image.Resampling.NEAREST)
        left, top = gap + channel % columns * (size + gap), gap + channel // columns * (size + gap)
        panel.paste(image, (left, top))
        middle, arm = (left + size // 2, top + size // 2), 3
        box = (middle[0] - arm, middle[1] - arm, middle[0] + arm, middle[1] + arm)
        ImageDraw.Draw(panel).ellipse(box, outline=TEXT)
    return panel


def _disc(
    draw: ImageDraw.ImageDraw, frame: Frame, at: tuple[float, float], radius_m: float, fine: int, colour: Colour
) -> None:
    (x, y), r = frame.pixels(np.array([at]), fine)[0], radius_m * frame.scale * fine
    draw.ellipse((x - r, y - r, x + r, y + r), fill=colour)


def _colour(drone: int) -> Colour:
    return DRONES[drone % len(DRONES)]


def _darker(colour: Colour) -> Colour:
    return colour[0] * 3 // 5, colour[1] * 3 // 5, colour[2] * 3 // 5


@lru_cache(maxsize=32)
def _font(size_px: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(max(6, size_px))
