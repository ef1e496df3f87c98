"""Visit maps: how long this drone, and its peers as far as it was told, have spent where.

Counts of ticks on the planning grid of 0.2 m, the frontier field's own. On board the grid grows with the evidence map;
in the twin one lies there for every drone. The same kernels count and show either.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from imagine.core.frontier import PLAN_CELL
from imagine.core.peer_poses import PeerPoses
from imagine.core.raster import CELL

PEER_COUNTED_S = 0.6
"""A peer's place counts while it was heard no longer ago than this: the mesh's status period, and one tick.

Longer, and each parting would leave a mark as of a long stay; shorter, and ticks between two statuses would be missed.
"""
_EPSILON_S = 1e-6
_MOST = np.uint16(65535)


@numba.njit(cache=True, nogil=True)
def count_visit(visits, column0, row0, x, y):  # type: ignore[no-untyped-def]
    """Add a tick at (x, y) to `visits` (uint16 `[rows, columns]`, planning cells), which stop at 65535.

    (column0, row0) is the origin of the map's grid in map cells, even numbers. Places outside the grid are left out.
    """
    column = math.floor(x / PLAN_CELL) - column0 // 2
    row = math.floor(y / PLAN_CELL) - row0 // 2
    if 0 <= row < visits.shape[0] and 0 <= column < visits.shape[1] and visits[row, column] < _MOST:
        visits[row, column] += np.uint16(1)


@numba.njit(cache=True, nogil=True)
def count_peer_visits(visits, column0, row0, positions, ages):  # type: ignore[no-untyped-def]
    """Add a tick at the last reported position of every peer that was heard just now; arguments as in `PeerPoses`."""
    for peer in range(len(ages)):
        if ages[peer] <= PEER_COUNTED_S + _EPSILON_S:
            count_visit(visits, column0, row0, positions[peer, 0], positions[peer, 1])


@numba.njit(cache=True, nogil=True)
def _fill_channel(channel, visits, cell_rows, cell_columns, block, levels):  # type: ignore[no-untyped-def]
    """Fill one view with how bright the most visited of each pixel's block of planning cells looks, 0 outside."""
    rows, columns = visits.shape
    brightest = np.uint16(len(levels) - 1)
    for i in range(channel.shape[0]):
        for j in range(channel.shape[1]):
            row, column = cell_rows[i, j], cell_columns[i, j]
            most = np.uint16(0)
            for r in range(max(0, row), min(rows, row + block)):
                for c in range(max(0, column), min(columns, column + block)):
                    most = max(most, visits[r, c])
            channel[i, j] = levels[min(most, brightest)]


@numba.njit(cache=True, nogil=True)
def fill_visits(channels, own, peers, team, column0, row0, x, y, turn, scales, levels):  # type: ignore[no-untyped-def]
    """Fill `channels` (float32 `[scales or 2 scales, n, n]`) with the visits around (x, y), turned by `turn` radians.

    One channel a scale, the drone's own; with `team` two, its own and its peers'. Pixels lie as in
    `observation.fill_views`; a pixel of several planning cells shows the most visited. `levels` as `visit_levels`.
    """
    n = channels.shape[1]
    cos_turn, sin_turn = math.cos(turn), math.sin(turn)
    each = 2 if team else 1
    cell_rows, cell_columns = np.empty((n, n), np.int64), np.empty((n, n), np.int64)
    for k in range(len(scales)):
        scale = scales[k]
        block = round(scale / CELL)
        if turn == 0.0:
            column = (math.floor(x / scale + 0.5) - n // 2) * block - column0
            row = (math.floor(y / scale + 0.5) - n // 2) * block - row0
            for i in range(n):
                for j in range(n):
                    cell_columns[i, j], cell_rows[i, j] = (column + j * block) >> 1, (row + i * block) >> 1
        else:
            for i in range(n):
                v = (i + 0.5 - 0.5 * n) * scale
                for j in range(n):
                    u = (j + 0.5 - 0.5 * n) * scale
                    across, along = x + cos_turn * u - sin_turn * v, y + sin_turn * u + cos_turn * v
                    cell_columns[i, j] = (math.floor(across / scale) * block - column0) >> 1
                    cell_rows[i, j] = (math.floor(along / scale) * block - row0) >> 1
        plan_block = max(1, block // 2)
        _fill_channel(channels[each * k], own, cell_rows, cell_columns, plan_block, levels)
        if team:
            _fill_channel(channels[2 * k + 1], peers, cell_rows, cell_columns, plan_block, levels)


def visit_levels(full_ticks: int) -> NDArray[np.float32]:
    """Return how bright 0, 1, … `full_ticks` ticks look, float32: log-scaled, 0 for none and 1 for `full_ticks`."""
    counts = np.arange(full_ticks + 1, dtype=np.float64)
    return np.asarray(np.log1p(counts) / np.log1p(float(full_ticks)), np.float32)


class VisitMap:
    """The visits that one drone on board knows of: `own` and `peers`, uint16 `[rows, columns]` planning cells."""

    def __init__(self) -> None:
        """Start without any; `fit` it to the evidence map before use."""
        self.origin_cells = (0, 0)
        self.own = np.zeros((0, 0), np.uint16)
        self.peers = np.zeros((0, 0), np.uint16)

    def fit(self, origin_cells: tuple[int, int], shape: tuple[int, int]) -> None:
        """Take the grid of an evidence map, given by its origin and its shape in map cells; what was counted stays.

        Maps only grow: the new grid holds the old one.
        """
        rows, columns = shape[0] // 2, shape[1] // 2
        if origin_cells == self.origin_cells and self.own.shape == (rows, columns):
            return
        row = (self.origin_cells[1] - origin_cells[1]) // 2
        column = (self.origin_cells[0] - origin_cells[0]) // 2
        for name in ("own", "peers"):
            old, grown = getattr(self, name), np.zeros((rows, columns), np.uint16)
            if old.size:
                grown[row : row + old.shape[0], column : column + old.shape[1]] = old
            setattr(self, name, grown)
        self.origin_cells = origin_cells

    def count(self, x: float, y: float, peers: PeerPoses) -> None:
        """Add this tick: the drone is at (x, y), metres in the map, and has heard of its peers."""
        column0, row0 = self.origin_cells
        count_visit(self.own, column0, row0, x, y)
        count_peer_visits(self.peers, column0, row0, peers.positions, peers.ages_s)
