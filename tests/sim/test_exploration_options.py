"""The decision process with its options: decisions that stand for ticks, deaths, and everything a policy may see."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from imagine.core.contract import ActionSpec
from imagine.core.observation_spec import ObservationSpec
from imagine.sim.exploration import Exploration
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.sim.reward import RewardSettings

EVERYTHING = ObservationSpec(view_cells=16, position=True, heading=True, peers=2, visits="team", axes="heading")
STILL = np.zeros((2, 3, 2), np.float32)


def make(restart: bool = True, **changes: Any) -> Exploration:
    base: dict[str, Any] = {"levels": ("3",), "worlds": 2, "drones": 3, "mirror": False, "observation": EVERYTHING}
    return Exploration(ExplorationSettings(**(base | changes)), seed=3, restart=restart)


@pytest.mark.parametrize("mode", ["plane", "body", "forward", "waypoint"])
@pytest.mark.parametrize("ticks", [1, 5])
def test_the_planner_explores_in_every_mode_of_action(mode: Any, ticks: int) -> None:
    env = make(action=ActionSpec(mode=mode, decision_ticks=ticks), stop_coverage=0.9, episode_ticks=500)
    seen = env.reset()
    assert seen.policy["views"].shape[2] == 8
    episodes = []
    for _ in range(500 // ticks):
        step = env.step(np.nan_to_num(env.planner_actions()))
        assert all(np.isfinite(array).all() for array in step.observation.policy.values())
        episodes += step.episodes
        if len(episodes) > 1:
            break
    assert min(episode.coverage for episode in episodes) >= 0.9
    assert max(episode.ticks for episode in episodes) <= 400
    assert all(len(episode.curve) == episode.ticks for episode in episodes)


def test_a_decision_earns_what_its_ticks_earn() -> None:
    once, often = make(action=ActionSpec(decision_ticks=4)), make()
    once.reset(), often.reset()
    actions = np.full((2, 3, 2), 0.5, np.float32)
    for _ in range(5):
        step = once.step(actions)
        parts = [often.step(actions) for _ in range(4)]
        np.testing.assert_allclose(step.reward, sum(part.reward for part in parts), atol=1e-6)
        for name, array in step.observation.policy.items():
            np.testing.assert_array_equal(array, parts[-1].observation.policy[name])
    assert once.ticks.tolist() == often.ticks.tolist() == [20, 20]


def test_a_world_that_ends_within_a_decision_is_seen_as_it_ended_and_the_other_flies_on() -> None:
    """The first episodes are staggered: world 0 ends with tick 50, two ticks into the 13th decision of four."""
    held = {"action": ActionSpec(decision_ticks=4), "episode_ticks": 100, "stagger": True, "stop_coverage": 1.0}
    once, often = make(restart=False, **held), make(restart=False, **(held | {"action": ActionSpec()}))
    once.reset(), often.reset()
    actions = np.full((2, 3, 2), 0.4, np.float32)
    for _ in range(13):
        step = once.step(actions)
    for tick in range(52):
        part = often.step(actions)
        if tick == 49:
            ended = {name: array[0].copy() for name, array in part.observation.policy.items()}
            poses = often.twin.poses[0].copy()
    assert step.done.tolist() == [True, False]
    assert once.ticks.tolist() == [50, 52]
    np.testing.assert_array_equal(once.twin.poses[0], poses)
    for name, array in step.observation.policy.items():
        np.testing.assert_array_equal(array[0], ended[name])
        np.testing.assert_array_equal(array[1], part.observation.policy[name][1])


def test_ended_worlds_are_seen_as_they_ended_while_the_last_one_flies_on() -> None:
    env = make(worlds=16, restart=False, episode_ticks=100, stagger=True, stop_coverage=1.0)
    env.reset()
    rng = np.random.default_rng(0)
    for tick in range(1, 99):
        step = env.step(rng.uniform(-1.0, 1.0, (16, 3, 2)).astype(np.float32))
        if tick == 94:  # the last but one ends, and two of sixteen worlds were left to fly
            ended = {name: array[14].copy() for name, array in step.observation.policy.items()}
        if tick >= 94:
            for name, array in step.observation.policy.items():
                np.testing.assert_array_equal(array[14], ended[name])
    assert step.done.tolist() == [True] * 15 + [False]


def test_observations_last_until_the_step_after_the_next() -> None:
    env = make()
    first = env.reset().policy["views"]
    kept = first.copy()
    second = env.step(STILL + 0.5).observation.policy["views"]
    np.testing.assert_array_equal(first, kept)
    kept = second.copy()
    env.reset()
    np.testing.assert_array_equal(second, kept)
    assert not np.shares_memory(first, second)


def test_a_drone_that_touches_anything_is_out_and_the_episode_ends_with_the_last(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    env = make(reward=RewardSettings(kill_on_collision=True, collision_penalty=1.0))
    env.reset()
    env.step(STILL)
    touched = np.zeros((2, 3), np.int64)
    run = env._run

    def touch(*drones: int) -> None:
        touched[0, list(drones)] = 1

    def run_and_touch(*arguments: Any) -> None:
        run(*arguments)
        env.twin.contacts += touched
        touched[:] = 0

    monkeypatch.setattr(env, "_run", run_and_touch)
    touch(1)
    assert env.step(STILL).reward[0, 1] <= -0.5
    assert env.alive.tolist() == [[True, False, True], [True, True, True]]
    at = env.twin.poses[0, 1, :2].copy()
    for _ in range(10):
        step = env.step(np.ones((2, 3, 2), np.float32))
        assert step.reward[0, 1] == 0.0
    assert np.hypot(*(env.twin.poses[0, 1, :2] - at)) < 0.1
    assert np.isnan(env.planner_actions()[0, 1]).all()
    assert not env.links()[0, 1].any()
    assert np.isnan(env.ranges[0, 1]).all()
    touch(0, 2)
    step = env.step(STILL)
    assert step.done.tolist() == [True, False]
    assert env.alive.all()  # the world started anew
    assert env.ticks[0] == 0
