"""The belief as a picture: white free, grey unknown, black occupied, the flown line in colour, and a scale bar."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from imagine.core.errors import WorkError
from imagine.core.raster import CELL, LIMIT

_UNKNOWN, _FREE, _OCCUPIED = 200, 255, 0
_LINES = ((215, 48, 39), (69, 117, 180), (230, 145, 30), (118, 42, 131), (27, 120, 55), (140, 81, 10))
_START, _END = (26, 152, 80), (33, 102, 172)
_MARGIN_CELLS = 5
_FOOTER_PX = 44
_SMALLEST_PX, _LARGEST_PX = 1000, 4000
_BAR_LENGTHS_M = (0.5, 1, 2, 5, 10, 20, 50, 100)


Track = Sequence[tuple[float, float]]
"""Where a drone went: points (x, y) of the map frame, metres."""


def draw_map(belief: NDArray[np.int8], origin_cells: tuple[int, int], tracks: Sequence[Track] = ()) -> Image.Image:
    """Draw a belief, cropped to what is known, with north up, and a line in a colour of its own for each track.

    `belief` is int8 log-odds `[rows, columns]`, its first cell at `origin_cells` (column, row) of the map frame.
    Raises WorkError where nothing is known.
    """
    rows, columns = np.nonzero(belief)
    if len(rows) == 0:
        raise WorkError("the map is empty: there is nothing to draw")
    top, left = max(rows.min() - _MARGIN_CELLS, 0), max(columns.min() - _MARGIN_CELLS, 0)
    known = belief[top : rows.max() + 1 + _MARGIN_CELLS, left : columns.max() + 1 + _MARGIN_CELLS]
    scale = _pixels_per_cell(max(known.shape))
    height, width = known.shape[0] * scale, known.shape[1] * scale

    shades = _shades()[known.astype(np.int16) + LIMIT]
    picture = Image.new("RGB", (width, height + _FOOTER_PX), (255, 255, 255))
    cells = Image.fromarray(np.ascontiguousarray(shades[::-1])).resize((width, height), Image.Resampling.NEAREST)
    picture.paste(cells.convert("RGB"), (0, 0))

    draw = ImageDraw.Draw(picture)
    x0, y0 = (origin_cells[0] + left) * CELL, (origin_cells[1] + top) * CELL
    for number, track in enumerate(tracks):
        line = [((x - x0) / CELL * scale, height - (y - y0) / CELL * scale) for x, y in track]
        if len(line) > 1:
            draw.line(line, fill=_LINES[number % len(_LINES)], width=max(2, scale // 3), joint="curve")
        if line:
            _dot(draw, line[-1], _END)
            _dot(draw, line[0], _START)
    _draw_scale_bar(draw, width, height, scale)
    return picture


def _pixels_per_cell(cells: int) -> int:
    """Enlarge small maps until they can be looked at; never past the largest picture."""
    wanted = -(-_SMALLEST_PX // cells)
    return max(1, min(wanted, _LARGEST_PX // cells))


def _shades() -> NDArray[np.uint8]:
    """Return the grey of each log-odds from -LIMIT to LIMIT: half the evidence is already as clear as can be."""
    log_odds = np.arange(-LIMIT, LIMIT + 1)
    strength = np.minimum(np.abs(log_odds) / (LIMIT / 2.0), 1.0)
    target = np.where(log_odds < 0, _FREE, _OCCUPIED)
    shades: NDArray[np.uint8] = np.rint(_UNKNOWN + (target - _UNKNOWN) * strength).astype(np.uint8)
    return shades


def _dot(draw: ImageDraw.ImageDraw, at: tuple[float, float], colour: tuple[int, int, int], radius: int = 6) -> None:
    x, y = at
    draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=colour, outline=(255, 255, 255))


def _draw_scale_bar(draw: ImageDraw.ImageDraw, width: int, height: int, scale: int) -> None:
    """Draw, under the map, a bar of a round length of about a fifth of the width, and what the dots mean."""
    metres_wide = width / scale * CELL
    length_m = max((m for m in _BAR_LENGTHS_M if m <= metres_wide / 4.0), default=_BAR_LENGTHS_M[0])
    length = length_m / CELL * scale
    left, y = 12, height + _FOOTER_PX // 2
    draw.line([(left, y), (left + length, y)], fill=(0, 0, 0), width=3)
    for x in (left, left + length):
        draw.line([(x, y - 7), (x, y + 7)], fill=(0, 0, 0), width=3)
    font = ImageFont.load_default(18)
    draw.text((left + length + 12, y), f"{length_m:g} m", fill=(0, 0, 0), font=font, anchor="lm")
    legend = (("start", _START), ("end", _END))
    x = width - 12.0
    for word, colour in reversed(legend):
        x -= draw.textlength(word, font=font)
        draw.text((x, y), word, fill=(0, 0, 0), font=font, anchor="lm")
        _dot(draw, (x - 12, y), colour)
        x -= 34
