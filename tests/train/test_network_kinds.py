"""Every paradigm, memory, LiDAR encoder and way of sharing one: all learn by the same calls."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch

from imagine.core.observation_spec import ObservationSpec
from imagine.sim.exploration import Exploration
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.train.baselines import baseline
from imagine.train.batches import Cut
from imagine.train.imitation import ImitationSettings, collect_labels, label_buffer, learn
from imagine.train.networks import Actor, Critic, NetworkSettings, at_precision, log_probability
from imagine.train.ppo import Optimisers, PpoSettings, update
from imagine.train.rollout import Recall, collect

SPEC = ObservationSpec(view_cells=16, lidar_sectors=16)
SMALL = {
    "view_channels": (4, 4, 4), "critic_channels": (4, 4), "lidar_channels": 2, "critic_lidar_channels": 2,
    "hidden": 16, "memory_size": 12, "stack_frames": 3,
}  # fmt: skip
IMITATION = ImitationSettings(gradient_steps=2, minibatch=16)
PPO = PpoSettings(minibatch=24, sequence_steps=4, actor_lr=1e-3, critic_lr=1e-3)
STEPS, AGENTS = 8, 4


def networks(seed=0, **kind):
    torch.manual_seed(seed)
    settings = NetworkSettings(**{**SMALL, **kind})
    actor, critic = Actor(settings, SPEC, 2), Critic(settings, SPEC)
    return actor, critic, Optimisers(actor, critic), torch.Generator().manual_seed(seed)


@pytest.fixture(scope="module")
def env():
    """Worlds whose episodes end within the rollouts of these tests."""
    settings = ExplorationSettings(levels=("1",), worlds=2, drones=2, episode_ticks=5, observation=SPEC, mirror=False)
    return Exploration(settings, seed=1)


@pytest.mark.parametrize(
    ("paradigm", "memory", "lidar", "encoder"),
    list(
        itertools.product(
            ("ctde", "dtde", "ctce"), ("none", "gru", "stack"), ("dense", "conv1", "conv2"), ("separate", "shared")
        )
    ),
)
def test_every_kind_learns_from_the_planner_and_from_rewards(env, paradigm, memory, lidar, encoder):
    views = "patch" if lidar == "conv1" else "strided"
    actor, critic, optimisers, generator = networks(
        paradigm=paradigm, memory=memory, lidar=lidar, encoder=encoder, views=views
    )
    recall = Recall.nothing(actor, AGENTS)
    buffer = label_buffer(actor, 1000)
    observation, teacher = env.reset(), baseline("frontier", 0)
    teacher.begin(env)
    observation, _, labels = collect_labels(
        env, observation, actor, teacher, buffer, STEPS, 0.5, np.random.default_rng(0), generator, recall=recall
    )
    assert labels > AGENTS
    untaught = weights_of(actor)
    loss = learn(actor, torch.optim.Adam(actor.parameters(), lr=1e-3), buffer, IMITATION, generator)
    assert np.isfinite(loss)
    assert changed(actor, untaught) > {"mean.weight", "encoder.trunk.0.weight", "encoder.lidar.linear.weight"}
    for number in range(2):
        before = weights_of(actor), weights_of(critic)
        rollout, observation = collect(env, observation, actor, STEPS, generator, recall=recall, sequence_steps=4)
        numbers = update(actor, critic, optimisers, rollout, PPO, generator, number=number)
        assert all(np.isfinite(list(numbers.values())))
        assert numbers["policy_steps"] > 0
        # everything learns, but for the layers of a memory that was still empty in a first step
        assert {"mean.weight", "log_std", "encoder.views.linear.weight"} <= changed(actor, before[0])
        assert "value.weight" in changed(critic, before[1])


def weights_of(network):
    return {name: weight.detach().clone() for name, weight in network.named_parameters()}


def changed(network, before):
    return {name for name, weight in network.named_parameters() if not torch.equal(weight, before[name])}


@pytest.mark.parametrize("paradigm", ["ctde", "ctce"])
@pytest.mark.parametrize("memory", ["none", "gru", "stack"])
@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_in_the_first_minibatch_the_policy_is_still_the_one_that_flew(env, paradigm, memory, precision):
    """Sequences are unrolled over ends of episodes, from chunks' first states: the ratio is 1 before the first step."""
    actor, critic, optimisers, generator = networks(paradigm=paradigm, memory=memory)
    torch.nn.init.normal_(actor.mean.weight)
    recall = Recall.nothing(actor, AGENTS)
    _, observation = collect(env, env.reset(), actor, 3, generator, precision, recall)  # remember something
    rollout, _ = collect(env, observation, actor, STEPS, generator, precision, recall, sequence_steps=4)
    assert rollout.dones[1:-1].any()
    samples = {key: value.flatten(0, 1) for key, value in rollout.observations.items()}
    samples |= {"actions": rollout.actions.flatten(0, 1), "log_probs": rollout.log_probs.flatten()}
    drones = 2 if paradigm == "ctce" else 1
    cut = Cut(samples, rollout.alive, drones, rollout.sequence_steps, rollout.states, rollout.starts)
    assert rollout.sequence_steps == (1 if memory == "none" else 4)
    with torch.no_grad(), at_precision(precision, actor):
        batch = cut.batch(cut.shuffled(10_000, generator)[0])
        log_probs = log_probability(batch["actions"], batch.of_counted(batch.decide(actor).mean), actor.spread())
    torch.testing.assert_close(log_probs, batch["log_probs"], rtol=0, atol=1e-4 if precision == "float32" else 0.1)
    settings = PPO.model_copy(update={"minibatch": 10_000, "epochs": 1, "precision": precision})
    numbers = update(actor, critic, optimisers, rollout, settings, generator)
    assert numbers["policy_steps"] == 1
    assert numbers["clipped_share"] == 0.0
    assert abs(numbers["kl"]) < (1e-6 if precision == "float32" else 1e-3)


