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
from imagine.core.frontier import PAD
from imagine.core.lidar import LidarSpec
from imagine.core.observation_spec import ObservationSpec
from imagine.core.raster import TILE
from imagine.core.vehicle_limits import VehicleLimits
from imagine.sim.air_receive import peer_place
from imagine.sim.dynamics import DynamicsSettings
from imagine.sim.exploration import Exploration
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.sim.level import BUILT_IN, Person, load_level
from imagine.sim.lidar_model import LidarModel
from imagine.sim.odometry_drift import DriftSettings
from imagine.sim.plain import PlainExploration
from imagine.sim.plain.exploration import Variant
from imagine.sim.plain.handover import hand_over_mesh
from imagine.sim.plain.world import PlainWorld
from imagine.sim.radio import RadioSettings
from imagine.sim.reward import RewardSettings
from imagine.sim.twin import Twin

VARIANTS: tuple[Variant, ...] = ("plain", "plain-scipy", "plain-kernels")
ALONE = {
    "map axes": {},
    "heading": {"observation": ObservationSpec(axes="heading"), "action": ActionSpec(mode="body")},
    "forward": {"observation": ObservationSpec(axes="heading"), "action": ActionSpec(mode="forward")},
    "waypoint": {"action": ActionSpec(mode="waypoint"), "lidar_beams": 64},
    "other views": {
        "observation": ObservationSpec(
            view_cells=20, view_scales_m=(0.2, 0.8), frontier_ranges_m=(2.0, 8.0), lidar_sectors=24
        )
    },
}
SHARING: dict[str, dict[str, Any]] = {
    "one-hop": {"levels": ("6",), "protocol": "one-hop"},
    "multi-hop": {"levels": ("4",), "protocol": "multi-hop", "drones": 4, "radio": RadioSettings(range_m=3.0)},
    "64 beams behind walls": {
        "levels": ("4",), "protocol": "one-hop", "lidar_beams": 64,
        "radio": RadioSettings(model="path-loss", threshold_dbm=-60.0),
    },
}  # fmt: skip


def settings(**changes: Any) -> ExplorationSettings:
    return ExplorationSettings(
        **({"levels": ("3",), "worlds": 2, "drones": 3, "mirror": False, "protocol": "off"} | changes)
    )


def launched(env: Exploration, world: int, variant: Variant = "plain") -> PlainExploration:
    """A plain world at the same launch as a batch's, which has looked around once, with the batch's eyes."""
    plain = PlainExploration(env.settings, 0, variant=variant)
    plain.begin(env.twin.levels[world], [Pose(*pose) for pose in env.twin.poses[world].tolist()])
    plain.sense(env.ranges[world].copy())
    return plain


