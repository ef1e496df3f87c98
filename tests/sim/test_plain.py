"""The plain step and the batched one, each worked out its own way, agree: tick by tick over whole flights."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from imagine.core.contract import ActionSpec
from imagine.core.errors import InputError
from imagine.core.frames import Pose
from imagine.core.lidar import LidarSpec
from imagine.core.observation_spec import ObservationSpec
from imagine.core.raster import TILE
from imagine.core.vehicle_limits import VehicleLimits
from imagine.sim.exploration import Exploration
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.sim.level import BUILT_IN, Person, load_level
from imagine.sim.plain import PlainExploration
from imagine.sim.plain.exploration import Variant
from imagine.sim.plain.kernel_maps import KernelMaps
from imagine.sim.plain.maps import PlainMaps
from imagine.sim.plain.world import PlainWorld
from imagine.sim.twin import Twin

VARIANTS: tuple[Variant, ...] = ("plain", "plain-scipy", "plain-kernels")
RULES = {
    "off": {"protocol": "off"},
    "one-hop": {"tiles_a_tick": 2, "radio_range_m": 3.0},
    "multi-hop": {"protocol": "multi-hop", "tiles_a_tick": 3, "radio_range_m": 1.5, "drones": 4},
    "heading": {"observation": ObservationSpec(axes="heading"), "action": ActionSpec(mode="body")},
    "other views": {
        "observation": ObservationSpec(
            view_cells=20, view_scales_m=(0.2, 0.8), frontier_ranges_m=(2.0, 8.0), lidar_sectors=24
        )
    },
}


def settings(**changes: Any) -> ExplorationSettings:
    return ExplorationSettings(**({"levels": ("3",), "worlds": 2, "drones": 3, "mirror": False} | changes))


def same_maps(plain: PlainExploration, env: Exploration, world: int) -> None:
    """The two hold the same evidence, beliefs, fields and coverage."""
    _, _, columns, rows = plain.world.level.grid
    maps, mine = env.maps, plain.maps
    layers = maps.layers[world, ..., :rows, :columns]
    versions = maps.versions[world, ..., : rows // TILE, : columns // TILE]
    belief = maps.belief[world, :, :rows, :columns]
    states, distance = (a[world, :, : rows // 2, : columns // 2] for a in (maps.states, maps.distance))
    if isinstance(mine, PlainMaps):
        np.testing.assert_array_equal(mine.layers, layers)
        np.testing.assert_array_equal(mine.versions, versions)
        np.testing.assert_array_equal(mine.belief, belief)
        np.testing.assert_array_equal(np.stack(mine.states), states)
        np.testing.assert_array_equal(np.stack(mine.distance), distance)
    else:
        assert isinstance(mine, KernelMaps)
        for drone, source in np.ndindex(layers.shape[:2]):
            np.testing.assert_array_equal(
                mine.on_level(drone, mine.maps[drone].layer(source).cells), layers[drone, source]
            )
        for drone in range(len(layers)):
            np.testing.assert_array_equal(mine.on_level(drone, mine.maps[drone].belief()), belief[drone])
    np.testing.assert_array_equal(mine.seen, maps.seen[world, :rows, :columns])
    np.testing.assert_array_equal(mine.discovered, maps.discovered[world])
    np.testing.assert_array_equal(mine.tiles_sent, maps.tiles_sent[world])
    assert plain.coverage() == env.maps.coverage()[world]


def same_observation(plain: PlainExploration, seen: Any, world: int) -> None:
    policy, critic = plain.observe()
    np.testing.assert_array_equal(policy["views"], seen.policy["views"][world])
    np.testing.assert_allclose(policy["lidar"], seen.policy["lidar"][world], atol=1e-7)
    np.testing.assert_allclose(policy["motion"], seen.policy["motion"][world], atol=1e-6)
    np.testing.assert_allclose(critic, seen.critic[world], atol=1e-6)


def planned(env: Exploration) -> NDArray[np.float32]:
    return np.nan_to_num(env.planner_actions())


def taken_over(env: Exploration, world: int, variant: Variant = "plain") -> PlainExploration:
    plain = PlainExploration(env.settings, 0, variant=variant)
    plain.take_over(env, world)
    return plain


def fly_together(
    env: Exploration, plain: PlainExploration, world: int, ticks: int, rng: np.random.Generator | None = None
) -> None:
    """Give both the same actions, and the plain one the batch's scans; they must go the same way and know the same."""
    shape = env.worlds, env.drones, env.settings.action.size
    for tick in range(ticks):
        if tick % 10 == 0 and rng is not None:
            held = np.sign(rng.uniform(-1.0, 1.0, shape)).astype(np.float32)
        actions = planned(env) if rng is None else held
        before = plain.maps.discovered.copy()
        np.testing.assert_allclose(plain.setpoints(actions[world]), env._setpoints(actions)[world], atol=1e-9)
        step = env.step(actions)
        plain.fly(actions[world])
        np.testing.assert_allclose(plain.world.poses, env.twin.poses[world], atol=1e-9)
        np.testing.assert_allclose(plain.world.velocity, env.twin.velocity[world], atol=1e-9)
        plain.sense(env._ranges[world].copy())
        told = plain.finish(before)
        np.testing.assert_allclose(told.reward, step.reward[world], atol=1e-6)
        assert told.done == step.done[world]
        same_maps(plain, env, world)
        same_observation(plain, step.observation, world)


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("rules", RULES)
def test_a_flight_from_launch_is_the_same(variant: Variant, rules: str) -> None:
    env = Exploration(settings(**RULES[rules]), seed=1)
    env.reset()
    plain = taken_over(env, 0, variant)
    rng = None if rules != "heading" else np.random.default_rng(0)
    fly_together(env, plain, 0, 25, rng)
    assert plain.coverage() > 0.2
    if rules != "off":
        assert env.maps.tiles_sent[0].any()


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_world_is_taken_over_in_the_middle_of_an_episode(variant: Variant) -> None:
    env = Exploration(settings(levels=("6",), drones=2), seed=2)
    env.reset()
    for _ in range(60):
        env.step(planned(env))
    plain = taken_over(env, 1, variant)
    same_maps(plain, env, 1)
    fly_together(env, plain, 1, 15)


