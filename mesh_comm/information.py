"""What a tile would tell a peer: cells that it does not know yet, and more for those at the edge of the unknown.

Whole numbers only, so that `sim.air_plan` ranks by the same numbers.
"""

from __future__ import annotations

import numba
import numpy as np

from imagine.core.raster import TILE

FRONTIER_WORTH = 4
"""A free cell beside unknown ones is worth so many cells more: it tells where to go on, or that nobody need."""
TYPICAL_TILE_BYTES = 80
"""A packed tile of a flight, where its own size is not known yet."""
NO_NEWS_S = 2.0
"""So long after the last scan one goes out that shows no cell but what scans before it told, and only changes it."""
_SCALE = 64
MOST_DENSITY = 2**20 - 1
"""No tile ranks higher: all cells of a tile at the frontier, new to 31 peers, for 20 bytes."""


@numba.njit(cache=True, nogil=True)
def tile_news(cells, row0, column0, peer_cells):  # type: ignore[no-untyped-def]
    """Return (fresh, edge, known) of the tile of `cells` (int8 `[rows, columns]`) that starts at (row0, column0).

    `fresh` cells have evidence here and none in `peer_cells` (the same grid; of another shape: nothing is known of the
    peer); `edge` of them are free and beside a cell of the tile without any; `known` have evidence here.
    """
    fresh, edge, known = np.int64(0), np.int64(0), np.int64(0)
    has_peer = peer_cells.shape == cells.shape
    for i in range(TILE):
        row = row0 + i
        for j in range(TILE):
            column = column0 + j
            value = cells[row, column]
            if value == 0:
                continue
            known += 1
            if has_peer and peer_cells[row, column] != 0:
                continue
            fresh += 1
            if value < 0 and (
                (i > 0 and cells[row - 1, column] == 0)
                or (i < TILE - 1 and cells[row + 1, column] == 0)
                or (j > 0 and cells[row, column - 1] == 0)
                or (j < TILE - 1 and cells[row, column + 1] == 0)
            ):
                edge += 1
    return fresh, edge, known


@numba.njit(cache=True, nogil=True)
def known_cells(cells, row0, column0):  # type: ignore[no-untyped-def]
    """Return how many cells of the tile that starts at (row0, column0) have evidence."""
    known = np.int64(0)
    for i in range(TILE):
        row_known = np.int8(0)
        for j in range(TILE):
            row_known = np.int8(row_known + np.int8(cells[np.uintp(row0 + i), np.uintp(column0 + j)] != 0))
        known += np.int64(row_known)
    return known


@numba.njit(cache=True, nogil=True)
def unsent_share(fresh, edge, known, known_when_sent):  # type: ignore[no-untyped-def]
    """Return (cells, worth): what a tile tells of `tile_news` to a peer that holds it as it was when last sent.

    `known_when_sent` 0: the peer holds nothing of it. What was known then is taken to be as fresh as the rest.
    """
    if known <= known_when_sent:
        return np.int64(0), np.int64(0)
    cells = fresh * (known - known_when_sent) // known
    return cells, (fresh + FRONTIER_WORTH * edge) * (known - known_when_sent) // known


@numba.njit(cache=True, nogil=True)
def density(worth, packed_bytes):  # type: ignore[no-untyped-def]
    """Return what a byte of a tile brings, in whole numbers to rank by: `worth` summed over peers."""
    return min(np.int64(MOST_DENSITY), worth * _SCALE // max(packed_bytes, 1))
