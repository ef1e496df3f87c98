"""Distance to the nearest frontier through known free space: the field that planner and policy both read.

A frontier is known free space beside unknown space (Yamauchi 1997). The field lives on a 0.2 m planning grid, two
cells of the map to a side: a quarter of the work, and still two free cells in the narrowest passage a drone may use.

From tick to tick few cells change their distance, so the grid is kept up to date: `refresh_states` where the belief
changed, `refresh_kinds` around that, and `update_costs`, which repairs the shortest paths (after Ramalingam and Reps
1996: first the paths that lost their support are dropped, then Dijkstra's search runs from what is left). Shortest
distances are unique, so this gives the very numbers of a search from nothing, which is what happens on board.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numba
import numpy as np
from numpy.typing import NDArray

from imagine.core.raster import CELL, TILE

PLAN_CELL = 2 * CELL
"""Side of a planning cell, metres."""
PLAN_TILE = TILE // 2
"""Side of a tile, planning cells."""
PAD = 2
"""Cells of unknown around a planning grid, which spare the loops every test for the edge."""
UNKNOWN, FREE, OCCUPIED = 0, 1, 2
"""States of a planning cell; OCCUPIED is a bit of its own."""
UNIT_M = 0.04
"""Costs are whole numbers of this, metres."""
FAR = 32767
"""Cost of what no path from a frontier was found to."""
BLOCKED = -1
"""Cost of what cannot be flown through."""

_STRAIGHT, _DIAGONAL = 5, 7  # 0.20 m and 0.28 m
_NEAR_WALL_COST = 3  # beside an obstacle a metre costs three: paths keep clear of walls where there is room
_NEAR, _FRONTIER, _OPEN = 1, 2, 4  # bits of a cell's kind


@dataclass(frozen=True)
class FrontierField:
    """Frontier distances and cell states on the planning grid, both with PAD cells of unknown around it.

    `cost`: int16 `[rows + 2 PAD, columns + 2 PAD]`, UNIT_M along the cheapest known path, a metre beside obstacles
    counting threefold; FAR where no frontier can be reached, BLOCKED where nothing flies. `padded_states`: uint8 of
    the same shape, UNKNOWN, FREE or OCCUPIED.
    """

    cost: NDArray[np.int16]
    padded_states: NDArray[np.uint8]

    @cached_property
    def distance(self) -> NDArray[np.float32]:
        """Frontier distance, float32 `[rows, columns]` metres; inf where no frontier can be reached."""
        distance = np.empty(self.states.shape, np.float32)
        fill_distance(self.cost, distance)
        return distance

    @property
    def states(self) -> NDArray[np.uint8]:
        """Cell states, `[rows, columns]`; row 0, column 0 is the map grid's first cell."""
        return self.padded_states[PAD:-PAD, PAD:-PAD]


@numba.njit(cache=True, nogil=True)
def refresh_states(belief, states, tile_row, tile_column):  # type: ignore[no-untyped-def]
    """Reduce a tile of a belief (int8 `[rows, columns]`) to planning cells: occupied before free before unknown.

    `states` is padded. Return the planning cells that changed as (first row, last row, first column, last column) of
    the padded grid, the first row past the last where none did.
    """
    first_row, last_row, first_column, last_column = 1 << 30, -1, 1 << 30, -1
    for i in range(PLAN_TILE):
        upper, lower = belief[tile_row * TILE + 2 * i], belief[tile_row * TILE + 2 * i + 1]
        row = tile_row * PLAN_TILE + i + PAD
        out = states[row]
        differing = np.uint8(0)
        for j in range(PLAN_TILE):  # without branches: whether anything in the row changed
            k = np.uint64(tile_column * TILE + 2 * j)
            state = _reduced(upper[k], upper[k + np.uint64(1)], lower[k], lower[k + np.uint64(1)])
            differing = np.uint8(differing | (state ^ out[np.uint64(tile_column * PLAN_TILE + j + PAD)]))
        if differing == 0:
            continue
        first_row, last_row = min(first_row, row), row
        for j in range(PLAN_TILE):
            k, column = tile_column * TILE + 2 * j, tile_column * PLAN_TILE + j + PAD
            state = _reduced(upper[k], upper[k + 1], lower[k], lower[k + 1])
            if out[column] != state:
                out[column] = state
                first_column, last_column = min(first_column, column), max(last_column, column)
    return first_row, last_row, first_column, last_column


@numba.njit(cache=True, nogil=True, inline="always")
def _reduced(a, b, c, d):  # type: ignore[no-untyped-def]
    """Return the state of a planning cell whose four cells have this evidence."""
    above, below = (a if a > b else b), (c if c > d else d)
    highest = above if above > below else below
    above, below = (a if a < b else b), (c if c < d else d)
    lowest = above if above < below else below
    free = np.uint8(FREE) if lowest < 0 else np.uint8(UNKNOWN)
    return np.uint8(OCCUPIED) if highest > 0 else free


