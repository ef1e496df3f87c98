"""Scans of many worlds at once: noise that is a world's own, a reach that only leaves out, and all that moves."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from ray_reference import furthest_error, reference

from imagine.core.errors import InputError
from imagine.core.lidar import LD19, PRESETS, LidarSpec
from imagine.sim.keyed_noise import LARGEST_DEVIATE, normal_table
from imagine.sim.level import BUILT_IN, Level, load_level
from imagine.sim.level_index import facing_edges, level_index
from imagine.sim.lidar_model import LidarModel
from imagine.sim.sensing import Sensing
from imagine.sim.twin import Twin
from imagine.sim.workers import Workers

LEVELS = {name: load_level(name) for name in BUILT_IN}
IDEAL = LidarSpec(beams=180, noise_std=0.0, range_min=0.0)
ROOM = LEVELS["0"]


def make(levels: list[Level], drones: int = 2, spec: LidarSpec = LD19, threads: int = 1, **rest: object) -> Sensing:
    sensing = Sensing(len(levels), drones, spec, 5, Workers(threads), **rest)  # type: ignore[arg-type]
    for world, level in enumerate(levels):
        sensing.set_level(world, level)
    return sensing


def launched(levels: list[Level], drones: int = 2, seed: int = 0) -> NDArray[np.float64]:
    rng = np.random.default_rng(seed)
    return np.array([level.launch_poses(drones, rng) for level in levels])


def look(sensing: Sensing, poses: NDArray[np.float64], tick: int = 0, **rest: object) -> NDArray[np.float32]:
    return sensing.scan(poses, np.zeros_like(poses), 0.08, tick, **rest)  # type: ignore[arg-type]


@pytest.mark.parametrize("model", [LidarModel(), LidarModel(noise_per_m=0.02, noise_std_m=0.03, miss_at_max=0.3)])
@pytest.mark.parametrize("reach_m", [0.7, 4.0, 6.0])
def test_a_shorter_reach_leaves_out_what_is_measured_beyond_it_and_changes_nothing_else(
    reach_m: float, model: LidarModel
) -> None:
    levels = [LEVELS[name] for name in BUILT_IN] * 3
    poses = launched(levels)
    whole = look(make(levels, model=model), poses)
    near = look(make(levels, model=model), poses, reach_m=reach_m)
    np.testing.assert_array_equal(near, np.where(whole > reach_m, np.inf, whole))
    assert np.isfinite(near).any()
    assert (np.isfinite(whole) & np.isinf(near)).any()


def test_reaches_may_change_from_scan_to_scan() -> None:
    levels = [LEVELS["6"], LEVELS["4"]]
    poses, sensing = launched(levels), make(levels)
    near, far = look(sensing, poses, reach_m=3.0), look(sensing, poses)
    np.testing.assert_array_equal(near, look(make(levels), poses, reach_m=3.0))
    np.testing.assert_array_equal(near, look(sensing, poses, reach_m=3.0))
    np.testing.assert_array_equal(far, look(make(levels), poses))


def test_a_worlds_scan_depends_on_seed_key_tick_and_drone_alone() -> None:
    levels = [LEVELS["3"], LEVELS["6"], LEVELS["3"], LEVELS["1"]]
    poses = launched(levels)
    together = look(make(levels, world_keys=[7, 2, 9, 4]), poses, tick=3)
    for world, key in enumerate([7, 2, 9, 4]):
        alone = look(make([levels[world]], world_keys=[key]), poses[[world]], tick=3)
        np.testing.assert_array_equal(together[world], alone[0])
    np.testing.assert_array_equal(together, look(make(levels, threads=3, world_keys=[7, 2, 9, 4]), poses, tick=3))


def test_seed_key_tick_drone_and_beam_each_change_the_noise() -> None:
    def noise(seed: int, key: int, tick: int) -> NDArray[np.float64]:
        sensing = Sensing(1, 2, LidarSpec(beams=64, noise_std=0.05), seed, Workers(1), [key])
        sensing.set_level(0, ROOM)
        poses = np.array([[[3.0, 3.0, 0.0], [3.0, 3.0, 0.0]]])
        scan = sensing.scan(poses, np.zeros((1, 2, 3)), 0.0, tick)[0].astype(np.float64)
        exact = reference(ROOM.segments, ROOM.circles, np.full((64, 2), 3.0), np.arange(64) * math.tau / 64, 12.0)
        return scan - exact

    draws = [noise(2**63 + 5, 1, 1), noise(2, 1, 1), noise(-1, 1, 1), noise(2, 3, 1), noise(2, 1, 2)]
    rows = np.concatenate(draws)
    assert (np.abs(np.corrcoef(rows) - np.eye(len(rows))) < 0.5).all()
    assert (np.abs(np.diff(rows, axis=1)) > 0.0).mean() > 0.99
    np.testing.assert_array_equal(noise(2, 3, 1), noise(2, 3, 1))


def test_noise_is_gaussian_of_the_given_width_and_beams_are_independent() -> None:
    sensing = make([ROOM] * 100, 1, LidarSpec(beams=360, noise_std=0.02))
    poses = np.tile([3.0, 3.0, 0.1], (100, 1, 1))
    exact = look(make([ROOM], 1, LidarSpec(beams=360, noise_std=0.0)), poses[:1])
    error = (look(sensing, poses) - exact).reshape(100, 360).astype(np.float64)
    assert error.mean() == pytest.approx(0.0, abs=4 * 0.02 / math.sqrt(error.size))
    assert error.std() == pytest.approx(0.02, rel=0.02)
    for deviations, share in ((1.0, 0.6827), (2.0, 0.9545), (3.0, 0.9973)):
        assert (np.abs(error) < deviations * 0.02).mean() == pytest.approx(share, abs=0.01)
    assert 0.02 * 3.5 < np.abs(error).max() <= 0.02 * LARGEST_DEVIATE
    for lag in (1, 2, 3, 4, 5, 8):
        assert abs(np.corrcoef(error[:, lag:].ravel(), error[:, :-lag].ravel())[0, 1]) < 0.03


def test_the_table_of_deviates_is_a_standard_normal_distribution() -> None:
    table = normal_table().astype(np.float64)
    assert table.std() == pytest.approx(1.0, abs=1e-4)
    assert np.abs(table + table[::-1]).max() < 1e-6
    assert np.abs(table).max() <= LARGEST_DEVIATE
    assert (table**4).mean() == pytest.approx(3.0, abs=0.01)


def test_what_is_too_near_or_too_far_is_no_measurement() -> None:
    spec = LidarSpec(beams=4, range_min=0.5, range_max=3.0, noise_std=0.0)
    scan = look(make([ROOM], 1, spec), np.array([[[0.3, 3.5, 0.0]]]))[0, 0]
    assert np.isinf(scan[0])  # 5.7 m ahead
    assert scan[1] == pytest.approx(2.5)
    assert np.isnan(scan[2])  # 0.3 m behind
    assert np.isinf(scan[3])  # 3.5 m to the right


def test_drones_see_each_other_but_not_those_that_are_not_alive() -> None:
    sensing, poses = make([ROOM], 3, IDEAL), np.array([[[1.0, 3.0, 0.0], [2.0, 3.0, 0.0], [4.0, 3.0, 0.0]]])
    assert look(sensing, poses)[0, 0, 0] == pytest.approx(0.92)
    alive = np.array([[True, False, True]])
    scan = look(sensing, poses, alive=alive)
    assert scan[0, 0, 0] == pytest.approx(2.92)
    assert scan[0, 2, 90] == pytest.approx(2.92)
    assert np.isnan(scan[0, 1]).all()


def test_moving_discs_and_edges_are_seen_where_they_are_and_absent_ones_are_not() -> None:
    rng = np.random.default_rng(3)
    levels = [LEVELS["2"], LEVELS["3"], LEVELS["6"]]
    poses = launched(levels, 3, seed=4)
    discs = np.zeros((3, 4, 3))
    discs[:, :3, :2] = poses[:, :, :2] + rng.uniform(0.4, 1.2, (3, 3, 2))
    discs[:, :2, 2] = 0.25  # the third has no radius, the fourth is all zeros
    corners = poses[:, [0], :2] + np.array([[-0.7, -0.9], [-0.3, -0.9], [-0.3, -0.5], [-0.7, -0.5]])
    edges = np.concatenate((np.concatenate((corners, np.roll(corners, -1, axis=1)), axis=2), np.zeros((3, 2, 4))), 1)
    for order in (slice(None), [2, 3, 0, 1]):  # a loop may turn either way
        found = look(make(levels, 3, IDEAL), poses, discs=discs, edges=edges[..., order]).astype(np.float64)
        for world, level in enumerate(levels):
            for drone in range(3):
                others = np.array([[*poses[world, k, :2], 0.08] for k in range(3) if k != drone])
                circles = np.concatenate((level.circles, discs[world, :2], others))
                circles = circles[np.hypot(*(circles[:, :2] - poses[world, drone, :2]).T) > circles[:, 2]]
                exact = reference(
                    np.concatenate((level.segments, edges[world, :4])), circles,
                    np.tile(poses[world, drone, :2], (180, 1)), IDEAL.bearings + poses[world, drone, 2], 12.0,
                )  # fmt: skip
                assert furthest_error(found[world, drone], exact) <= 0.001
    assert not np.array_equal(found, look(make(levels, 3, IDEAL), poses))


def test_levels_come_and_go_world_by_world() -> None:
    """Whatever was shown before, in a larger or smaller level, a scan is that of sensors made afresh."""
    rng = np.random.default_rng(0)
    shown = [ROOM] * 6
    sensing = make(shown)
    look(sensing, launched(shown))
    for step in range(40):
        world, level = int(rng.integers(6)), LEVELS[str(rng.integers(7))]
        shown[world] = level
        sensing.set_level(world, level)
        poses = launched(shown, seed=step)
        if step % 8 == 7:
            np.testing.assert_array_equal(look(sensing, poses, tick=step), look(make(shown), poses, tick=step))


def test_a_levels_lists_are_built_once_and_go_with_it() -> None:
    level = load_level("3")
    assert level_index(level, 4.5) is level_index(level, 4.5)
    assert level_index(level, 4.5) is not level_index(level, 9.0)


def odd_level() -> Level:
    """A room with a solid that is not convex, given clockwise, and one that crosses itself."""
    outline = np.array([[0.0, 0.0], [0.0, 6.0], [8.0, 6.0], [8.0, 0.0]])  # clockwise
    hook = np.array([[2.0, 2.0], [2.0, 4.0], [4.0, 4.0], [4.0, 3.6], [2.4, 3.6], [2.4, 2.0]])
    bow = np.array([[5.0, 2.0], [6.5, 3.5], [6.5, 2.0], [5.0, 3.5]])
    return Level("odd", "", outline, (), np.zeros((0, 3)), (1.0, 1.0), solids=(hook, bow))


def test_solids_of_any_shape_and_outlines_that_run_either_way_are_seen_exactly() -> None:
    level, rng = odd_level(), np.random.default_rng(9)
    places = rng.uniform((0.0, 0.0), (8.0, 6.0), (400, 2))
    places = places[level.is_free(places)]
    poses = np.column_stack((places, rng.uniform(-4, 4, len(places))))[None]
    found = make([level], len(places), IDEAL).scan(poses, np.zeros_like(poses), 0.0, 0)[0]
    for pose, scan in zip(poses[0], found, strict=True):
        exact = reference(level.segments, level.circles, np.tile(pose[:2], (180, 1)), IDEAL.bearings + pose[2], 12.0)
        assert furthest_error(scan.astype(np.float64), exact) <= 0.001


def test_only_the_edges_of_loops_that_cross_themselves_face_both_ways() -> None:
    assert len(facing_edges(odd_level())) == 4 + 6 + 2 * 4
    assert len(facing_edges(LEVELS["6"])) == len(LEVELS["6"].segments)


def test_from_outside_the_level_everything_is_looked_at() -> None:
    """No list is made for there; walls face inward, so from outside only obstacles on the outline can be seen."""
    level = LEVELS["3"]
    box = Level("box", "", level.outline, (np.array([[-2.0, 4.0], [-1.0, 4.0], [-1.0, 5.0], [-2.0, 5.0]]),),
                np.zeros((0, 3)), level.launch)  # fmt: skip
    scan = look(make([box], 1, IDEAL), np.array([[[-4.0, 4.5, 0.0]]]))[0, 0]
    assert scan[0] == pytest.approx(2.0)


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_sees_what_lies_along_its_bearings(name: str) -> None:
    spec, level = PRESETS[name], LEVELS["6"]
    poses = launched([level], 3, seed=8)
    scan = look(make([level], 3, spec), poses)[0].astype(np.float64)
    for drone, pose in enumerate(poses[0]):
        others = np.array([[*p[:2], 0.08] for k, p in enumerate(poses[0]) if k != drone])
        exact = reference(
            level.segments, np.concatenate((level.circles, others)), np.tile(pose[:2], (spec.beams, 1)),
            spec.bearings + pose[2], spec.range_max,
        )  # fmt: skip
        both = np.isfinite(scan[drone]) & np.isfinite(exact)
        assert np.abs(scan[drone][both] - exact[both]).max() <= spec.noise_std * LARGEST_DEVIATE + 1e-6
        assert (both | np.isinf(exact) | (exact > spec.range_max - 0.2) | (exact < spec.range_min + 0.2)).all()


def test_front_left_back_and_right_of_the_ranger() -> None:
    scan = look(make([ROOM], 1, PRESETS["ranger4"]), np.array([[[1.0, 2.5, 0.0]]]))[0, 0]
    assert np.isinf(scan[0])  # the wall ahead is 5 m away
    np.testing.assert_allclose(scan[1:], [3.5, 1.0, 2.5], atol=0.1)


def test_the_urg_looks_120_degrees_to_either_side_and_not_behind() -> None:
    spec = PRESETS["urg04lx"]
    assert math.degrees(spec.bearings[0]) == pytest.approx(-119.5, abs=0.1)
    assert math.degrees(spec.bearings[-1]) == pytest.approx(119.9, abs=0.1)
    assert spec.bearings[340] == pytest.approx(0.0, abs=1e-12)


def test_a_world_without_a_level_is_named() -> None:
    sensing = Sensing(2, 1, IDEAL, 0, Workers(1))
    sensing.set_level(0, ROOM)
    with pytest.raises(InputError, match="world 1 has no level"):
        look(sensing, np.zeros((2, 1, 3)))
    with pytest.raises(InputError, match="3 world keys for 2 worlds"):
        Sensing(2, 1, IDEAL, 0, Workers(1), [1, 2, 3])


def test_a_worlds_scans_do_not_depend_on_the_worlds_beside_it() -> None:
    level, other = LEVELS["3"], LEVELS["6"]
    alone = Twin([level], 2, seed=4)
    beside = Twin([level, other, level], 2, seed=4)
    for _ in range(3):
        alone.step(np.full((1, 2, 3), 0.3))
        beside.step(np.full((3, 2, 3), 0.3))
    np.testing.assert_array_equal(alone.scan()[0], beside.scan()[0])
    assert not np.array_equal(beside.scan()[0], beside.scan()[2])


def test_drones_of_the_twin_see_each_other_as_posts() -> None:
    twin = Twin([ROOM], 2, LidarSpec(beams=360, noise_std=0.0))
    (ax, ay, _), (bx, by, _) = twin.poses[0]
    apart = math.hypot(bx - ax, by - ay)
    beam = round(math.degrees(math.atan2(by - ay, bx - ax))) % 360
    assert twin.scan()[0, 0, beam] == pytest.approx(apart - twin.limits.radius_m, abs=0.005)
