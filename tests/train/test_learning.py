import numpy as np
import pytest
import torch

from imagine.core.errors import WorkError
from imagine.core.observation_spec import ObservationSpec
from imagine.sim.exploration import Exploration
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.train.imitation import ImitationSettings, collect_labels, imitation_loss, learn
from imagine.train.labels import LabelBuffer
from imagine.train.networks import Actor, Critic, NetworkSettings, log_probability
from imagine.train.ppo import Optimisers, PpoSettings, update
from imagine.train.rollout import Rollout, collect

SPEC = ObservationSpec(view_cells=16, lidar_sectors=16)
SMALL = NetworkSettings(view_channels=(8, 8, 8), critic_channels=(8, 8), lidar_channels=4, hidden=32)
PPO = PpoSettings(minibatch=64, actor_lr=1e-3, critic_lr=1e-3)


def learners(seed=0):
    torch.manual_seed(seed)
    actor, critic = Actor(SMALL, SPEC, 2), Critic(SMALL, SPEC)
    return actor, critic, Optimisers(actor, critic), torch.Generator().manual_seed(seed)


def rollout_that_pays_for_going_east(actor, generator, steps=8, agents=32):
    observations = {key: torch.rand((steps, agents, *shape), generator=generator) for key, shape in SPEC.shapes.items()}
    observations["level"] = torch.rand((steps, agents, 5, 32, 32), generator=generator)
    with torch.no_grad():
        mean = actor(*(observations[key].flatten(0, 1) for key in ("views", "lidar", "motion")))
        actions = mean + actor.spread().exp() * torch.randn(mean.shape, generator=generator)
        log_probs = log_probability(actions, mean, actor.spread())
    actions = actions.reshape(steps, agents, 2)
    return Rollout(
        observations, actions, log_probs.reshape(steps, agents), actions[..., 0].clone(),
        torch.ones((steps, agents), dtype=torch.bool), {key: value[-1] for key, value in observations.items()},
        torch.ones((steps, agents), dtype=torch.bool),
    )  # fmt: skip


def test_ppo_learns_what_pays_and_what_it_is_worth():
    actor, critic, optimisers, generator = learners()
    first = rollout_that_pays_for_going_east(actor, generator)
    before = actor(*(first.last[key] for key in ("views", "lidar", "motion"))).detach()
    losses = [update(actor, critic, optimisers, first, PPO, generator)["value_loss"]]
    for _ in range(8):
        rollout = rollout_that_pays_for_going_east(actor, generator)
        losses.append(update(actor, critic, optimisers, rollout, PPO, generator)["value_loss"])
    after = actor(*(first.last[key] for key in ("views", "lidar", "motion"))).detach()
    assert (after - before)[:, 0].mean() > 0.05
    assert abs((after - before)[:, 1].mean()) < (after - before)[:, 0].mean() / 2
    assert losses[-1] < losses[0]


def test_the_value_loss_falls_on_a_fixed_rollout():
    actor, critic, optimisers, generator = learners()
    rollout = rollout_that_pays_for_going_east(actor, generator)
    losses = [update(actor, critic, optimisers, rollout, PPO, generator, False)["value_loss"] for _ in range(10)]
    assert losses[-1] < 0.8 * losses[0]


def test_the_policy_rests_while_the_critic_warms_up():
    actor, critic, optimisers, generator = learners()
    rollout = rollout_that_pays_for_going_east(actor, generator)
    weights = {name: value.clone() for name, value in actor.state_dict().items()}
    value_weights = critic.value.weight.detach().clone()
    numbers = update(actor, critic, optimisers, rollout, PPO, generator, policy_moves=False)
    assert all(torch.equal(value, weights[name]) for name, value in actor.state_dict().items())
    assert not torch.equal(critic.value.weight, value_weights)
    assert "kl" not in numbers


def test_a_large_divergence_ends_the_policys_steps():
    actor, critic, optimisers, generator = learners()
    rollout = rollout_that_pays_for_going_east(actor, generator)
    rollout.log_probs += 1.0  # as if flown by a very different policy
    weights = actor.mean.weight.detach().clone()
    update(actor, critic, optimisers, rollout, PPO, generator)
    assert torch.equal(actor.mean.weight, weights)


def test_a_loss_that_is_no_number_never_reaches_the_weights():
    actor, critic, optimisers, generator = learners()
    rollout = rollout_that_pays_for_going_east(actor, generator)
    rollout.rewards[3, 3] = float("nan")
    weights = {name: value.clone() for name, value in critic.state_dict().items()}
    with pytest.raises(WorkError, match="diverged"):
        update(actor, critic, optimisers, rollout, PPO, generator)
    assert all(torch.equal(value, weights[name]) for name, value in critic.state_dict().items())


def test_imitation_comes_close_to_the_planner():
    env = Exploration(ExplorationSettings(levels=("1",), worlds=4, drones=2, observation=SPEC), seed=3)
    actor, _, _, generator = learners()
    buffer = LabelBuffer(2000)
    settings = ImitationSettings(gradient_steps=60, minibatch=128, lr=2e-3)
    rng = np.random.default_rng(0)
    _, _, added = collect_labels(env, env.reset(), actor, buffer, 60, 0.5, rng, generator)
    assert added == len(buffer) > 300
    batch = buffer.sample(256, generator)
    before = imitation_loss(batch.decide(actor).mean, batch["labels"], 0.25).item()
    optimiser = torch.optim.Adam(actor.parameters(), lr=settings.lr)
    learn(actor, optimiser, buffer, settings, generator)
    after = imitation_loss(batch.decide(actor).mean, batch["labels"], 0.25).item()
    assert after < 0.3 * before


def test_the_buffer_keeps_the_newest_labels():
    buffer = LabelBuffer(10)
    for first in range(0, 24, 4):
        numbers = torch.arange(first, first + 4.0)[:, None]
        buffer.add({"motion": numbers.repeat(1, 3)}, numbers.repeat(1, 2))
    assert len(buffer) == 10
    batch = buffer.sample(500, torch.Generator().manual_seed(0))
    assert set(batch["labels"][:, 0].tolist()) == set(range(14, 24))
    assert torch.equal(batch["motion"][:, 0], batch["labels"][:, 0])


def test_a_rollout_holds_what_was_seen_done_and_earned():
    env = Exploration(ExplorationSettings(levels=("0",), worlds=2, drones=2, episode_ticks=8, observation=SPEC), seed=1)
    actor, _, _, generator = learners()
    observation = env.reset()
    seen = observation.policy["views"].reshape(4, *SPEC.shapes["views"]).copy()
    rollout, after = collect(env, observation, actor, 10, generator)
    assert rollout.agent_steps == 40
    assert rollout.dones.any(dim=0).all()
    assert len(rollout.episodes) >= 2
    assert rollout.rewards.min() >= 0.0
    assert rollout.rewards.sum() > 0.0
    np.testing.assert_array_equal(rollout.observations["views"][0], seen.astype(np.float16))
    np.testing.assert_array_equal(rollout.last["level"], after.critic.reshape(4, 5, 32, 32).astype(np.float16))
    assert rollout.observations["views"].flatten(0, 1).is_contiguous(memory_format=torch.channels_last)
    mean = actor(*(rollout.observations[key][4] for key in ("views", "lidar", "motion")))
    torch.testing.assert_close(rollout.log_probs[4], log_probability(rollout.actions[4], mean, actor.spread()))
