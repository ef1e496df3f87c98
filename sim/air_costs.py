"""What the messages of the mesh cost in bytes, sealed, without packing them: for the batched air.

Framing is counted exactly (MessagePack of `mesh_comm.messages`, the seal of `mesh_comm.seal`). Compressed parts are
estimated as a weighted sum of what makes them compress badly. The weights are fitted on messages of real nodes:
`python -m imagine.sim.air_fit` flies again and prints them, to be done whenever `mesh_comm.codec` changes.
"""

from __future__ import annotations

import numba
import numpy as np

from imagine.core.raster import LIMIT, RANGE_STEP_M, TILE
from imagine.mesh_comm.messages import MAX_DATAGRAM
from imagine.mesh_comm.seal import OVERHEAD

SCAN_WEIGHTS = (5.276, 0.417, 0.392, 0.716)
"""Bytes of a packed scan: in all, and per beam whose code differs from that before, by 8 or more, by 128 or more."""
TILE_WEIGHTS = (4.093, 0.047, 0.548, 0.295, 0.191)
"""Bytes of a packed tile: in all, per change along a row, per change that the row above has not, to a sure cell and to
an unsure one, and per unsure cell."""
VERSIONS_WEIGHTS = (-3.762, 1.924)
"""Bytes of a packed version list: in all, and per tile."""

_SCAN_BYTES = OVERHEAD + 73  # wire version, array, tag, sender, stamp, pose, angles, beams, cap, length of the ranges
_TILES_BYTES = OVERHEAD + 10  # wire version, array, tag, source, length of the list, boot number
_TILE_BYTES = 5  # array, column, row, length of the cells
_DIGEST_BYTES = OVERHEAD + 13  # wire version, array, tag, stamp, length of the list
_HOLDING_BYTES = 11  # array, source, two bounds of no interval, length of the versions, boot number
_STATUS_TEXT_BYTES = 8 + 6 + 9  # "OFFBOARD", "policy", "exploring": what a drone that explores has to tell
_TAUGHT_BYTES = 11 + 2 * 3  # the names scan and tile, and cells of each, up to 65535
_STATUS_BYTES = OVERHEAD + 112 + _STATUS_TEXT_BYTES + _TAUGHT_BYTES
_HERE_BYTES = OVERHEAD + 60  # wire version, array, tag, sender, stamp, pose, velocity
_LINK_BYTES = 10  # id and seconds
_LOWEST, _HIGHEST = np.int8(-LIMIT), np.int8(LIMIT)
_STEPS_A_METRE = round(1.0 / RANGE_STEP_M)


@numba.njit(cache=True, nogil=True)
def int_bytes(value):  # type: ignore[no-untyped-def]
    """Return the bytes MessagePack needs for a whole number, 0 or greater."""
    if value < 128:
        return 1
    if value < 256:
        return 2
    if value < 65536:
        return 3
    return 5 if value < 4294967296 else 9


@numba.njit(cache=True, nogil=True)
def blob_bytes(size):  # type: ignore[no-untyped-def]
    """Return the bytes that a blob takes beyond its content and the two bytes of the shortest header."""
    return size if size < 256 else size + 1


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _range_code(r, range_min, range_cap):  # type: ignore[no-untyped-def]
    """Return the number that a range is sent as, float32: centimetres + 2, 1 for no return, 0 for invalid."""
    code = np.floor(r * np.float32(_STEPS_A_METRE) + np.float32(0.5)) + np.float32(2.0)
    code = code if r >= range_min else np.float32(0.0)
    return np.float32(1.0) if r > range_cap else code


@numba.njit(cache=True, nogil=True, error_model="numpy")
def scan_features(ranges, range_min, range_cap):  # type: ignore[no-untyped-def]
    """Count the beams of `ranges` (float32, metres) whose code differs from the one before: at all, by 8, by 128."""
    low, high = np.float32(range_min), np.float32(range_cap)
    first = _range_code(ranges[0], low, high)  # sent as it is
    differing, far, jumps = np.int32(first >= 1.0), np.int32(first >= 8.0), np.int32(first >= 128.0)
    for beam in range(1, ranges.shape[0]):  # codes are made twice, for then nothing is carried along: vectors
        here, before = ranges[np.uintp(beam)], ranges[np.uintp(beam - 1)]
        difference = abs(_range_code(here, low, high) - _range_code(before, low, high))
        differing = np.int32(differing + np.int32(difference >= np.float32(1.0)))
        far = np.int32(far + np.int32(difference >= np.float32(8.0)))
        jumps = np.int32(jumps + np.int32(difference >= np.float32(128.0)))
    return differing, far, jumps


