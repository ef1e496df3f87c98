"""Small binary forms of scans, tiles and version lists, compressed with zstandard and checked when read."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import zstandard
from numpy.typing import NDArray

from imagine.core.errors import InputError
from imagine.core.evidence import MAX_TILES, TileKey
from imagine.core.raster import LIMIT, TILE

RANGE_STEP_M = 0.01
"""Ranges are rounded to the centimetre: an error of 5 mm at most, half the reference sensor's noise."""
_INVALID, _NO_RETURN = 0, 1
_FIRST = 2  # codes from here on are ranges, in steps
_MAX_VERSIONS = MAX_TILES**2  # no map holds more

_compressor = zstandard.ZstdCompressor(level=9, write_checksum=False)
_decompressor = zstandard.ZstdDecompressor()


def pack_ranges(ranges: NDArray[np.float32], range_min: float, range_cap: float) -> bytes:
    """Return ranges as bytes: to the centimetre, beyond `range_cap` as no return, below `range_min` as invalid.

    Differences between neighbouring beams are small and cluster around zero; low and high bytes are kept apart.
    """
    r = ranges.astype(np.float64)
    with np.errstate(invalid="ignore"):
        measured = (r >= range_min) & (r <= range_cap)
        codes = np.where(r > range_cap, _NO_RETURN, _INVALID).astype(np.uint16)
    # never rounded past the cap: a hit just inside it must not turn into free space
    steps = np.clip(np.rint(r[measured] / RANGE_STEP_M), 1, np.floor(range_cap / RANGE_STEP_M + 1e-9))
    codes[measured] = steps.astype(np.uint16) + _FIRST
    difference = np.diff(codes, prepend=np.uint16(0)).view(np.int16)
    zigzag = ((difference << 1) ^ (difference >> 15)).view(np.uint16)
    return _compress(_planes(zigzag))


def unpack_ranges(packed: bytes, beams: int, range_cap: float) -> NDArray[np.float32]:
    """Return `[beams]` ranges in metres, no return = inf, invalid = nan.

    Raises InputError on damaged bytes and on ranges beyond `range_cap`.
    """
    zigzag = _from_planes(_decompress(packed, 2 * beams), np.dtype("<u2"))
    difference = (zigzag >> 1).view(np.int16) ^ -(zigzag & 1).view(np.int16)
    codes = np.cumsum(difference, dtype=np.int16).view(np.uint16)
    if codes.max() > range_cap / RANGE_STEP_M + _FIRST + 0.5:
        raise InputError(f"mesh scan holds ranges beyond its cap of {range_cap} m")
    metres = np.minimum((codes.astype(np.float64) - _FIRST) * RANGE_STEP_M, range_cap)
    ranges: NDArray[np.float32] = metres.astype(np.float32)
    ranges[codes == _INVALID] = np.nan
    ranges[codes == _NO_RETURN] = np.inf
    return ranges


def pack_tile(cells: NDArray[np.int8]) -> bytes:
    """Return the cells of a tile, int8 `[TILE, TILE]`, as bytes."""
    return _compress(np.ascontiguousarray(cells).tobytes())


def unpack_tile(packed: bytes) -> NDArray[np.int8]:
    """Return the cells of a tile, int8 `[TILE, TILE]`. Raises InputError on damaged bytes or evidence out of range."""
    cells = np.frombuffer(_decompress(packed, TILE * TILE), np.int8).reshape(TILE, TILE)
    if cells.max() > LIMIT or cells.min() < -LIMIT:
        raise InputError(f"mesh tile holds evidence beyond ±{LIMIT}")
    return cells


def pack_versions(versions: Mapping[TileKey, int]) -> bytes:
    """Return tile versions as bytes, sorted by key; keys as differences, which are mostly 0 and 1."""
    keys = sorted(versions)
    places = np.array(keys, np.int16).reshape(-1, 2)
    steps = np.diff(places, axis=0, prepend=np.zeros((1, 2), np.int16))
    numbers = np.array([versions[key] for key in keys], np.uint32)
    return _compress(_planes(steps[:, 0]) + _planes(steps[:, 1]) + _planes(numbers))


def unpack_versions(packed: bytes) -> dict[TileKey, int]:
    """Return the tile versions of `pack_versions`. Raises InputError on damaged bytes."""
    raw = _decompress(packed, None, limit=8 * _MAX_VERSIONS)
    if len(raw) % 8:
        raise InputError(f"mesh version list of {len(raw)} bytes is cut off")
    count = len(raw) // 8
    columns = np.cumsum(_from_planes(raw[: 2 * count], np.dtype("<i2")), dtype=np.int16)
    rows = np.cumsum(_from_planes(raw[2 * count : 4 * count], np.dtype("<i2")), dtype=np.int16)
    numbers = _from_planes(raw[4 * count :], np.dtype("<u4"))
    if count and max(abs(places).max() for places in (columns.astype(int), rows.astype(int))) > MAX_TILES:
        raise InputError("mesh version list holds a tile that no map can hold")
    entries = zip(columns.tolist(), rows.tolist(), numbers.tolist(), strict=True)
    return {TileKey(column, row): version for column, row, version in entries}


def _planes(values: NDArray[np.int16] | NDArray[np.uint16] | NDArray[np.uint32]) -> bytes:
    """Return little-endian values with all lowest bytes first, then the next: high bytes repeat and compress away."""
    little = np.ascontiguousarray(values, values.dtype.newbyteorder("<"))
    return little.view(np.uint8).reshape(len(values), values.itemsize).T.tobytes()


def _from_planes(raw: bytes, dtype: np.dtype[np.generic]) -> NDArray[np.uint16]:
    planes = np.frombuffer(raw, np.uint8).reshape(dtype.itemsize, -1)
    return np.ascontiguousarray(planes.T).view(dtype).reshape(-1)


def _compress(raw: bytes) -> bytes:
    return _compressor.compress(raw)


def _decompress(packed: bytes, size: int | None, limit: int = 0) -> bytes:
    """Decompress to exactly `size` bytes (None: at most `limit`), refusing before it allocates more."""
    try:
        declared = zstandard.frame_content_size(packed)
        if declared < 0 or (declared > limit if size is None else declared != size):
            raise InputError(f"mesh message holds {declared} packed bytes, expected {size if size else f'<= {limit}'}")
        raw = _decompressor.decompress(packed, max_output_size=max(1, declared))
    except zstandard.ZstdError as error:
        raise InputError(f"mesh message holds bytes that do not decompress: {error}") from error
    if len(raw) != declared:
        raise InputError("mesh message holds packed bytes that are cut off")
    return raw
