"""How a scan becomes evidence: one update a cell, hits first, beams cut at the cap, clamped."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from imagine.core.raster import CELL, HIT, LIMIT, MISS, RANGE_STEP_M, TILE, integrate_scan, probability, sum_layers

SIDE = 128  # 12.8 m, the map's origin in the middle
ORIGIN = -SIDE // 2
CAP_M = 4.0
METRES = st.floats(-1.5, 1.5)
ANGLES = st.floats(-7.0, 7.0)
RANGES = st.one_of(st.floats(0.0, 6.0), st.sampled_from([math.inf, math.nan, -math.inf]))


def draw(
    cells: NDArray[np.int8], x: float, y: float, yaw: float, ranges: list[float], fov: float = 2 * math.pi
) -> tuple[int, NDArray[np.bool_]]:
    touched = np.zeros((cells.shape[0] // TILE, cells.shape[1] // TILE), np.bool_)
    values = np.array(ranges, np.float32)
    changed = integrate_scan(
        cells, touched, ORIGIN, ORIGIN, x, y, yaw, 0.0, fov / len(values), values, 0.05, CAP_M
    )  # fmt: skip
    return changed, touched


def empty() -> NDArray[np.int8]:
    return np.zeros((SIDE, SIDE), np.int8)


def ends_at(x: float, y: float, yaw: float, bearing: float, r: float) -> tuple[int, int]:
    """Return the cell that a return at `r`, rounded to the centimetre as all mapped ranges are, falls into."""
    r = float(np.float32(min(max(round(float(np.float32(r)) / RANGE_STEP_M), 1), CAP_M / RANGE_STEP_M) * RANGE_STEP_M))
    c, s, cb, sb = math.cos(yaw), math.sin(yaw), math.cos(bearing), math.sin(bearing)
    return cell_of(x + r * (c * cb - s * sb), y + r * (s * cb + c * sb))


def cell_of(x: float, y: float) -> tuple[int, int]:
    return math.floor(y / CELL) - ORIGIN, math.floor(x / CELL) - ORIGIN


@given(METRES, METRES, ANGLES, st.floats(0.3, 3.9))
def test_a_beam_frees_its_line_and_marks_its_end(x: float, y: float, yaw: float, distance: float) -> None:
    cells = empty()
    draw(cells, x, y, yaw, [distance])
    row0, column0 = cell_of(x, y)
    row1, column1 = ends_at(x, y, yaw, 0.0, distance)
    assert cells[row1, column1] == HIT
    rows, columns = np.nonzero(cells == MISS)
    assert len(rows) == max(abs(row1 - row0), abs(column1 - column0)) == np.count_nonzero(cells) - 1
    # All freed cells lie within half a cell, along the minor axis, of the line between the end cells' centres.
    length = math.hypot(row1 - row0, column1 - column0)
    across = np.abs((rows - row0) * (column1 - column0) - (columns - column0) * (row1 - row0)) / length
    assert across.max() <= 0.5 + 1e-9
    assert (row0, column0) in set(zip(rows, columns, strict=True))


@given(METRES, METRES, ANGLES, st.sampled_from([math.inf, 4.5, 12.0]))
def test_what_lies_past_the_cap_frees_the_whole_length_and_marks_nothing(
    x: float, y: float, yaw: float, distance: float
) -> None:
    cells = empty()
    draw(cells, x, y, yaw, [distance])
    row0, column0 = cell_of(x, y)
    row1, column1 = cell_of(x + CAP_M * math.cos(yaw), y + CAP_M * math.sin(yaw))
    assert (cells <= 0).all()
    assert np.count_nonzero(cells) == max(abs(row1 - row0), abs(column1 - column0))


@pytest.mark.parametrize("distance", [math.nan, 0.01, 0.0, -1.0, -math.inf])
def test_invalid_ranges_say_nothing(distance: float) -> None:
    cells = empty()
    changed, touched = draw(cells, 0.0, 0.0, 0.0, [distance] * 16)
    assert changed == 0
    assert not cells.any()
    assert not touched.any()


@given(METRES, METRES, ANGLES, st.lists(RANGES, min_size=1, max_size=60), st.integers(0, 2**32 - 1))
def test_a_cell_takes_at_most_one_update_a_scan_and_a_hit_wins(
    x: float, y: float, yaw: float, ranges: list[float], seed: int
) -> None:
    before = np.random.default_rng(seed).integers(-LIMIT, LIMIT, (SIDE, SIDE), np.int8, endpoint=True)
    cells = before.copy()
    changed, touched = draw(cells, x, y, yaw, ranges)
    hits = np.zeros((SIDE, SIDE), bool)
    for beam, r in enumerate(np.array(ranges, np.float32).astype(float)):
        if 0.05 <= r <= CAP_M:
            hits[ends_at(x, y, yaw, beam * (2 * math.pi / len(ranges)), r)] = True
    expected_hit = np.minimum(before.astype(int) + HIT, LIMIT)
    expected_miss = np.maximum(before.astype(int) + MISS, -LIMIT)
    assert (cells[hits] == expected_hit[hits]).all()
    elsewhere = ~hits
    assert ((cells == before) | (cells == expected_miss))[elsewhere].all()
    different = cells != before
    assert changed == np.count_nonzero(different)
    tiles = different.reshape(SIDE // TILE, TILE, SIDE // TILE, TILE).any(axis=(1, 3))
    np.testing.assert_array_equal(touched, tiles)


@pytest.mark.parametrize("order", [1, -1])
def test_a_hit_is_kept_where_another_beam_passes_through_its_cell(order: int) -> None:
    cells = empty()
    draw(cells, 0.05, 0.05, -0.005, [1.0, 3.0, math.inf][::order], fov=0.01)
    assert cells[cell_of(1.05, 0.05)] == HIT
    assert cells[cell_of(2.05, 0.05)] == MISS
    assert cells[cell_of(3.05, 0.05)] == HIT


def test_looking_on_saturates_and_then_changes_nothing() -> None:
    cells = empty()
    ranges = [2.0] * 360
    for _ in range(LIMIT):
        draw(cells, 0.0, 0.0, 0.0, ranges)
    assert set(np.unique(cells)) == {-LIMIT, 0, LIMIT}
    changed, touched = draw(cells, 0.0, 0.0, 0.0, ranges)
    assert changed == 0
    assert not touched.any()


def test_what_moved_away_is_forgotten_within_two_seconds() -> None:
    cells = empty()
    for _ in range(20):
        draw(cells, 0.05, 0.05, 0.0, [2.0])
    for _ in range(20):
        draw(cells, 0.05, 0.05, 0.0, [3.0])
    assert cells[cell_of(2.05, 0.05)] == -LIMIT


@given(st.floats(-20.0, 20.0), st.floats(-20.0, 20.0))
def test_cells_outside_the_grid_are_left_out(x: float, y: float) -> None:
    inside, whole = empty(), np.zeros((8 * SIDE, 8 * SIDE), np.int8)
    draw(inside, x, y, 0.3, [3.0, math.inf, 1.0, 5.0] * 4)
    touched = np.zeros((8 * SIDE // TILE, 8 * SIDE // TILE), np.bool_)
    first = 4 * ORIGIN * 2
    values = np.array([3.0, math.inf, 1.0, 5.0] * 4, np.float32)
    integrate_scan(whole, touched, first, first, x, y, 0.3, 0.0, 2 * math.pi / 16, values, 0.05, CAP_M)
    part = slice(ORIGIN - first, ORIGIN - first + SIDE)
    np.testing.assert_array_equal(inside, whole[part, part])


@given(st.integers(0, 2**32 - 1), st.integers(1, 17))
def test_the_belief_is_the_clamped_sum(seed: int, sources: int) -> None:
    layers = np.random.default_rng(seed).integers(-LIMIT, LIMIT, (sources, 6, 5), np.int8, endpoint=True)
    out = np.empty((6, 5), np.int8)
    sum_layers(layers, out)
    np.testing.assert_array_equal(out, np.clip(layers.astype(int).sum(axis=0), -LIMIT, LIMIT))


def test_probabilities_of_the_limits() -> None:
    assert probability(np.array([-LIMIT, 0, LIMIT], np.int8)) == pytest.approx([0.039, 0.5, 0.961], abs=0.001)
