"""A scan on the air: packing one's own, and drawing a peer's ahead of its tiles."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from imagine.core.errors import InputError
from imagine.core.evidence import EvidenceMap
from imagine.core.frames import Pose
from imagine.core.lidar import LidarSpec, Scan
from imagine.core.raster import CELL, beam_directions, ray_table
from imagine.mesh_comm import messages
from imagine.mesh_comm.codec import SCAN_CHANCES, code_metres, pack_ranges
from imagine.mesh_comm.known_cells import NOBODY_COUNTS, KnownCells
from imagine.mesh_comm.scan_arrival import DAMAGED, draw_packed_scan

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
    evidence: EvidenceMap,
    message: messages.Scan,
    teammates: NDArray[np.float64],
    mask_radius_m: float,
    known: KnownCells | None = None,
) -> int:
    """Draw a peer's scan into its layer, except on tiles that already contain it and on teammates `[n, 2]` (metres).

    Returns how many cells of `known` that makes known, 0 without. Raises InputError on damaged ranges, on a pose whose
    surroundings no map can hold, and on the drone's own id.
    """
    sender, pose, beams, cap = message.sender, message.pose, message.beams, message.range_cap_m
    if sender == evidence.own:
        raise InputError(f"source {sender} is this drone itself: its scans are not a peer's")
    reach_m = cap + 2 * CELL
    evidence.cover(pose.x - reach_m, pose.y - reach_m, pose.x + reach_m, pose.y + reach_m, of_peer=True)
    layer = evidence.layer(sender)
    column0, row0 = evidence.origin_cells
    increment = min(message.increment * beams, 2.0 * math.pi) / beams
    table = ray_table(cap)
    is_known = NOBODY_COUNTS if known is None else known.not_yet(sender)
    found = np.empty(table.sheet[0] * table.width, np.int32)
    count = draw_packed_scan(
        np.frombuffer(message.packed, np.uint8), SCAN_CHANCES, code_metres(cap), beams,
        pose.x, pose.y, pose.yaw, message.start, increment, beam_directions(message.start, increment, beams), cap,
        table.reach, table.width, table.starts, table.offsets, teammates, mask_radius_m,
        layer.cells, layer.versions, layer.provisional, message.clock, row0, column0, is_known, found,
    )  # fmt: skip
    if count == DAMAGED:
        raise InputError(f"mesh scan: {len(message.packed)} bytes do not tell {beams} ranges up to {cap} m")
    return 0 if known is None else known.claim_found(found, count)
