"""Lists of tile versions, as the range coder packs them: sorted by key, each as the difference to the one before.

All numbers learn from even odds. First the count; then for each tile its column step; its row step, zigzag (from the
row before, or where the column steps, from the row that the column before began with); and its version's difference to
the version before, zigzag. The first tile follows column `-BIAS`, row 0 and version 0.
"""

from __future__ import annotations

import numba
import numpy as np

from imagine.core.evidence import MAX_TILES
from imagine.mesh_comm.range_coder import (
    MOST_NUMBER_STEPS,
    NUMBER_CONTEXTS,
    ONE,
    decode_number,
    has_only_zeros_left,
    number_steps,
    start_decoder,
)

BIAS = MAX_TILES + 1
"""What is added to columns, so that the first is above 0."""
MOST_LISTED = 4096
"""No list holds more tiles."""
TILES_A_BYTE = 64
"""Nor more tiles than this for each of its bytes, and so many again: what a few bytes cost to read is bounded.

Zeros make up for missing bytes.
"""
_COUNT, _COLUMN, _ROW, _ROW_AFTER, _VERSION = (1 + k * NUMBER_CONTEXTS for k in range(5))
VERSION_CONTEXTS = 1 + 5 * NUMBER_CONTEXTS
MOST_ENTRY_STEPS = 3 * MOST_NUMBER_STEPS


@numba.njit(cache=True, nogil=True)
def _zigzag(value):  # type: ignore[no-untyped-def]
    """Return 0, 1, 2, 3, 4 ... for 0, -1, 1, -2, 2 ..."""
    return 2 * value if value >= 0 else -2 * value - 1


@numba.njit(cache=True, nogil=True)
def _unzigzag(value):  # type: ignore[no-untyped-def]
    return value >> 1 if value & 1 == 0 else -((value + 1) >> 1)


@numba.njit(cache=True, nogil=True)
def version_steps(entries, steps):  # type: ignore[no-untyped-def]
    """Write the steps that tell `entries` (int64 `[n, 3]`: column, row, version, sorted); return how many.

    `steps` int16 `[MOST_NUMBER_STEPS + n MOST_ENTRY_STEPS]`.
    """
    at = number_steps(len(entries), _COUNT, steps, 0)
    column, row, first_row, version = -BIAS, np.int64(0), np.int64(0), np.int64(0)
    for k in range(len(entries)):
        column_step = entries[k, 0] - column
        at = number_steps(column_step, _COLUMN, steps, at)
        if column_step > 0:
            at = number_steps(_zigzag(entries[k, 1] - first_row), _ROW, steps, at)
            first_row = entries[k, 1]
        else:
            at = number_steps(_zigzag(entries[k, 1] - row), _ROW_AFTER, steps, at)
        at = number_steps(_zigzag(entries[k, 2] - version), _VERSION, steps, at)
        column, row, version = entries[k, 0], entries[k, 1], entries[k, 2]
    return at


@numba.njit(cache=True, nogil=True)
def decode_count(data, zeros):  # type: ignore[no-untyped-def]
    """Begin to read a list from `data` (uint8); return how many tiles it claims to hold, and the decoder's state.

    `zeros` int64 `[VERSION_CONTEXTS]` become even odds, and learn.
    """
    zeros[:] = ONE // 2
    return decode_number(data, start_decoder(data), zeros, _COUNT)


@numba.njit(cache=True, nogil=True)
def decode_entries(data, zeros, state, entries):  # type: ignore[no-untyped-def]
    """Read `entries` (int64 `[count, 3]`) behind the count; return whether they are sorted, in bounds, and the last.

    `zeros` and `state` as `decode_count` left them.
    """
    column, row, first_row, version = -BIAS, np.int64(0), np.int64(0), np.int64(0)
    for k in range(len(entries)):
        column_step, state = decode_number(data, state, zeros, _COLUMN)
        before = row
        if column_step > 0:
            step, state = decode_number(data, state, zeros, _ROW)
            row = first_row + _unzigzag(step)
            first_row = row
        else:
            step, state = decode_number(data, state, zeros, _ROW_AFTER)
            row += _unzigzag(step)
            if k > 0 and row <= before:
                return False
        column += column_step
        step, state = decode_number(data, state, zeros, _VERSION)
        version += _unzigzag(step)
        if abs(column) > MAX_TILES or abs(row) > MAX_TILES or version < 0 or version >= 1 << 32:
            return False
        entries[k, 0], entries[k, 1], entries[k, 2] = column, row, version
    return has_only_zeros_left(data, state)
