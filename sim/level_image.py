"""A level as a picture: free space white, solids grey, crates, people's ways, the launch, and a scale bar."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from imagine.core.raster import CELL
from imagine.sim.level import Level

_OUTSIDE, _FREE, _UNSEEN = (214, 214, 214), (255, 255, 255), (255, 214, 204)
_SOLID, _EDGE, _CRATE, _PERSON, _LAUNCH = (118, 124, 132), (52, 56, 62), (201, 148, 74), (69, 117, 180), (26, 152, 80)
_MARGIN_M = 0.5
_FOOTER_PX = 44
_WANTED_PX, _MOST_PX_A_M = 1200, 120.0
_FINER = 2  # drawn so much larger, then scaled down: smooth edges
_BAR_LENGTHS_M = (0.5, 1, 2, 5, 10, 20, 50, 100)

Points = Sequence[Sequence[float]] | Sequence[tuple[float, float]] | NDArray[np.float64]


def draw_level(level: Level) -> Image.Image:
    """Draw a level with north up; free cells that no drone can see are tinted."""
    low, high = level.outline.min(axis=0) - _MARGIN_M, level.outline.max(axis=0) + _MARGIN_M
    scale = min(_WANTED_PX / float((high - low).max()), _MOST_PX_A_M) * _FINER
    width, height = (math.ceil(side * scale) for side in high - low)
    picture = Image.new("RGB", (width, height), _OUTSIDE)
    draw = ImageDraw.Draw(picture)

    def at(points: Points) -> list[tuple[float, float]]:
        return [((x - low[0]) * scale, height - (y - low[1]) * scale) for x, y in points]

    line = max(2, round(0.02 * scale))
    draw.polygon(at(level.outline), fill=_FREE)
    _draw_unseen(draw, level, at)
    for solid in (*level.polygons, *level.solids):
        draw.polygon(at(solid), fill=_SOLID)
    for x, y, radius in level.circles:
        _disc(draw, at([(x, y)])[0], radius * scale, _SOLID)
    indoors = Image.new("L", picture.size, 0)
    ImageDraw.Draw(indoors).polygon(at(level.outline), fill=255)
    picture = Image.composite(picture, Image.new("RGB", picture.size, _OUTSIDE), indoors)  # cuts walls that stick out
    draw = ImageDraw.Draw(picture)
    draw.line([*at(level.outline), *at(level.outline[:1])], fill=_EDGE, width=2 * line, joint="curve")
    for crate in level.crates:
        draw.polygon(at(crate.corners()), fill=_CRATE, outline=_EDGE, width=line)
    for person in level.people:
        loop = at(person.loop)
        draw.line([*loop, loop[0]], fill=_PERSON, width=line, joint="curve")
        _disc(draw, loop[0], person.radius * scale, _PERSON)
    launch = at([level.launch])[0]
    _disc(draw, launch, max(0.15 * scale, 6.0), _LAUNCH)
    smooth = picture.resize((width // _FINER, height // _FINER), Image.Resampling.LANCZOS)
    final = Image.new("RGB", (max(smooth.width, 420), smooth.height + _FOOTER_PX), (255, 255, 255))
    final.paste(smooth, (0, 0))
    _draw_footer(ImageDraw.Draw(final), level, final.width, smooth.height, scale / _FINER)
    return final


def _draw_unseen(draw: ImageDraw.ImageDraw, level: Level, at: Callable[[Points], list[tuple[float, float]]]) -> None:
    column0, row0, _, _ = level.grid
    for row, column in np.argwhere(level.free & ~level.survey.seen):
        x, y = (column + column0) * CELL, (row + row0) * CELL
        draw.polygon(at([(x, y), (x + CELL, y), (x + CELL, y + CELL), (x, y + CELL)]), fill=_UNSEEN)


def _disc(draw: ImageDraw.ImageDraw, at: tuple[float, float], radius: float, colour: tuple[int, int, int]) -> None:
    x, y = at
    draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=colour)


def _draw_footer(draw: ImageDraw.ImageDraw, level: Level, width: int, top: int, scale: float) -> None:
    """Draw, under the plan, a bar of a round length, and what the colours mean."""
    font = ImageFont.load_default(15)
    length_m = max((m for m in _BAR_LENGTHS_M if m * scale <= width / 4.0), default=_BAR_LENGTHS_M[0])
    length, left, y = length_m * scale, 12, top + _FOOTER_PX // 2
    draw.line([(left, y), (left + length, y)], fill=(0, 0, 0), width=3)
    for x in (left, left + length):
        draw.line([(x, y - 6), (x, y + 6)], fill=(0, 0, 0), width=2)
    draw.text((left + length + 8, y), f"{length_m:g} m", fill=(0, 0, 0), font=font, anchor="lm")
    legend = [("launch", _LAUNCH)]
    legend += [("person", _PERSON)] if level.people else []
    legend += [("crate", _CRATE)] if level.crates else []
    x = width - 12.0
    for word, colour in reversed(legend):
        x -= draw.textlength(word, font=font)
        draw.text((x, y), word, fill=(0, 0, 0), font=font, anchor="lm")
        _disc(draw, (x - 12, y), 6, colour)
        x -= 34
