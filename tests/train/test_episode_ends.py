"""Only a time limit cuts an episode off; all other ends are ends, after which nothing more is earned."""

import numpy as np
import pytest
import torch

from imagine.core.observation_spec import ObservationSpec
from imagine.sim.exploration import Exploration
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.train.networks import Actor, NetworkSettings
from imagine.train.rollout import collect

SPEC = ObservationSpec(view_cells=16, lidar_sectors=16)


def flown(steps, env_class=Exploration, **settings):
    """Return a rollout of two drones in one world, and how the first episode went."""
    torch.manual_seed(0)
    actor = Actor(NetworkSettings(hidden=16, view_channels=(4, 4), critic_channels=(4, 4)), SPEC, 2)
    env = env_class(ExplorationSettings(worlds=1, drones=2, observation=SPEC, mirror=False, **settings), seed=1)
    rollout, _ = collect(env, env.reset(), actor, steps, torch.Generator().manual_seed(0))
    return rollout, rollout.episodes[0]


class Closed(Exploration):
    """Exploration in which nobody ever knows of a frontier, as behind a closed door."""

    def _run(self, modes, shown, derives=True):
        super()._run(modes, shown, derives)
        self.maps.arrays.frontiers[...] = False


def at_first_end(rollout):
    """Return who was done, and who cut off, with the step that ended the first episode."""
    ended = int(rollout.dones.all(dim=1).nonzero()[0])
    return rollout.dones[ended].tolist(), rollout.truncated[ended].tolist()


def test_a_time_limit_cuts_off():
    rollout, episode = flown(8, levels=("1",), episode_ticks=6)
    assert (episode.ticks, episode.coverage < 0.995) == (6, True)
    assert at_first_end(rollout) == ([True, True], [True, True])
    assert rollout.truncated.sum() == 2


def test_a_level_with_nowhere_left_to_go_has_ended_though_less_than_asked_for_is_covered():
    rollout, episode = flown(40, Closed, levels=("1",), episode_ticks=400)
    assert episode.ticks == 30
    assert episode.coverage < 0.9
    assert at_first_end(rollout) == ([True, True], [False, False])


def test_a_covered_level_has_ended():
    rollout, episode = flown(20, levels=("0",), episode_ticks=400, stop_coverage=0.3)
    assert episode.coverage >= 0.3
    assert at_first_end(rollout) == ([True, True], [False, False])


class Falling(Exploration):
    """Exploration in which drones fall with tick 6: drone 1, or all of them."""

    everyone = False

    def _advance(self, running, shown, derives=True):
        self._falls = int(self.ticks[0]) == 5
        return super()._advance(running, shown, derives)

    def _run(self, modes, shown, derives=True):
        super()._run(modes, shown, derives)
        if getattr(self, "_falls", False):
            self.alive[0, 0 if self.everyone else 1 :] = False
            self._falls = False


class AllFalling(Falling):
    everyone = True


@pytest.mark.parametrize(
    ("env_class", "limit", "cut"),
    [(AllFalling, 50, [False, False]), (AllFalling, 6, [False, False]), (Falling, 6, [True, False])],
    ids=["all fell", "all fell as time was up", "one fell as time was up"],
)
def test_who_fell_is_not_cut_off(env_class, limit, cut):
    rollout, episode = flown(8, env_class, levels=("1",), episode_ticks=limit)
    assert episode.ticks == 6
    assert at_first_end(rollout) == ([True, True], cut)


def test_the_step_tells_a_limit_that_comes_with_another_end_as_the_other_end():
    settings = ExplorationSettings(
        worlds=1, drones=2, levels=("0",), episode_ticks=1, stop_coverage=0.01, observation=SPEC
    )
    env = Exploration(settings, seed=0)
    env.reset()
    step = env.step(np.zeros((1, 2, settings.action.size), np.float32))
    assert step.done.tolist() == [True]
    assert step.late.tolist() == [False]