def recall_task(generator, rows=32, steps=4):
    """A signal in the first step says where to go in the last; everything between looks alike."""
    signal = torch.where(torch.rand(rows, generator=generator) < 0.5, -1.0, 1.0)
    seen = {key: torch.zeros((steps, rows, *shape)) for key, shape in SPEC.shapes.items()}
    seen["views"][0] = signal[:, None, None, None]
    flat = {key: value.flatten(0, 1) for key, value in seen.items()}
    starts = torch.zeros((steps, rows), dtype=torch.bool)
    starts[0] = True
    return flat, starts, signal


@pytest.mark.parametrize(("memory", "remembers"), [("none", False), ("gru", True), ("stack", True)])
def test_only_a_memory_learns_to_recall(memory, remembers):
    actor, _, _, generator = networks(memory=memory, stack_frames=4, hidden=32)
    optimiser = torch.optim.Adam(actor.parameters(), lr=3e-3)
    for _ in range(60):
        seen, starts, signal = recall_task(generator)
        state = torch.rand((len(signal), actor.state_size), generator=generator)  # of before: it must not count
        last = actor.decide(seen, state, starts).mean[-len(signal) :, 0]
        loss = (last - 0.8 * signal).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    assert loss.item() < 0.1 if remembers else loss.item() > 0.5


@pytest.mark.parametrize("memory", ["gru", "stack"])
def test_a_sequence_is_its_steps_one_by_one(memory):
    actor, _, _, generator = networks(memory=memory)
    torch.nn.init.normal_(actor.mean.weight)
    steps, rows = 7, 3
    seen = {key: torch.rand((steps, rows, *shape), generator=generator) for key, shape in SPEC.shapes.items()}
    starts = torch.zeros((steps, rows), dtype=torch.bool)
    starts[0, 0] = starts[2, 1] = starts[5, 1] = starts[3, 2] = True
    before = torch.rand((rows, actor.state_size), generator=generator)
    with torch.no_grad():
        unrolled = actor.decide({key: value.flatten(0, 1) for key, value in seen.items()}, before, starts)
        state = before
        for t in range(steps):
            state = state * ~starts[t][:, None]
            mean, state = actor(*(seen[key][t] for key in SPEC.shapes), state)
            torch.testing.assert_close(unrolled.mean[t * rows : (t + 1) * rows], mean)
    torch.testing.assert_close(unrolled.state, state)
    assert unrolled.state.shape == (rows, actor.state_size)


def team_inputs(generator, rows):
    seen = {key: torch.rand((rows, *shape), generator=generator) for key, shape in SPEC.shapes.items()}
    return {**seen, "level": torch.rand((rows, 5, 32, 32), generator=generator)}


