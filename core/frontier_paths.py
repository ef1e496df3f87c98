"""Repairing shortest paths from all frontiers after some planning cells have changed.

After Ramalingam and Reps (1996): first the paths that lost their support are dropped, then Dijkstra's search runs from
what is left. Shortest distances are unique, so this gives the very numbers of a search from nothing.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

FAR = 32767
"""Cost of what no path from a frontier was found to."""
BLOCKED = -1
"""Cost of what cannot be flown through."""
NEAR, FRONTIER, OPEN = 1, 2, 4
"""Bits of a planning cell's kind: an obstacle is beside it, it is a frontier, a drone can fly there."""

_STRAIGHT, _DIAGONAL = 5, 7  # 0.20 m and 0.28 m
_NEAR_WALL_COST = 3  # beside an obstacle a metre costs three: paths keep clear of walls where there is room


@numba.njit(cache=True, nogil=True)
def update_costs(cost, kinds, dirty, count, is_dirty, scratch):  # type: ignore[no-untyped-def]
    """Repair `cost` (int16, padded) around the first `count` cells of `dirty`, whose marks are taken off.

    `kinds` uint8 are bits (see OPEN), `is_dirty` uint8 flat; `scratch` is `search_scratch` for a grid of this size.
    """
    heads, entry_cell, entry_next = scratch
    width = cost.shape[1]
    costs, flat_kinds = cost.ravel(), kinds.ravel()
    entries, lowest = 0, np.int64(FAR)
    for k in range(count):
        cell = dirty[k]
        old = np.int64(costs[cell])
        if 0 <= old < FAR:
            entry_cell[entries], entry_next[entries], heads[old] = cell, heads[old], entries
            is_dirty[cell] |= np.uint8(2)
            entries += 1
            lowest = min(lowest, old)
    count = _drop_unsupported(costs, flat_kinds, np.uint32(width), lowest, entries, dirty, count, is_dirty, scratch)
    entries, lowest = 0, np.int64(FAR)
    for k in range(count):
        cell = np.uint32(dirty[k])
        is_dirty[cell] = 0
        kind = flat_kinds[cell]
        if not kind & np.uint8(OPEN):
            continue
        found = np.int64(0) if kind & np.uint8(FRONTIER) else _least(costs, flat_kinds, cell, np.uint32(width))
        if found < costs[cell]:
            costs[cell] = found
            entry_cell[entries], entry_next[entries], heads[found] = cell, heads[found], entries
            entries += 1
            lowest = min(lowest, found)
    settle(costs, flat_kinds, np.uint32(width), lowest, entries, scratch)


@numba.njit(cache=True, nogil=True, inline="always")
def _via(cost, kinds, step):  # type: ignore[no-untyped-def]
    """Return what a cell costs by way of a neighbour of this cost; `kinds` are both cells' kinds, or-ed."""
    step = step * _NEAR_WALL_COST if kinds & np.uint8(NEAR) else step
    return np.int64(cost) + step if cost >= 0 else np.int64(FAR)


@numba.njit(cache=True, nogil=True)
def _least(costs, kinds, cell, width):  # type: ignore[no-untyped-def]
    """Return the least cost of a cell by way of its neighbours, FAR or more where none has any. Without branches."""
    one = np.uint32(1)
    e, w, n, s = np.uint32(cell + one), np.uint32(cell - one), np.uint32(cell + width), np.uint32(cell - width)
    ne, nw, se, sw = np.uint32(n + one), np.uint32(n - one), np.uint32(s + one), np.uint32(s - one)
    kind = kinds[cell]
    east, west, north, south = costs[e], costs[w], costs[n], costs[s]
    blocked = np.int16(BLOCKED)  # a diagonal step cuts no corner: both cells beside it must be free
    north_east = costs[ne] if (north >= 0) & (east >= 0) else blocked
    north_west = costs[nw] if (north >= 0) & (west >= 0) else blocked
    south_east = costs[se] if (south >= 0) & (east >= 0) else blocked
    south_west = costs[sw] if (south >= 0) & (west >= 0) else blocked
    straight = min(
        min(_via(east, kind | kinds[e], _STRAIGHT), _via(west, kind | kinds[w], _STRAIGHT)),
        min(_via(north, kind | kinds[n], _STRAIGHT), _via(south, kind | kinds[s], _STRAIGHT)),
    )
    diagonal = min(
        min(_via(north_east, kind | kinds[ne], _DIAGONAL), _via(north_west, kind | kinds[nw], _DIAGONAL)),
        min(_via(south_east, kind | kinds[se], _DIAGONAL), _via(south_west, kind | kinds[sw], _DIAGONAL)),
    )
    return min(straight, diagonal)


