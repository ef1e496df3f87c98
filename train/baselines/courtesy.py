"""Two drones that meet each keep to the right, so that neither waits for the other nor touches it.

The shield takes what it sees to stand still. Of two drones that come at each other both would stop too late, or for
good, as each is in the other's way.
"""

from __future__ import annotations

import math

import numba

_ROOM_M = 1.3
"""Distance at which a drone begins to turn aside: at twice 0.8 m/s, 0.8 s off."""
_NEAREST_M = 0.4
_CLOSING_MPS = 0.3  # of one that flies ahead in the same direction nothing need be made
_AHEAD = 0.5  # cosine of 60 degrees
_FRESH_S = 0.6  # a status every 0.5 s is the least that is heard of a peer in reach


@numba.njit(cache=True, nogil=True)
def keep_right(dx, dy, drone, x, y, peers, tick, ticks_per_s, speed):  # type: ignore[no-untyped-def]
    """Return the unit course (dx, dy) of a drone at (x, y), turned right, up to 45 degrees, for peers that come at it.

    `peers` are the drone's PEER records of all drones; only poses told lately count, carried on to `tick`.
    """
    turn = 0.0
    for peer in range(peers.shape[0]):
        told = peers[peer]
        if peer == drone or told.pose_tick < 0 or tick - told.pose_tick > _FRESH_S * ticks_per_s:
            continue
        ahead_s = (tick - told.pose_tick) / ticks_per_s
        rx, ry = told.x + told.vx * ahead_s - x, told.y + told.vy * ahead_s - y
        distance = math.sqrt(rx * rx + ry * ry)
        if not 1e-6 < distance < _ROOM_M or (rx * dx + ry * dy) / distance < _AHEAD:
            continue
        closing = ((speed * dx - told.vx) * rx + (speed * dy - told.vy) * ry) / distance
        if closing > _CLOSING_MPS:
            turn = max(turn, min(1.0, (_ROOM_M - distance) / (_ROOM_M - _NEAREST_M)))
    dx, dy = dx + turn * dy, dy - turn * dx
    length = math.sqrt(dx * dx + dy * dy)
    return dx / length, dy / length