@numba.njit(cache=True, nogil=True)
def tile_features(cells, row0, column0):  # type: ignore[no-untyped-def]
    """Count, in the tile of `cells` (int8 `[rows, columns]`) that starts at (row0, column0), what is hard to compress.

    Changes along rows; those of them that the row above has not, to cells without evidence or with evidence at its
    limit, and to the others, which are unsure; and all unsure cells.
    """
    changes, news, unsure_news, unsure = np.int64(0), np.int64(0), np.int64(0), np.int64(0)
    for i in range(TILE):
        row = np.uintp(row0 + i)
        above = np.uintp(row0 + i - 1) if i > 0 else row
        row_changes, row_news, row_unsure_news, row_unsure = np.int8(0), np.int8(0), np.int8(0), np.int8(0)
        for j in range(TILE):
            row_unsure = np.int8(row_unsure + _is_unsure(cells[row, np.uintp(column0 + j)]))
        for j in range(1, TILE):
            here, left = np.uintp(column0 + j), np.uintp(column0 + j - 1)
            value, before = cells[row, here], cells[row, left]
            value_above, before_above = cells[above, here], cells[above, left]
            changed = np.int8(value != before)
            other = np.int8(np.int8(value != value_above) | np.int8(before != before_above))
            new = np.int8(changed & other) if i > 0 else changed
            row_changes = np.int8(row_changes + changed)
            row_news = np.int8(row_news + new)
            row_unsure_news = np.int8(row_unsure_news + np.int8(new & _is_unsure(value)))
        changes += np.int64(row_changes)
        news += np.int64(row_news - row_unsure_news)
        unsure_news += np.int64(row_unsure_news)
        unsure += np.int64(row_unsure)
    return changes, news, unsure_news, unsure


@numba.njit(cache=True, nogil=True)
def _is_unsure(value):  # type: ignore[no-untyped-def]
    return np.int8(value != 0) & np.int8(value != _LOWEST) & np.int8(value != _HIGHEST)


@numba.njit(cache=True, nogil=True)
def packed_tile_bytes(cells, row0, column0):  # type: ignore[no-untyped-def]
    """Estimate the bytes of `codec.pack_tile` for the tile of `cells` that starts at (row0, column0)."""
    changes, news, unsure_news, unsure = tile_features(cells, row0, column0)
    base, per_change, per_new, per_unsure_new, per_unsure = TILE_WEIGHTS
    size = base + per_change * changes + per_new * news + per_unsure_new * unsure_news + per_unsure * unsure
    return int(size + 0.5)


@numba.njit(cache=True, nogil=True)
def packed_versions_bytes(tiles):  # type: ignore[no-untyped-def]
    """Estimate the bytes of `codec.pack_versions` for so many tiles."""
    base, per_tile = VERSIONS_WEIGHTS
    return max(1, int(base + per_tile * tiles + 0.5))


@numba.njit(cache=True, nogil=True)
def packed_ranges_bytes(ranges, range_min, range_cap):  # type: ignore[no-untyped-def]
    """Estimate the bytes of `codec.pack_ranges`."""
    differing, far, jumps = scan_features(ranges, range_min, range_cap)
    base, per_differing, per_far, per_jump = SCAN_WEIGHTS
    return int(base + per_differing * differing + per_far * far + per_jump * jumps + 0.5)


@numba.njit(cache=True, nogil=True)
def scan_message_bytes(packed, clock):  # type: ignore[no-untyped-def]
    """Return the sealed bytes of a scan with so many bytes of packed ranges; beams are thinned until it fits."""
    return min(_SCAN_BYTES + int_bytes(clock) + blob_bytes(packed), MAX_DATAGRAM)


@numba.njit(cache=True, nogil=True)
def tiles_message_bytes(tiles):  # type: ignore[no-untyped-def]
    """Return the sealed bytes of a message of so many tiles, beside what `tile_in_message_bytes` counts for each."""
    return _TILES_BYTES + (0 if tiles < 16 else 2)


@numba.njit(cache=True, nogil=True)
def tile_in_message_bytes(packed, version):  # type: ignore[no-untyped-def]
    """Return what a tile adds to its message, given the bytes of its packed cells."""
    return _TILE_BYTES + int_bytes(version) + blob_bytes(packed)


@numba.njit(cache=True, nogil=True)
def digest_message_bytes(holdings, packed):  # type: ignore[no-untyped-def]
    """Return the sealed bytes of a digest of so many holdings with `packed` bytes of version lists in all."""
    return _DIGEST_BYTES + _HOLDING_BYTES * holdings + packed


@numba.njit(cache=True, nogil=True)
def here_bytes():  # type: ignore[no-untyped-def]
    """Return the sealed bytes of a message of where a drone is."""
    return _HERE_BYTES


@numba.njit(cache=True, nogil=True)
def status_bytes(counters, peers):  # type: ignore[no-untyped-def]
    """Return the sealed bytes of a status that tells these counters and when each of `peers` peers was heard."""
    size = _STATUS_BYTES + _LINK_BYTES * peers
    for count in counters:
        size += int_bytes(count)
    return size
