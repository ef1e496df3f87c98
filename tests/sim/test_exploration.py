"""The training world is the flying world: same setpoints, same coverage, and a reward that adds up."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from imagine.core.action import to_body_velocity
from imagine.core.contract import ActionSpec
from imagine.core.errors import InputError
from imagine.core.lidar import Scan
from imagine.core.observation_spec import ObservationSpec
from imagine.core.shield import shield_velocity
from imagine.mesh_comm.settings import MeshSettings
from imagine.sim.coverage import Coverage
from imagine.sim.exploration import Exploration, Step
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.sim.level import load_level
from imagine.sim.radio import RadioMedium, RadioSettings
from imagine.sim.reward import RewardSettings

SMALL: dict[str, Any] = {
    "levels": ("3",), "worlds": 1, "drones": 2, "mirror": False, "observation": ObservationSpec(view_cells=16),
}  # fmt: skip


def settings(**changes: Any) -> ExplorationSettings:
    return ExplorationSettings(**(SMALL | changes))


def random_actions(env: Exploration, rng: np.random.Generator) -> NDArray[np.float32]:
    shape = env.worlds, env.drones, env.settings.action.size
    return rng.uniform(-1.0, 1.0, shape).astype(np.float32)


def planner_step(env: Exploration) -> Step:
    return env.step(np.nan_to_num(env.planner_actions()))


@pytest.mark.parametrize("mode", ["plane", "body"])
@pytest.mark.parametrize("axes", ["map", "heading"])
def test_actions_become_the_setpoints_that_fly(mode: Any, axes: Any) -> None:
    spec = ActionSpec(mode=mode)
    env = Exploration(settings(worlds=3, action=spec, observation=ObservationSpec(axes=axes, view_cells=16)), seed=1)
    env.reset()
    rng = np.random.default_rng(2)
    shielded = 0
    for _ in range(60):
        actions = 1.4 * random_actions(env, rng)
        scans, yaws = env.ranges.copy(), env.twin.poses[..., 2].copy()
        env.step(actions)
        for world, drone in np.ndindex(3, 2):
            vx, vy, rate = to_body_velocity(actions[world, drone], spec, axes, float(yaws[world, drone]))
            safe = shield_velocity(vx, vy, Scan(0.0, scans[world, drone]), env.lidar, env.settings.limits)
            assert env._setpoints[world, drone] == pytest.approx((*safe, rate), abs=1e-9)
            shielded += safe != (vx, vy)
    assert shielded > 10


def test_the_shield_keeps_a_team_off_the_walls() -> None:
    env = Exploration(settings(levels=("3", "5", "6"), worlds=6, drones=3, protocol="off"), seed=0)
    env.reset()
    rng = np.random.default_rng(0)
    actions = random_actions(env, rng)
    for tick in range(150):
        if tick % 15 == 0:
            actions = np.sign(random_actions(env, rng))
        env.step(actions)
    walls = env.twin.contacts.sum()
    assert walls <= 2  # drones that fly at each other may meet; walls never move


def test_rewards_sum_to_the_share_discovered() -> None:
    env = Exploration(settings(reward=RewardSettings(area_weight=5.0, own_credit=0.3), drones=3), seed=2)
    env.reset()
    for _ in range(30):
        before = env.maps.discovered.copy()
        step = planner_step(env)
        found = (env.maps.discovered - before)[0] / env.maps.coverable_cells[0]
        assert step.reward.sum() == pytest.approx(5.0 * found.sum(), abs=1e-5)
        np.testing.assert_allclose(step.reward[0], 5.0 * (0.3 * found + 0.7 * found.mean()), atol=1e-6)
    assert (env.maps.discovered[0] > 0).all()


def test_coverage_is_what_the_flight_reports() -> None:
    env = Exploration(settings(protocol="off", random_launch=False), seed=3)
    truth = Coverage(load_level("3"), 2, env.lidar, 4.0)
    env.reset()
    for _ in range(60):
        assert truth.update(env.twin.poses[0], env.twin.scan()[0]) == pytest.approx(env.maps.coverage()[0], abs=1e-12)
        planner_step(env)
    assert env.maps.coverage()[0] > 0.3


def run(seed: int, ticks: int = 25, **changes: Any) -> list[NDArray[Any]]:
    env = Exploration(settings(levels=("1", "3"), worlds=2, mirror=True, **changes), seed)
    rng = np.random.default_rng(0)
    seen = env.reset()
    told = [seen.policy["views"].copy(), seen.critic]
    for _ in range(ticks):
        step = env.step(random_actions(env, rng))
        seen = step.observation
        told += [*(array.copy() for array in seen.policy.values()), seen.critic, step.reward, step.done]
    return told


def test_equal_seeds_give_equal_runs_and_others_do_not() -> None:
    first, again, other = run(7, episode_ticks=15), run(7, episode_ticks=15), run(8, episode_ticks=15)
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
    assert not all(np.array_equal(a, b) for a, b in zip(first, other, strict=True))


def test_saved_generators_give_the_same_next_episodes() -> None:
    changes = {"levels": ("0", "1", "3"), "mirror": True}
    first = Exploration(settings(**changes), seed=1)
    first.reset()
    saved = first.state_dict()
    other = Exploration(settings(**changes), seed=1)
    other.load_state_dict(saved)
    for _ in range(3):
        first.reset()
        other.reset()
        assert first.twin.levels[0].name == other.twin.levels[0].name
        np.testing.assert_array_equal(first.twin.poses, other.twin.poses)


def test_worlds_end_at_their_length_tell_how_it_went_and_start_anew() -> None:
    env = Exploration(settings(worlds=2, episode_ticks=20, stop_coverage=1.0), seed=0)
    env.reset()
    for tick in range(1, 41):
        coverage = env.maps.coverage()
        step = planner_step(env)
        assert step.done.tolist() == [tick % 20 == 0] * 2
        assert len(step.episodes) == step.done.sum()
        for episode in step.episodes:
            assert (episode.level, episode.ticks, len(episode.curve)) == ("3", 20, 20)
            assert (np.diff(episode.curve) >= 0.0).all()
            assert episode.coverage == episode.curve[-1] >= coverage[episode.world]
            assert episode.t95 is None
            assert 0.0 < episode.path_m.max() <= 0.8 * 2.0
            assert episode.discovered.sum() == pytest.approx(
                episode.coverage * load_level("3").coverable.sum(), rel=1e-5
            )
            assert 1.0 <= episode.overlap <= 2.0
        if step.done.any():
            assert not env.ticks.any()
            assert (env.maps.arrays.clocks == 1).all()  # the one scan from the launch poses of the next episode
            assert not step.observation.policy["motion"].any()
            assert step.observation.policy["views"].any()


def test_without_restart_a_world_stays_as_it_ended() -> None:
    env = Exploration(settings(episode_ticks=3, stop_coverage=1.0), seed=0, restart=False)
    env.reset()
    for tick in range(1, 4):
        step = planner_step(env)
        assert env.ticks[0] == tick
    assert step.done.all()
    assert len(step.episodes) == 1
    assert env.maps.coverage()[0] == pytest.approx(step.episodes[0].coverage)
    poses, versions = env.twin.poses.copy(), env.maps.versions.copy()
    for _ in range(3):
        step = planner_step(env)
        assert step.done.all()
        assert not step.episodes
        assert not step.reward.any()
    assert env.ticks[0] == 3
    np.testing.assert_array_equal(env.twin.poses, poses)
    np.testing.assert_array_equal(env.maps.versions, versions)
    env.reset()
    assert env.ticks[0] == 0
    assert not planner_step(env).done.any()


def test_an_explored_world_ends_early_and_says_when_shares_were_reached() -> None:
    env = Exploration(settings(levels=("0",), stop_coverage=0.97, random_launch=False), seed=0)
    env.reset()
    for _ in range(300):
        step = planner_step(env)
        if step.done[0]:
            break
    (episode,) = step.episodes
    assert episode.coverage >= 0.97
    assert episode.t90 is not None
    assert episode.t95 is not None
    assert 1 <= episode.t90 <= episode.t95 <= episode.ticks < 300
    assert episode.curve[episode.t90 - 1] >= 0.9
    assert episode.t90 == 1 or episode.curve[episode.t90 - 2] < 0.9


def test_a_world_with_no_frontier_left_ends() -> None:
    env = Exploration(settings(levels=("0",), stop_coverage=1.0, random_launch=False), seed=0)
    env.reset()
    ticks = next(tick for tick in range(400) if planner_step(env).done[0])
    assert ticks >= 30


def test_first_episodes_can_be_staggered() -> None:
    env = Exploration(settings(worlds=4, episode_ticks=240, stagger=True, levels=("6",)), seed=0)
    env.reset()
    ends: list[int | None] = [None] * 4
    still = np.zeros((4, 2, 2), np.float32)
    for tick in range(1, 241):
        for world in np.flatnonzero(env.step(still).done):
            ends[world] = ends[world] or tick
    assert ends == [60, 120, 180, 240]


@pytest.mark.parametrize("protocol", ["off", "one-hop", "multi-hop"])
@pytest.mark.parametrize("radio", [{"range_m": 4.0}, {"model": "path-loss", "wall_db": 25.0}], ids=["disc", "walls"])
def test_links_are_whom_the_radio_reaches(protocol: Any, radio: dict[str, Any]) -> None:
    env = Exploration(settings(drones=3, levels=("6",), protocol=protocol, radio=RadioSettings(**radio)), seed=0)
    env.reset()
    medium = RadioMedium(3, env.settings.radio, np.random.default_rng(0), env.twin.levels[0].segments)
    reached = set()
    for tick in range(120):
        planner_step(env)
        expected = medium.in_reach(env.twin.poses[0])[1:, 1:] & env.alive[0] & env.alive[0][:, None]
        linked = env.links()[0]
        assert linked.tolist() == (expected if protocol != "off" else np.zeros((3, 3), bool)).tolist()
        assert (linked == linked.T).all()
        assert not linked.diagonal().any()
        reached.add(int(expected.sum()))
        env.alive[0, 1] = tick < 100
    assert len(reached) > 1  # they met, or parted


def test_the_fallen_say_and_hear_nothing() -> None:
    env = Exploration(settings(drones=3, radio=RadioSettings(range_m=50.0)), seed=0)
    env.reset()
    for _ in range(10):
        planner_step(env)
    assert env.links()[0].sum() == 6
    env.alive[0, 1] = False
    planner_step(env)
    sent, layers = env.air.bytes_sent[0].copy(), env.maps.layers[0].copy()
    for _ in range(20):
        planner_step(env)
    assert env.links()[0].tolist() == [[False, False, True], [False] * 3, [True, False, False]]
    np.testing.assert_array_equal(env.air.bytes_sent[0, 1], sent[1])
    assert (env.air.bytes_sent[0, [0, 2]].sum(axis=1) > sent[[0, 2]].sum(axis=1)).all()
    np.testing.assert_array_equal(env.maps.layers[0, 1], layers[1])
    assert (env.maps.layers[0, 0, 2] != layers[0, 2]).any()


@pytest.mark.parametrize("level", ["3", "6"])
def test_the_critics_image_adds_up(level: str) -> None:
    env = Exploration(settings(levels=(level,), worlds=2, drones=3), seed=0)
    critic = env.reset().critic
    for _ in range(10):
        critic = planner_step(env).observation.critic
    assert critic.shape == (2, 3, 5, 32, 32)
    np.testing.assert_allclose(critic[:, :, :3].sum(axis=2), 1.0, atol=1e-5)
    cells = critic[:, :, :2].sum(axis=(3, 4)) * 64
    np.testing.assert_allclose(cells.sum(axis=2), np.repeat(env.maps.coverable_cells[:, None], 3, axis=1), rtol=1e-5)
    np.testing.assert_allclose(cells[:, 0, 1], env.maps.discovered.sum(axis=1), rtol=1e-5)
    column0, row0, _, _ = load_level(level).grid
    for world, drone in np.ndindex(2, 3):
        x, y, _ = env.twin.poses[world, drone]
        pixel = (math.floor(y / 0.1) - row0) // 8, (math.floor(x / 0.1) - column0) // 8
        assert np.argwhere(critic[world, drone, 3]).tolist() == [list(pixel)]
        assert 1 <= critic[world, drone, 4].sum() <= 2
        others = [d for d in range(3) if d != drone]
        np.testing.assert_array_equal(critic[world, drone, 4], critic[world, others, 3].max(axis=0))


def test_wrong_actions_and_settings_are_refused_by_name() -> None:
    env = Exploration(settings(), seed=0)
    env.reset()
    with pytest.raises(InputError, match=r"actions are \(1, 2, 3\), expected \(1, 2, 2\)"):
        env.step(np.zeros((1, 2, 3), np.float32))
    x, y, _ = env.twin.poses[0, 1]
    where = rf"level 3: the action of drone 1 in world 0, at \({x:.2f}, {y:.2f}\), is not finite"
    for wrong in (np.nan, np.inf, -np.inf):
        with pytest.raises(InputError, match=where):
            env.step(np.array([[[0, 0], [0, wrong]]], np.float32))
    with pytest.raises(InputError, match="is not finite"):
        env.step(np.array([[[0, 0], [0, 1e39]]]))  # more than float32 holds
    with pytest.raises(InputError, match="actions: not numbers but str"):
        env.step([[["1", "0"], ["0", "0"]]])
    with pytest.raises(InputError, match="actions: lists of unequal lengths"):
        env.step([[[0.0, 0.0], [0.0]]])
    assert env.ticks[0] == 0  # nothing was flown
    with pytest.raises(InputError, match="level_weights"):
        Exploration(settings(level_weights=(1.0, 2.0)), seed=0)
    with pytest.raises(InputError, match="unknown level '9'"):
        Exploration(settings(levels=("9",)), seed=0)
    with pytest.raises(ValueError, match="unknown LiDAR"):
        settings(lidar="none")
    with pytest.raises(ValueError, match="drones"):
        settings(drones=17)


def test_negative_seeds_and_world_keys_are_refused_by_name() -> None:
    with pytest.raises(InputError, match="seed is -7"):
        Exploration(settings(), seed=-7)
    for keys in ([-1], [0, 1]):
        with pytest.raises(InputError, match=r"world_keys .*: give one for each of the 1 worlds, none negative"):
            Exploration(settings(), seed=0, world_keys=keys)


def test_actions_may_be_nested_lists() -> None:
    listed, given = Exploration(settings(), seed=0), Exploration(settings(), seed=0)
    listed.reset(), given.reset()
    for _ in range(5):
        listed.step([[[1, 0.5], [0, -1]]])
        given.step(np.array([[[1, 0.5], [0, -1]]], np.float32))
    assert np.hypot(*given.twin.velocity[0, 0, :2]) > 0.1
    np.testing.assert_array_equal(listed.twin.poses, given.twin.poses)


def test_a_smaller_budget_sends_fewer_bytes() -> None:
    sent = []
    for budget in (MeshSettings().rate_bytes_per_s, 100.0):
        env = Exploration(settings(levels=("4",), budget_bytes_per_s=budget), seed=0)
        env.reset()
        for _ in range(150):
            env.step(np.nan_to_num(env.planner_actions()))
        sent.append(env.air.bytes_sent[0].sum(axis=-1))
    assert sent[1].sum() < 0.8 * sent[0].sum()
    assert (sent[1] <= 100.0 * 15.1 + MeshSettings().burst_bytes).all()


def test_more_drones_than_a_level_has_room_for_are_refused(tmp_path: Path) -> None:
    (tmp_path / "closet.yaml").write_text("{size_m: [2, 2], launch: [1, 1]}")
    closet = str(tmp_path / "closet.yaml")
    assert Exploration(settings(levels=(closet,)), seed=0).drones == 2
    with pytest.raises(
        InputError, match=r"closet.*: room for \d+ drones around .*, not 16: .* take fewer, or a larger"
    ):
        Exploration(settings(levels=(closet,), drones=16), seed=0)


def test_level_weights_are_shares_of_the_episodes() -> None:
    env = Exploration(settings(levels=("0", "1"), level_weights=(0.0, 1.0), worlds=5), seed=0)
    env.reset()
    assert {level.name for level in env.twin.levels} == {"1"}
