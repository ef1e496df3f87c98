"""A scan on the air: packing one's own, and drawing a peer's ahead of its tiles."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from imagine.core.evidence import EvidenceMap
from imagine.core.frames import Pose
from imagine.core.lidar import LidarSpec, Scan
from imagine.core.peer_marks import mask_targets
from imagine.core.raster import CELL, TILE
from imagine.mesh_comm import messages
from imagine.mesh_comm.codec import pack_ranges, unpack_ranges

_SCAN_BYTES = 80  # a scan message beside its packed ranges


def scan_message(
    sender: int, clock: int, pose: Pose, scan: Scan, spec: LidarSpec, range_cap_m: float, max_bytes: int
) -> messages.Scan:
    """Return the message of a scan, at most `max_bytes` long: beams are thinned out evenly if all do not fit."""
    stride = 1
    while True:
        ranges = scan.ranges[::stride]
        packed = pack_ranges(ranges, spec.range_min, range_cap_m)
        if len(packed) + _SCAN_BYTES <= max_bytes and len(ranges) <= messages.MAX_BEAMS:
            increment = spec.increment * stride
            return messages.Scan(
                sender, scan.stamp, pose, clock, spec.start, increment, len(ranges), range_cap_m, packed
            )
        stride += 1


def draw_peer_scan(
    evidence: EvidenceMap, message: messages.Scan, teammates: NDArray[np.float64], mask_radius_m: float
) -> None:
    """Draw a peer's scan into its layer, except on tiles that already contain it and on teammates `[n, 2]` (metres).

    Raises InputError on damaged ranges and on a pose whose surroundings no map can hold.
    """
    cap = message.range_cap_m
    ranges = unpack_ranges(message.packed, message.beams, cap)
    pose = message.pose
    reach = cap + 2 * CELL
    evidence.cover(pose.x - reach, pose.y - reach, pose.x + reach, pose.y + reach)
    layer = evidence.layer(message.sender)
    corner, side = evidence.corner, CELL * TILE
    row0, row1 = math.floor((pose.y - reach) / side) - corner.row, math.floor((pose.y + reach) / side) - corner.row
    column0, column1 = (
        math.floor((pose.x - reach) / side) - corner.column, math.floor((pose.x + reach) / side) - corner.column,
    )  # fmt: skip
    if layer.versions[row0 : row1 + 1, column0 : column1 + 1].min() >= message.clock:
        return  # every tile in reach contains this scan
    spec = _sensor(message.beams, message.increment, message.start, cap)
    if len(teammates):
        ranges = mask_targets(ranges, spec.start, spec.increment, spec.range_max, pose, teammates, mask_radius_m)
    evidence.integrate_provisional(message.sender, pose, Scan(message.stamp, ranges), spec, cap, message.clock)


@lru_cache(maxsize=64)
def _sensor(beams: int, increment: float, start: float, range_cap_m: float) -> LidarSpec:
    fov = min(increment * beams, 2.0 * math.pi)
    return LidarSpec(beams, fov, range_min=0.0, range_max=range_cap_m + 1.0, start=start)