def own_maps(plain: PlainExploration, env: Exploration, world: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """What each drone holds of itself: cells and tile versions, in the plain step and in the batch, side by side."""
    rows, columns = plain.maps.seen.shape
    own = np.arange(env.drones)
    cells = np.stack([plain.maps.layer(drone, drone) for drone in own])
    versions = np.stack([plain.maps.versions(drone, drone) for drone in own])
    np.testing.assert_array_equal(versions, env.maps.versions[world, own, own, : rows // TILE, : columns // TILE])
    return cells, env.maps.layers[world, own, own, :rows, :columns]


def same_own_maps(plain: PlainExploration, env: Exploration, world: int) -> None:
    """What does not depend on when a datagram comes: own layers, and what the team has seen."""
    np.testing.assert_array_equal(*own_maps(plain, env, world))
    rows, columns = plain.maps.seen.shape
    np.testing.assert_array_equal(plain.maps.seen, env.maps.seen[world, :rows, :columns])
    np.testing.assert_array_equal(plain.maps.discovered, env.maps.discovered[world])
    assert plain.coverage() == env.maps.coverage()[world]


def same_maps(plain: PlainExploration, env: Exploration, world: int) -> None:
    """All that anybody knows."""
    same_own_maps(plain, env, world)
    rows, columns = plain.maps.seen.shape
    arrays = env.maps.arrays
    padded = slice(rows // 2 + 2 * PAD), slice(columns // 2 + 2 * PAD)
    for drone in range(env.drones):
        for source in range(env.drones):
            held = arrays.layers[world, drone, source, :rows, :columns]
            np.testing.assert_array_equal(plain.maps.layer(drone, source), held)
        np.testing.assert_array_equal(plain.maps.beliefs[drone], arrays.belief[world, drone, :rows, :columns])
        np.testing.assert_array_equal(plain.maps.fields[drone].padded_states, arrays.states[world, drone][padded])
        np.testing.assert_array_equal(plain.maps.fields[drone].cost, arrays.cost[world, drone][padded])


def same_observation(plain: PlainExploration, seen: Any, world: int) -> None:
    policy = plain.observe()
    np.testing.assert_array_equal(policy["views"], seen.policy["views"][world])
    np.testing.assert_array_equal(policy["lidar"], seen.policy["lidar"][world])
    np.testing.assert_allclose(policy["motion"], seen.policy["motion"][world], atol=1e-6)
    np.testing.assert_allclose(plain.critic_images(), seen.critic[world], atol=1e-6)


def planned(env: Exploration) -> NDArray[np.float32]:
    return np.nan_to_num(env.planner_actions())


def tick_together(env: Exploration, plain: PlainExploration, world: int, actions: NDArray[np.float32]) -> Any:
    """Give both the same actions, and the plain one the batch's scans; they must go the same way and earn the same."""
    plain.decide(actions[world])
    before = plain.world.contacts.sum(axis=0)
    step = env.step(actions)
    np.testing.assert_allclose(plain.setpoints(), env._setpoints[world], atol=1e-9)
    plain.fly()
    if step.done[world]:
        return step
    np.testing.assert_allclose(plain.world.poses, env.twin.poses[world], atol=1e-9)
    np.testing.assert_allclose(plain.world.velocity, env.twin.velocity[world], atol=1e-9)
    plain.sense(env.ranges[world].copy())
    earned, done = plain.judge(before)
    np.testing.assert_allclose(earned, step.reward[world], atol=1e-6)
    np.testing.assert_array_equal(plain.alive, env.alive[world])
    assert not done
    return step


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("rules", ALONE)
def test_without_exchange_a_flight_is_the_same_bit_for_bit(variant: Variant, rules: str) -> None:
    env = Exploration(settings(**ALONE[rules]), seed=1)
    env.reset()
    plain = launched(env, 0, variant)
    rng = np.random.default_rng(0)
    shape = env.worlds, env.drones, env.settings.action.size
    for tick in range(20):
        if tick % 10 == 0:
            held = np.sign(rng.uniform(-1.0, 1.0, shape)).astype(np.float32)
        step = tick_together(env, plain, 0, planned(env) if rules == "map axes" else held)
        same_maps(plain, env, 0)
        same_observation(plain, step.observation, 0)
    assert plain.coverage() > 0.2
    actions = np.where(np.isnan(asked := env.planner_actions()[0]), 0.0, asked)
    np.testing.assert_allclose(plain.planner_actions(), actions, atol=1e-6)


def known(plain: PlainExploration, env: Exploration, world: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """How many cells each belief knows, in the plain step and in the batch."""
    beliefs = np.stack(plain.maps.beliefs)
    return (beliefs != 0).sum(axis=(1, 2)), (env.maps.belief[world] != 0).sum(axis=(1, 2))


@pytest.mark.parametrize("rules", SHARING)
def test_with_exchange_own_maps_are_the_same_and_the_rest_is_within_a_tenth(rules: str) -> None:
    """The batch estimates how long datagrams are, so tiles may come a tick sooner or later; the rest follows."""
    env = Exploration(settings(**SHARING[rules]), seed=1)
    env.reset()
    plain = launched(env, 0, "plain-kernels")
    apart = []
    for _ in range(150):
        tick_together(env, plain, 0, planned(env))
        same_own_maps(plain, env, 0)
        mine, theirs = known(plain, env, 0)
        apart.append(np.abs(mine / theirs - 1.0))
    alone = np.array([np.count_nonzero(plain.maps.layer(drone, drone)) for drone in range(env.drones)])
    assert (known(plain, env, 0)[0] / alone).max() > 1.2  # so there is something to be wrong about
    assert np.max(apart) < 0.1
    assert np.mean(apart) < 0.01
    mine, theirs = plain.mesh.bytes_sent(), env.air.bytes_sent[0]
    np.testing.assert_allclose(mine.sum(axis=0), theirs.sum(axis=0), rtol=0.1)
    np.testing.assert_allclose(mine.sum(axis=1), theirs.sum(axis=1), rtol=0.1)


def test_all_variants_say_and_know_the_same_and_can_stand_in_for_each_other() -> None:
    env = Exploration(settings(protocol="multi-hop", drones=3, lidar_beams=90), seed=3)
    env.reset()
    team = [launched(env, 0, variant) for variant in VARIANTS]
    for tick in range(24):
        actions = planned(env)
        env.step(actions)
        if tick == 12:
            for plain, variant in zip(team, reversed(VARIANTS), strict=True):
                plain.use(variant)
        for plain in team:
            plain.decide(actions[0])
            plain.fly()
            plain.sense(env.ranges[0].copy())
        for plain in team[1:]:
            for drone, source in np.ndindex(3, 3):
                np.testing.assert_array_equal(plain.maps.layer(drone, source), team[0].maps.layer(drone, source))
            np.testing.assert_array_equal(plain.mesh.bytes_sent(), team[0].mesh.bytes_sent())
    assert (team[0].mesh.bytes_sent() > 0).all()


@pytest.mark.parametrize("protocol", ["one-hop", "multi-hop"])
def test_a_world_is_taken_over_in_the_middle_of_an_episode(protocol: str) -> None:
    env = Exploration(settings(levels=("6",), protocol=protocol), seed=2)
    env.reset()
    for _ in range(60):
        env.step(planned(env))
    plain = PlainExploration(env.settings, 0, variant="plain-kernels")
    plain.take_over(env, 1)
    same_maps(plain, env, 1)
    np.testing.assert_array_equal([own.layers[own.own].clock for own in plain.maps.evidence], env.maps.arrays.clocks[1])
    tick_together(env, plain, 1, planned(env))
    assert plain.mesh.bytes_sent()[:, 1].sum() > 0  # which takes knowing what the peers lack
    for _ in range(9):  # until it is forgotten that nobody knew when what was sent
        tick_together(env, plain, 1, planned(env))
    before = plain.mesh.bytes_sent().sum(), env.air.bytes_sent[1].sum()
    apart = []
    for _ in range(140):
        tick_together(env, plain, 1, planned(env))
        mine, theirs = known(plain, env, 1)
        apart.append(np.abs(mine / theirs - 1.0))
    assert np.mean(apart) < 0.01  # where two meet again, much is told at once, here or there a tick or two sooner
    assert np.quantile(apart, 0.95) < 0.01
    np.testing.assert_array_equal(*own_maps(plain, env, 1))
    sent = plain.mesh.bytes_sent().sum() - before[0], env.air.bytes_sent[1].sum() - before[1]
    assert sent[0] == pytest.approx(sent[1], rel=0.1)


def test_nodes_that_take_over_know_where_their_peers_are_and_what_they_may_pass_on() -> None:
    env = Exploration(settings(levels=("6",), protocol="multi-hop"), seed=2)
    env.reset()
    for _ in range(60):
        env.step(planned(env))
    plain = PlainExploration(env.settings, 0, variant="plain-kernels")
    plain.take_over(env, 1)
    air = env.air.state
    for drone, node in enumerate(plain.mesh.nodes):
        told = [peer_place(air.peers[1, drone, peer], 60, air.rules) for peer in range(3) if peer != drone]
        assert all(known for _, _, known in told)
        np.testing.assert_allclose(node.teammates(6.0), [(x, y) for x, y, _ in told])
    plain.begin(env.twin.levels[1], [Pose(*pose) for pose in env.twin.poses[1].tolist()])
    hand_over_mesh(env, 1, plain.maps, plain.mesh)  # the maps themselves not yet: all that they hold is confirmed
    rows, columns = plain.maps.seen.shape
    for drone, source in np.ndindex(3, 3):
        confirmed = air.confirmed[1, drone, source, :rows, :columns]
        np.testing.assert_array_equal(plain.maps.layer(drone, source), confirmed)
        assert confirmed.any() == (drone != source)


def test_who_cannot_see_runs_into_things_is_punished_and_falls_in_both() -> None:
    blind = settings(
        worlds=6, drones=4, lidar="ranger4", action=ActionSpec(mode="body"),
        reward=RewardSettings(collision_penalty=0.5, kill_on_collision=True, step_cost=0.01, normalise="sweep"),
    )  # fmt: skip
    env = Exploration(blind, seed=0)
    env.reset()
    team = [launched(env, world, "plain-kernels") for world in range(6)]
    rng = np.random.default_rng(1)
    flying = set(range(6))
    fallen = 0
    for tick in range(60):
        if tick % 10 == 0:
            held = np.sign(rng.uniform(-1.0, 1.0, (6, 4, 3))).astype(np.float32)
        step = env.step(held)
        flying -= set(np.flatnonzero(step.done).tolist())
        for world in sorted(flying):
            plain = team[world]
            before = plain.world.contacts.sum(axis=0)
            plain.decide(held[world])
            plain.fly()
            plain.sense(env.ranges[world].copy())
            earned, done = plain.judge(before)
            assert not done
            np.testing.assert_allclose(earned, step.reward[world], atol=1e-6)
            np.testing.assert_array_equal(plain.alive, env.alive[world])
            np.testing.assert_allclose(plain.world.poses, env.twin.poses[world], atol=1e-6)
            np.testing.assert_array_equal(plain.world.contacts[0], env.twin.wall_contacts[world])
            np.testing.assert_array_equal(plain.world.contacts[1], env.twin.drone_contacts[world])
            same_maps(plain, env, world)
            fallen = max(fallen, int((~plain.alive).sum()))
    assert fallen >= 2


@pytest.mark.parametrize(("variant", "as_designed"), [("plain", 0.0), ("plain-kernels", 0.0), ("plain", 0.5)])
def test_equal_seeds_launch_equal_episodes_and_end_them_alike(variant: Variant, as_designed: float) -> None:
    chosen = settings(
        levels=("0", "1", "3"), level_weights=(1.0, 2.0, 1.0), mirror=True, episode_ticks=4, as_designed=as_designed
    )
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


def test_a_decision_stands_for_its_ticks_in_both() -> None:
    chosen = settings(
        levels=("0",), drones=1, random_launch=False, action=ActionSpec(mode="waypoint", decision_ticks=5)
    )
    env, plain = Exploration(chosen, seed=0), PlainExploration(chosen, 0, variant="plain-scipy")
    env.reset()
    plain.reset()
    rng = np.random.default_rng(2)
    for _ in range(4):  # in the middle of an empty room, where no shield looks at noisy scans
        actions = rng.uniform(-0.4, 0.4, (2, 1, 2)).astype(np.float32)
        env.step(actions)
        plain.step(actions[0])
        np.testing.assert_allclose(plain.world.poses, env.twin.poses[0], atol=1e-9)
    assert plain.ticks == env.ticks[0] == 20


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
    level, lidar = load_level("0"), LidarSpec(beams=720, noise_std=0.02, range_min=0.3, range_max=12.0)
    world = PlainWorld(level, [Pose(3.0, 3.0, 0.1), Pose(3.2, 3.0, 0.0)], lidar, VehicleLimits(), reach_m=3.5)
    exact, scan = world.exact_ranges(), world.scan(np.random.default_rng(0)).astype(float)
    measured = np.isfinite(scan)
    error = scan[measured] - exact[measured]
    assert error.std() == pytest.approx(0.02, rel=0.1)
    assert error.mean() == pytest.approx(0.0, abs=0.003)
    assert np.isnan(scan[exact < 0.2]).all()
    assert (exact < 0.2).any()
    assert scan[measured].max() <= 3.5
    assert np.isinf(scan[exact > 3.6]).all()
    assert np.isinf(exact).any()


def test_running_into_walls_and_each_other_is_the_same_in_both() -> None:
    met = np.zeros(2, np.int64)
    turns = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    tower = (3.0 + 0.8 * np.column_stack((np.cos(turns), np.sin(turns))),)
    round_the_tower = dataclasses.replace(load_level("0"), solids=tower, launch=(1.0, 1.0))
    lidar = LidarSpec(beams=8)
    for level, drones in ((load_level("3"), 3), (load_level("0"), 5), (round_the_tower, 4)):
        twin = Twin([level], drones, lidar)
        plain = PlainWorld(level, level.launch_poses(drones), lidar, VehicleLimits())
        rng = np.random.default_rng(4)
        for tick in range(300):
            if tick % 10 == 0:
                setpoints = rng.uniform(-1.5, 1.5, (1, drones, 3))
            twin.step(setpoints.copy())
            plain.step(setpoints[0])
            np.testing.assert_allclose(plain.poses, twin.poses[0], atol=1e-6)
            np.testing.assert_array_equal(plain.contacts[0], twin.wall_contacts[0])
            np.testing.assert_array_equal(plain.contacts[1], twin.drone_contacts[0])
        met += plain.contacts.sum(axis=1)
    assert (met > 5).all()


def test_who_leans_on_a_wall_touches_it_once_and_who_comes_back_touches_it_again() -> None:
    level = load_level("0")
    plain = PlainWorld(level, [Pose(0.5, 3.0, 0.0)], LidarSpec(beams=8), VehicleLimits())
    for vx, ticks in ((-1.0, 30), (1.0, 10), (-1.0, 30)):
        for _ in range(ticks):
            plain.step(np.array([[vx, 0.0, 0.0]]))
    np.testing.assert_array_equal(plain.contacts, [[2], [0]])


def test_a_clock_tells_the_stages_apart() -> None:
    readings = iter(range(1_000_000))
    plain = PlainExploration(settings(), 0, clock=lambda: float(next(readings)))
    plain.reset()
    before = dict(plain.stage_seconds)
    plain.step(plain.planner_actions())
    took = {name: plain.stage_seconds[name] - before[name] for name in before}
    assert took == {"fly": 1.0, "scan": 1.0, "share": 1.0, "derive": 1.0, "observe": 1.0, "rest": 2.0}


def test_what_the_plain_step_lacks_is_refused() -> None:
    level = dataclasses.replace(load_level("0"), people=(Person(loop=[(1.0, 1.0), (2.0, 2.0)]),))
    with pytest.raises(InputError, match="level 0: the plain world has no people"):
        PlainWorld(level, level.launch_poses(1), LidarSpec(beams=8), VehicleLimits())
    for name, changes in {
        "dynamics": {"dynamics": DynamicsSettings(wind_mps=0.1)},
        "sensing": {"sensing": LidarModel(skew=True)},
        "observation": {"observation": ObservationSpec(peers=2)},
        "drift": {"drift": DriftSettings(enabled=True)},
    }.items():
        with pytest.raises(InputError, match=f"plain exploration has no {name}"):
            PlainExploration(settings(**changes), 0)
