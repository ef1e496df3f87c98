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
KEY_BIAS, KEY_SPAN = MAX_TILES, 2 * MAX_TILES + 1
"""A tile's code is (column + KEY_BIAS) KEY_SPAN + row + KEY_BIAS, from 0 on: codes are in order where keys are."""
DAMAGED, OVERLONG = -1, -2
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
def decode_versions(data, codes, versions):  # type: ignore[no-untyped-def]
    """Read a list from `data` (uint8) into `codes` and `versions` (int64); return how many tiles it tells.

    Sorted by code, see `KEY_BIAS`. OVERLONG where it claims to tell more than there is room for; DAMAGED where it is
    not sorted, out of bounds, or has more behind it than zeros.
    """
    zeros = np.empty(VERSION_CONTEXTS, np.int64)
    zeros[:] = ONE // 2
    count, state = decode_number(data, start_decoder(data), zeros, _COUNT)
    if count > len(codes):
        return np.int64(OVERLONG)
    column, row, first_row, version = -BIAS, np.int64(0), np.int64(0), np.int64(0)
    for k in range(count):
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
                return np.int64(DAMAGED)
        column += column_step
        step, state = decode_number(data, state, zeros, _VERSION)
        version += _unzigzag(step)
        if abs(column) > MAX_TILES or abs(row) > MAX_TILES or version < 0 or version >= 1 << 32:
            return np.int64(DAMAGED)
        codes[k], versions[k] = (column + KEY_BIAS) * KEY_SPAN + row + KEY_BIAS, version
    return count if has_only_zeros_left(data, state) else np.int64(DAMAGED)
