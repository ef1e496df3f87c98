"""Each part of the plain step against the compiled one, on whatever input: evidence, field, views, sectors, shield."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from imagine.core import frontier, raster
from imagine.core.action import intended_velocity, to_intent
from imagine.core.contract import ActionSpec
from imagine.core.frames import Pose
from imagine.core.lidar import LidarSpec, Scan
from imagine.core.observation import observe
from imagine.core.observation_spec import ObservationSpec
from imagine.core.shield import shield_velocity
from imagine.core.vehicle_limits import VehicleLimits
from imagine.sim.plain.evidence import integrate_scan, line_cells, without_teammates
from imagine.sim.plain.field import Ways, cost_at, frontier_field, heap_ways, scipy_ways
from imagine.sim.plain.steering import body_velocity, intent, shielded
from imagine.sim.plain.views import motion, sectors, views

SEEDS = st.integers(0, 2**32 - 1)


def some_ranges(rng: np.random.Generator, beams: int, most: float = 6.0) -> NDArray[np.float32]:
    ranges = rng.uniform(0.0, most, beams).astype(np.float32)
    ranges[rng.random(beams) < 0.1] = np.inf
    ranges[rng.random(beams) < 0.1] = np.nan
    return ranges


def some_belief(rng: np.random.Generator, rows: int, columns: int) -> NDArray[np.int8]:
    """Blots of free space, walls across them, single cells of anything."""
    belief = np.zeros((rows, columns), np.int8)
    for _ in range(rng.integers(0, 12)):
        row, column = rng.integers(0, rows), rng.integers(0, columns)
        height, width = rng.integers(1, 24, 2)
        belief[row : row + height, column : column + width] = rng.integers(-8, 0)
    for _ in range(rng.integers(0, 10)):
        row, column, length = rng.integers(0, rows), rng.integers(0, columns), rng.integers(1, 30)
        if rng.random() < 0.5:
            belief[row : row + length, column] = rng.integers(1, 9)
        else:
            belief[row, column : column + length] = rng.integers(1, 9)
    dots = rng.random(belief.shape) < 0.01
    belief[dots] = rng.integers(-8, 9, dots.sum())
    return belief


@given(SEEDS, st.integers(1, 400), st.floats(0.3, 2.0 * math.pi), st.floats(0.6, 6.0))
def test_a_scan_leaves_the_same_evidence(seed: int, beams: int, fov: float, cap: float) -> None:
    rng = np.random.default_rng(seed)
    lidar = LidarSpec(beams=beams, fov=fov, start=rng.uniform(-3.0, 3.0))
    mine = rng.integers(-8, 9, (64, 96)).astype(np.int8)
    compiled, touched = mine.copy(), np.zeros((2, 3), np.bool_)
    ranges = some_ranges(rng, beams)
    x, y, yaw = rng.uniform((-4.0, -7.0, -9.0), (7.0, 1.0, 9.0))  # also where the grid ends before the beams do
    changed = raster.integrate_scan(
        compiled, touched, -32, -64, x, y, yaw, lidar.start, lidar.increment, ranges, lidar.range_min, cap
    )
    before = mine.copy()
    own_changed, tiles = integrate_scan(mine, (-32, -64), (x, y, yaw), ranges, lidar, cap)
    np.testing.assert_array_equal(mine, compiled)
    np.testing.assert_array_equal(tiles, touched)
    assert np.count_nonzero(mine != before) == changed == own_changed


def test_ranges_are_mapped_to_the_centimetre_and_never_past_the_cap() -> None:
    """0.3049 m is 0.30 m, which ends in the cell of 0.30 m, and 0.996 m ends before a cap of 0.999 m."""
    for measured, cap, end in ((0.2951, 4.0, 3), (0.2949, 4.0, 2), (0.9985, 0.999, 9)):
        cells = np.zeros((32, 32), np.int8)
        lidar = LidarSpec(beams=1)
        integrate_scan(cells, (0, 0), (0.0, 0.05, 0.0), np.array([measured], np.float32), lidar, cap)
        assert np.flatnonzero(cells[0] > 0).tolist() == [end]


def test_a_line_without_length_has_no_cells() -> None:
    rows, columns = line_cells(3, 4, np.array([3]), np.array([4]))
    assert len(rows) == len(columns) == 0


def test_returns_on_teammates_are_left_out_and_no_others() -> None:
    lidar = LidarSpec(beams=4)
    ranges = np.array([2.0, 2.0, np.inf, 4.3], np.float32)
    places = np.array([[3.1, 1.05], [-2.0, 1.0], [1.0, -3.3], [50.0, 0.0]])
    kept = without_teammates(ranges, lidar, (1.0, 1.0, 0.0), places)
    np.testing.assert_array_equal(kept, [np.nan, 2.0, np.inf, np.nan])
    turned = without_teammates(ranges, lidar, (1.0, 1.0, -math.pi / 2), places)
    np.testing.assert_array_equal(turned, [2.0, np.nan, np.inf, np.float32(4.3)])


@pytest.mark.parametrize("ways", [heap_ways, scipy_ways])
@given(seed=SEEDS)
def test_the_frontier_field_is_the_same(ways: Ways, seed: int) -> None:
    rng = np.random.default_rng(seed)
    belief = some_belief(rng, *(2 * rng.integers(1, 40, 2)))
    compiled, mine = frontier.frontier_field(belief), frontier_field(belief, ways)
    np.testing.assert_array_equal(mine.padded_states, compiled.padded_states)
    np.testing.assert_array_equal(mine.cost, compiled.cost)
    for row, column in rng.integers(-5, 45, (10, 2)).tolist():
        assert cost_at(mine.cost, column, row) == frontier.cost_at(compiled.cost, column, row)


def test_random_beliefs_do_have_frontiers_and_walls() -> None:
    """The property above would say nothing about fields that are all infinite."""
    beliefs = [some_belief(np.random.default_rng(seed), 64, 64) for seed in range(20)]
    reached = [np.isfinite(frontier.frontier_field(belief).distance).mean() for belief in beliefs]
    assert np.mean(reached) > 0.1


@given(SEEDS, st.sampled_from(["map", "heading"]), st.sampled_from([(0.1, 0.4), (0.2,), (0.8, 0.1, 0.4)]))
def test_a_policy_sees_the_same(seed: int, axes: object, scales: tuple[float, ...]) -> None:
    rng = np.random.default_rng(seed)
    lidar = LidarSpec(beams=int(rng.integers(1, 400)), start=rng.uniform(-3.0, 3.0))
    spec = ObservationSpec.model_validate(
        {"view_cells": 16, "view_scales_m": scales, "frontier_ranges_m": [1.0] * len(scales), "axes": axes}
    )
    belief = some_belief(rng, 64, 96)
    field = frontier.frontier_field(belief)
    origin = 32, -64
    x, y, yaw = rng.uniform((2.0, -8.0, -4.0), (14.0, 1.0, 4.0))
    velocity = rng.uniform(-2.5, 2.5, 3)
    scan = Scan(0.0, some_ranges(rng, lidar.beams))
    seen = observe(spec, belief, field, origin, Pose(x, y, yaw), (velocity[0], velocity[1]), velocity[2], scan, lidar)
    turn = yaw if axes == "heading" else 0.0
    np.testing.assert_array_equal(views(spec, belief, field.cost, origin, (x, y), turn), seen["views"])
    np.testing.assert_array_equal(
        sectors(scan.ranges, lidar, yaw - turn, spec.lidar_sectors, spec.lidar_range_m), seen["lidar"]
    )
    np.testing.assert_allclose(motion(spec, velocity, turn), seen["motion"], atol=1e-6)


@given(
    SEEDS,
    st.sampled_from(["plane", "body", "forward", "waypoint"]),
    st.sampled_from(["map", "heading"]),
    st.floats(0.1, 2.0),
)
def test_an_action_becomes_the_same_setpoint(seed: int, mode: object, axes: object, nearest: float) -> None:
    rng = np.random.default_rng(seed)
    spec, limits = ActionSpec.model_validate({"mode": mode}), VehicleLimits()
    lidar = LidarSpec(beams=int(rng.integers(1, 90)), range_min=0.01)
    action = rng.uniform(-1.5, 1.5, spec.size).astype(np.float32)
    taken, later = (Pose(*rng.uniform((-2.0, -2.0, -4.0), (2.0, 2.0, 4.0)).tolist()) for _ in range(2))
    compiled, mine = to_intent(action, spec, axes, taken), intent(action, spec, axes == "map", taken)  # type: ignore[arg-type]
    assert mine == pytest.approx(compiled[: len(mine)], abs=1e-12)
    wanted = intended_velocity(compiled, spec, axes, later)  # type: ignore[arg-type]
    assert body_velocity(mine, spec, axes == "map", later) == pytest.approx(wanted, abs=1e-12)
    scan = Scan(0.0, some_ranges(rng, lidar.beams, nearest))
    safe = shield_velocity(wanted[0], wanted[1], scan, lidar, limits)
    assert shielded(wanted[0], wanted[1], scan.ranges, lidar, limits) == pytest.approx(safe, abs=1e-9)