@numba.njit(cache=True, nogil=True)
def _squeezed(states, row, column):  # type: ignore[no-untyped-def]
    """Tell whether obstacles lie on two opposite sides of a cell, straight or diagonal."""
    return (
        (states[row, column - 1] == OCCUPIED and states[row, column + 1] == OCCUPIED)
        or (states[row - 1, column] == OCCUPIED and states[row + 1, column] == OCCUPIED)
        or (states[row - 1, column - 1] == OCCUPIED and states[row + 1, column + 1] == OCCUPIED)
        or (states[row - 1, column + 1] == OCCUPIED and states[row + 1, column - 1] == OCCUPIED)
    )


@numba.njit(cache=True, nogil=True)
def _opens(states, row, column):  # type: ignore[no-untyped-def]
    """Tell whether an unknown cell has unknown beside it and no obstacles on two sides.

    Lone unknown cells, and chinks in what is surely a wall, are not worth a flight.
    """
    rows, columns = states.shape
    if not (0 < row < rows - 1 and 0 < column < columns - 1):
        return False
    if _squeezed(states, row, column):
        return False
    for i in range(row - 1, row + 2):
        for j in range(column - 1, column + 2):
            if states[i, j] == UNKNOWN and (i != row or j != column):
                return True
    return False


@numba.njit(cache=True, nogil=True)
def refresh_kinds(states, kinds, cost, changed, dirty, count, is_dirty):  # type: ignore[no-untyped-def]
    """Bring `kinds` (uint8) up to date around states that changed, and note the cells whose paths it may change.

    A kind says whether a drone can fly there, whether an obstacle is beside it, and whether it is a frontier. All
    grids are padded; `changed` is what `refresh_states` returned, once all states are in place. What opens or closes
    gets the cost FAR or BLOCKED. `dirty` holds `count` flat cells, `is_dirty` (uint8, flat) their marks; return the
    new count.
    """
    rows, columns = states.shape
    first_row, last_row, first_column, last_column = changed
    for row in range(max(PAD, first_row - 2), min(rows - PAD, last_row + 3)):
        for column in range(max(PAD, first_column - 2), min(columns - PAD, last_column + 3)):
            kind = np.uint8(0)
            if states[row, column] == FREE:
                w, e = states[row, column - 1], states[row, column + 1]
                s, n = states[row - 1, column], states[row + 1, column]
                sw, se = states[row - 1, column - 1], states[row - 1, column + 1]
                nw, ne = states[row + 1, column - 1], states[row + 1, column + 1]
                kind = np.uint8(_OPEN)
                if ((w | e | s | n | sw | se | nw | ne) & OCCUPIED) != 0:
                    kind = np.uint8(_OPEN | _NEAR)
                    if (w & e & OCCUPIED) | (s & n & OCCUPIED) | (sw & ne & OCCUPIED) | (nw & se & OCCUPIED):
                        kind = np.uint8(0)  # a gap of 0.2 m: nothing flies through
                if kind != 0 and (
                    (w == UNKNOWN and _opens(states, row, column - 1))
                    or (e == UNKNOWN and _opens(states, row, column + 1))
                    or (s == UNKNOWN and _opens(states, row - 1, column))
                    or (n == UNKNOWN and _opens(states, row + 1, column))
                ):
                    kind |= np.uint8(_FRONTIER)
            old = kinds[row, column]
            if kind == old:
                continue
            kinds[row, column] = kind
            if (kind ^ old) & _OPEN:
                cost[row, column] = FAR if kind & _OPEN else BLOCKED
            reach = 1 if (kind ^ old) & (_OPEN | _NEAR) else 0  # a frontier's flag is its own affair
            for i in range(row - reach, row + reach + 1):
                for j in range(column - reach, column + reach + 1):
                    cell = i * columns + j
                    if is_dirty[cell] == 0:
                        is_dirty[cell] = 1
                        dirty[count] = cell
                        count += 1
    return count


@numba.njit(cache=True, nogil=True)
def update_costs(cost, kinds, dirty, count, is_dirty, scratch):  # type: ignore[no-untyped-def]
    """Repair `cost` (int16, padded) around the first `count` cells of `dirty`, whose marks are taken off.

    `scratch` is `search_scratch` for a grid of this size.
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
        if not kind & np.uint8(_OPEN):
            continue
        found = np.int64(0) if kind & np.uint8(_FRONTIER) else _least(costs, flat_kinds, cell, np.uint32(width))
        if found < costs[cell]:
            costs[cell] = found
            entry_cell[entries], entry_next[entries], heads[found] = cell, heads[found], entries
            entries += 1
            lowest = min(lowest, found)
    _settle(costs, flat_kinds, np.uint32(width), lowest, entries, scratch)


@numba.njit(cache=True, nogil=True, inline="always")
def _via(cost, kinds, step):  # type: ignore[no-untyped-def]
    """Return what a cell costs by way of a neighbour of this cost; `kinds` are both cells' kinds, or-ed."""
    step = step * _NEAR_WALL_COST if kinds & np.uint8(_NEAR) else step
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
                if kind & np.uint8(_FRONTIER):
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
    return level + (step * _NEAR_WALL_COST if kinds & np.uint8(_NEAR) else step)


