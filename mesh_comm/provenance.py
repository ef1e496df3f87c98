"""Where a map's cells come from: who saw a cell, when, and by which way that came here."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from imagine.core.evidence import EvidenceMap, TileKey
from imagine.core.frames import IDENTITY, inverse, transform_points
from imagine.core.raster import CELL, LIMIT, TILE

Way = Literal["own scan", "scan", "tile", "relay"]


@dataclass(frozen=True)
class Sighting:
    """One source's evidence on a cell: `units` of log-odds, and how the tile that holds it came here.

    `way`: the drone's own scan; a peer's scan ahead of its tile; a tile from its source; a tile passed on. `via` is the
    node that it was heard from. `version` is the tile's, 0 where only scans came; `stamp` the newest scan's on the
    tile, by its source's clock, None where only tiles came; `heard_at` the listener's seconds. All are the tile's: of
    a cell alone nobody keeps them. `provisional`: peers' scans are drawn over the tile.
    """

    source: int
    units: int
    way: Way
    via: int
    version: int
    stamp: float | None
    heard_at: float | None
    provisional: bool


@dataclass(frozen=True)
class CellProvenance:
    """Who says what of a cell: its centre (metres, own map frame), the belief, and the sources that see it, by id."""

    x: float
    y: float
    belief: int
    sightings: tuple[Sighting, ...]


@dataclass
class _Arrival:
    """How a tile of a source came: the copy held, and the newest scan on it."""

    version: int = 0
    via: int = 0
    tile_at: float | None = None
    stamp: float | None = None
    scan_at: float | None = None
    sketch_via: int | None = None


class Provenance:
    """How every tile of every source came here. As many records as the map holds tiles, which bounds them."""

    def __init__(self, evidence: EvidenceMap) -> None:
        """Start with nothing heard."""
        self._evidence = evidence
        self._arrivals: dict[int, dict[TileKey, _Arrival]] = {}
        self._own_clock = 0

    def note_own(self, stamp: float, now: float) -> None:
        """Take it that the own layer's newest tiles were changed by a scan of this stamp, seconds."""
        evidence = self._evidence
        layer = evidence.layers[evidence.own]
        if layer.clock == self._own_clock:
            return
        for row, column in np.argwhere(layer.versions > self._own_clock):
            key = TileKey(int(column) + evidence.corner.column, int(row) + evidence.corner.row)
            arrival = self._arrival(evidence.own, key)
            arrival.version, arrival.via = int(layer.versions[row, column]), evidence.own
            arrival.stamp, arrival.scan_at = stamp, now
        self._own_clock = layer.clock

    def note_scan(self, source: int, x: float, y: float, reach_m: float, stamp: float, now: float) -> None:
        """Note a peer's scan from (x, y), metres in its frame, on the tiles in reach that it turned provisional."""
        side, corner = CELL * TILE, self._evidence.corner
        row = max(0, math.floor((y - reach_m) / side) - corner.row)
        column = max(0, math.floor((x - reach_m) / side) - corner.column)
        last_row = max(0, math.floor((y + reach_m) / side) - corner.row)
        last_column = max(0, math.floor((x + reach_m) / side) - corner.column)
        provisional = self._evidence.layers[source].provisional[row : last_row + 1, column : last_column + 1]
        for i, j in np.argwhere(provisional).tolist():
            arrival = self._arrival(source, TileKey(column + j + corner.column, row + i + corner.row))
            arrival.stamp, arrival.scan_at, arrival.sketch_via = stamp, now, None

    def note_tile(self, source: int, key: TileKey, version: int, via: int, now: float) -> None:
        """Note a tile that was taken into the map, heard from node `via`."""
        arrival = self._arrival(source, key)
        arrival.version, arrival.via, arrival.tile_at = version, via, now

    def note_sketch(self, source: int, key: TileKey, via: int, now: float) -> None:
        """Note that node `via` filled in cells of a tile from scans of the source that it heard."""
        arrival = self._arrival(source, key)
        arrival.sketch_via, arrival.scan_at = via, now

    def forget(self, source: int) -> None:
        """Drop what is noted of a source, whose layer was dropped."""
        self._arrivals.pop(source, None)

    def at(self, x: float, y: float) -> CellProvenance:
        """Return where the belief in the cell at (x, y), metres of the own frame, comes from; nothing off the map."""
        column, row = math.floor(x / CELL), math.floor(y / CELL)
        centre = (column + 0.5) * CELL, (row + 0.5) * CELL
        evidence = self._evidence
        placed = evidence.placed()
        column0, row0 = evidence.origin_cells
        rows, columns = evidence.shape
        sightings: list[Sighting] = []
        if 0 <= row - row0 < rows and 0 <= column - column0 < columns:
            for source in sorted(placed):
                units = int(placed[source][row - row0, column - column0])
                if units:
                    sightings.append(self._sighting(source, units, centre))
        total = max(-LIMIT, min(LIMIT, sum(sighting.units for sighting in sightings)))
        return CellProvenance(centre[0], centre[1], total, tuple(sightings))

    def _sighting(self, source: int, units: int, centre: tuple[float, float]) -> Sighting:
        evidence = self._evidence
        pose = evidence.placement(source) or IDENTITY
        at: NDArray[np.float64] = np.array([centre])
        if pose != IDENTITY:
            at = transform_points(inverse(pose), at)
        side = CELL * TILE
        key = TileKey(math.floor(at[0, 0] / side), math.floor(at[0, 1] / side))
        arrival = self._arrivals.get(source, {}).get(key, _Arrival())
        provisional = evidence.is_provisional(source, key)
        if source == evidence.own:
            return Sighting(source, units, "own scan", source, arrival.version, arrival.stamp, arrival.scan_at, False)
        if arrival.version == 0 or (provisional and (arrival.scan_at or 0.0) >= (arrival.tile_at or 0.0)):
            if provisional and arrival.sketch_via is not None:
                via = arrival.sketch_via
                return Sighting(source, units, "relay", via, arrival.version, arrival.stamp, arrival.scan_at, True)
            return Sighting(source, units, "scan", source, arrival.version, arrival.stamp, arrival.scan_at, provisional)
        way: Way = "tile" if arrival.via == source else "relay"
        return Sighting(source, units, way, arrival.via, arrival.version, arrival.stamp, arrival.tile_at, provisional)

    def _arrival(self, source: int, key: TileKey) -> _Arrival:
        arrivals = self._arrivals.setdefault(source, {})
        arrival = arrivals.get(key)
        if arrival is None:
            arrival = arrivals[key] = _Arrival()
        return arrival
