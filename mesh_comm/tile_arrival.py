"""What happens to a message of tiles when it arrives, in one compiled pass: the newer ones are written."""

from __future__ import annotations

import numba
import numpy as np

from imagine.core.peer_marks import write_tile
from imagine.core.raster import TILE
from imagine.mesh_comm.information import known_cells
from imagine.mesh_comm.known_cells import find_changes


@numba.njit(cache=True, nogil=True)
def write_tiles(  # type: ignore[no-untyped-def]
    tiles, entries, spares_provisional, cells, versions, provisional, first_row, first_column, known, found, taken, held
):
    """Write those of `tiles` (int8 `[n, TILE, TILE]`, within ±LIMIT) that are newer than what is held, in their order.

    `entries` int64 `[n, 3]`: column, row and version of each, all on the grid, whose first tile is (`first_row`,
    `first_column`). With `spares_provisional` tiles that hold scans are left alone. `cells`, `versions`, `provisional`
    are the layer. Fills in `taken` (bool `[n]`) and `held` (int64 `[n]`: the cells with evidence on the tile after all
    this); returns how many cells in `found` may have become known, as `find_changes` does.
    """
    count = 0
    for k in range(len(entries)):
        row, column = entries[k, 1] - first_row, entries[k, 0] - first_column
        taken[k] = False
        if (spares_provisional and provisional[row, column]) or entries[k, 2] <= np.int64(versions[row, column]):
            continue
        count = find_changes(cells, tiles[k], row * TILE, column * TILE, known, found, count)
        taken[k] = write_tile(cells, versions, provisional, row, column, entries[k, 2], tiles[k]) == 1
    for k in range(len(entries)):
        held[k] = known_cells(cells, (entries[k, 1] - first_row) * TILE, (entries[k, 0] - first_column) * TILE)
    return count
