"""Where a map's cells come from: who saw a cell, when, and by which way that came here."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from imagine.core.evidence import EvidenceMap, TileKey
from imagine.core.frames import IDENTITY, inverse, transform_points
from imagine.core.raster import CELL, LIMIT, TILE

_NOBODY = -1
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


class _Arrival(NamedTuple):
    """How one tile of a source came: the copy held, and the newest scan on it."""

    version: int = 0
    via: int = 0
    tile_at: float | None = None
    stamp: float | None = None
    scan_at: float | None = None
    sketch_via: int | None = None


class _Arrivals:
    """How every tile of a source came, as arrays `[tile rows, tile columns]` on the map's grid; nan: nothing did."""

    def __init__(self, corner: TileKey, tile_rows: int, tile_columns: int) -> None:
        shape = tile_rows, tile_columns
        self.corner = corner
        self.version = np.zeros(shape, np.int64)
        self.via = np.zeros(shape, np.uint8)
        self.sketch_via = np.full(shape, _NOBODY, np.int16)
        self.tile_at, self.stamp, self.scan_at = np.full((3, *shape), np.nan)

    def copy_from(self, old: _Arrivals) -> None:
        """Take over what is noted on a smaller grid."""
        row, column = old.corner.row - self.corner.row, old.corner.column - self.corner.column
        rows, columns = old.version.shape
        for name in ("version", "via", "sketch_via", "tile_at", "stamp", "scan_at"):
            getattr(self, name)[row : row + rows, column : column + columns] = getattr(old, name)

    def at(self, key: TileKey) -> _Arrival:
        """Return how a tile came."""
        row, column = key.row - self.corner.row, key.column - self.corner.column
        if not (0 <= row < self.version.shape[0] and 0 <= column < self.version.shape[1]):
            return _Arrival()
        tile_at, stamp, scan_at = (
            None if math.isnan(value) else value
            for value in map(float, (self.tile_at[row, column], self.stamp[row, column], self.scan_at[row, column]))
        )
        via = int(self.sketch_via[row, column])
        sketch_via = None if via == _NOBODY else via
        return _Arrival(int(self.version[row, column]), int(self.via[row, column]), tile_at, stamp, scan_at, sketch_via)


@numba.njit(cache=True, nogil=True)
def _note_scan(  # type: ignore[no-untyped-def]
    provisional, row, last_row, column, last_column, stamp, now, stamps, scan_at, sketch_via
):
    """Note a scan on the provisional ones among the tiles from (row, column) to the last ones, where on the grid."""
    for i in range(row, min(last_row + 1, provisional.shape[0])):
        for j in range(column, min(last_column + 1, provisional.shape[1])):
            if provisional[i, j]:
                stamps[i, j], scan_at[i, j], sketch_via[i, j] = stamp, now, _NOBODY


@numba.njit(cache=True, nogil=True)
def _note_tiles(entries, taken, column0, row0, via, now, version, vias, tile_at):  # type: ignore[no-untyped-def]
    """Note the tiles that were taken; the grid's first one is (column0, row0)."""
    for k in range(len(entries)):
        if taken[k]:
            i, j = entries[k, 1] - row0, entries[k, 0] - column0
            version[i, j], vias[i, j], tile_at[i, j] = entries[k, 2], via, now


class Provenance:
    """How every tile of every source came here. One record for each tile of the map's grid, which bounds them."""

    def __init__(self, evidence: EvidenceMap) -> None:
        """Start with nothing heard."""
        self._evidence = evidence
        self._arrivals: dict[int, _Arrivals] = {}
        self._own_clock = 0

    def note_own(self, stamp: float, now: float) -> None:
        """Take it that the own layer's newest tiles were changed by a scan of this stamp, seconds."""
        own = self._evidence.own
        layer = self._evidence.layers[own]
        if layer.clock == self._own_clock:
            return
        arrivals, changed = self._of(own), layer.versions > self._own_clock
        arrivals.version[changed] = layer.versions[changed]
        arrivals.via[changed] = own
        arrivals.stamp[changed], arrivals.scan_at[changed] = stamp, now
        self._own_clock = layer.clock

    def note_scan(self, source: int, x: float, y: float, reach_m: float, stamp: float, now: float) -> None:
        """Note a peer's scan from (x, y), metres in its frame, on the tiles in reach that it turned provisional."""
        side, corner = CELL * TILE, self._evidence.corner
        row = max(0, math.floor((y - reach_m) / side) - corner.row)
        column = max(0, math.floor((x - reach_m) / side) - corner.column)
        last_row = max(0, math.floor((y + reach_m) / side) - corner.row)
        last_column = max(0, math.floor((x + reach_m) / side) - corner.column)
        arrivals = self._of(source)
        _note_scan(
            self._evidence.layers[source].provisional, row, last_row, column, last_column, stamp, now,
            arrivals.stamp, arrivals.scan_at, arrivals.sketch_via,
        )  # fmt: skip

    def note_tiles(
        self, source: int, entries: NDArray[np.int64], taken: NDArray[np.bool_], via: int, now: float
    ) -> None:
        """Note the tiles that were `taken` (bool `[n]`) into the map, heard from node `via`.

        `entries` int64 `[n, 3]`: column, row and version of each tile.
        """
        arrivals = self._of(source)
        column, row = arrivals.corner
        _note_tiles(entries, taken, column, row, via, now, arrivals.version, arrivals.via, arrivals.tile_at)

    def note_sketch(self, source: int, key: TileKey, via: int, now: float) -> None:
        """Note that node `via` filled in cells of a tile from scans of the source that it heard."""
        arrivals = self._of(source)
        at = key.row - arrivals.corner.row, key.column - arrivals.corner.column
        arrivals.sketch_via[at], arrivals.scan_at[at] = via, now

    def forget(self, source: int) -> None:
        """Drop what is noted of a source, whose layer was dropped."""
        self._arrivals.pop(source, None)

    def _of(self, source: int) -> _Arrivals:
        """Return what is noted of a source, on the grid as it is now."""
        evidence, arrivals = self._evidence, self._arrivals.get(source)
        if arrivals is not None and arrivals.corner is evidence.corner:  # the map makes a new one when it grows
            return arrivals
        grown = _Arrivals(evidence.corner, evidence.tile_rows, evidence.tile_columns)
        if arrivals is not None:
            grown.copy_from(arrivals)
        self._arrivals[source] = grown
        return grown

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
        arrivals = self._arrivals.get(source)
        arrival = _Arrival() if arrivals is None else arrivals.at(key)
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
