"""Lockstep markers: on a radio modem's link they say that all mesh traffic of a tick has been sent; never on air.

A marker is `IMTK` and the tick's stamp as a little-endian f64, seconds.
"""

from __future__ import annotations

import struct

MARKER_MAGIC = b"IMTK"
_MARKER = struct.Struct("<4sd")


def encode_marker(stamp: float) -> bytes:
    """Return the marker that ends a tick's mesh traffic; `stamp` in seconds."""
    return _MARKER.pack(MARKER_MAGIC, stamp)


def decode_marker(datagram: bytes) -> float | None:
    """Return the stamp of a marker, which may be no finite number; None when the datagram is a mesh message."""
    if len(datagram) != _MARKER.size or not datagram.startswith(MARKER_MAGIC):
        return None
    return float(_MARKER.unpack(datagram)[1])
