"""The observation, pixel by pixel: what a view, a LiDAR sector and a motion number say about the world."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from pydantic import ValidationError

from imagine.core.frames import Pose
from imagine.core.frontier import PAD, FrontierField, frontier_field
from imagine.core.frontier_paths import BLOCKED
from imagine.core.lidar import LD19, LidarSpec, Scan
from imagine.core.observation import observe
from imagine.core.observation_spec import ObservationSpec
from imagine.core.raster import LIMIT

SPEC = ObservationSpec(view_cells=16)
HEADING = ObservationSpec(view_cells=16, axes="heading")
NOTHING = Scan(0.0, np.full(360, np.inf, np.float32))
ORIGIN = (-64, -64)  # a grid of 12.8 x 12.8 m around the map's origin
METRES = st.floats(-2.0, 2.0)
SEEDS = st.integers(0, 2**32 - 1)


def blank() -> NDArray[np.int8]:
    return np.zeros((128, 128), np.int8)


def at(belief: NDArray[np.int8], x: float, y: float) -> tuple[int, int]:
    return math.floor(y / 0.1) - ORIGIN[1], math.floor(x / 0.1) - ORIGIN[0]


def see(
    spec: ObservationSpec,
    belief: NDArray[np.int8],
    pose: Pose,
    velocity: tuple[float, float] = (0.0, 0.0),
    yaw_rate: float = 0.0,
    scan: Scan = NOTHING,
    lidar: LidarSpec = LD19,
    field: FrontierField | None = None,
) -> dict[str, NDArray[np.float32]]:
    return observe(spec, belief, field or frontier_field(belief), ORIGIN, pose, velocity, yaw_rate, scan, lidar)


@pytest.mark.parametrize(
    "spec",
    [
        SPEC,
        HEADING,
        ObservationSpec(),
        ObservationSpec(view_cells=8, view_scales_m=(0.2,), frontier_ranges_m=(2.0,), lidar_sectors=7),
        ObservationSpec(view_scales_m=(0.1, 0.2, 0.4, 0.8), frontier_ranges_m=(1.0, 2.0, 4.0, 8.0)),
    ],
)
def test_arrays_are_as_the_spec_says(spec: ObservationSpec) -> None:
    belief = np.random.default_rng(0).integers(-8, 9, (128, 128)).astype(np.int8)
    observation = see(spec, belief, Pose(0.3, -0.4, 1.0), (0.5, 0.1), 0.2)
    assert {name: array.shape for name, array in observation.items()} == spec.shapes
    assert all(array.dtype == np.float32 for array in observation.values())
    assert all(np.isfinite(array).all() for array in observation.values())
    assert np.abs(observation["views"]).max() <= 1.0
    assert observation["lidar"].min() >= 0.0
    assert observation["lidar"].max() <= 1.0


# In the middle of a cell the pixels' centres lie on cells' edges, where rounding decides.
OFF_MIDDLE = st.builds(
    lambda cell, part: (cell + part) * 0.1, st.integers(-20, 19), st.floats(0.02, 0.46) | st.floats(0.54, 0.98)
)


@given(OFF_MIDDLE, OFF_MIDDLE, st.integers(-8, 7), st.integers(-8, 7), st.integers(-LIMIT, LIMIT))
def test_a_cell_shows_where_it_lies_from_the_drone(x: float, y: float, right: int, up: int, value: int) -> None:
    """A cell of the fine view is the cell that lies as many cells east and north of the drone's own."""
    belief = blank()
    row, column = at(belief, x, y)
    belief[row + up, column + right] = value
    fine = see(SPEC, belief, Pose(x, y, 0.7))["views"][0]
    # The middle of an even view lies on a cell's edge, so the drone's own cell may be one of two a side.
    rows, columns = np.nonzero(fine)
    if value == 0:
        assert len(rows) == 0
    else:
        assert len(rows) == len(columns) <= 1
        if len(rows):
            assert fine[rows[0], columns[0]] == pytest.approx(value / LIMIT)
            assert rows[0] - up in (7, 8)
            assert columns[0] - right in (7, 8)
        else:
            assert up in (-8, 7) or right in (-8, 7)


