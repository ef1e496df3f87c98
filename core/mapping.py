"""How scans become evidence: the settings every map in a swarm must share, written into the policy contract."""

from __future__ import annotations

from pydantic import Field

from imagine.core import raster
from imagine.core.config import Settings


class MapSettings(Settings):
    """Scale and weights of the evidence map. All but `range_cap_m` are fixed by the code and stated for the record."""

    cell_m: float = Field(default=raster.CELL, description="side of a cell, metres")
    tile_cells: int = Field(default=raster.TILE, description="side of a tile, cells")
    unit_log_odds: float = Field(default=raster.UNIT_LOG_ODDS)
    hit: int = Field(default=raster.HIT)
    miss: int = Field(default=raster.MISS)
    limit: int = Field(default=raster.LIMIT)
    range_cap_m: float = Field(default=4.0, gt=0.5, le=30.0, description="beams are mapped up to here, metres")
