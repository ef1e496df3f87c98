import math

import numpy as np
import pytest
import torch

from imagine.core.errors import WorkError
from imagine.core.observation_spec import ObservationSpec
from imagine.sim.exploration import Exploration
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.train.baselines import baseline
from imagine.train.imitation import ImitationSettings, collect_labels, imitation_loss, learn
from imagine.train.labels import LabelBuffer
from imagine.train.networks import Actor, Critic, NetworkSettings, at_precision, compute_dtype, log_probability
from imagine.train.ppo import Optimisers, PpoSettings, update
from imagine.train.rollout import Rollout, collect

SPEC = ObservationSpec(view_cells=16, lidar_sectors=16)
SMALL = NetworkSettings(view_channels=(8, 8, 8), critic_channels=(8, 8), lidar_channels=4, hidden=32)
PPO = PpoSettings(minibatch=64, actor_lr=1e-3, critic_lr=1e-3, precision="float32")


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


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda rollout: rollout.rewards.__setitem__((3, 3), float("nan")), "in update 7: the rewards are not finite"),
        (lambda rollout: rollout.observations["level"].fill_(float("inf")), "the critic's values are not finite"),
        (lambda rollout: rollout.log_probs.fill_(float("nan")), r"the policy loss is nan, .*actor.*ppo\.actor_lr"),
    ],
    ids=["rewards", "values", "policy"],
)
def test_a_loss_that_is_no_number_never_reaches_the_weights(spoil, message):
    actor, critic, optimisers, generator = learners()
    rollout = rollout_that_pays_for_going_east(actor, generator)
    spoil(rollout)
    networks = (actor,) if "policy" in message else (actor, critic)
    before = [{name: value.clone() for name, value in network.state_dict().items()} for network in networks]
    with pytest.raises(WorkError, match=f"training diverged.*{message}"):
        update(actor, critic, optimisers, rollout, PPO, generator, number=7)
    for network, weights in zip(networks, before, strict=True):
        assert all(torch.equal(value, weights[name]) for name, value in network.state_dict().items())
    assert all(value.isfinite().all() for value in critic.state_dict().values())


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_values_are_learned_at_any_scale_of_rewards(scale):
    """Normalised returns: how fast the critic learns does not depend on the size of rewards."""
    actor, critic, optimisers, generator = learners()
    rollout = rollout_that_pays_for_going_east(actor, generator, steps=4)
    signal = (rollout.observations["motion"][..., 0] > 0.5).float()
    rollout.observations["lidar"][:] = signal[..., None]
    rollout.rewards = scale * (5.0 + signal)
    for _ in range(14):
        numbers = update(actor, critic, optimisers, rollout, PPO, generator, policy_moves=False)
    assert numbers["explained_variance"] > 0.7
    assert numbers["value"] == pytest.approx(numbers["return"], rel=0.1)
    assert numbers["return_std"] == pytest.approx(scale * 0.5, rel=0.1)


def test_a_new_scale_of_returns_leaves_the_values_as_they_are():
    _, critic, _, generator = learners()
    seen = {key: torch.rand((6, *shape), generator=generator) for key, shape in SPEC.shapes.items()}
    seen["level"] = torch.rand((6, 5, 32, 32), generator=generator)
    critic.rescale(torch.randn(500, generator=generator))
    with torch.no_grad():
        before = critic.scale.returns(critic(seen))
        for offset in (3.0, -40.0):
            critic.rescale(offset + 7.0 * torch.randn(500, generator=generator))
            torch.testing.assert_close(critic.scale.returns(critic(seen)), before, rtol=1e-4, atol=1e-4)
    assert critic.scale.std.item() > 7.0
    returns = torch.randn(9)
    torch.testing.assert_close(critic.scale.returns(critic.scale.normalised(returns)), returns, rtol=1e-4, atol=1e-4)


def test_without_normalisation_the_critic_learns_returns_themselves():
    actor, critic, optimisers, generator = learners()
    settings = PPO.model_copy(update={"value_normalisation": False})
    rollout = rollout_that_pays_for_going_east(actor, generator)
    update(actor, critic, optimisers, rollout, settings, generator)
    assert (critic.scale.mean.item(), critic.scale.std.item()) == (0.0, 1.0)


