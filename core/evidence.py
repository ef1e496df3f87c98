"""The evidence map: one int8 log-odds layer per source, each tile with a version that only its source advances.

Merging takes the newer version of a tile and the belief is the clamped sum over sources, computed when read. So
merging is idempotent, commutative and associative (a state-based CRDT with single writers, Shapiro et al. 2011):
order, duplicates, loss and relays cannot count evidence twice.

Every layer is kept in its source's own frame, exactly as it was sent. A placement says where that frame lies in the
drone's; a layer without one is held, served and merged, but no part of the belief.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from imagine.core.errors import InputError
from imagine.core.frames import IDENTITY, Pose
from imagine.core.lidar import LidarSpec, Scan
from imagine.core.peer_marks import add_marks_ahead, write_tile
from imagine.core.placed_layer import PlacedLayer
from imagine.core.raster import CELL, LIMIT, TILE, beam_directions, integrate_scan, mark_scan, ray_table, sum_layers

_NEVER = 2**40  # no version is so late

MAX_TILES = 160
"""Largest extent any map may be given, in tiles along an axis (512 m)."""


class TileKey(NamedTuple):
    """A tile's place in the map frame, in tiles from the origin: column along x, row along y."""

    column: int
    row: int


@dataclass
class Layer:
    """What one source has seen: `cells` int8 `[rows, columns]`, and per tile its version and whether it is provisional.

    A tile is provisional when a peer's scan was drawn ahead of the tile itself: good for the belief, never relayed.
    `boot` is the number of the source's start that all of it is of, the high part of every version.
    """

    cells: NDArray[np.int8]
    versions: NDArray[np.uint32]
    provisional: NDArray[np.bool_]
    clock: int = 0
    boot: int = 0

    @staticmethod
    def empty(tile_rows: int, tile_columns: int) -> Layer:
        """Return a layer without evidence, `tile_rows` by `tile_columns` tiles."""
        return Layer(
            cells=np.zeros((tile_rows * TILE, tile_columns * TILE), np.int8),
            versions=np.zeros((tile_rows, tile_columns), np.uint32),
            provisional=np.zeros((tile_rows, tile_columns), np.bool_),
        )


