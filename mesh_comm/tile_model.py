"""How likely a tile's cells are, given their neighbours: what the range coder packs a tile by.

Cells go row by row. Of the cells W, N, NW and NE of one, each is of one of five classes (0 unknown, 1 surely free,
2 freer than not, 3 more occupied than not, 4 surely occupied), and the classes choose the contexts of the bits that
tell the cell: does it differ from W; if so, is it surely free, is it unknown, is it surely occupied (leaving out what W
is); else its sign and the three digits of its size. What Weinberger, Seroussi and Sapiro (1996) do for grey images, but
with chances that are fixed: maps are alike, and a tile is too small to learn from.

Off the tile: in the first row W stands for N, NW and NE, and the first W is 0; in the first column N stands for W and
NW; in the last column N stands for NE.

A first bit tells that the tile is plain instead: 5 bits a cell, which bounds what noise may take.
"""

from __future__ import annotations

import numba
import numpy as np

from imagine.core.raster import LIMIT, TILE
from imagine.mesh_comm.range_coder import ONE, decode_bit, is_used_up, start_decoder

CLASSES = 5
PLAIN = 1
"""The context of the first bit."""
DIFFERS = 2
"""Where the contexts of "differs from W" begin, by the classes of W, N, NW and NE."""
CANDIDATES = DIFFERS + CLASSES**4
"""... of "is surely free", then of "is unknown", then of "is surely occupied", each by the classes of W, N and NE."""
SIGN = CANDIDATES + 3 * CLASSES**3
"""... of "is more occupied than not", by the classes of W and N."""
SIZES = SIGN + CLASSES**2
"""... of the digits of the size, by sign, by the classes of W and N, and by the digits before (1, 2-3, 4-7 of 8)."""
TILE_CONTEXTS = SIZES + 2 * CLASSES**2 * 8
MOST_TILE_STEPS = 1 + 8 * TILE * TILE
_PLAIN_BITS = 5
PLAIN_TILE_BYTES = (_PLAIN_BITS * TILE * TILE + 11) // 8 + 4
"""A plain tile is not longer."""


@numba.njit(cache=True, nogil=True)
def _class(value):  # type: ignore[no-untyped-def]
    if value == 0:
        return 0
    if value < 0:
        return 1 if value == -LIMIT else 2
    return 4 if value == LIMIT else 3


@numba.njit(cache=True, nogil=True)
def tile_steps(cells, steps):  # type: ignore[no-untyped-def]
    """Write the steps that tell `cells` (int8 `[TILE, TILE]`, within ±LIMIT) into `steps`; return how many.

    `steps` int16 `[MOST_TILE_STEPS]`.
    """
    steps[0] = 2 * PLAIN
    at = 1
    for i in range(TILE):
        west = np.int64(cells[i - 1, 0]) if i > 0 else 0
        w = _class(west)
        n = nw = ne = w
        for j in range(TILE):
            if i > 0:
                n = _class(cells[i - 1, j])
                ne = _class(cells[i - 1, j + 1]) if j + 1 < TILE else n
            else:
                n = nw = ne = w
            value = np.int64(cells[i, j])
            context = DIFFERS + ((w * CLASSES + n) * CLASSES + nw) * CLASSES + ne
            if value == west:
                steps[at] = 2 * context
                at += 1
            else:
                steps[at] = 2 * context + 1
                at = _other_steps(value, west, w, n, ne, steps, at + 1)
            west, w, nw = value, _class(value), n
    return at


@numba.njit(cache=True, nogil=True)
def _other_steps(value, west, w, n, ne, steps, at):  # type: ignore[no-untyped-def]
    """Write the steps of a cell that differs from W."""
    pair = w * CLASSES + n
    context = CANDIDATES + pair * CLASSES + ne
    for candidate in (-LIMIT, 0, LIMIT):
        if candidate != west:
            steps[at] = 2 * context + (1 if value == candidate else 0)
            at += 1
            if value == candidate:
                return at
        context += CLASSES**3
    is_positive = 1 if value > 0 else 0
    steps[at] = 2 * (SIGN + pair) + is_positive
    tree = SIZES + (is_positive * CLASSES**2 + pair) * 8
    size, node = abs(value), 1
    for k in range(3):
        digit = (size >> (2 - k)) & 1
        steps[at + 1 + k] = 2 * (tree + node) + digit
        node = 2 * node + digit
    return at + 4


