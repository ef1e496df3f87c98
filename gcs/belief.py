"""The merged belief cut into versioned tiles, so that a reader can be sent only what changed."""

from __future__ import annotations

from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from imagine.core.evidence import EvidenceMap, TileKey
from imagine.core.raster import TILE
from imagine.gcs.snapshot import MapTile, MapView


class BeliefTiles:
    """Follows an evidence map: each `view` holds the belief, with every changed tile at a new version."""

    def __init__(self) -> None:
        """Start with nothing known."""
        self._view = MapView()

    def view(self, evidence: EvidenceMap) -> MapView:
        """Return the belief of now as an immutable view; the same object if nothing changed since the last."""
        belief = evidence.belief()
        rows, columns = evidence.tile_rows, evidence.tile_columns
        by_tile = belief.reshape(rows, TILE, columns, TILE)
        known: NDArray[np.bool_] = np.any(by_tile, axis=(1, 3))
        held = self._view.tiles
        # a source that corrects its trajectory may empty a tile: tiles once held are looked at again
        for key in held:
            known[key.row - evidence.corner.row, key.column - evidence.corner.column] = True
        version = self._view.version + 1
        changed: dict[TileKey, MapTile] = {}
        for row, column in np.argwhere(known):
            key = TileKey(int(column) + evidence.corner.column, int(row) + evidence.corner.row)
            cells = by_tile[row, :, column, :].tobytes()
            if key not in held or held[key].cells != cells:
                changed[key] = MapTile(version, cells)
        if changed:
            self._view = MapView(
                version=version,
                known_cells=int(np.count_nonzero(belief)),
                free_cells=int(np.count_nonzero(belief < 0)),
                tiles=MappingProxyType({**held, **changed}),
            )
        return self._view