@numba.njit(cache=True, nogil=True)
def _settle(costs, kinds, width, level, queued, scratch):  # type: ignore[no-untyped-def]
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


@numba.njit(cache=True, nogil=True)
def has_frontier(kinds):  # type: ignore[no-untyped-def]
    """Tell whether any cell is a frontier."""
    words = kinds.ravel().view(np.uint64)  # a padded grid of whole tiles is a multiple of 16 cells
    word = 0
    while word < len(words) and not words[word] & np.uint64(0x0101010101010101 * _FRONTIER):
        word += 1
    return word < len(words)


@numba.njit(cache=True, nogil=True)
def fill_distance(cost, distance):  # type: ignore[no-untyped-def]
    """Write padded costs (int16) as metres into `distance` (float32 `[rows, columns]`), inf where none was found."""
    rows, columns = distance.shape
    for row in range(rows):
        for column in range(columns):
            c = cost[row + PAD, column + PAD]
            distance[row, column] = np.float32(c) * np.float32(UNIT_M) if 0 <= c < FAR else np.float32(np.inf)


@numba.njit(cache=True, nogil=True)
def cost_at(cost, column, row):  # type: ignore[no-untyped-def]
    """Return the cost at a planning cell of the unpadded grid, or the least within two cells where it has none; FAR."""
    rows, columns = cost.shape[0] - 2 * PAD, cost.shape[1] - 2 * PAD
    best = np.int64(FAR)
    for ring in range(3):
        for i in range(max(0, row - ring), min(rows, row + ring + 1)):
            for j in range(max(0, column - ring), min(columns, column + ring + 1)):
                c = cost[i + PAD, j + PAD]
                if 0 <= c < best:
                    best = np.int64(c)
        if best < FAR:
            break
    return best


def frontier_field(belief: NDArray[np.int8]) -> FrontierField:
    """Return the frontier field of a belief (int8 `[rows, columns]`, both even); beyond it all is unknown."""
    plan_rows, plan_columns = belief.shape[0] // 2, belief.shape[1] // 2
    belief = np.pad(belief, ((0, -belief.shape[0] % TILE), (0, -belief.shape[1] % TILE)))
    rows, columns = belief.shape[0] // 2 + 2 * PAD, belief.shape[1] // 2 + 2 * PAD
    states, kinds = np.zeros((rows, columns), np.uint8), np.zeros((rows, columns), np.uint8)
    cost = np.full((rows, columns), BLOCKED, np.int16)
    dirty, is_dirty = np.empty(cost.size, np.int32), np.zeros(cost.size, np.uint8)
    _field_from_nothing(belief, states, kinds, cost, dirty, is_dirty, search_scratch(cost.size))
    inner = slice(plan_rows + 2 * PAD), slice(plan_columns + 2 * PAD)
    return FrontierField(np.ascontiguousarray(cost[inner]), np.ascontiguousarray(states[inner]))


@numba.njit(cache=True, nogil=True)
def _field_from_nothing(belief, states, kinds, cost, dirty, is_dirty, scratch):  # type: ignore[no-untyped-def]
    for i in range(belief.shape[0] // TILE):
        for j in range(belief.shape[1] // TILE):
            refresh_states(belief, states, i, j)
    count = refresh_kinds(states, kinds, cost, (0, states.shape[0], 0, states.shape[1]), dirty, 0, is_dirty)
    update_costs(cost, kinds, dirty, count, is_dirty, scratch)


def plan_cell(x: float, y: float, origin_cells: tuple[int, int]) -> tuple[int, int]:
    """Return the planning column and row that hold a point of the map frame, on a grid with this origin in cells."""
    return (
        math.floor(x / PLAN_CELL) - origin_cells[0] // 2,
        math.floor(y / PLAN_CELL) - origin_cells[1] // 2,
    )


def own_distance(field: FrontierField, origin_cells: tuple[int, int], x: float, y: float) -> float:
    """Return the frontier distance of the drone at (x, y), metres; inf where nothing is left to explore."""
    column, row = plan_cell(x, y, origin_cells)
    cost = cost_at(field.cost, column, row)
    return float(cost) * UNIT_M if cost < FAR else math.inf
