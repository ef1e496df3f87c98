"""A drone that died teaches nothing more until its world starts anew, and its death is the end of its own episode."""

import numpy as np
import pytest
import torch

from imagine.core.errors import WorkError
from imagine.core.observation_spec import ObservationSpec
from imagine.sim.exploration import Exploration
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.train.gae import advantages_and_returns
from imagine.train.networks import Actor, Critic, NetworkSettings, log_probability
from imagine.train.ppo import Optimisers, PpoSettings, update
from imagine.train.rollout import Rollout, collect

SPEC = ObservationSpec(view_cells=16, lidar_sectors=16)
SMALL = NetworkSettings(view_channels=(8, 8, 8), critic_channels=(8, 8), lidar_channels=4, hidden=32)
PPO = PpoSettings(minibatch=32, actor_lr=1e-3, critic_lr=1e-3, kl_stop=None)


def learners():
    torch.manual_seed(0)
    actor, critic = Actor(SMALL, SPEC, 2), Critic(SMALL, SPEC)
    return actor, critic, Optimisers(actor, critic), torch.Generator().manual_seed(0)


def rollout_with_dead_drones(actor, garbage):
    """Eight steps of sixteen drones; the second half of the drones die in step 3. `garbage` is what the dead leave."""
    generator = torch.Generator().manual_seed(7)
    steps, agents = 8, 16
    observations = {key: torch.rand((steps, agents, *shape), generator=generator) for key, shape in SPEC.shapes.items()}
    observations["level"] = torch.rand((steps, agents, 5, 32, 32), generator=generator)
    with torch.no_grad():
        mean = actor(*(observations[key].flatten(0, 1) for key in ("views", "lidar", "motion")))
        actions = mean + actor.spread().exp() * torch.randn(mean.shape, generator=generator)
        log_probs = log_probability(actions, mean, actor.spread()).reshape(steps, agents)
    actions = actions.reshape(steps, agents, 2)
    rewards = actions[..., 0].clone()
    alive = torch.ones((steps, agents), dtype=torch.bool)
    alive[4:, 8:] = False
    dones = torch.zeros((steps, agents), dtype=torch.bool)
    dones[3, 8:] = dones[-1] = True
    rewards[~alive], actions[~alive], log_probs[~alive] = garbage, garbage, garbage
    for value in observations.values():
        value[~alive] = garbage
    last = {key: value[-1] for key, value in observations.items()}
    return Rollout(observations, actions, log_probs, rewards, dones, last, alive)


def test_nothing_of_what_the_dead_leave_reaches_the_weights():
    learned = []
    for garbage in (0.0, 40.0):
        actor, critic, optimisers, generator = learners()
        rollout = rollout_with_dead_drones(actor, garbage)
        assert rollout.agent_steps == 8 * 16 - 4 * 8
        numbers = update(actor, critic, optimisers, rollout, PPO, generator)
        learned.append((actor.state_dict(), critic.state_dict(), numbers))
    (actor, critic, numbers), (other_actor, other_critic, other_numbers) = learned
    assert numbers == other_numbers
    assert all(torch.equal(value, other_actor[name]) for name, value in actor.items())
    assert all(torch.equal(value, other_critic[name]) for name, value in critic.items())


def test_the_living_teach_while_others_are_dead():
    actor, critic, optimisers, generator = learners()
    before = actor.mean.weight.detach().clone()
    update(actor, critic, optimisers, rollout_with_dead_drones(actor, 0.0), PPO, generator)
    assert not torch.equal(actor.mean.weight, before)


def test_a_rollout_of_the_dead_alone_is_an_error():
    actor, critic, optimisers, generator = learners()
    rollout = rollout_with_dead_drones(actor, 0.0)
    rollout.alive[:] = False
    with pytest.raises(WorkError, match="living"):
        update(actor, critic, optimisers, rollout, PPO, generator)


def test_a_death_ends_a_drones_own_episode():
    """Rewards after it, of whoever flies on in that row, are none of the dead drone's."""
    rewards = torch.tensor([[1.0], [-2.0], [50.0], [3.0]])
    dones = torch.tensor([[False], [True], [True], [False]])
    advantages, _ = advantages_and_returns(rewards, torch.zeros((4, 1)), dones, torch.tensor([10.0]), 0.5, 1.0)
    assert advantages[:, 0].tolist() == [0.0, -2.0, 50.0, 8.0]


class Deadly(Exploration):
    """Exploration in which drone 1 of world 0 dies in the third step of every episode."""

    def step(self, actions):
        step = super().step(actions)
        self.alive[:] = True
        self.alive[0, 1] = self.ticks[0] < 3
        return step


def test_a_rollout_tells_who_acted_and_whose_episode_ended():
    settings = ExplorationSettings(levels=("1",), worlds=2, drones=2, episode_ticks=6, observation=SPEC, mirror=False)
    env = Deadly(settings, seed=0)
    rollout, _ = collect(env, env.reset(), learners()[0], 9, torch.Generator().manual_seed(0))
    dead = np.zeros((9, 4), bool)
    dead[3:6, 1] = True
    assert rollout.alive.numpy().tolist() == (~dead).tolist()
    assert rollout.dones[:, 1].nonzero().flatten().tolist() == [2, 5, 8]
    assert rollout.dones[:, [0, 2, 3]].nonzero()[:, 0].unique().tolist() == [5]
    assert rollout.agent_steps == 33
