"""What happens to a peer's scan when it arrives, in one compiled pass: from its bytes to marks on the peer's layer."""

from __future__ import annotations

import numba
import numpy as np

from imagine.core.peer_marks import add_marks_ahead, mask_targets
from imagine.core.raster import TILE, mark_scan
from imagine.mesh_comm.known_cells import find_marked
from imagine.mesh_comm.scan_model import decode_scan

DAMAGED = -1
"""What `draw_packed_scan` returns for bytes that tell no scan."""
_BEYOND_CAP_M = 1.0  # a teammate stands out of the scan from so far behind the cap on


@numba.njit(cache=True, nogil=True)
def _reach_is_newer(versions, clock, row0, column0, rows, columns):  # type: ignore[no-untyped-def]
    """Tell whether every tile under a sheet of marks, as far as it is on the grid, is of version `clock` or later."""
    tile_rows, tile_columns = versions.shape
    for row in range(max(0, row0 // TILE), min(tile_rows, (row0 + rows - 1) // TILE + 1)):
        for column in range(max(0, column0 // TILE), min(tile_columns, (column0 + columns - 1) // TILE + 1)):
            if np.int64(versions[row, column]) < clock:
                return False
    return True


@numba.njit(cache=True, nogil=True)
def draw_packed_scan(  # type: ignore[no-untyped-def]
    packed, chances, metres, beams,
    x, y, yaw, start, increment, directions, range_cap, reach, width, starts, offsets, targets, radius,
    cells, versions, provisional, clock, grid_row, grid_column, known, found,
):  # fmt: skip
    """Read a scan and draw it ahead of its source's tiles; return how many cells may have become known, or DAMAGED.

    `packed` uint8 with `beams` ranges, `chances` int64 `[SCAN_CONTEXTS]` (left as they are), `metres` float32 what the
    codes stand for. Pose, `start` and `increment` in metres and radians, the frame of the layer; `directions` of
    `beam_directions`; `reach`, `width`, `starts`, `offsets` of the cap's `RayTable`. Returns within `radius` of
    `targets` (float64 `[n, 2]`) are left out. `cells`, `versions`, `provisional` are the layer, the grid's first cell
    (`grid_row`, `grid_column`); tiles of version `clock` or later stay. `known` and `found` are those of `find_marked`,
    `known` empty where nobody counts. Nothing is drawn of a damaged scan.
    """
    codes = np.empty(beams, np.int64)
    if not decode_scan(packed, chances.copy(), len(metres) - 1, codes):
        return DAMAGED
    ends = 2 * reach + 1
    ranges = np.empty(beams, np.float32)
    for beam in range(beams):
        ranges[beam] = metres[np.uint64(codes[beam])]
    if len(targets) > 0:
        ranges = mask_targets(ranges, start, increment, range_cap + _BEYOND_CAP_M, (x, y, yaw), targets, radius)
    marks = np.empty((ends, width), np.int8)
    first_row, first_column = mark_scan(marks, x, y, yaw, directions, ranges, 0.0, range_cap, starts, offsets)
    row0, column0 = first_row - grid_row, first_column - grid_column
    if _reach_is_newer(versions, clock, row0, column0, ends, width):
        return 0
    add_marks_ahead(cells, versions, provisional, clock, marks, row0, column0)
    return find_marked(marks, row0, column0, known, found)
