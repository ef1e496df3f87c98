"""Where the peers are, as far as this drone was told: last reported positions, and how long ago each was heard."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

PEER_KNOWN_S = 2.0
"""A peer heard no longer ago than this counts as known, where it last said it was; the mesh's own peer timeout."""
_EPSILON_S = 1e-6  # ages are sums of ticks: rounding must not cost one


class PeerPoses(NamedTuple):
    """Last reported positions of peers, float64 `[n, 2]` metres in the map, and the seconds since each was heard."""

    positions: NDArray[np.float64]
    ages_s: NDArray[np.float64]

    @staticmethod
    def none() -> PeerPoses:
        """Return that nobody was ever heard."""
        return PeerPoses(np.zeros((0, 2)), np.zeros(0))


@numba.njit(cache=True, nogil=True)
def fill_peer_distances(distances, x, y, positions, ages, range_m):  # type: ignore[no-untyped-def]
    """Fill `distances` (float32 `[k]`) with those to the k nearest known peers, nearest first, over `range_m`.

    At most 1, and 1 where no further peer is known. `positions` and `ages` as in `PeerPoses`; a drone among its own
    peers is left out by an age of inf.
    """
    distances[:] = 1.0
    for peer in range(len(ages)):
        if not ages[peer] <= PEER_KNOWN_S + _EPSILON_S:
            continue
        dx, dy = positions[peer, 0] - x, positions[peer, 1] - y
        here = np.float32(min(np.sqrt(dx * dx + dy * dy) / range_m, 1.0))
        for k in range(len(distances)):  # insert in order; what falls off the end is farther than all kept
            if here < distances[k]:
                here, distances[k] = distances[k], here


@numba.njit(cache=True, nogil=True)
def fill_peer_places(places, x, y, turn, positions, ages, range_m, memory_s):  # type: ignore[no-untyped-def]
    """Fill `places` (float32 `[3 k]`) with where the k nearest peers were heard last: two offsets and a freshness each.

    Offsets from (x, y) are along axes turned by `turn` radians, over `range_m`, in [-1, 1]; freshness falls from 1 to
    0 as the report gets `memory_s` old. Nearest first; zeros where no further peer was heard in that time. `positions`
    and `ages` as in `PeerPoses`; a drone among its own peers is left out by an age of inf.
    """
    places[:] = 0.0
    cos_turn, sin_turn = np.cos(turn), np.sin(turn)
    count = len(places) // 3
    nearest = np.full(count, np.inf)
    for peer in range(len(ages)):
        if not ages[peer] < memory_s:
            continue
        dx, dy = positions[peer, 0] - x, positions[peer, 1] - y
        distance = dx * dx + dy * dy
        slot = count
        while slot > 0 and distance < nearest[slot - 1]:
            slot -= 1
        if slot == count:
            continue
        for k in range(count - 1, slot, -1):
            nearest[k] = nearest[k - 1]
            for part in range(3):
                places[3 * k + part] = places[3 * k - 3 + part]
        nearest[slot] = distance
        ahead, left = cos_turn * dx + sin_turn * dy, cos_turn * dy - sin_turn * dx
        places[3 * slot] = np.float32(min(max(ahead / range_m, -1.0), 1.0))
        places[3 * slot + 1] = np.float32(min(max(left / range_m, -1.0), 1.0))
        places[3 * slot + 2] = np.float32(1.0 - max(ages[peer], 0.0) / memory_s)
