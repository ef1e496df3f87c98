"""What can be set about finding out where peers' frames lie."""

from __future__ import annotations

import math

from pydantic import Field

from imagine.core.config import Settings


class AlignmentSettings(Settings):
    """When a place is believed, and how often it is looked for. Cells are 0.01 m² of map, or 0.1 m of wall."""

    period_s: float = Field(default=3.0, gt=0.0, description="between estimates for the same peer")
    yaws_per_slice: int = Field(default=6, ge=1, description="of the 120 yaws searched, so many in one call")
    least_overlap: int = Field(default=1000, ge=1, description="cells known to both maps, or an estimate says nothing")
    least_matched: int = Field(default=100, ge=1, description="cells of wall that both maps have")
    least_hold: float = Field(default=0.15, ge=0.0, le=1.0, description="walls lost by a shift along the loosest way")
    most_contradiction: float = Field(default=0.03, ge=0.0, le=1.0, description="share of walls the other map denies")
    most_rival: float = Field(default=0.5, ge=0.0, lt=1.0, description="score of the next best place over the best's")
    more_overlap: int = Field(default=300, ge=1, description="cells that an estimate must add to confirm the last")
    confirmations: int = Field(default=2, ge=1, description="estimates that must confirm the first")
    agree_m: float = Field(default=0.2, gt=0.0, description="estimates this near to each other are the same place")
    agree_rad: float = Field(default=math.radians(3.0), gt=0.0)
    move_m: float = Field(default=0.02, ge=0.0, description="a trusted place is moved when it is better by so much")
    move_rad: float = Field(default=math.radians(0.2), ge=0.0)
    withdraw_contradiction: float = Field(default=0.06, ge=0.0, le=1.0)
    withdraw_rival: float = Field(default=0.85, ge=0.0, le=1.0)
    strikes: int = Field(default=2, ge=1, description="bad checks in a row that withdraw a trusted place")
    launch_radius_m: float | None = Field(
        default=None, gt=0.0, description="frames begin at most so far apart, or from where the layout has them"
    )
    search_every: int = Field(
        default=3, ge=1, description="of the checks of a trusted place, each so many-eth searches"
    )
