"""Distance to the nearest frontier through known free space: the field that planner and policy both read.

A frontier is known free space beside unknown space (Yamauchi 1997). The field lives on a 0.2 m planning grid, two
cells of the map to a side: a quarter of the work, and still two free cells in the narrowest passage a drone may use.

From tick to tick few cells change their distance, so the grid is kept up to date: `refresh_states` where the belief
changed, `refresh_kinds` around that, and `frontier_paths.update_costs`, which repairs the shortest paths. On board,
where there is time, all of it is done anew for every scan.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numba
import numpy as np
from numpy.typing import NDArray

from imagine.core.frontier_paths import BLOCKED, FAR, FRONTIER, NEAR, OPEN, search_scratch, update_costs
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


@dataclass(frozen=True)
class FrontierField:
    """Frontier distances and cell states on the planning grid, both with PAD cells of unknown around it.

    `cost`: int16 `[rows + 2 PAD, columns + 2 PAD]`, UNIT_M along the cheapest known path, a metre beside obstacles
    counting threefold; FAR where no frontier can be reached, BLOCKED where nothing flies. `padded_states`: uint8 of
    the same shape, UNKNOWN, FREE or OCCUPIED; `kinds`: uint8 of the same shape, bits as in `frontier_paths`.
    """

    cost: NDArray[np.int16]
    padded_states: NDArray[np.uint8]
    kinds: NDArray[np.uint8]

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
                kind = np.uint8(OPEN)
                if ((w | e | s | n | sw | se | nw | ne) & OCCUPIED) != 0:
                    kind = np.uint8(OPEN | NEAR)
                    if (w & e & OCCUPIED) | (s & n & OCCUPIED) | (sw & ne & OCCUPIED) | (nw & se & OCCUPIED):
                        kind = np.uint8(0)  # a gap of 0.2 m: nothing flies through
                if kind != 0 and (
                    (w == UNKNOWN and _opens(states, row, column - 1))
                    or (e == UNKNOWN and _opens(states, row, column + 1))
                    or (s == UNKNOWN and _opens(states, row - 1, column))
                    or (n == UNKNOWN and _opens(states, row + 1, column))
                ):
                    kind |= np.uint8(FRONTIER)
            old = kinds[row, column]
            if kind == old:
                continue
            kinds[row, column] = kind
            if (kind ^ old) & OPEN:
                cost[row, column] = FAR if kind & OPEN else BLOCKED
            reach = 1 if (kind ^ old) & (OPEN | NEAR) else 0  # a frontier's flag is its own affair
            for i in range(row - reach, row + reach + 1):
                for j in range(column - reach, column + reach + 1):
                    cell = i * columns + j
                    if is_dirty[cell] == 0:
                        is_dirty[cell] = 1
                        dirty[count] = cell
                        count += 1
    return count


@numba.njit(cache=True, nogil=True)
def has_frontier(kinds):  # type: ignore[no-untyped-def]
    """Tell whether any cell is a frontier."""
    words = kinds.ravel().view(np.uint64)  # a padded grid of whole tiles is a multiple of 16 cells
    word = 0
    while word < len(words) and not words[word] & np.uint64(0x0101010101010101 * FRONTIER):
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
    return FrontierField(*(np.ascontiguousarray(grid[inner]) for grid in (cost, states, kinds)))


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
