"""The baselines' kernels do what plain searches and sums do, on small grids."""

from __future__ import annotations

import heapq
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from imagine.core.dealing import coordinated_target
from imagine.core.frontier import FREE, OCCUPIED, PAD, UNKNOWN, refresh_kinds, refresh_states
from imagine.core.frontier_gaps import fill_flyable
from imagine.core.frontier_paths import BLOCKED, FAR, FRONTIER, NEAR, OPEN, search_scratch
from imagine.core.frontier_targets import (
    GAIN_MARGIN,
    claim,
    expected_gain,
    fill_ways,
    find_targets,
    gain_canvas,
    gain_rays,
    nearest_open,
)
from imagine.core.frontier_ways import follow, near_on_line, trace_back

RAYS, REACH = gain_rays(), 8
NOBODY = np.full(8, -1, np.int32)


def grid(inner: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Return padded states and kinds of planning cells in these states."""
    states = np.pad(inner, PAD, constant_values=UNKNOWN)
    kinds, cost = np.zeros(states.shape, np.uint8), np.full(states.shape, BLOCKED, np.int16)
    dirty, is_dirty = np.empty(states.size, np.int32), np.zeros(states.size, np.uint8)
    refresh_kinds(states, kinds, cost, (0, states.shape[0], 0, states.shape[1]), dirty, 0, is_dirty)
    return states, kinds


def random_grid(seed: int) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    rng = np.random.default_rng(seed)
    return grid(rng.choice(np.array([UNKNOWN, FREE, OCCUPIED], np.uint8), (14, 18), p=[0.12, 0.8, 0.08]))


def ways_from(kinds: NDArray[np.uint8], start: int) -> NDArray[np.int16]:
    cost = np.empty(kinds.shape, np.int16)
    fill_ways(cost, kinds, start, search_scratch(kinds.size))
    return cost


def plain_ways(kinds: NDArray[np.uint8], start: int) -> dict[int, int]:
    """Dijkstra's search with a heap, written from the rules in docs/architecture.md."""
    columns, flat = kinds.shape[1], kinds.ravel()
    settled: dict[int, int] = {}
    heap = [(0, start)]
    while heap:
        cost, cell = heapq.heappop(heap)
        if cell in settled:
            continue
        settled[cell] = cost
        for d_row in (-1, 0, 1):
            for d_column in (-1, 0, 1):
                other = cell + d_row * columns + d_column
                diagonal = d_row != 0 and d_column != 0
                if other == cell or not flat[other] & OPEN:
                    continue
                if diagonal and not (flat[cell + d_row * columns] & OPEN and flat[cell + d_column] & OPEN):
                    continue
                step = (7 if diagonal else 5) * (3 if (flat[cell] | flat[other]) & NEAR else 1)
                heapq.heappush(heap, (cost + step, other))
    return settled


@given(st.integers(0, 10_000))
@settings(max_examples=40, deadline=None)
def test_ways_are_the_cheapest_and_paths_run_along_them(seed: int) -> None:
    _, kinds = random_grid(seed)
    start = nearest_open(kinds, 9, 9, 8)
    if start < 0:
        return
    cost, plain = ways_from(kinds, start), plain_ways(kinds, start)
    for cell, value in enumerate(cost.ravel()):
        assert value == plain.get(cell, FAR if kinds.ravel()[cell] & OPEN else BLOCKED)
    path = np.empty(400, np.int32)
    for goal in list(plain)[::7]:
        length = trace_back(path, cost, kinds, goal)
        assert (path[0], path[length - 1]) == (start, goal)
        rows, columns = np.divmod(path[:length], kinds.shape[1])
        assert (np.maximum(abs(np.diff(rows)), abs(np.diff(columns))) == 1).all()
        assert (np.diff(cost.ravel()[path[:length]]) > 0).all()


def test_no_way_leads_out_of_a_closed_room() -> None:
    inner = np.full((12, 20), FREE, np.uint8)
    inner[:, 10] = OCCUPIED
    _, kinds = grid(inner)
    cost = ways_from(kinds, 6 * kinds.shape[1] + 6)
    goal = 6 * kinds.shape[1] + 18
    assert cost.ravel()[goal] == FAR
    assert trace_back(np.empty(50, np.int32), cost, kinds, goal) == 0


@given(st.integers(0, 10_000))
@settings(max_examples=40, deadline=None)
def test_every_frontier_in_reach_belongs_to_a_target(seed: int) -> None:
    _, kinds = random_grid(seed)
    start = nearest_open(kinds, 9, 9, 8)
    if start < 0:
        return
    cost, radius = ways_from(kinds, start), 4
    targets, marks = np.empty(96, np.int32), np.zeros(kinds.size, np.uint8)
    queue = np.empty(kinds.size, np.int32)
    found = find_targets(targets, kinds, cost, NOBODY, radius, marks, queue)
    reached = np.flatnonzero(((kinds & FRONTIER) != 0) & (cost >= 0) & (cost < FAR))
    assert not marks.any()
    assert len(set(targets[:found])) == found
    assert set(targets[:found]) <= set(reached)
    columns = kinds.shape[1]
    for cell in reached:
        rows_off, columns_off = targets[:found] // columns - cell // columns, targets[:found] % columns - cell % columns
        assert (np.maximum(abs(rows_off), abs(columns_off)) <= 2 * radius).any()
    banned = NOBODY.copy()
    if found:
        banned[3] = targets[0]
        kept = find_targets(targets, kinds, cost, banned, radius, marks, queue)
        apart = np.maximum(
            abs(targets[:kept] // columns - banned[3] // columns), abs(targets[:kept] % columns - banned[3] % columns)
        )
        assert (apart > 2).all()


def plain_gain(states: NDArray[np.uint8], left: NDArray[np.float64], cell: int, reach: int) -> float:
    """Gain by stepping along every ray, point by point."""
    row0, column0 = cell // states.shape[1] + 0.5, cell % states.shape[1] + 0.5
    wide = np.pad(states, GAIN_MARGIN, constant_values=UNKNOWN)  # of what lies beyond, nothing is known
    total, unknown = 0.0, 0.0
    for d_row, d_column in RAYS:
        hidden = False
        for step in range(1, reach + 1):
            total += step
            row, column = math.floor(row0 + step * d_row), math.floor(column0 + step * d_column)
            at = row + GAIN_MARGIN, column + GAIN_MARGIN
            hidden = hidden or bool(wide[at] == OCCUPIED)
            if not hidden and wide[at] == UNKNOWN:
                unknown += step * left[at]
    return unknown / total


def test_gain_counts_the_unknown_that_nothing_hides() -> None:
    """Half of what lies around a cell at the edge of the known is unknown; behind a wall nothing counts."""
    inner = np.full((60, 60), FREE, np.uint8)
    inner[:, 30:] = UNKNOWN
    states, _ = grid(inner)
    cell, everything = (30 + PAD) * states.shape[1] + 29 + PAD, gain_canvas(*states.shape)
    assert expected_gain(states, everything, cell, 20, RAYS) == pytest.approx(0.5, abs=0.03)
    assert expected_gain(states, 0.5 * everything, cell, 20, RAYS) == pytest.approx(0.25, abs=0.02)
    inner[:, 35] = OCCUPIED
    walled, _ = grid(inner)
    assert expected_gain(walled, everything, cell, 20, RAYS) < 0.2
    known = grid(np.full((60, 60), FREE, np.uint8))[0]
    assert expected_gain(known, everything, cell, 20, RAYS) == 0.0


def deal(
    states: NDArray[np.uint8],
    targets: NDArray[np.int32],
    ways: NDArray[np.float64],
    weight: float,
    form: int,
    share: float,
) -> int:
    """Deal with utilities as the survey makes them; return the target of robot 0."""
    left = gain_canvas(*states.shape)
    utility = np.array([expected_gain(states, left, target, REACH, RAYS) for target in targets])
    options = (weight, form, 1.0, REACH, share)
    return int(coordinated_target(ways, utility, targets, states, len(ways), len(targets), left, RAYS, options))


def plain_deal(
    states: NDArray[np.uint8], targets: NDArray[np.int32], ways: NDArray[np.float64], weight: float, share: float
) -> int:
    """Burgard et al. (2005), algorithm 1: the target of robot 0."""
    left, waiting, taken = np.float64(gain_canvas(*states.shape)), set(range(len(ways))), set[int]()
    while True:
        gains = [plain_gain(states, left, t, REACH) * (k not in taken) for k, t in enumerate(targets)]
        _, minus_t, minus_r = max(
            (gains[t] - weight * ways[r, t], -t, -r) for r in waiting for t in range(len(targets))
        )
        if minus_r == 0:
            return -minus_t
        waiting.discard(-minus_r)
        taken.add(-minus_t)
        if share == 0.0:
            continue
        cell = targets[-minus_t]
        row0, column0 = cell // states.shape[1] + 0.5, cell % states.shape[1] + 0.5
        for d_row, d_column in RAYS:
            for step in range(REACH):
                row, column = math.floor(row0 + step * d_row), math.floor(column0 + step * d_column)
                inside = 0 <= row < states.shape[0] and 0 <= column < states.shape[1]
                if inside and states[row, column] == OCCUPIED:
                    break
                at = row + GAIN_MARGIN, column + GAIN_MARGIN
                left[at] = min(left[at], 1.0 - share * (1.0 - step / REACH))


@given(st.integers(0, 10_000), st.sampled_from([0.0, 0.7, 1.0]))
@settings(max_examples=60, deadline=None)
def test_dealing_is_that_of_the_plain_algorithm(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    states, _ = random_grid(seed)
    robots, count = int(rng.integers(1, 5)), int(rng.integers(1, 8))
    rows, columns = rng.integers(PAD, 14 + PAD, count), rng.choice(18, count, replace=False) + PAD
    targets = (rows * states.shape[1] + columns).astype(np.int32)
    ways = rng.uniform(0.0, 10.0, (robots, count))
    assert deal(states, targets, ways, 0.02, 0, share) == plain_deal(states, targets, ways, 0.02, share)


@pytest.mark.parametrize("form", [0, 1, 2])
def test_two_drones_take_two_equal_frontiers(form: int) -> None:
    """Each decides for itself; the one that is a little nearer to both takes the nearer, the other the other."""
    inner = np.full((40, 40), FREE, np.uint8)
    inner[:4], inner[-4:] = UNKNOWN, UNKNOWN
    states, _ = grid(inner)
    columns = states.shape[1]
    targets = np.array([(4 + PAD) * columns + 20, (35 + PAD) * columns + 20], np.int32)
    mine, other = [3.0, 3.1], [2.9, 3.0]
    first = deal(states, targets, np.array([mine, other]), 0.02, form, 1.0)
    second = deal(states, targets, np.array([other, mine]), 0.02, form, 1.0)
    assert {first, second} == {0, 1}


def test_what_a_peer_will_see_is_left_to_it_unless_a_wall_is_between() -> None:
    """Of two frontiers of one unknown region the second is worth less once the first is dealt out."""
    inner = np.full((40, 40), FREE, np.uint8)
    inner[:14, 10:30] = UNKNOWN
    open_states, _ = grid(inner)
    inner[:24, 20] = OCCUPIED
    walled, _ = grid(inner)
    columns = walled.shape[1]
    first, second = (14 + PAD) * columns + 18 + PAD, (14 + PAD) * columns + 22 + PAD
    for states, least, most in ((open_states, 0.5, 0.8), (walled, 1.0, 1.0)):
        left = gain_canvas(*states.shape)
        before = expected_gain(states, left, second, REACH, RAYS)
        claim(left, states, first, REACH, RAYS, 1.0)
        assert least <= expected_gain(states, left, second, REACH, RAYS) / before <= most
        assert expected_gain(states, left, first, REACH, RAYS) < 0.75 * before


def test_nothing_to_deal_is_no_target() -> None:
    states, _ = grid(np.full((10, 10), FREE, np.uint8))
    assert deal(states, np.empty(0, np.int32), np.empty((1, 0)), 0.02, 0, 1.0) == -1


def test_a_way_around_a_corner_is_flown_straight_and_clear_of_it() -> None:
    """An L of two corridors 2 m wide: the first leg is one straight line, and its end looks around the corner."""
    inner = np.full((40, 40), OCCUPIED, np.uint8)
    inner[2:12, 2:38] = FREE
    inner[2:38, 28:38] = FREE
    states, kinds = grid(inner)
    columns = states.shape[1]
    start, goal = (6 + PAD) * columns + 5 + PAD, (34 + PAD) * columns + 33 + PAD
    cost = ways_from(kinds, start)
    path = np.empty(200, np.int32)
    length = trace_back(path, cost, kinds, goal)
    walls = np.argwhere(states == OCCUPIED)
    row, column, at = 6.5 + PAD, 5.5 + PAD, 0
    flown, turns, before = 0.0, 0.0, None
    for _ in range(400):
        d_row, d_column, at, lost = follow(path, length, at, kinds, states, row, column)
        assert not lost
        if math.hypot(goal // columns + 0.5 - row, goal % columns + 0.5 - column) < 0.8:
            break
        size = math.hypot(d_row, d_column)
        bearing = math.atan2(d_row, d_column)
        turns += 0.0 if before is None else abs(math.remainder(bearing - before, math.tau))
        before = bearing
        row, column, flown = row + 0.4 * d_row / size, column + 0.4 * d_column / size, flown + 0.4
        gaps = np.maximum(np.maximum(walls - (row, column), (row, column) - walls - 1.0), 0.0)
        assert np.hypot(*gaps.T).min() > 0.8  # cells: 0.16 m
    else:
        raise AssertionError("never arrived")
    assert flown < 1.05 * (math.hypot(23 - 0, 5) + 23.5)
    assert turns < 2.2  # hardly more than the quarter turn of the corner


def test_no_line_runs_through_obstacles_or_the_unknown() -> None:
    inner = np.full((20, 20), FREE, np.uint8)
    inner[:, 10] = UNKNOWN
    inner[5, 3] = OCCUPIED
    _, kinds = grid(inner)
    assert near_on_line(kinds, 10.5, 4.5, 10.5, 9.5) == 0.0
    assert near_on_line(kinds, 8.5, 1.5, 8.5, 9.5) > 0.0
    assert near_on_line(kinds, 10.5, 4.5, 10.5, 17.5) == -1.0
    assert near_on_line(kinds, 3.5, 5.5, 12.5, 5.5) == -1.0
    assert near_on_line(kinds, 10.5, 4.5, -40.0, 4.5) == -1.0


@pytest.mark.parametrize("shift", [0, 1])
@pytest.mark.parametrize(("width", "is_open"), [(5, True), (4, True), (3, False), (2, False)])
def test_a_gap_is_open_wherever_it_lies_on_the_grid(shift: int, width: int, is_open: bool) -> None:
    """A wall with a gap of so many map cells of 0.1 m parts two rooms; 0.3 m is too narrow for a drone."""
    belief = np.full((64, 64), -8, np.int8)
    belief[:, 30:33] = 8
    belief[20 + shift : 20 + shift + width, 30:33] = -8
    states = np.zeros((32 + 2 * PAD, 32 + 2 * PAD), np.uint8)
    for i in range(2):
        for j in range(2):
            refresh_states(belief, states, i, j)
    _, kinds = grid(states[PAD:-PAD, PAD:-PAD])
    flyable = np.empty_like(kinds)
    fill_flyable(flyable, kinds, states, belief)
    columns = kinds.shape[1]
    ways = ways_from(flyable, (10 + PAD) * columns + 5 + PAD)
    assert (ways.ravel()[(10 + PAD) * columns + 25 + PAD] < FAR) == is_open
    np.testing.assert_array_equal(flyable[kinds != 0], kinds[kinds != 0])
