"""A question to the flight's loop: who saw this cell, when, and by which way that came to the ground."""

from __future__ import annotations

import math
from collections.abc import Mapping
from concurrent.futures import Future
from dataclasses import asdict, dataclass, field
from typing import Any

from imagine.core.errors import InputError
from imagine.mesh_comm.messages import POSITION_LIMIT_M
from imagine.mesh_comm.provenance import CellProvenance


@dataclass(frozen=True)
class CellQuestion:
    """A cell asked for, by a point in it (metres, map frame); the loop sets `answer`, plain JSON values."""

    x: float
    y: float
    answer: Future[dict[str, Any]] = field(default_factory=Future)


def cell_question(query: Mapping[str, str]) -> CellQuestion:
    """Read a question from a URL's query, `x=1.2&y=-3`. Raises InputError where these are no places on a map."""
    place = []
    for name in ("x", "y"):
        text = query.get(name, "")
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not abs(value) <= POSITION_LIMIT_M:  # nan is not, either
            raise InputError(f"{name} is {text!r:.40}: expected metres, at most {POSITION_LIMIT_M:.0f} either way")
        place.append(value)
    return CellQuestion(x=place[0], y=place[1])


def cell_state(cell: CellProvenance, now: float) -> dict[str, Any]:
    """Return a cell's provenance as plain JSON values; `age_s` is how long ago a sighting was heard, seconds."""
    state = asdict(cell)
    state["sightings"] = [
        asdict(s) | {"age_s": None if s.heard_at is None else round(max(0.0, now - s.heard_at), 2)}
        for s in cell.sightings
    ]
    return state