def test_coarse_views_show_the_strongest_obstacle_or_the_mean_of_a_block() -> None:
    belief = blank()
    belief[64:68, 64:68] = -4  # the block of 0.4 m that begins at the origin
    pose = Pose(0.01, 0.01, 0.0)
    assert see(SPEC, belief, pose)["views"][2][8, 8] == pytest.approx(-0.5)
    belief[64:66, 64:68] = 0
    assert see(SPEC, belief, pose)["views"][2][8, 8] == pytest.approx(-0.25)
    belief[67, 67] = 2
    belief[66, 66] = 6
    assert see(SPEC, belief, pose)["views"][2][8, 8] == pytest.approx(0.75)


def test_outside_the_map_all_is_unknown_and_far() -> None:
    views = see(SPEC, blank() - np.int8(3), Pose(300.0, -300.0, 0.0))["views"]
    assert not views[[0, 2]].any()
    assert (views[[1, 3]] == 1.0).all()


@given(METRES, METRES, SEEDS)
def test_frontier_pixels_are_relative_to_the_drones_own_cell(x: float, y: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    cost = np.full((64 + 2 * PAD, 64 + 2 * PAD), BLOCKED, np.int16)
    cost[PAD:-PAD, PAD:-PAD] = np.where(rng.random((64, 64)) < 0.2, BLOCKED, rng.integers(0, 75, (64, 64)))
    field = FrontierField(cost, np.ones(cost.shape, np.uint8), np.zeros(cost.shape, np.uint8))
    distance = field.distance
    views = see(SPEC, blank(), Pose(x, y, 0.0), field=field)["views"]
    plan_row, plan_column = math.floor(y / 0.2) + 32, math.floor(x / 0.2) + 32
    own = distance[plan_row, plan_column]
    if not np.isfinite(own):
        ring = distance[plan_row - 1 : plan_row + 2, plan_column - 1 : plan_column + 2]
        own = ring.min()
    if not np.isfinite(own):
        return
    for i, j in ((0, 0), (3, 12), (9, 9), (15, 1)):
        column = math.floor(x / 0.1 + 0.5) - 8 + j + 64
        row = math.floor(y / 0.1 + 0.5) - 8 + i + 64
        there = distance[row // 2, column // 2]
        expected = np.clip(there - own, -1.0, 1.0) if np.isfinite(there) else 1.0
        assert views[1][i, j] == pytest.approx(expected, abs=1e-6)
        block_column = (math.floor(x / 0.4 + 0.5) - 8 + j) * 2 + 32
        block_row = (math.floor(y / 0.4 + 0.5) - 8 + i) * 2 + 32
        there = distance[block_row : block_row + 2, block_column : block_column + 2].min()
        expected = np.clip((there - own) / 4.0, -1.0, 1.0) if np.isfinite(there) else 1.0
        assert views[3][i, j] == pytest.approx(expected, abs=1e-6)


def test_with_nothing_left_to_explore_all_is_far() -> None:
    views = see(SPEC, np.full((128, 128), -8, np.int8), Pose(0.0, 0.0, 0.0), field=frontier_field(blank()))["views"]
    assert (views[[1, 3]] == 1.0).all()


def quarter_turns(belief: NDArray[np.int8], turns: int) -> NDArray[np.int8]:
    """Return the world turned clockwise about the map's origin, which a drone turned counter-clockwise sees."""
    return np.ascontiguousarray(np.rot90(belief, turns))  # rows run along y, so numpy's sense of turning is mirrored


@pytest.mark.parametrize("turns", [1, 2, 3])
def test_heading_axes_see_the_map_turned(turns: int) -> None:
    rng = np.random.default_rng(turns)
    belief = rng.choice(np.array([0, -6, 6], np.int8), (128, 128), p=[0.3, 0.65, 0.05])
    yaw = turns * math.pi / 2
    x, y = 0.93, -0.47  # in the middle of no cell, so that a turn by rounding errors moves no pixel
    pose = Pose(x, y, yaw)
    c, s = round(math.cos(yaw)), round(math.sin(yaw))
    straight = Pose(c * x + s * y, -s * x + c * y, 0.0)
    turned_scan = Scan(0.0, rng.uniform(0.3, 5.0, 360).astype(np.float32))
    velocity = (0.4, -0.2)
    ahead = (c * velocity[0] + s * velocity[1], -s * velocity[0] + c * velocity[1])
    seen = see(HEADING, belief, pose, velocity, 0.3, turned_scan)
    expected = see(SPEC, quarter_turns(belief, turns), straight, ahead, 0.3, turned_scan)
    np.testing.assert_allclose(seen["views"], expected["views"], atol=1e-5)
    np.testing.assert_array_equal(seen["lidar"], expected["lidar"])
    np.testing.assert_allclose(seen["motion"], expected["motion"], atol=1e-6)


def test_heading_and_map_axes_agree_for_a_drone_that_looks_east() -> None:
    belief = np.random.default_rng(1).integers(-8, 9, (128, 128)).astype(np.int8)
    scan = Scan(0.0, np.random.default_rng(2).uniform(0.1, 6.0, 360).astype(np.float32))
    one, other = (see(spec, belief, Pose(0.2, 0.3, 0.0), (0.1, 0.2), 1.0, scan) for spec in (SPEC, HEADING))
    for name, array in one.items():
        np.testing.assert_array_equal(array, other[name])


@pytest.mark.parametrize(("yaw_deg", "beam"), [(0, 90), (90, 0), (45, 45), (180, 270), (-90, 180)])
def test_a_return_shows_in_the_sector_of_its_direction(yaw_deg: float, beam: int) -> None:
    ranges = np.full(360, np.inf, np.float32)
    ranges[beam] = 1.0
    pose = Pose(0.0, 0.0, math.radians(yaw_deg) + 1e-9)  # just past the sector's edge
    sectors = see(ObservationSpec(lidar_sectors=4), blank(), pose, scan=Scan(0.0, ranges))["lidar"]
    assert sectors.tolist() == [1.0, 0.25, 1.0, 1.0]
    body = see(ObservationSpec(lidar_sectors=4, axes="heading"), blank(), pose, scan=Scan(0.0, ranges))["lidar"]
    assert body.tolist()[beam // 90] == 0.25


@given(SEEDS, st.integers(4, 90), st.floats(-7.0, 7.0))
def test_a_sector_reads_its_least_valid_range(seed: int, count: int, yaw: float) -> None:
    rng = np.random.default_rng(seed)
    ranges = rng.uniform(0.0, 6.0, 360).astype(np.float32)
    ranges[rng.random(360) < 0.2] = np.nan
    ranges[rng.random(360) < 0.2] = np.inf
    sectors = see(ObservationSpec(lidar_sectors=count), blank(), Pose(0, 0, yaw), scan=Scan(0.0, ranges))["lidar"]
    expected = np.ones(count)
    for beam, r in enumerate(ranges.astype(float)):
        if r >= LD19.range_min:
            sector = math.floor((beam * LD19.increment + yaw) / (2 * math.pi) * count) % count
            expected[sector] = min(expected[sector], r / 4.0)
    np.testing.assert_allclose(sectors, expected, atol=1e-6)


def test_a_sensor_that_looks_only_ahead_leaves_the_rest_open() -> None:
    ahead = LidarSpec(beams=90, fov=math.pi / 2, start=0.0)
    scan = Scan(0.0, np.full(90, 2.0, np.float32))
    sectors = see(ObservationSpec(lidar_sectors=4), blank(), Pose(0, 0, 0), scan=scan, lidar=ahead)["lidar"]
    assert sectors.tolist() == [0.5, 1.0, 1.0, 1.0]


@given(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0), st.floats(-10.0, 10.0))
def test_motion_is_scaled_and_bounded(vx: float, vy: float, rate: float) -> None:
    motion = see(SPEC, blank(), Pose(0.0, 0.0, 2.0), (vx, vy), rate)["motion"]
    np.testing.assert_allclose(motion, np.clip([vx / 0.8, vy / 0.8, rate / 3.0], -2.0, 2.0), atol=1e-6)


@pytest.mark.parametrize(
    "wrong",
    [
        {"view_cells": 9},
        {"view_scales_m": (0.3,), "frontier_ranges_m": (1.0,)},
        {"view_scales_m": (0.1,)},
        {"version": 3},
        {"version": 1, "peers": 1},
        {"version": 1, "visits": "self"},
        {"peers": -1},
        {"visits": "all"},
        {"axes": "compass"},
        {"lidar_sectors": 2},
    ],
)
def test_specs_that_cannot_be_built_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        ObservationSpec.model_validate(wrong)
