"""How soon a level could be explored: what holds of the floor whatever the level."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from imagine.core.frames import Pose
from imagine.sim.clairvoyant import Clairvoyant
from imagine.sim.exploration import Exploration
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.sim.level import load_level
from imagine.train.baselines import baseline


@pytest.fixture(scope="module")
def known() -> Clairvoyant:
    return Clairvoyant(load_level("2"))


def test_what_is_seen_at_the_launch_takes_no_time() -> None:
    level = load_level("0")
    floor = Clairvoyant(level).floor(level.launch_poses(1), share=0.05, tries=10)
    assert floor.bound == floor.plan == 0.0


def test_the_bound_is_the_flight_to_the_end_of_a_corridor(tmp_path: Path) -> None:
    corridor = tmp_path / "corridor.yaml"
    corridor.write_text("title: corridor\nsize_m: [20, 1]\nlaunch: [1, 0.5]\n", encoding="utf-8")
    level = load_level(str(corridor))
    floor = Clairvoyant(level).floor([Pose(1.0, 0.5, 0.0)], speed_mps=0.8, share=0.9, tries=300)
    ticks = (18.0 - 4.0 - 1.0) / 0.8 * 10.0  # 90 % are seen once 18 m are, from 4 m before
    assert 0.93 * ticks < floor.bound < ticks
    assert ticks - 5.0 < floor.plan < ticks + 10.0


def test_more_drones_lower_the_plan_and_nothing_is_below_the_bound(known: Clairvoyant) -> None:
    launch = load_level("2").launch_poses(4)
    floors = [known.floor(launch[:drones], tries=4000) for drones in (1, 2, 4)]
    assert floors[0].plan > floors[1].plan > floors[2].plan
    assert all(floor.bound <= floor.plan for floor in floors)


def test_twice_the_speed_is_half_the_time(known: Clairvoyant) -> None:
    launch = load_level("2").launch_poses(2)
    slow, quick = known.floor(launch, 0.4, tries=10), known.floor(launch, 0.8, tries=10)
    assert slow.bound == pytest.approx(2.0 * quick.bound)


def test_a_planner_that_does_not_know_the_level_takes_longer(known: Clairvoyant) -> None:
    env = Exploration(
        ExplorationSettings(levels=("2",), worlds=4, mirror=False, random_launch=False), seed=5, restart=False
    )
    observation, pilot = env.reset(), baseline("coordinated", 0)
    pilot.begin(env)
    floor = known.floor([Pose(*pose) for pose in env.twin.poses[0].tolist()])
    episodes = []
    for _ in range(600):
        step = env.step(np.nan_to_num(pilot.act(env, observation)))
        observation = step.observation
        episodes += step.episodes
        if step.done.all():
            break
    times = [episode.t90 for episode in episodes]
    assert len(times) == 4
    assert all(time is not None and floor.bound <= time for time in times)
    assert floor.plan < np.mean([time for time in times if time is not None])
