"""One LiDAR scan in one UDP datagram: how the twin, or a small driver beside a real sensor, hands scans to a runner.

Little-endian: magic `IMLS`, version u8, reserved u8, beams u16, stamp f64 (seconds), start f32 and increment f32
(radians), then `beams` ranges as u16 millimetres; 0 is invalid, 65535 no return.
"""

from __future__ import annotations

import struct

import numpy as np

from imagine.core.errors import InputError
from imagine.core.lidar import LidarSpec, Scan

_HEADER = struct.Struct("<4sBBHdff")
_MAGIC = b"IMLS"
_VERSION = 1
_INVALID, _NO_RETURN, _LARGEST_MM = 0, 65535, 65534


def encode_scan(scan: Scan, spec: LidarSpec) -> bytes:
    """Return the datagram of a scan; ranges are rounded to the millimetre."""
    ranges = scan.ranges.astype(np.float64)
    millimetres = np.full(len(ranges), _INVALID, dtype="<u2")
    finite = np.isfinite(ranges)
    millimetres[finite] = np.clip(np.rint(ranges[finite] * 1000.0), 1, _LARGEST_MM).astype("<u2")
    millimetres[np.isposinf(ranges)] = _NO_RETURN
    header = _HEADER.pack(_MAGIC, _VERSION, 0, len(ranges), scan.stamp, spec.start, spec.increment)
    return header + millimetres.tobytes()


def decode_scan(datagram: bytes, spec: LidarSpec) -> Scan:
    """Read a scan datagram of the sensor `spec`. Raises InputError on anything malformed or of another sensor."""
    if len(datagram) < _HEADER.size:
        raise InputError(f"LiDAR datagram of {len(datagram)} bytes is shorter than its header")
    magic, version, _, beams, stamp, start, increment = _HEADER.unpack_from(datagram)
    if magic != _MAGIC or version != _VERSION:
        raise InputError(f"LiDAR datagram starts with {magic!r} version {version}, expected {_MAGIC!r} {_VERSION}")
    if len(datagram) != _HEADER.size + 2 * beams:
        raise InputError(f"LiDAR datagram of {len(datagram)} bytes does not hold its {beams} beams")
    if beams != spec.beams or abs(start - spec.start) > 1e-3 or abs(increment - spec.increment) > 1e-5:
        raise InputError(
            f"LiDAR sends {beams} beams of {increment:.5f} rad from {start:.3f} rad, "
            f"expected {spec.beams} of {spec.increment:.5f} from {spec.start:.3f}"
        )
    if not np.isfinite(stamp):
        raise InputError("LiDAR datagram has a stamp that is not finite")
    millimetres = np.frombuffer(datagram, dtype="<u2", offset=_HEADER.size)
    ranges = millimetres.astype(np.float32) / np.float32(1000.0)
    ranges[millimetres == _INVALID] = np.nan
    ranges[millimetres == _NO_RETURN] = np.inf
    return Scan(stamp, ranges)
