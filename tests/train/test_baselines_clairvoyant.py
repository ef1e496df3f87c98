"""The teacher that knows the level: quicker than who does not, wherever drones are, and only where it is asked."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from imagine.core.observation_spec import ObservationSpec
from imagine.sim.exploration import Exploration
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.train.baselines import baseline
from imagine.train.imitation import collect_labels
from imagine.train.labels import LabelBuffer
from imagine.train.networks import Actor, NetworkSettings
from imagine.train.pilots import Pilot
from imagine.train.rehearsal import RehearsalPilot, RehearsalSettings


def worlds(level: str, number: int, **changes: Any) -> Exploration:
    settings = {"action": {"decision_ticks": 4}, "stop_coverage": 0.91, "random_launch": False} | changes
    return Exploration(ExplorationSettings(levels=(level,), worlds=number, drones=3, **settings), seed=3, restart=False)


def flown(env: Exploration, pilot: Pilot) -> list[float]:
    observation = env.reset()
    pilot.begin(env)
    episodes = []
    for _ in range(250):
        step = env.step(np.nan_to_num(pilot.act(env, observation)))
        observation = step.observation
        episodes += step.episodes
        if step.done.all():
            break
    assert sum(episode.contacts for episode in episodes) == 0
    return [1000.0 if episode.t90 is None else episode.t90 for episode in episodes]


@pytest.mark.parametrize(
    "observation", [{}, {"frontiers": 8}, {"frontiers": 8, "axes": "heading"}], ids=["ways", "frontiers", "heading"]
)
def test_who_knows_level_2_is_done_long_before_who_does_not(observation: dict[str, Any]) -> None:
    known = flown(worlds("2", 4, random_launch=True, observation=observation), baseline("clairvoyant", 0))
    unknown = flown(worlds("2", 4, random_launch=True, action={}), baseline("coordinated", 0))
    assert np.mean(known) < 0.9 * np.mean(unknown)


def test_its_plans_from_a_launch_point_are_the_same_again() -> None:
    times = [flown(worlds("4", 2), baseline("clairvoyant", 0)) for _ in range(2)]
    assert times[0] == times[1]
    assert max(times[0]) < 195  # coordinated takes 197


def test_in_rehearsal_each_world_has_the_teacher_for_where_it_began_and_how_far_it_is() -> None:
    env = worlds("4", 12, random_launch=True, mirror=True, as_designed=0.5, observation={"frontiers": 8})
    observation = env.reset()
    designed = env.as_designed
    assert 2 < designed.sum() < 10
    names = ("frontier", "clairvoyant", "coordinated")
    alone = [baseline(name, 0) for name in names]
    threshold = float(np.median(env.maps.coverage()))
    both = RehearsalPilot(*(baseline(name, 0) for name in names), late_coverage=threshold)
    for pilot in (*alone, both):
        pilot.begin(env)
    policy, known, planned = (pilot.act(env, observation) for pilot in alone)
    mixed = both.act(env, observation)
    late = env.maps.coverage() >= threshold
    np.testing.assert_array_equal(mixed[late], planned[late])
    np.testing.assert_array_equal(mixed[designed & ~late], known[designed & ~late])
    np.testing.assert_array_equal(mixed[~designed & ~late], policy[~designed & ~late])
    assert (designed & ~late).any()
    assert (~designed & ~late).any()


def test_labels_tell_whether_the_policy_gave_them() -> None:
    spec = ObservationSpec(view_cells=16, lidar_sectors=16, frontiers=4)
    env = worlds("4", 8, random_launch=True, as_designed=0.5, observation=spec)
    observation = env.reset()
    designed = np.repeat(env.as_designed, env.drones)
    pilot = RehearsalPilot(*(baseline(name, 0) for name in ("frontier", "clairvoyant", "coordinated")), 0.95)
    pilot.begin(env)
    settings = NetworkSettings(head="choice", view_channels=(8, 8, 8), critic_channels=(8, 8), hidden=32)
    buffer = LabelBuffer(100)
    collect_labels(
        env, observation, Actor(settings, spec, 2), pilot, buffer, 1, 0.0, np.random.default_rng(0),
        torch.Generator().manual_seed(0),
    )  # fmt: skip
    assert len(buffer) == 24
    np.testing.assert_array_equal(buffer.arrays["by_reference"][:24, 0].numpy() > 0.5, ~designed)


def test_generated_houses_are_not_learned_by_heart() -> None:
    env = worlds("house:3001:60", 3, observation={"frontiers": 8}, as_designed=1.0)
    observation = env.reset()
    assert env.as_designed.all()
    policy = baseline("frontier", 0)
    both = RehearsalPilot(policy, baseline("clairvoyant", 0), baseline("coordinated", 0), late_coverage=0.92)
    both.begin(env)
    np.testing.assert_array_equal(both.act(env, observation), policy.act(env, observation))


def test_rehearsal_gives_levels_that_can_be_known_the_share_that_is_asked_for() -> None:
    env = ExplorationSettings(levels=("4", "5", "house:1000-1001:60"), level_weights=(1.0, 3.0, 16.0))
    rehearsed = RehearsalSettings(known_share=0.6, as_designed=0.7).environment(env)
    assert rehearsed.level_weights == pytest.approx((0.15, 0.45, 0.2, 0.2))
    assert rehearsed.as_designed == 0.7
    assert len(rehearsed.levels) == 4
    alone = env.model_copy(update={"levels": ("4", "5"), "level_weights": (1.0, 3.0)})
    assert RehearsalSettings(known_share=0.6).environment(alone).level_weights == (1.0, 3.0)


def test_of_worlds_that_nobody_asks_for_it_says_nothing() -> None:
    env, pilot = worlds("2", 3), baseline("clairvoyant", 0)
    observation = env.reset()
    pilot.begin(env)
    asked = np.array([False, True, False])
    actions = pilot.act(env, observation, asked)
    assert np.isfinite(actions[asked]).any()
    assert np.isnan(actions[~asked]).all()


def test_a_late_teacher_that_would_never_be_asked_is_refused() -> None:
    with pytest.raises(ValueError, match="never be asked"):
        RehearsalSettings(late_coverage=0.99, stop_coverage=0.985)