@numba.njit(cache=True, nogil=True)
def _drop_unsupported(  # type: ignore[no-untyped-def]
    costs, kinds, width, level, queued, dirty, count, is_dirty, scratch
):
    """Set to FAR, from the queued cells on, what no neighbour's cost explains any more; note it, return the count.

    Cells come by their old cost, so that what may support a cell has been looked at before it; each comes once, which
    the second bit of `is_dirty` sees to.
    """
    heads, entry_cell, entry_next = scratch
    found, at = np.empty(9, np.uint32), np.empty(9, np.int64)
    one = np.uint32(1)
    entries = queued
    while queued > 0:
        while heads[level] >= 0:
            entry = heads[level]
            heads[level] = entry_next[entry]
            queued -= 1
            cell = np.uint32(entry_cell[entry])
            kind = kinds[cell]
            if level == 0:
                if kind & np.uint8(FRONTIER):
                    continue
            elif _least(costs, kinds, cell, width) <= level:
                continue
            costs[cell] = FAR
            if not is_dirty[cell] & np.uint8(1):
                is_dirty[cell] |= np.uint8(1)
                dirty[count] = cell
                count += 1
            # What may have come this way is looked at next; corners do not matter, it can only prove supported.
            e, w, n, s = np.uint32(cell + one), np.uint32(cell - one), np.uint32(cell + width), np.uint32(cell - width)
            ne, nw, se, sw = np.uint32(n + one), np.uint32(n - one), np.uint32(s + one), np.uint32(s - one)
            ways = np.uint64(0)
            reached = _onward(level, kind | kinds[e], _STRAIGHT)
            found[ways], at[ways] = e, reached
            ways += np.uint64((reached == costs[e]) & (is_dirty[e] < 2))
            reached = _onward(level, kind | kinds[w], _STRAIGHT)
            found[ways], at[ways] = w, reached
            ways += np.uint64((reached == costs[w]) & (is_dirty[w] < 2))
            reached = _onward(level, kind | kinds[n], _STRAIGHT)
            found[ways], at[ways] = n, reached
            ways += np.uint64((reached == costs[n]) & (is_dirty[n] < 2))
            reached = _onward(level, kind | kinds[s], _STRAIGHT)
            found[ways], at[ways] = s, reached
            ways += np.uint64((reached == costs[s]) & (is_dirty[s] < 2))
            reached = _onward(level, kind | kinds[ne], _DIAGONAL)
            found[ways], at[ways] = ne, reached
            ways += np.uint64((reached == costs[ne]) & (is_dirty[ne] < 2))
            reached = _onward(level, kind | kinds[nw], _DIAGONAL)
            found[ways], at[ways] = nw, reached
            ways += np.uint64((reached == costs[nw]) & (is_dirty[nw] < 2))
            reached = _onward(level, kind | kinds[se], _DIAGONAL)
            found[ways], at[ways] = se, reached
            ways += np.uint64((reached == costs[se]) & (is_dirty[se] < 2))
            reached = _onward(level, kind | kinds[sw], _DIAGONAL)
            found[ways], at[ways] = sw, reached
            ways += np.uint64((reached == costs[sw]) & (is_dirty[sw] < 2))
            for k in range(ways):
                target = at[k]
                entry_cell[entries], entry_next[entries], heads[target] = found[k], heads[target], entries
                is_dirty[found[k]] |= np.uint8(2)
                entries += 1
                queued += 1
        level += 1
    for k in range(entries):
        is_dirty[entry_cell[k]] &= np.uint8(1)
    return count


