"""Gaps that the planning grid closes and a drone gets through: doors of half a metre that lie across its cells.

A planning cell is an obstacle as soon as one of its four map cells is, so of a passage of 0.5 m a single free cell may
be left, with obstacles on both sides. The map itself tells it from a chink: there a square of four map cells, 0.4 m, is
free of obstacles. That is also what a level counts as flyable, and more than the safety shield asks for.
"""

from __future__ import annotations

import numba
import numpy as np

from imagine.core.frontier import FREE, PAD, UNKNOWN
from imagine.core.frontier_paths import FRONTIER, NEAR, OPEN


@numba.njit(cache=True, nogil=True)
def fill_flyable(out, kinds, states, belief):  # type: ignore[no-untyped-def]
    """Copy `kinds` to `out` (uint8, padded), with the gaps in `belief` (int8) opened; they count as beside obstacles.

    A gap is a frontier where unknown lies behind it, straight on.
    """
    rows, columns = kinds.shape
    for row in range(rows):
        for column in range(columns):
            out[row, column] = kinds[row, column]
            if kinds[row, column] != 0 or states[row, column] != FREE:
                continue
            if not _is_gap(belief, 2 * (row - PAD), 2 * (column - PAD)):
                continue
            out[row, column] = np.uint8(OPEN | NEAR)
            for d_row, d_column in ((0, 1), (0, -1), (1, 0), (-1, 0)):
                if states[row + d_row, column + d_column] == UNKNOWN:
                    out[row, column] = np.uint8(OPEN | NEAR | FRONTIER)


@numba.njit(cache=True, nogil=True)
def _is_gap(belief, row, column):  # type: ignore[no-untyped-def]
    """Tell whether no obstacle lies in the four by four map cells around the planning cell that begins here."""
    rows, columns = belief.shape
    for i in range(max(0, row - 1), min(rows, row + 3)):
        for j in range(max(0, column - 1), min(columns, column + 3)):
            if belief[i, j] > 0:
                return False
    return True