def test_schedules_follow_the_run():
    actor, critic, optimisers, generator = learners()
    rollout = rollout_that_pays_for_going_east(actor, generator)
    settings = PpoSettings(
        minibatch=128, actor_lr={"start": 1e-3, "end": 1e-4}, critic_lr={"start": 1e-3, "end": 1e-5, "shape": "cosine"},
        entropy_weight={"start": 0.02, "end": 0.0, "until": 0.5}, action_std={"start": 0.4, "end": 0.1},
    )  # fmt: skip
    numbers = update(actor, critic, optimisers, rollout, settings, generator, progress=0.5)
    assert numbers["actor_lr"] == pytest.approx(5.5e-4)
    assert numbers["critic_lr"] == pytest.approx(5.05e-4)
    assert numbers["entropy_weight"] == 0.0
    assert numbers["action_std_0"] == numbers["action_std_1"] == pytest.approx(0.25)
    assert actor.spread().exp().tolist() == pytest.approx([0.25, 0.25])
    assert {"actor_gradient", "critic_gradient", "explained_variance", "action_abs", "entropy"} <= numbers.keys()


def test_a_clipped_value_loss_moves_values_less():
    moved = []
    for clip in (None, 0.01):
        actor, critic, optimisers, generator = learners()
        rollout = rollout_that_pays_for_going_east(actor, generator)
        settings = PPO.model_copy(update={"value_clip": clip, "epochs": 4})
        before = critic.scale.returns(critic(rollout.last)).detach()
        update(actor, critic, optimisers, rollout, settings, generator, policy_moves=False)
        moved.append((critic.scale.returns(critic(rollout.last)).detach() - before).abs().mean().item())
    assert moved[1] < 0.7 * moved[0]


def test_bfloat16_computes_about_the_same_and_leaves_weights_and_flight_in_float32():
    actor, critic, _, generator = learners()
    torch.nn.init.normal_(actor.mean.weight)
    seen = {key: torch.rand((6, *shape), generator=generator) for key, shape in SPEC.shapes.items()}
    seen["level"] = torch.rand((6, 5, 32, 32), generator=generator)
    exact, exact_values = actor.decide(seen).mean, critic(seen)
    with at_precision("bfloat16", actor, critic):
        rough, values = actor.decide(seen).mean, critic(seen)
    assert rough.dtype == values.dtype == torch.float32
    assert not torch.equal(rough, exact)
    torch.testing.assert_close(rough, exact, atol=0.05, rtol=0)
    torch.testing.assert_close(values, exact_values, atol=0.05, rtol=0.05)
    assert torch.equal(actor.decide(seen).mean, exact)
    assert {weight.dtype for weight in actor.parameters()} == {torch.float32}


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_on_cuda_rollouts_and_updates_stay_there():
    assert compute_dtype("auto", torch.device("cuda")) == torch.bfloat16
    env = Exploration(ExplorationSettings(levels=("0",), worlds=2, drones=2, observation=SPEC), seed=1)
    actor, critic, _, generator = learners()
    actor, critic = actor.to("cuda"), critic.to("cuda")
    rollout, _ = collect(env, env.reset(), actor, 8, generator, "auto")
    assert {rollout.observations["views"].device.type, rollout.rewards.device.type} == {"cuda"}
    numbers = update(actor, critic, Optimisers(actor, critic), rollout, PPO, generator)
    assert np.isfinite(list(numbers.values())).all()


def test_imitation_comes_close_to_the_planner():
    env = Exploration(ExplorationSettings(levels=("1",), worlds=4, drones=2, observation=SPEC), seed=3)
    actor, _, _, generator = learners()
    buffer = LabelBuffer(2000)
    settings = ImitationSettings(gradient_steps=60, minibatch=128, lr=2e-3)
    rng = np.random.default_rng(0)
    seen, teacher = env.reset(), baseline("frontier", 0)
    teacher.begin(env)
    _, _, added = collect_labels(env, seen, actor, teacher, buffer, 60, 0.5, rng, generator)
    assert added == len(buffer) > 300
    batch = buffer.sample(256, generator)
    before = imitation_loss(batch.decide(actor).mean, batch["labels"], 0.25).item()
    optimiser = torch.optim.Adam(actor.parameters(), lr=settings.lr)
    learn(actor, optimiser, buffer, settings, generator)
    after = imitation_loss(batch.decide(actor).mean, batch["labels"], 0.25).item()
    assert after < 0.3 * before