@pytest.mark.parametrize("variant", ["plain", "plain-kernels"])
def test_equal_seeds_launch_equal_episodes_and_end_them_alike(variant: Variant) -> None:
    chosen = settings(levels=("0", "1", "3"), level_weights=(1.0, 2.0, 1.0), mirror=True, episode_ticks=4)
    env, plain = Exploration(chosen, seed=5), PlainExploration(chosen, 5, world=1, variant=variant)
    env.reset()
    plain.reset()
    still = np.zeros((2, 3, 2), np.float32)
    names = set()
    for tick in range(1, 17):
        names.add(plain.world.level.name)
        assert plain.world.level.name == env.twin.levels[1].name
        np.testing.assert_array_equal(plain.world.level.segments, env.twin.levels[1].segments)
        np.testing.assert_allclose(plain.world.poses, env.twin.poses[1], atol=1e-9)
        assert plain.step(still[1]).done == env.step(still).done[1] == (tick % 4 == 0)
    assert len(names) > 1


@pytest.mark.parametrize("name", BUILT_IN)
def test_queries_and_exact_rays_measure_the_same(name: str) -> None:
    level, lidar = load_level(name), LidarSpec(beams=360, noise_std=0.0)
    rng = np.random.default_rng(int(name))
    twin = Twin([level], 2, lidar)
    found = 0
    for _ in range(8):
        poses = level.launch_poses(2, rng)
        twin.set_level(0, level, poses)
        plain = PlainWorld(level, poses, lidar, VehicleLimits())
        exact, queried = twin.scan()[0], plain.scan(rng)
        np.testing.assert_allclose(queried, exact, atol=1e-3)
        found += int(np.isfinite(exact).sum())
        for mine, other in ((0, 1), (1, 0)):  # they see each other where nothing is between them
            bearing = math.atan2(poses[other].y - poses[mine].y, poses[other].x - poses[mine].x) - poses[mine].yaw
            apart = math.dist(poses[mine][:2], poses[other][:2])
            beam = round(math.degrees(bearing)) % 360
            assert queried[mine, beam] <= apart - 0.08 + 0.01
    assert found > 5000


def test_noise_has_the_sensors_width_and_what_it_cannot_measure_is_apart() -> None:
    level, lidar = load_level("0"), LidarSpec(beams=720, noise_std=0.02, range_min=0.3, range_max=3.5)
    world = PlainWorld(level, [Pose(3.0, 3.0, 0.1), Pose(3.2, 3.0, 0.0)], lidar, VehicleLimits())
    exact, scan = world.exact_ranges(), world.scan(np.random.default_rng(0)).astype(float)
    measured = np.isfinite(scan)
    error = scan[measured] - exact[measured]
    assert error.std() == pytest.approx(0.02, rel=0.1)
    assert error.mean() == pytest.approx(0.0, abs=0.003)
    assert np.isnan(scan[exact < 0.2]).all()
    assert (exact < 0.2).any()
    assert np.isinf(scan[np.isinf(exact)]).all()
    assert np.isinf(exact).any()


def test_running_into_walls_and_each_other_is_the_same_in_both() -> None:
    level, lidar = load_level("3"), LidarSpec(beams=8)
    twin = Twin([level], 3, lidar)
    plain = PlainWorld(level, level.launch_poses(3), lidar, VehicleLimits())
    rng = np.random.default_rng(4)
    for tick in range(300):
        if tick % 10 == 0:
            setpoints = rng.uniform(-1.5, 1.5, (1, 3, 3))
        twin.step(setpoints.copy())
        plain.step(setpoints[0])
        np.testing.assert_allclose(plain.poses, twin.poses[0], atol=1e-6)
        np.testing.assert_array_equal(plain.contacts, twin.contacts[0])
    assert plain.contacts.sum() > 5


def test_a_clock_tells_the_stages_apart() -> None:
    readings = iter(range(1_000_000))
    plain = PlainExploration(settings(), 0, clock=lambda: float(next(readings)))
    plain.reset()
    before = dict(plain.stage_seconds)
    plain.step(plain.planner_actions())
    assert {name: plain.stage_seconds[name] - before[name] for name in before} == dict.fromkeys(before, 1.0)


def test_a_level_with_moving_things_is_refused() -> None:
    level = dataclasses.replace(load_level("0"), people=(Person(loop=[(1.0, 1.0), (2.0, 2.0)]),))
    with pytest.raises(InputError, match="level 0: the plain world has no people"):
        PlainWorld(level, level.launch_poses(1), LidarSpec(beams=8), VehicleLimits())
