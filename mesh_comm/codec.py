"""Small binary forms of scans, tiles and version lists: range-coded, exact, and alike on every machine.

What is packed is told in whole numbers alone (`scan_model`, `tile_model`, `version_model`, by `range_coder`), and no
bytes, however damaged, take more time or memory to read than sound ones.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from itertools import accumulate

import numpy as np
from numpy.typing import NDArray

from imagine.core.errors import InputError
from imagine.core.evidence import TileKey
from imagine.core.raster import LIMIT, RANGE_STEP_M, TILE
from imagine.mesh_comm.chances import load_chances
from imagine.mesh_comm.range_coder import MOST_NUMBER_STEPS, ONE, encode_steps
from imagine.mesh_comm.scan_model import FIRST_RANGE, INVALID, MOST_BEAM_STEPS, NO_RETURN, decode_scan, scan_steps
from imagine.mesh_comm.tile_model import (
    MOST_TILE_STEPS,
    PLAIN_TILE_BYTES,
    decode_tile,
    decode_tiles,
    plain_tile_steps,
    tile_steps,
)
from imagine.mesh_comm.version_model import (
    KEY_BIAS,
    KEY_SPAN,
    MOST_ENTRY_STEPS,
    MOST_LISTED,
    OVERLONG,
    TILES_A_BYTE,
    VERSION_CONTEXTS,
    decode_versions,
    version_steps,
)

_CHANCES = load_chances()
SCAN_CHANCES = _CHANCES.scan
"""Where the chances of every scan start, int64 `[SCAN_CONTEXTS]`; not to be changed."""
_SPARE_BYTES = 8  # what the coder wants free behind its last byte
_MOST_BEAM_BYTES = 24  # no step takes more than 11 bits: two of kind, 12 and 11 of a size up to 3000, one of sign
_MOST_ENTRY_BYTES = 192  # three numbers, each of at most 40 steps that learn, and 39 digits


def pack_ranges(ranges: NDArray[np.float32], range_min: float, range_cap: float) -> bytes:
    """Return ranges as bytes: to the centimetre, beyond `range_cap` as no return, below `range_min` as invalid."""
    codes = range_codes(ranges, range_min, range_cap)
    steps = np.empty(MOST_BEAM_STEPS * len(codes), np.int16)
    count = scan_steps(codes, largest_code(range_cap), steps)
    out = np.empty(_MOST_BEAM_BYTES * len(codes) + _SPARE_BYTES, np.uint8)
    return out[: encode_steps(steps, count, _CHANCES.scan.copy(), True, out)].tobytes()


def range_codes(ranges: NDArray[np.float32], range_min: float, range_cap: float) -> NDArray[np.int64]:
    """Return what ranges in metres are sent as: 0 invalid, 1 no return, or centimetres plus 2; int64 `[beams]`."""
    r = ranges.astype(np.float64)
    with np.errstate(invalid="ignore"):
        measured = (r >= range_min) & (r <= range_cap)
        codes = np.where(r > range_cap, NO_RETURN, INVALID).astype(np.int64)
    # never rounded past the cap: a hit just inside it must not turn into free space
    steps = np.clip(np.rint(r[measured] / RANGE_STEP_M), 1, largest_code(range_cap) - FIRST_RANGE)
    codes[measured] = steps.astype(np.int64) + FIRST_RANGE
    return codes


def unpack_ranges(packed: bytes, beams: int, range_cap: float) -> NDArray[np.float32]:
    """Return `[beams]` ranges in metres, no return = inf, invalid = nan.

    Raises InputError on bytes left over and on ranges beyond `range_cap`.
    """
    codes = np.empty(beams, np.int64)
    if not decode_scan(np.frombuffer(packed, np.uint8), _CHANCES.scan.copy(), largest_code(range_cap), codes):
        raise InputError(f"mesh scan: {len(packed)} bytes do not tell {beams} ranges up to {range_cap} m")
    ranges: NDArray[np.float32] = code_metres(range_cap)[codes]
    return ranges


def pack_tile(cells: NDArray[np.int8]) -> bytes:
    """Return the cells of a tile, int8 `[TILE, TILE]` within ±LIMIT, as bytes; none packs into more than a datagram."""
    if cells.shape != (TILE, TILE) or cells.dtype != np.int8 or cells.max() > LIMIT or cells.min() < -LIMIT:
        raise InputError(f"mesh tile of {cells.dtype} {cells.shape}, expected int8 {TILE}x{TILE} within ±{LIMIT}")
    cells = np.ascontiguousarray(cells)
    steps = np.empty(MOST_TILE_STEPS, np.int16)
    out = np.empty(PLAIN_TILE_BYTES + _SPARE_BYTES, np.uint8)
    size = encode_steps(steps, tile_steps(cells, steps), _CHANCES.tile, False, out)
    if not 0 <= size < PLAIN_TILE_BYTES:
        size = encode_steps(steps, plain_tile_steps(cells, steps), _CHANCES.tile, False, out)
    return out[:size].tobytes()


def unpack_tile(packed: bytes) -> NDArray[np.int8]:
    """Return the cells of a tile, int8 `[TILE, TILE]` within ±LIMIT. Raises InputError on bytes that tell no tile."""
    cells = np.empty((TILE, TILE), np.int8)
    if not decode_tile(np.frombuffer(packed, np.uint8), _CHANCES.tile, cells):
        raise InputError(f"mesh tile: {len(packed)} bytes do not tell {TILE}x{TILE} cells within ±{LIMIT}")
    return cells


def unpack_tiles(packed: Sequence[bytes]) -> NDArray[np.int8]:
    """Return the cells of tiles, int8 `[n, TILE, TILE]`, each as `unpack_tile` does. Raises InputError if any fails."""
    ends = np.array(list(accumulate(map(len, packed))), np.int64)
    cells = np.empty((len(packed), TILE, TILE), np.int8)
    sound = decode_tiles(np.frombuffer(b"".join(packed), np.uint8), ends, _CHANCES.tile, cells)
    if sound < len(packed):
        raise InputError(f"mesh tile: {len(packed[sound])} bytes do not tell {TILE}x{TILE} cells within ±{LIMIT}")
    return cells


def pack_versions(versions: Mapping[TileKey, int]) -> bytes:
    """Return at most `MOST_LISTED` tile versions, each below 2^32, as bytes."""
    entries = np.array([(*key, versions[key]) for key in sorted(versions)], np.int64).reshape(-1, 3)
    count = len(entries)
    if count > MOST_LISTED:
        raise InputError(f"mesh version list of {count} tiles, expected {MOST_LISTED} at most: split it")
    steps = np.empty(MOST_NUMBER_STEPS + count * MOST_ENTRY_STEPS, np.int16)
    out = np.empty((1 + count) * _MOST_ENTRY_BYTES, np.uint8)
    size = encode_steps(steps, version_steps(entries, steps), _even_odds(VERSION_CONTEXTS), True, out)
    return out[:size].tobytes().ljust((count - 1) // TILES_A_BYTE, b"\0")


def unpack_versions(packed: bytes) -> dict[TileKey, int]:
    """Return the tile versions of `pack_versions`. Raises InputError on bytes that tell no list."""
    return {
        TileKey(code // KEY_SPAN - KEY_BIAS, code % KEY_SPAN - KEY_BIAS): version
        for code, version in unpack_coded_versions(packed).items()
    }


def unpack_coded_versions(packed: bytes) -> dict[int, int]:
    """Return what `unpack_versions` does by `tile_code`, which takes a third of the time."""
    room = min(TILES_A_BYTE * (len(packed) + 1), MOST_LISTED)
    codes, versions = np.empty((2, room), np.int64)
    count = decode_versions(np.frombuffer(packed, np.uint8), codes, versions)
    if count == OVERLONG:
        raise InputError(f"mesh version list: {len(packed)} bytes claim to tell of more than {room} tiles")
    if count < 0:
        raise InputError(f"mesh version list: {len(packed)} bytes do not tell of tiles that a map can hold")
    return dict(zip(codes[:count].tolist(), versions[:count].tolist(), strict=True))


def tile_code(key: tuple[int, int]) -> int:
    """Return one number for a tile's column and row, within the largest map; numbers are in order where keys are."""
    return (key[0] + KEY_BIAS) * KEY_SPAN + key[1] + KEY_BIAS


def tile_of(code: int) -> TileKey:
    """Return the tile that a number of `tile_code` is of."""
    column, row = divmod(code, KEY_SPAN)
    return TileKey(column - KEY_BIAS, row - KEY_BIAS)


@lru_cache(maxsize=8)
def code_metres(range_cap: float) -> NDArray[np.float32]:
    """Return the range in metres of every code up to the largest."""
    steps = np.arange(largest_code(range_cap) + 1) - FIRST_RANGE
    metres: NDArray[np.float32] = np.minimum(steps * RANGE_STEP_M, range_cap).astype(np.float32)
    # nor rounded past it as float32, as 2.4 m would be: a receiver would draw free space where the hit is
    beyond = metres.astype(np.float64) > range_cap
    metres[beyond] = np.nextafter(metres[beyond], np.float32(0.0))
    metres[INVALID], metres[NO_RETURN] = np.nan, np.inf
    return metres


def largest_code(range_cap: float) -> int:
    """Return the greatest code of a range up to `range_cap` metres."""
    return math.floor(range_cap / RANGE_STEP_M + 1e-9) + FIRST_RANGE


def _even_odds(contexts: int) -> NDArray[np.int64]:
    return np.full(contexts, ONE // 2, np.int64)