class EvidenceMap:
    """The layers of all sources a drone knows of, on one grid that grows by whole tiles.

    Sources are small integers (drone ids). Metres and radians, map frame.
    """

    def __init__(
        self, own: int, half_extent_m: float = 12.8, max_extent_m: float = 128.0, shares_frame: bool = True
    ) -> None:
        """Make an empty map for drone `own`, reserving `half_extent_m` around the origin.

        With `shares_frame` all sources draw in one frame, unless `place` says otherwise; without, nobody's frame is
        known but the own.

        It grows to at most `max_extent_m` along an axis: a bound on memory, and on the time a tick takes, whatever
        peers send. What they send makes it grow to half of that at most, each way from `begin_at`, so that there is
        always room for the drone's own scans. Raises InputError if that is less than is reserved, or more than 512 m.
        """
        tiles = max(1, math.ceil(half_extent_m / (CELL * TILE)))
        self._max_tiles = math.floor(max_extent_m / (CELL * TILE) + 1e-9)
        if not 2 * tiles <= self._max_tiles <= MAX_TILES:
            raise InputError(
                f"a map of {max_extent_m:g} m at most, with {half_extent_m:g} m reserved each way: "
                f"needs to hold what is reserved, and be at most {MAX_TILES * CELL * TILE:.0f} m"
            )
        self.own = own
        self._home = TileKey(0, 0)
        self.corner = TileKey(-tiles, -tiles)
        self.tile_rows = self.tile_columns = 2 * tiles
        self.layers: dict[int, Layer] = {own: Layer.empty(self.tile_rows, self.tile_columns)}
        self.shares_frame = shares_frame
        self._placements: dict[int, Pose | None] = {own: IDENTITY}
        self._placed: dict[int, PlacedLayer] = {}

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the grid, in cells."""
        return self.tile_rows * TILE, self.tile_columns * TILE

    @property
    def origin_cells(self) -> tuple[int, int]:
        """Column and row, in cells of the map frame, of the grid's first cell."""
        return self.corner.column * TILE, self.corner.row * TILE

    def layer(self, source: int) -> Layer:
        """Return the layer of a source, made empty if it is new."""
        if source not in self.layers:
            self.layers[source] = Layer.empty(self.tile_rows, self.tile_columns)
        return self.layers[source]

    def renew(self, source: int, boot: int) -> bool:
        """Tell whether what start number `boot` of a source says still counts; a new start drops what was held before.

        A version is (boot, clock): everything of a later start is newer than anything of an earlier one, of which
        nothing is left once the later one is known.
        """
        layer = self.layer(source)
        if boot > layer.boot:
            if source != self.own and (layer.clock or layer.provisional.any()):
                layer = self.layers[source] = Layer.empty(self.tile_rows, self.tile_columns)
            layer.boot = boot
        return boot == layer.boot

    def integrate(self, pose: Pose, scan: Scan, spec: LidarSpec, range_cap_m: float) -> int:
        """Add the drone's own scan, taken at `pose`, to its own layer; return how many cells changed."""
        changed, touched = self._draw(self.own, pose, scan, spec, range_cap_m)
        if changed:
            layer = self.layers[self.own]
            layer.clock += 1
            layer.versions[touched] = layer.clock
        return changed

    def integrate_provisional(
        self, source: int, pose: Pose, scan: Scan, spec: LidarSpec, range_cap_m: float, clock: int | None = None
    ) -> int:
        """Draw a peer's scan into the peer's layer ahead of its tiles; the tiles it changes turn provisional.

        Tiles of version `clock` or later contain the scan already and are left alone.
        """
        if source == self.own:
            raise InputError(f"source {source} is this drone itself: its scans are not a peer's")
        self._cover_scan(pose, range_cap_m)
        layer = self.layer(source)
        column0, row0 = self.origin_cells
        table = ray_table(range_cap_m)
        marks = np.empty(table.sheet, np.int8)
        first_row, first_column = mark_scan(
            marks, pose.x, pose.y, pose.yaw, beam_directions(spec.start, spec.increment, len(scan.ranges)),
            scan.ranges, spec.range_min, range_cap_m, table.starts, table.offsets,
        )  # fmt: skip
        newest = _NEVER if clock is None else clock
        return int(
            add_marks_ahead(
                layer.cells, layer.versions, layer.provisional, newest, marks, first_row - row0, first_column - column0
            )
        )

    def _draw(
        self, source: int, pose: Pose, scan: Scan, spec: LidarSpec, range_cap_m: float
    ) -> tuple[int, NDArray[np.bool_]]:
        self._cover_scan(pose, range_cap_m)
        layer = self.layer(source)
        touched = np.zeros((self.tile_rows, self.tile_columns), np.bool_)
        column0, row0 = self.origin_cells
        changed = integrate_scan(
            layer.cells, touched, column0, row0,
            pose.x, pose.y, pose.yaw, spec.start, spec.increment, scan.ranges, spec.range_min, range_cap_m,
        )  # fmt: skip
        return int(changed), touched

    def _cover_scan(self, pose: Pose, range_cap_m: float) -> None:
        if not all(map(math.isfinite, pose)):
            raise InputError(f"pose {tuple(pose)} is not finite")
        self.cover(pose.x - range_cap_m, pose.y - range_cap_m, pose.x + range_cap_m, pose.y + range_cap_m)

    def tile(self, source: int, key: TileKey) -> NDArray[np.int8]:
        """Return the cells of one tile of a source's layer, int8 `[TILE, TILE]`; a view, zeros where unheld."""
        row, column = key.row - self.corner.row, key.column - self.corner.column
        if source not in self.layers or not (0 <= row < self.tile_rows and 0 <= column < self.tile_columns):
            return np.zeros((TILE, TILE), np.int8)
        return self.layers[source].cells[row * TILE : (row + 1) * TILE, column * TILE : (column + 1) * TILE]

    def versions(self, source: int) -> dict[TileKey, int]:
        """Return the version of every tile this map holds of a source; tiles never seen are left out."""
        layer = self.layers.get(source)
        if layer is None:
            return {}
        rows, columns = np.nonzero(layer.versions)
        return {
            TileKey(int(c) + self.corner.column, int(r) + self.corner.row): int(layer.versions[r, c])
            for r, c in zip(rows, columns, strict=True)
        }

    def is_provisional(self, source: int, key: TileKey) -> bool:
        """Tell whether a tile holds scans drawn ahead of it, which must not be relayed."""
        row, column = key.row - self.corner.row, key.column - self.corner.column
        layer = self.layers.get(source)
        if layer is None or not (0 <= row < self.tile_rows and 0 <= column < self.tile_columns):
            return False
        return bool(layer.provisional[row, column])

    def merge_tile(self, source: int, key: TileKey, version: int, cells: NDArray[np.int8]) -> bool:
        """Take a tile of another source if it is newer than what is held; tell whether it was taken.

        Raises InputError on the drone's own source (only the drone itself writes it), on cells of the wrong shape or
        out of range, and on a tile too far away to hold.
        """
        if source == self.own:
            raise InputError(f"a tile of source {source} came from outside, but only drone {source} writes it")
        if cells.shape != (TILE, TILE) or cells.dtype != np.int8:
            raise InputError(f"a tile is int8 {TILE}x{TILE}, got {cells.dtype} {cells.shape}")
        if not 1 <= version < 2**32:
            raise InputError(f"tile {tuple(key)} of source {source}: version {version} is out of range")
        self.cover_tiles(key.column, key.row, key.column, key.row, of_peer=True)
        layer = self.layer(source)
        row, column = key.row - self.corner.row, key.column - self.corner.column
        taken = write_tile(layer.cells, layer.versions, layer.provisional, row, column, version, cells)
        if taken < 0:
            raise InputError(f"tile {tuple(key)} of source {source}: its cells are out of range")
        if taken:
            layer.clock = max(layer.clock, version)
        return bool(taken)

    def sketch_tile(self, source: int, key: TileKey, version: int, cells: NDArray[np.int8]) -> bool:
        """Fill in cells without evidence from a copy of a tile that holds scans of a source heard by a third.

        `version` is what the copy was drawn on: it tells nothing where a later one is held. The tile turns provisional;
        tells whether any cell was filled in. Raises InputError as `merge_tile`.
        """
        if source == self.own:
            raise InputError(f"a sketch of source {source} came from outside, but only drone {source} writes it")
        if cells.shape != (TILE, TILE) or cells.dtype != np.int8 or cells.max() > LIMIT or cells.min() < -LIMIT:
            raise InputError(f"sketch {tuple(key)} of source {source} is no int8 {TILE}x{TILE} tile within its bounds")
        self.cover_tiles(key.column, key.row, key.column, key.row, of_peer=True)
        layer = self.layer(source)
        row, column = key.row - self.corner.row, key.column - self.corner.column
        held = self.tile(source, key)
        new = (held == 0) & (cells != 0)
        if version < layer.versions[row, column] or not new.any():
            return False
        held[new] = cells[new]
        layer.provisional[row, column] = True
        return True

    def place(self, source: int, pose: Pose | None) -> None:
        """Say where a source's frame lies in the drone's own (metres, radians), or (None) that it is not known.

        Raises InputError on the drone itself and on a pose that is not finite.
        """
        if source == self.own:
            raise InputError(f"source {source} is this drone itself: its frame is the map's")
        if pose is not None and not all(map(math.isfinite, pose)):
            raise InputError(f"placement {tuple(pose)} of source {source} is not finite")
        self._placements[source] = pose
        if pose is None or pose == IDENTITY:
            self._placed.pop(source, None)
        elif source not in self._placed or self._placed[source].pose != pose:
            self._placed[source] = PlacedLayer(pose)

    def placement(self, source: int) -> Pose | None:
        """Return where a source's frame lies in the own, metres and radians; None while that is not known."""
        return self._placements.get(source, IDENTITY if self.shares_frame else None)

    def placed(self) -> dict[int, NDArray[np.int8]]:
        """Return what of every placed source counts in the belief, int8 `[rows, columns]` on the own grid; views.

        The grid may grow to hold a layer in its new place; what lies beyond the largest extent is left out.
        """
        if not self._placed:  # all that count lie in the own frame as they are
            frames, unplaced = self._placements, IDENTITY if self.shares_frame else None
            return {
                source: layer.cells for source, layer in self.layers.items() if frames.get(source, unplaced) is not None
            }
        stale = {
            source: placed
            for source, placed in self._placed.items()
            if source in self.layers and not placed.is_current(self.layers[source].cells, self.origin_cells)
        }
        for source, placed in stale.items():
            extent = placed.extent(self.layers[source].cells, self.origin_cells)
            if extent is not None:
                with suppress(InputError):  # far away: what fits is drawn
                    self.cover(*extent, of_peer=True)
        if stale:  # the grid may have grown under all of them
            for source, placed in self._placed.items():
                if source in self.layers:
                    placed.refresh(self.layers[source].cells, self.origin_cells)
        counted: dict[int, NDArray[np.int8]] = {}
        for source, layer in self.layers.items():
            if source in self._placed:
                counted[source] = self._placed[source].cells
            elif self.placement(source) is not None:
                counted[source] = layer.cells
        return counted

    def belief(self) -> NDArray[np.int8]:
        """Return the clamped sum over placed sources, int8 `[rows, columns]`: negative free, positive occupied.

        0 is unknown. The grid may grow first, see `placed`: ask for `origin_cells` afterwards.
        """
        layers = list(self.placed().values())
        out = np.empty(self.shape, np.int8)
        sum_layers(np.stack(layers), out)
        return out

    def begin_at(self, x: float, y: float) -> None:
        """Take it that the drone begins at (x, y), metres: there is to be room around it. Raises InputError."""
        self.cover(x, y, x, y)
        self._home = TileKey(math.floor(x / (CELL * TILE)), math.floor(y / (CELL * TILE)))

    def cover(self, x_min: float, y_min: float, x_max: float, y_max: float, of_peer: bool = False) -> None:
        """Grow the grid to hold a rectangle of the map frame, metres.

        Raises InputError past the largest extent, and for what is `of_peer` past what peers may take up.
        """
        side = CELL * TILE
        column_min, row_min = math.floor(x_min / side), math.floor(y_min / side)
        self.cover_tiles(column_min, row_min, math.floor(x_max / side), math.floor(y_max / side), of_peer)

    def cover_tiles(self, column_min: int, row_min: int, column_max: int, row_max: int, of_peer: bool = False) -> None:
        """Grow the grid to hold tiles from the least column and row to the greatest; raise InputError as `cover`."""
        column, row = self.corner
        if (
            column_min >= column
            and row_min >= row
            and column_max < column + self.tile_columns
            and row_max < row + self.tile_rows
        ):
            return
        half, home = self._max_tiles // 2, self._home
        if of_peer and (
            min(column_min - home.column, row_min - home.row) < -half
            or max(column_max - home.column, row_max - home.row) >= half
        ):
            raise InputError(
                f"a peer's tiles, columns {column_min} to {column_max} and rows {row_min} to {row_max}, lie far "
                f"outside: more than {half * CELL * TILE:.0f} m from where this drone began"
            )
        low = TileKey(min(column_min, column), min(row_min, row))
        high_column = max(column_max + 1, self.corner.column + self.tile_columns)
        high_row = max(row_max + 1, self.corner.row + self.tile_rows)
        rows, columns = high_row - low.row, high_column - low.column
        if rows > self._max_tiles or columns > self._max_tiles:
            raise InputError(
                f"the map would grow to {columns}x{rows} tiles, over the limit of {self._max_tiles} "
                f"({self._max_tiles * CELL * TILE:.0f} m): a pose or tile lies far outside"
            )
        for source, old in self.layers.items():
            new = Layer.empty(rows, columns)
            row, column = self.corner.row - low.row, self.corner.column - low.column
            tiles = slice(row, row + self.tile_rows), slice(column, column + self.tile_columns)
            new.versions[tiles], new.provisional[tiles] = old.versions, old.provisional
            new.cells[
                row * TILE : (row + self.tile_rows) * TILE, column * TILE : (column + self.tile_columns) * TILE
            ] = old.cells
            new.clock, new.boot = old.clock, old.boot
            self.layers[source] = new
        self.corner, self.tile_rows, self.tile_columns = low, rows, columns