@numba.njit(cache=True, nogil=True, inline="always")
def _onward(level, kinds, step):  # type: ignore[no-untyped-def]
    """Return the cost a step on from a cell of cost `level`; `kinds` are both cells' kinds, or-ed."""
    return level + (step * _NEAR_WALL_COST if kinds & np.uint8(NEAR) else step)


@numba.njit(cache=True, nogil=True)
def settle(costs, kinds, width, level, queued, scratch):  # type: ignore[no-untyped-def]
    """Carry lowered costs on from the queued cells: Dijkstra's search with a queue for every cost (Dial 1969).

    The eight ways are written out and gathered without branches, which would be guessed wrong too often.
    """
    heads, entry_cell, entry_next = scratch
    found, at = np.empty(9, np.uint32), np.empty(9, np.int64)
    one = np.uint32(1)
    entries = queued
    while queued > 0:
        while heads[level] >= 0:
            entry = heads[level]
            heads[level] = entry_next[entry]
            queued -= 1
            cell = np.uint32(entry_cell[entry])
            if costs[cell] != level:
                continue  # a shorter way was found since
            kind = kinds[cell]
            e, w, n, s = np.uint32(cell + one), np.uint32(cell - one), np.uint32(cell + width), np.uint32(cell - width)
            ne, nw, se, sw = np.uint32(n + one), np.uint32(n - one), np.uint32(s + one), np.uint32(s - one)
            ways = np.uint64(0)
            # BLOCKED is below all; a diagonal step cuts no corner: both cells beside it must be free
            reached = _onward(level, kind | kinds[e], _STRAIGHT)
            found[ways], at[ways] = e, reached
            ways += np.uint64(reached < costs[e])
            reached = _onward(level, kind | kinds[w], _STRAIGHT)
            found[ways], at[ways] = w, reached
            ways += np.uint64(reached < costs[w])
            reached = _onward(level, kind | kinds[n], _STRAIGHT)
            found[ways], at[ways] = n, reached
            ways += np.uint64(reached < costs[n])
            reached = _onward(level, kind | kinds[s], _STRAIGHT)
            found[ways], at[ways] = s, reached
            ways += np.uint64(reached < costs[s])
            reached = _onward(level, kind | kinds[ne], _DIAGONAL)
            found[ways], at[ways] = ne, reached
            ways += np.uint64((reached < costs[ne]) & (costs[n] >= 0) & (costs[e] >= 0))
            reached = _onward(level, kind | kinds[nw], _DIAGONAL)
            found[ways], at[ways] = nw, reached
            ways += np.uint64((reached < costs[nw]) & (costs[n] >= 0) & (costs[w] >= 0))
            reached = _onward(level, kind | kinds[se], _DIAGONAL)
            found[ways], at[ways] = se, reached
            ways += np.uint64((reached < costs[se]) & (costs[s] >= 0) & (costs[e] >= 0))
            reached = _onward(level, kind | kinds[sw], _DIAGONAL)
            found[ways], at[ways] = sw, reached
            ways += np.uint64((reached < costs[sw]) & (costs[s] >= 0) & (costs[w] >= 0))
            for k in range(ways):
                other, reached = found[k], at[k]
                costs[other] = reached
                entry_cell[entries], entry_next[entries], heads[reached] = other, heads[reached], entries
                entries += 1
                queued += 1
        level += 1


def search_scratch(cells: int) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32]]:
    """Return what `update_costs` works with on a padded grid of so many cells; one for each thread."""
    entries = 9 * cells + 1  # each settled cell relaxes at most 8 edges
    return np.full(FAR + 1, -1, np.int32), np.empty(entries, np.int32), np.empty(entries, np.int32)
