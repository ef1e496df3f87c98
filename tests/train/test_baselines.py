"""Frontier baselines in flight: they get on, hold on to their goals, and advise in any state."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from imagine.core.errors import InputError
from imagine.sim.exploration import Exploration
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.train.baselines import BASELINES, baseline
from imagine.train.baselines.parameters import COORDINATED
from imagine.train.baselines.pilot import FrontierPilot

PLANNERS = ["frontier", "coordinated", "hungarian"]


def explored(level: str, worlds: int = 2, **changes: Any) -> Exploration:
    return Exploration(ExplorationSettings(levels=(level,), worlds=worlds, drones=3, **changes), seed=31, restart=False)


@pytest.mark.parametrize("name", PLANNERS)
def test_they_cover_level_4_and_never_stand_still(name: str) -> None:
    """While it is advised, no drone stays within 0.3 m for four seconds; nobody touches anything."""
    env, pilot = explored("4", worlds=4), baseline(name, 0)
    observation = env.reset()
    pilot.begin(env)
    anchors, still = env.twin.poses[..., :2].copy(), np.zeros((4, 3), int)
    episodes = []
    for _ in range(500):
        actions = pilot.act(env, observation)
        advised = np.isfinite(actions).all(axis=-1)
        step = env.step(np.nan_to_num(actions))
        observation, places = step.observation, env.twin.poses[..., :2]
        episodes += step.episodes
        gone = np.hypot(*np.moveaxis(places - anchors, -1, 0)) > 0.3
        restart = gone | ~advised | step.done[:, None]
        still = np.where(restart, 0, still + 1)
        anchors[restart] = places[restart]
        assert still.max() < 40
        if step.done.all():
            break
    assert len(episodes) == 4
    assert min(episode.coverage for episode in episodes) >= 0.99
    assert sum(episode.contacts for episode in episodes) == 0


def coordinated() -> FrontierPilot:
    pilot = baseline("coordinated", 0)
    assert isinstance(pilot, FrontierPilot)
    return pilot


def wander(env: Exploration, ticks: int, *pilots: FrontierPilot) -> None:
    """Fly at random while the pilots are asked all along, as a student does."""
    rng = np.random.default_rng(5)
    observation = env.reset()
    for pilot in pilots:
        pilot.begin(env)
    actions = np.zeros((env.worlds, env.drones, 2), np.float32)
    for tick in range(ticks):
        for pilot in pilots:
            labels = pilot.act(env, observation)
            assert (np.isnan(labels).any(axis=-1) == np.isnan(labels).all(axis=-1)).all()
        if tick % 15 == 0:
            actions = rng.uniform(-1.0, 1.0, actions.shape).astype(np.float32)
        observation = env.step(actions).observation


@pytest.mark.parametrize("name", PLANNERS)
def test_advice_depends_on_the_state_and_not_on_what_was_flown(name: str) -> None:
    env = explored("3")
    used, fresh = baseline(name, 0), baseline(name, 0)
    assert isinstance(used, FrontierPilot)
    wander(env, 60, used)
    observation = env.reset()
    used.forget(np.ones(env.worlds, np.bool_))
    fresh.begin(env)
    for _ in range(12):
        advice = used.act(env, observation)
        np.testing.assert_array_equal(advice, fresh.act(env, observation))
        observation = env.step(np.nan_to_num(advice)).observation


def test_forgetting_one_world_leaves_the_others() -> None:
    env = explored("3")
    one, other = coordinated(), coordinated()
    wander(env, 30, one, other)
    observation = env.reset()
    one.forget(np.array([True, False]))
    before = other.act(env, observation)
    after = one.act(env, observation)
    np.testing.assert_array_equal(after[1], before[1])


def test_advice_points_along_the_action_of_every_mode() -> None:
    """The same course comes out of the numbers of each action mode."""
    courses: list[NDArray[np.float64]] = []
    for mode in ("plane", "waypoint", "body"):
        env, pilot = explored("4", action={"mode": mode}), baseline("coordinated", 0)
        observation = env.reset()
        pilot.begin(env)
        actions = pilot.act(env, observation).astype(float)
        yaw = env.estimates[..., 2] if mode == "body" else np.zeros((2, 3))
        c, s = np.cos(yaw), np.sin(yaw)
        course = np.stack((c * actions[..., 0] - s * actions[..., 1], s * actions[..., 0] + c * actions[..., 1]), -1)
        courses.append(course / np.linalg.norm(course, axis=-1, keepdims=True))
    np.testing.assert_allclose(courses[1], courses[0], atol=1e-5)
    np.testing.assert_allclose(courses[2], courses[0], atol=1e-5)


def test_without_radio_peers_make_no_difference() -> None:
    """Under `off` a drone decides as if it were alone; else, from one launch, peers do count."""
    for protocol, alike in (("off", True), ("one-hop", False)):
        env = explored("6", protocol=protocol)
        team, loner = coordinated(), FrontierPilot("loner", COORDINATED._replace(peer_age_s=-1.0))
        observation = env.reset()
        team.begin(env)
        loner.begin(env)
        same = True
        for _ in range(20):
            advice = team.act(env, observation)
            same = same and np.array_equal(advice, loner.act(env, observation), equal_nan=True)
            observation = env.step(np.nan_to_num(advice)).observation
        assert same == alike


@pytest.mark.parametrize("name", PLANNERS)
def test_there_is_no_advice_for_the_dead_nor_where_all_is_known(name: str) -> None:
    env, pilot = explored("0", stop_coverage=1.0, episode_ticks=400), baseline(name, 0)
    observation = env.reset()
    pilot.begin(env)
    env.alive[0, 1] = False
    assert np.isnan(pilot.act(env, observation)[0, 1]).all()
    for _ in range(150):
        step = env.step(np.nan_to_num(pilot.act(env, observation)))
        observation = step.observation
        if step.done.all():
            break
    advice = np.isfinite(pilot.act(env, observation)).all(axis=-1)
    np.testing.assert_array_equal(advice & ~env.maps.arrays.frontiers, np.zeros((2, 3), bool))
    assert not advice[env.maps.arrays.frontiers.sum(axis=1) == 0].any()


def test_goals_are_held_while_they_last() -> None:
    """Along a flight the goal changes when its frontier has gone, and seldom otherwise."""
    env, pilot = explored("6"), coordinated()
    observation = env.reset()
    pilot.begin(env)
    returns, past = 0, [[list[int]() for _ in range(3)] for _ in range(2)]
    for _ in range(200):
        observation = env.step(np.nan_to_num(pilot.act(env, observation))).observation
        for world in range(2):
            for drone in range(3):
                goals = past[world][drone]
                goal = pilot.goals()[world, drone]
                if not goals or goals[-1] != goal:
                    returns += goal in goals[-6:-1]
                    goals.append(goal)
    assert returns <= 6 * 4  # flights of 20 s in which a drone goes back to a goal that it had left


def test_an_unknown_name_is_refused_with_the_nearest() -> None:
    assert set(BASELINES) == {"random", *PLANNERS, "clairvoyant"}
    with pytest.raises(InputError, match="coordinated"):
        baseline("cordinated", 0)