def test_between_two_labels_what_the_planner_flies_keeps_its_way():
    class Clock:
        """Says (step / 100, 0) to everyone, and remembers when it was asked."""

        name, asked, step = "clock", [], 0

        def begin(self, env):
            pass

        def forget(self, worlds):
            self.step += 1

        def act(self, env, observation, worlds=None):
            self.asked.append(self.step)
            return np.full((env.worlds, env.drones, 2), [self.step / 100, 0.0], np.float32)

    env = Exploration(ExplorationSettings(levels=("4",), worlds=2, drones=2, observation=SPEC), 0)
    flown, step = [], env.step
    env.step = lambda actions: (flown.append(actions.copy()), step(actions))[1]
    teacher, buffer, actor = Clock(), LabelBuffer(1000), Actor(SMALL, SPEC, 2)
    rng, generator = np.random.default_rng(0), torch.Generator().manual_seed(0)
    _, _, added = collect_labels(
        env, env.reset(), actor, teacher, buffer, 10, 1.0, rng, generator, label_every=4
    )  # fmt: skip
    assert teacher.asked == [0, 4, 8]
    assert added == len(buffer) == 3 * 4
    assert [round(100 * float(actions[0, 0, 0])) for actions in flown] == [0, 0, 0, 0, 4, 4, 4, 4, 8, 8]


def test_a_label_is_not_held_into_the_next_episode():
    class East:
        name = "east"

        def forget(self, worlds):
            pass

        def act(self, env, observation, worlds=None):
            return np.full((env.worlds, env.drones, 2), [1.0, 0.0], np.float32)

    env = Exploration(ExplorationSettings(levels=("4",), worlds=1, drones=1, episode_ticks=3, observation=SPEC), 0)
    flown, step = [], env.step
    env.step = lambda actions: (flown.append(actions[0, 0].copy()), step(actions))[1]
    rng, generator = np.random.default_rng(0), torch.Generator().manual_seed(0)
    actor = Actor(SMALL, SPEC, 2)
    collect_labels(
        env, env.reset(), actor, East(), LabelBuffer(9), 6, 1.0, rng, generator, student_draws=False, label_every=6
    )  # fmt: skip
    assert [bool((action == [1.0, 0.0]).all()) for action in flown] == [True, True, True, False, False, False]


def test_the_buffer_keeps_the_newest_labels():
    buffer = LabelBuffer(10)
    for first in range(0, 24, 4):
        numbers = torch.arange(first, first + 4.0)[:, None]
        buffer.add({"motion": numbers.repeat(1, 3)}, numbers.repeat(1, 2))
    assert len(buffer) == 10
    batch = buffer.sample(500, torch.Generator().manual_seed(0))
    assert set(batch["labels"][:, 0].tolist()) == set(range(14, 24))
    assert torch.equal(batch["motion"][:, 0], batch["labels"][:, 0])


def test_a_planner_without_advice_teaches_nothing():
    """As at a launch from which all is seen: nothing is kept, and nothing learned until there is a label."""
    actor, _, _, generator = learners()
    buffer = LabelBuffer(10)
    buffer.add({key: torch.zeros((0, *shape)) for key, shape in SPEC.shapes.items()}, torch.zeros((0, 2)))
    before = actor.mean.weight.detach().clone()
    assert math.isnan(learn(actor, torch.optim.Adam(actor.parameters()), buffer, ImitationSettings(), generator))
    assert torch.equal(actor.mean.weight, before)
    buffer.add({key: torch.ones((3, *shape)) for key, shape in SPEC.shapes.items()}, torch.ones((3, 2)))
    assert len(buffer) == 3


def test_imitation_that_diverges_names_what_can_be_done_without_a_checkpoint():
    """There is none before imitation has ended, and none is promised."""
    actor, _, _, generator = learners()
    buffer = LabelBuffer(10)
    buffer.add({key: torch.ones((3, *shape)) for key, shape in SPEC.shapes.items()}, torch.full((3, 2), torch.inf))
    before = actor.mean.weight.detach().clone()
    with pytest.raises(WorkError, match=r"begin anew, .*no checkpoint before its end: .*--resume RUN --set") as told:
        learn(actor, torch.optim.Adam(actor.parameters()), buffer, ImitationSettings(), generator)
    assert "last checkpoint" not in str(told.value)
    assert torch.equal(actor.mean.weight, before)


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
