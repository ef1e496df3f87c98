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