def test_a_central_executive_decides_by_what_the_living_see_and_no_one_else():
    actor, _, _, generator = networks(paradigm="ctce")
    torch.nn.init.normal_(actor.mean.weight)
    seen, alive = team_inputs(generator, 6), torch.tensor([True, True, False] * 2)

    def means(**changes):
        with torch.no_grad():
            return actor.decide({**seen, "alive": alive, **changes}, drones=3).mean

    def other(row):
        lidar = seen["lidar"].clone()
        lidar[row] += 1.0
        return lidar

    usual = means()
    of_mate, of_dead, of_stranger = means(lidar=other(1)), means(lidar=other(2)), means(lidar=other(4))
    assert not torch.equal(of_mate[0], usual[0])
    assert torch.equal(of_dead[:2], usual[:2])
    torch.testing.assert_close(of_stranger[:3], usual[:3])
    swapped = torch.tensor([1, 0, 2, 3, 4, 5])
    turned = actor.decide({**{key: value[swapped] for key, value in seen.items()}, "alive": alive}, drones=3).mean
    torch.testing.assert_close(turned[swapped], usual)  # who is called first makes no difference


def test_the_paradigms_differ_in_what_the_networks_see():
    generator = torch.Generator().manual_seed(0)
    seen = team_inputs(generator, 4)
    others = {**seen, "level": torch.rand((4, 5, 32, 32), generator=generator)}
    told = {}
    for paradigm in ("dtde", "ctde", "ctce"):
        actor, critic, _, _ = networks(paradigm=paradigm)
        told[paradigm] = tuple(
            not torch.equal(*(output(part) for part in (seen, others)))
            for output in (
                lambda part, actor=actor: actor.decide(part, drones=2).mean,
                lambda part, critic=critic: critic(part, 2),
            )
        )
    assert told == {"dtde": (False, False), "ctde": (False, True), "ctce": (True, True)}


def test_while_the_policy_rests_a_shared_encoder_does_too(env):
    actor, critic, optimisers, generator = networks(encoder="shared")
    rollout, _ = collect(env, env.reset(), actor, STEPS, generator)
    before = weights_of(actor), weights_of(critic)
    numbers = update(actor, critic, optimisers, rollout, PPO, generator, policy_moves=False)
    assert changed(actor, before[0]) == set()
    assert "value.weight" in changed(critic, before[1])
    assert numbers["policy_steps"] == 0
    update(actor, critic, optimisers, rollout, PPO, generator)
    assert "encoder.views.linear.weight" in changed(actor, before[0])


def test_a_batch_holds_whole_teams_and_whole_sequences_of_the_living(env):
    steps, agents = 6, 4
    numbers = torch.arange(steps * agents)
    alive = torch.ones((steps, agents), dtype=torch.bool)
    alive[:, 2:] = False
    alive[4, 3] = True
    states = torch.arange(2 * agents).view(2, agents, 1).float()
    cut = Cut({"row": numbers}, alive, drones=2, length=3, states=states, starts=~alive)
    assert len(cut) == 3  # the second team flew in the second half alone
    batch = cut.batch(torch.tensor([2, 12]))
    assert batch.samples["row"].tolist() == [2, 3, 12, 13, 6, 7, 16, 17, 10, 11, 20, 21]
    assert batch["row"].tolist() == [12, 13, 16, 17, 20, 21]
    assert batch.state.flatten().tolist() == [2, 3, 4, 5]
    assert batch.starts.tolist() == [[True, True, False, False]] * 3
    pieces = cut.shuffled(8, torch.Generator().manual_seed(0))
    seen = [row for units in pieces for row in cut.batch(units)["row"].tolist()]
    assert sorted(seen) == sorted([0, 1, 4, 5, 8, 9, 12, 13, 16, 17, 20, 21, 19])


def test_what_is_remembered_can_be_saved(env):
    actor, _, _, generator = networks(memory="gru")
    recall = Recall.nothing(actor, AGENTS)
    rollout, _ = collect(env, env.reset(), actor, 7, generator, recall=recall)
    assert recall.state.abs().max() > 0.0
    again = Recall.restored(recall.state_dict(), actor)
    assert torch.equal(again.state, rollout.recall.state)
    assert torch.equal(again.starts, rollout.recall.starts)
