"""The frontier field with numpy and a heap, or scipy: definitions, costs and results are those of `core.frontier`."""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from imagine.core.frontier import FREE, OCCUPIED, PAD, UNKNOWN, FrontierField
from imagine.core.frontier_paths import BLOCKED, FAR, FRONTIER, NEAR, OPEN

_EDGES = ((1, 0, 5), (-1, 0, 5), (0, 1, 5), (0, -1, 5), (1, 1, 7), (-1, -1, 7), (1, -1, 7), (-1, 1, 7))
"""Steps (row, column, length in UNIT_M): a planning cell's 0.2 m, and its diagonal. Opposites stand in pairs."""
_NEAR_WALL_COST = 3

Mask = NDArray[np.bool_]
Ways = Callable[[Mask, NDArray[np.int64], Mask], NDArray[np.float64]]


def plan_states(belief: NDArray[np.int8]) -> NDArray[np.uint8]:
    """Reduce a belief (int8 `[2 r, 2 c]`) to planning cells (uint8 `[r, c]`): occupied before free before unknown."""
    corners = [belief[i::2, j::2] for i in (0, 1) for j in (0, 1)]
    free = np.logical_or.reduce([corner < 0 for corner in corners])
    occupied = np.logical_or.reduce([corner > 0 for corner in corners])
    return np.where(occupied, OCCUPIED, np.where(free, FREE, UNKNOWN)).astype(np.uint8)


def frontier_field(belief: NDArray[np.int8], ways: Ways) -> FrontierField:
    """Return the frontier field of a belief (int8 `[2 r, 2 c]`), beyond which all is unknown.

    `ways` is how the cheapest ways are found: `heap_ways` or `scipy_ways`.
    """
    states = np.pad(plan_states(belief), PAD, constant_values=UNKNOWN)  # so that all have neighbours of neighbours
    free, weight, frontier = _masks(states)
    costs = np.minimum(ways(free, weight, frontier), FAR)
    kinds = np.where(free, OPEN + NEAR * (weight > 1) + FRONTIER * frontier, 0).astype(np.uint8)
    return FrontierField(np.where(free, costs, BLOCKED).astype(np.int16), states, kinds)


def _shifted(mask: Mask, rows: int, columns: int) -> Mask:
    """Return the mask of cells whose neighbour `rows` up and `columns` right is in `mask`."""
    return np.roll(mask, (-rows, -columns), axis=(0, 1))  # what wraps round is the padding


def _masks(padded: NDArray[np.uint8]) -> tuple[Mask, NDArray[np.int64], Mask]:
    """Return which cells can be flown through, what a metre costs in each, and which are frontiers."""
    occupied, unknown = padded == OCCUPIED, padded == UNKNOWN
    around = [(row, column) for row in (-1, 0, 1) for column in (-1, 0, 1) if row or column]
    beside = {step: _shifted(occupied, *step) for step in around}
    near_wall = np.logical_or.reduce([occupied, *beside.values()])
    squeezed = np.logical_or.reduce(
        [beside[row, column] & beside[-row, -column] for row, column in ((0, 1), (1, 0), (1, 1), (1, -1))]
    )
    free = (padded == FREE) & ~squeezed  # a gap of one cell is no way
    opening = unknown & ~squeezed & np.logical_or.reduce([_shifted(unknown, *step) for step in around])
    frontier = free & np.logical_or.reduce([_shifted(opening, *step) for step in ((0, 1), (0, -1), (1, 0), (-1, 0))])
    return free, np.where(near_wall, _NEAR_WALL_COST, 1), frontier


def _edges(free: Mask, weight: NDArray[np.int64]) -> Iterator[tuple[int, NDArray[np.int64]]]:
    """Yield, for each direction, the step to the next cell and its price from each cell (flat), 0 where none is.

    A diagonal step cuts no corner: both cells beside it must be free.
    """
    width = free.shape[1]
    for rows, columns, length in _EDGES:
        passable = free & _shifted(free, rows, columns)
        if rows and columns:
            passable &= _shifted(free, rows, 0) & _shifted(free, 0, columns)
        price = length * np.maximum(weight, np.roll(weight, (-rows, -columns), axis=(0, 1)))
        yield rows * width + columns, np.where(passable, price, 0).ravel()


def heap_ways(free: Mask, weight: NDArray[np.int64], frontier: Mask) -> NDArray[np.float64]:
    """Return the cost of the cheapest way from each cell to a frontier, in UNIT_M, inf where none is.

    On flat lists, which Python reads faster than arrays.
    """
    edges = [(step, prices.tolist()) for step, prices in _edges(free, weight)]
    cost = np.where(frontier, 0.0, np.inf).ravel().tolist()
    heap = [(0.0, int(cell)) for cell in np.flatnonzero(frontier)]
    while heap:
        level, cell = heapq.heappop(heap)
        if level > cost[cell]:
            continue  # a shorter way was found since
        for step, prices in edges:
            price = prices[cell]
            if price and level + price < cost[cell + step]:
                cost[cell + step] = level + price
                heapq.heappush(heap, (level + price, cell + step))
    return np.array(cost).reshape(free.shape)


def scipy_ways(free: Mask, weight: NDArray[np.int64], frontier: Mask) -> NDArray[np.float64]:
    """Return what `heap_ways` returns, by scipy's compiled Dijkstra on a sparse graph."""
    sources = np.flatnonzero(frontier)
    if not len(sources):
        return np.full(free.shape, np.inf)
    starts, ends, prices = [], [], []
    for step, price in itertools.islice(_edges(free, weight), 0, None, 2):  # one of each pair of opposite directions
        cells = np.flatnonzero(price)
        starts.append(cells)
        ends.append(cells + step)
        prices.append(price[cells])
    graph = csr_array(
        (np.concatenate(prices).astype(float), (np.concatenate(starts), np.concatenate(ends))),
        shape=(free.size, free.size),
    )
    cost: NDArray[np.float64] = dijkstra(graph, directed=False, indices=sources, min_only=True)
    return cost.reshape(free.shape)


def cost_at(cost: NDArray[np.int16], column: int, row: int) -> int:
    """Return the cost (padded, as `FrontierField.cost`) at a planning cell, or the least within two cells; or FAR."""
    inner = cost[PAD:-PAD, PAD:-PAD]
    for ring in range(3):
        window = inner[max(0, row - ring) : max(0, row + ring + 1), max(0, column - ring) : max(0, column + ring + 1)]
        best = int(window[window >= 0].min(initial=FAR))
        if best < FAR:
            return best
    return FAR