@numba.njit(cache=True, nogil=True)
def plain_tile_steps(cells, steps):  # type: ignore[no-untyped-def]
    """Write the steps that tell `cells` whatever they hold; return how many."""
    steps[0] = 2 * PLAIN + 1
    at = 1
    for i in range(TILE):
        for j in range(TILE):
            code = np.int64(cells[i, j]) + LIMIT
            for k in range(_PLAIN_BITS - 1, -1, -1):
                steps[at] = (code >> k) & 1
                at += 1
    return at


@numba.njit(cache=True, nogil=True)
def decode_tile(data, zeros, cells):  # type: ignore[no-untyped-def]
    """Read `cells` (int8 `[TILE, TILE]`) from `data` (uint8); return whether they are sound and no bytes are left.

    `zeros` int64 `[TILE_CONTEXTS]`. Takes the same time and memory whatever the bytes; no cell is beyond ±LIMIT.
    """
    is_plain, state = decode_bit(data, start_decoder(data), zeros[PLAIN])
    if is_plain == 1:
        return _decode_plain(data, state, cells)
    above = np.zeros(TILE + 1, np.int64)  # classes: of the row above, and of this row as far as it is read
    west = np.int64(0)
    for i in range(TILE):
        if i > 0:
            west = np.int64(cells[i - 1, 0])
            above[TILE] = above[TILE - 1]
        w = _class(west)
        n = nw = ne = w
        for j in range(TILE):
            if i > 0:
                n, ne = above[j], above[j + 1]
            else:
                n = nw = ne = w
            context = DIFFERS + ((w * CLASSES + n) * CLASSES + nw) * CLASSES + ne
            differs, state = decode_bit(data, state, zeros[np.uint64(context)])
            if differs == 1:
                west, state = _decode_other(data, state, zeros, west, w, n, ne)
                w = _class(west)
            cells[i, j] = west
            above[j] = w
            nw = n
    return is_used_up(data, state)


@numba.njit(cache=True, nogil=True)
def decode_tiles(data, ends, zeros, cells):  # type: ignore[no-untyped-def]
    """Read `cells` (int8 `[n, TILE, TILE]`), tile k from the bytes of `data` before `ends[k]` (int64 `[n]`).

    Return how many tiles are sound before the first that is not, which ends it.
    """
    first = np.int64(0)
    for k in range(len(ends)):
        if not decode_tile(data[first : ends[k]], zeros, cells[k]):
            return k
        first = ends[k]
    return len(ends)


@numba.njit(cache=True, nogil=True)
def _decode_other(data, state, zeros, west, w, n, ne):  # type: ignore[no-untyped-def]
    """Return a cell that differs from W, and the state after it."""
    pair = w * CLASSES + n
    context = CANDIDATES + pair * CLASSES + ne
    for candidate in (-LIMIT, 0, LIMIT):
        if candidate != west:
            is_it, state = decode_bit(data, state, zeros[np.uint64(context)])
            if is_it == 1:
                return np.int64(candidate), state
        context += CLASSES**3
    is_positive, state = decode_bit(data, state, zeros[SIGN + pair])
    tree = SIZES + (is_positive * CLASSES**2 + pair) * 8
    node = np.int64(1)
    for _ in range(3):
        digit, state = decode_bit(data, state, zeros[tree + node])
        node = 2 * node + digit
    return np.int64(node - 8 if is_positive == 1 else 8 - node), state


@numba.njit(cache=True, nogil=True)
def _decode_plain(data, state, cells):  # type: ignore[no-untyped-def]
    """Read the cells of a plain tile."""
    for i in range(TILE):
        for j in range(TILE):
            code = 0
            for _ in range(_PLAIN_BITS):
                digit, state = decode_bit(data, state, ONE // 2)
                code = 2 * code + digit
            if code > 2 * LIMIT:
                return False
            cells[i, j] = code - LIMIT
    return is_used_up(data, state)
