"""What can be flown and seen: by the planner's rule for passages, and by straight lines of sight of four metres."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from imagine.core.raster import CELL
from imagine.sim.generator import generate_level
from imagine.sim.level import Level, load_level, rectangle
from imagine.sim.level_check import hidden_regions, narrowest_passage_m
from imagine.sim.level_survey import FLIGHT_CLEARANCE_M, SIGHT_M, lattice_index, reachable, roomiest_point

NO_POSTS = np.empty((0, 3))


def room(width: float, depth: float, *polygons: NDArray[np.float64], launch: tuple[float, float]) -> Level:
    outline = np.array([[0.0, 0.0], [width, 0.0], [width, depth], [0.0, depth]])
    return Level("room", "", outline, polygons, NO_POSTS, launch)


def block(x0: float, y0: float, x1: float, y1: float) -> NDArray[np.float64]:
    return rectangle(((x0 + x1) / 2, (y0 + y1) / 2), (x1 - x0, y1 - y0), 0.0)


def two_rooms(gap: float, at: float) -> Level:
    """Rooms of 4 × 4 m with a wall between them, 0.4 m thick, and a passage through it."""
    return room(8.4, 4.0, block(4, 0, 4.4, at), block(4, at + gap, 4.4, 4), launch=(1.0, 1.0))


def cell(level: Level, x: float, y: float) -> tuple[int, int]:
    return math.floor(y / CELL) - level.grid[1], math.floor(x / CELL) - level.grid[0]


def reaches(level: Level, x: float, y: float) -> bool:
    _, clearance = level.geometry.lattice()
    return bool(reachable(clearance, level.grid, level.launch)[lattice_index((x, y), level.grid)])


@given(st.floats(0.4, 3.0))
def test_a_passage_of_half_a_metre_is_open_and_one_of_04_is_closed_wherever_it_lies(at: float) -> None:
    assert reaches(two_rooms(0.5, at), 7.0, 2.0)
    assert not reaches(two_rooms(0.4, at), 7.0, 2.0)


def test_behind_a_passage_that_is_open_nothing_is_hidden_and_behind_a_closed_one_much_is() -> None:
    assert not hidden_regions(two_rooms(0.5, 1.0))
    closed = two_rooms(0.4, 1.0)
    (first, *_) = hidden_regions(closed)
    assert first.point[0] > 4.4
    assert not closed.flyable[:, cell(closed, 4.4, 0)[1] :].any()
    assert closed.coverable[cell(closed, 4.85, 1.25)]  # one can still look in


@given(st.floats(0.0, math.pi), st.floats(-0.5, 0.5))
def test_so_it_is_in_whichever_direction_it_leads(yaw: float, shift: float) -> None:
    c, s = math.cos(yaw), math.sin(yaw)

    def reached(gap: float) -> bool:
        middle = np.array([6.0 + shift * s, 6.0 - shift * c])
        walls = [
            rectangle(tuple(middle + side * (gap / 2 + 8.0) * np.array([-s, c])), (0.4, 16.0), yaw) for side in (-1, 1)
        ]
        launch, goal = middle - 1.5 * np.array([c, s]), middle + 1.5 * np.array([c, s])
        level = room(12.0, 12.0, *walls, launch=(float(launch[0]), float(launch[1])))
        return reaches(level, float(goal[0]), float(goal[1]))

    assert reached(0.5)
    assert not reached(0.4)


def test_a_niche_too_narrow_to_enter_counts_as_far_as_one_can_see_into_it() -> None:
    straight = room(6.0, 4.0, block(4, 0, 6, 1.8), block(4, 2.1, 6, 4), launch=(1.0, 1.0))
    assert not hidden_regions(straight)
    assert straight.coverable[cell(straight, 5.85, 1.95)]
    bent = room(6.0, 4.0, block(4, 0, 5.7, 1.8), block(4, 2.1, 6, 4), launch=(1.0, 1.0))
    assert bent.free[cell(bent, 5.85, 0.35)]
    assert not bent.coverable[cell(bent, 5.85, 0.35)]
    (region,) = hidden_regions(bent)
    assert 0.25 <= region.area_m2 <= 0.3 * 1.8
    assert 5.7 < region.point[0] < 6.0
    assert region.point[1] < 1.8


def test_sight_ends_at_four_metres() -> None:
    level = room(8.0, 3.0, block(2, 0, 8, 1.4), block(2, 1.6, 8, 3), launch=(1.0, 1.0))
    seen = np.flatnonzero(level.coverable[cell(level, 0.05, 1.55)[0]])
    farthest = (seen.max() + level.grid[0] + 0.5) * CELL
    # from 0.3 m inside the mouth of the slot, where a drone of this clearance just gets to
    assert farthest == pytest.approx(2.0 + SIGHT_M - CELL, abs=0.3)
    assert farthest < 2.0 + SIGHT_M


def test_thin_walls_are_no_window() -> None:
    level = room(6.0, 4.0, block(3, 0, 3.004, 4), launch=(1.0, 1.0))
    assert not level.coverable[:, cell(level, 3.05, 0)[1] :].any()
    (region,) = hidden_regions(level)
    assert region.area_m2 == pytest.approx(12.0, rel=0.02)


def blocked(start: NDArray[np.float64], ends: NDArray[np.float64], level: Level) -> NDArray[np.bool_]:
    """Tell, for straight ways `[n, 2]` from a cell's centre, whether an edge or post stands in them (in numpy)."""
    way = (ends - start)[:, None, :]
    origin, edge = level.segments[None, :, :2] - start, (level.segments[:, 2:] - level.segments[:, :2])[None]
    cross = way[..., 0] * edge[..., 1] - way[..., 1] * edge[..., 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (origin[..., 0] * edge[..., 1] - origin[..., 1] * edge[..., 0]) / cross
        u = (origin[..., 0] * way[..., 1] - origin[..., 1] * way[..., 0]) / cross
    length = np.hypot(way[..., 0], way[..., 1])
    hit: NDArray[np.bool_] = ((t * length > 2e-3) & (t <= 1.0) & (u >= 0.0) & (u <= 1.0)).any(axis=1)
    for x, y, radius in level.circles:
        share = np.clip(((np.array([x, y]) - start) * way[:, 0]).sum(axis=1) / length[:, 0] ** 2, 0.0, 1.0)
        nearest = start + share[:, None] * way[:, 0]
        hit |= np.hypot(nearest[:, 0] - x, nearest[:, 1] - y) < radius
    return hit


@pytest.mark.parametrize("level", [load_level("5"), generate_level(7), generate_level(24)], ids=lambda lv: lv.name)
def test_what_counts_is_seen_from_where_drones_fly_and_the_rest_is_not(level: Level) -> None:
    column0, row0, _, _ = level.grid
    _, clearance = level.geometry.lattice()
    rows, columns = np.nonzero(reachable(clearance, level.grid, level.launch))
    points = np.column_stack(((2 * column0 + columns) * CELL / 2, (2 * row0 + rows) * CELL / 2))
    rng = np.random.default_rng(1)
    seen = np.argwhere(level.coverable & ~level.flyable)
    unseen = np.argwhere(level.free & ~level.coverable)

    def is_seen(row: int, column: int) -> bool:
        centre = np.array([(column + column0 + 0.5) * CELL, (row + row0 + 0.5) * CELL])
        apart = np.hypot(*(points - centre).T)
        order = np.argsort(apart)
        near = points[order[(apart[order] <= SIGHT_M - CELL + 1e-9) & (apart[order] > 0)]]
        return any(not blocked(centre, near[k : k + 200], level).all() for k in range(0, len(near), 200))

    assert all(is_seen(*at) for at in rng.permutation(seen)[:150])
    # of the others a few are seen through slits that the search of the survey, half a degree a ray, passes over
    assert sum(is_seen(*at) for at in unseen) <= 0.1 * len(unseen)


def test_clearances_are_distances() -> None:
    level = load_level("6")
    column0, row0, _, _ = level.grid
    inside, clearance = level.geometry.lattice()
    rng = np.random.default_rng(0)
    for i, j in rng.permutation(np.argwhere(inside))[:300]:
        x, y = (2 * column0 + j) * CELL / 2, (2 * row0 + i) * CELL / 2
        edges = level.segments[:, 2:] - level.segments[:, :2]
        t = np.clip(((np.array([x, y]) - level.segments[:, :2]) * edges).sum(axis=1) / (edges**2).sum(axis=1), 0, 1)
        to_edges = np.hypot(*(level.segments[:, :2] + t[:, None] * edges - (x, y)).T).min()
        to_posts = (np.hypot(level.circles[:, 0] - x, level.circles[:, 1] - y) - level.circles[:, 2]).min()
        assert clearance[i, j] == pytest.approx(min(to_edges, to_posts, 0.6), abs=1e-9)
    assert (clearance[~inside] == 0.0).all()


@pytest.mark.parametrize(("gap", "at"), [(0.6, 1.0), (0.75, 1.23), (0.9, 2.02)])
def test_the_narrowest_passage_is_measured(gap: float, at: float) -> None:
    assert narrowest_passage_m(two_rooms(gap, at)) == pytest.approx(gap, abs=0.06)
    assert narrowest_passage_m(two_rooms(1.2, at)) is None


def test_the_roomiest_point_of_a_room_is_its_middle_and_repeats() -> None:
    level = room(5.0, 4.0, block(0, 0, 2, 4), launch=(3.0, 2.0))
    x, y = roomiest_point(level.geometry)
    assert x == pytest.approx(3.5, abs=0.001)
    assert 1.5 <= y <= 2.5
    assert (x, y) == roomiest_point(level.geometry)


def test_drones_keep_clear_where_they_are_said_to_fly() -> None:
    for level in (load_level("6"), generate_level(5)):
        rows, columns = np.nonzero(level.flyable)
        centres = np.column_stack(((columns + level.grid[0] + 0.5) * CELL, (rows + level.grid[1] + 0.5) * CELL))
        assert level.is_free(centres, FLIGHT_CLEARANCE_M - 1e-6).all()
        assert level.is_free(level.launch_spots, 0.25).all()
