"""The frontier field against a slow reference, written from its definition, on small random maps."""

from __future__ import annotations

import heapq
import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from imagine.core.frontier import (
    FREE,
    OCCUPIED,
    PAD,
    UNKNOWN,
    frontier_field,
    has_frontier,
    own_distance,
    plan_cell,
    refresh_kinds,
    refresh_states,
)
from imagine.core.frontier_paths import BLOCKED, search_scratch, update_costs
from imagine.core.raster import TILE

STRAIGHT_M, DIAGONAL_M, NEAR_WALL = 0.20, 0.28, 3.0
AROUND = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j]
PICTURE = {"?": 0, ".": -4, "#": 4}

Cell = tuple[int, int]


def reference(states: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Dijkstra from all frontiers, cell by cell; outside the grid all is unknown."""
    rows, columns = states.shape

    def state(cell: Cell) -> int:
        return int(states[cell]) if 0 <= cell[0] < rows and 0 <= cell[1] < columns else UNKNOWN

    def beside(cell: Cell, i: int, j: int) -> Cell:
        return cell[0] + i, cell[1] + j

    def squeezed(cell: Cell) -> bool:
        return any(
            state(beside(cell, i, j)) == OCCUPIED == state(beside(cell, -i, -j))
            for i, j in ((0, 1), (1, 0), (1, 1), (1, -1))
        )

    def opens(cell: Cell) -> bool:
        lone = all(state(beside(cell, i, j)) != UNKNOWN for i, j in AROUND)
        return state(cell) == UNKNOWN and not lone and not squeezed(cell)

    def passable(cell: Cell) -> bool:
        return state(cell) == FREE and not squeezed(cell)

    def weight(cell: Cell) -> float:
        return NEAR_WALL if any(state(beside(cell, i, j)) == OCCUPIED for i, j in AROUND) else 1.0

    distance = np.full(states.shape, np.inf)
    queue: list[tuple[float, Cell]] = []
    for cell in itertools.product(range(rows), range(columns)):
        if passable(cell) and any(opens(beside(cell, i, j)) for i, j in AROUND if not (i and j)):
            distance[cell] = 0.0
            heapq.heappush(queue, (0.0, cell))
    while queue:
        reached, cell = heapq.heappop(queue)
        if reached > distance[cell]:
            continue
        for i, j in AROUND:
            other = beside(cell, i, j)
            if not passable(other):
                continue
            if i and j and not (passable(beside(cell, i, 0)) and passable(beside(cell, 0, j))):
                continue
            step = (DIAGONAL_M if i and j else STRAIGHT_M) * max(weight(cell), weight(other))
            if reached + step < distance[other] - 1e-9:
                distance[other] = reached + step
                heapq.heappush(queue, (distance[other], other))
    return distance


def belief_of(states: NDArray[np.uint8]) -> NDArray[np.int8]:
    """Return a belief whose planning cells have these states."""
    units = np.array([0, -4, 4], np.int8)[states]
    return np.repeat(np.repeat(units, 2, axis=0), 2, axis=1)


def picture(*lines: str) -> NDArray[np.int8]:
    """Return a belief drawn one planning cell a character, the first line lowest."""
    units = np.array([[PICTURE[character] for character in line] for line in lines], np.int8)
    return np.repeat(np.repeat(units, 2, axis=0), 2, axis=1)


GRIDS = st.tuples(
    st.integers(1, 14), st.integers(1, 14), st.sampled_from([0.05, 0.3, 0.6]), st.sampled_from([0.05, 0.2, 0.4]),
    st.integers(0, 2**32 - 1),
)  # fmt: skip


@settings(max_examples=150)
@given(GRIDS)
def test_the_field_is_the_references(grid: tuple[int, int, float, float, int]) -> None:
    rows, columns, unknown, occupied, seed = grid
    rng = np.random.default_rng(seed)
    drawn = rng.random((rows, columns))
    states = np.where(drawn < unknown, UNKNOWN, np.where(drawn > 1 - occupied, OCCUPIED, FREE)).astype(np.uint8)
    field = frontier_field(belief_of(states))
    np.testing.assert_array_equal(field.states, states)
    np.testing.assert_allclose(field.distance, reference(states), rtol=1e-6)


def test_the_field_is_the_references_where_the_way_is_long() -> None:
    rng = np.random.default_rng(4)
    drawn = rng.random((40, 50))
    states = np.where(drawn > 0.92, OCCUPIED, FREE).astype(np.uint8)
    states[[0, -1], :] = states[:, [0, -1]] = OCCUPIED
    states[20:23, 24:27] = UNKNOWN
    field = frontier_field(belief_of(states))
    expected = reference(states)
    assert np.isfinite(expected).sum() > 1000
    np.testing.assert_allclose(field.distance, expected, rtol=1e-6)


@given(st.integers(0, 2**32 - 1))
def test_one_occupied_cell_makes_the_planning_cell_so_and_one_free_cell_beats_unknown(seed: int) -> None:
    belief = np.random.default_rng(seed).integers(-8, 8, (8, 6), np.int8, endpoint=True)
    belief[np.random.default_rng(seed + 1).random((8, 6)) < 0.6] = 0
    blocks = belief.reshape(4, 2, 3, 2)
    expected = np.where((blocks > 0).any(axis=(1, 3)), OCCUPIED, np.where((blocks < 0).any(axis=(1, 3)), FREE, UNKNOWN))
    np.testing.assert_array_equal(frontier_field(belief).states, expected)


def test_a_straight_way_in_the_open_costs_its_length() -> None:
    corridor = picture(*["." * 21] * 21)
    corridor[:, :2] = 0
    field = frontier_field(corridor)
    assert field.distance[10, 10] == pytest.approx(9 * 0.2, rel=1e-6)


def test_beside_a_wall_a_metre_costs_three() -> None:
    walled = picture("##########", "#.........", "#.........", "#.........", "##########")
    field = frontier_field(walled)
    assert field.distance[1, 9] == 0.0  # the grid ends there, and what lies beyond is unknown
    assert field.distance[2, 8] == pytest.approx(0.2)
    assert field.distance[2, 1] == pytest.approx(7 * 0.2 + 3 * 0.2)
    assert field.distance[1, 8] == pytest.approx(3 * 0.2)


def test_nothing_is_left_where_walls_close() -> None:
    room = picture("#####", "#...#", "#...#", "#...#", "#####")
    field = frontier_field(room)
    assert np.isinf(field.distance).all()
    assert math.isinf(own_distance(field, (0, 0), 0.5, 0.5))


def test_a_chink_in_a_wall_is_no_frontier_but_a_door_is() -> None:
    chink = picture("#######", "#.....#", "#.....#", "#.....#", "###?###")
    assert np.isinf(frontier_field(chink).distance).all()
    diagonal = picture("#######", "#.....#", "#.....#", "#.....#", "####?##", "?????##")
    assert np.isinf(frontier_field(diagonal).distance).all()
    door = picture("#######", "#.....#", "#.....#", "#.....#", "##???##")
    assert np.isfinite(frontier_field(door).distance).any()


def test_a_lone_unknown_cell_is_no_frontier_but_two_are() -> None:
    lone = picture("#######", "#.....#", "#..?..#", "#.....#", "#######")
    assert np.isinf(frontier_field(lone).distance).all()
    pair = picture("#######", "#.....#", "#..??.#", "#.....#", "#######")
    assert np.isfinite(frontier_field(pair).distance).any()


def test_a_gap_too_narrow_to_fly_is_no_way() -> None:
    gap = picture("#######", "#.....#", "#.....#", "###.###", "#.....#", "#.....?", "#.....?")
    field = frontier_field(gap)
    assert np.isfinite(field.distance[4, 3])
    assert np.isinf(field.distance[:4]).all()
    passage = picture("#######", "#.....#", "#.....#", "###..##", "#.....#", "#.....?", "#.....?")
    assert np.isfinite(frontier_field(passage).distance[1, 3])


def test_no_way_cuts_a_corner() -> None:
    corner = picture("??????", "#..###", "#..###", "###..#", "###..#", "######")
    field = frontier_field(corner)
    assert np.isfinite(field.distance[1, 1])
    assert np.isinf(field.distance[3:, :]).all()


def test_a_point_reads_its_own_cell_or_the_best_within_two() -> None:
    field = frontier_field(picture("##########", "#.........", "#.........", "#.........", "##########"))
    origin = (-4, 6)  # in map cells: the grid begins at (-0.4 m, 0.6 m)
    assert plan_cell(-0.3, 0.7, origin) == (0, 0)
    assert plan_cell(0.41, 1.01, origin) == (4, 2)
    assert own_distance(field, origin, 0.41, 1.01) == pytest.approx(float(field.distance[2, 4]))
    in_the_wall = own_distance(field, origin, 0.41, 0.61)
    assert in_the_wall == pytest.approx(float(field.distance[1, 3:6].min()))
    assert math.isinf(own_distance(field, origin, 50.0, 50.0))


class KeptField:
    """A field that is kept up to date tile by tile, as the twin keeps those of its drones."""

    def __init__(self, tile_rows: int, tile_columns: int) -> None:
        self.belief = np.zeros((tile_rows * TILE, tile_columns * TILE), np.int8)
        shape = tile_rows * TILE // 2 + 2 * PAD, tile_columns * TILE // 2 + 2 * PAD
        self.states, self.kinds = np.zeros(shape, np.uint8), np.zeros(shape, np.uint8)
        self.cost = np.full(shape, BLOCKED, np.int16)
        self.dirty, self.is_dirty = np.empty(self.cost.size, np.int32), np.zeros(self.cost.size, np.uint8)
        self.scratch = search_scratch(self.cost.size)

    def become(self, belief: NDArray[np.int8], rng: np.random.Generator) -> None:
        """Take over a belief, looking only at the tiles where it differs, in any order."""
        blocks = (belief != self.belief).reshape(len(belief) // TILE, TILE, -1, TILE)
        tiles = rng.permutation(np.argwhere(blocks.any(axis=(1, 3))))
        self.belief = belief.copy()
        boxes = [refresh_states(self.belief, self.states, row, column) for row, column in tiles]
        count = 0
        for box in boxes:
            if box[0] <= box[1]:
                count = refresh_kinds(self.states, self.kinds, self.cost, box, self.dirty, count, self.is_dirty)
        update_costs(self.cost, self.kinds, self.dirty, count, self.is_dirty, self.scratch)


def change(belief: NDArray[np.int8], rng: np.random.Generator) -> NDArray[np.int8]:
    """Return a belief changed as flights change it, or worse: patches, walls, doors, specks, forgetting, a tile."""
    rows, columns = belief.shape
    out = belief.copy()
    for _ in range(rng.integers(1, 4)):
        row, column = int(rng.integers(rows)), int(rng.integers(columns))
        value = int(rng.choice([-8, -1, 0, 2, 8]))
        match int(rng.integers(7)):
            case 0:
                out[row : row + rng.integers(1, rows), column : column + rng.integers(1, columns)] = value
            case 1:
                out[row : row + 2, column : column + rng.integers(2, columns)] = 8  # a wall
            case 2:
                out[row : row + rng.integers(2, rows), column : column + 2] = 8
            case 3:
                out[row : row + rng.integers(2, 8), column : column + rng.integers(2, 8)] = -8  # a door
            case 4:
                out[rng.random(out.shape) < rng.choice([0.001, 0.02])] = value
            case 5:
                out[out == 0] = -1  # all is known
            case _:
                row, column = row // TILE * TILE, column // TILE * TILE
                out[row : row + TILE, column : column + TILE] = value
    return out


@settings(max_examples=80)
@given(st.integers(1, 3), st.integers(1, 3), st.integers(1, 14), st.integers(0, 2**32 - 1))
def test_a_field_kept_up_to_date_is_the_field_from_nothing(rows: int, columns: int, steps: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    kept = KeptField(rows, columns)
    for _ in range(steps):
        kept.become(change(kept.belief, rng), rng)
        field = frontier_field(kept.belief)
        np.testing.assert_array_equal(kept.states, field.padded_states)
        np.testing.assert_array_equal(kept.cost, field.cost)
        assert has_frontier(kept.kinds) == (field.cost == 0).any()
        assert not kept.is_dirty.any()
        assert (kept.scratch[0] == -1).all()  # clean for whichever field is next
    np.testing.assert_allclose(field.distance, reference(field.states), rtol=1e-6)


def test_a_door_that_opens_and_shuts_on_a_long_way_round_changes_all_beyond_it() -> None:
    """Two rooms and one frontier: with the door shut the second room's distances go round, then nowhere."""
    rng = np.random.default_rng(0)
    belief = np.full((64, 96), -8, np.int8)
    belief[[0, 1, -1, -2], :] = belief[:, [0, 1, -1, -2]] = 8
    belief[:, 46:50] = 8
    belief[20:26, 46:50] = belief[50:56, 46:50] = -8  # two doors
    belief[30:36, 4:10] = 0  # the frontier, in the left room
    kept = KeptField(2, 3)
    kept.become(belief, rng)
    costs = []
    for doors in ((8, -8), (8, 8), (-8, 8), (-8, -8)):
        belief[20:26, 46:50], belief[50:56, 46:50] = doors
        kept.become(belief, rng)
        np.testing.assert_array_equal(kept.cost, frontier_field(belief).cost)
        costs.append(int(kept.cost[PAD + 10, PAD + 40]))
    assert costs[1] == 32767
    assert costs[0] > costs[2] == costs[3]
