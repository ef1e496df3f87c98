"""A policy that chooses among frontiers learns from its choices alone: none is made where no frontier is shown."""

import math

import pytest
import torch

from imagine.core.observation_spec import ObservationSpec
from imagine.train.imitation import learn
from imagine.train.labels import LabelBuffer
from imagine.train.networks import Actor, Critic, NetworkSettings
from imagine.train.networks.choice import choice_entropy, choice_log_probability, draw_choice, has_choice
from imagine.train.ppo import Optimisers, PpoSettings, update
from imagine.train.rehearsal import RehearsalSettings
from imagine.train.rollout import Rollout

SPEC = ObservationSpec(view_cells=16, lidar_sectors=16, frontiers=4)
SMALL = NetworkSettings(
    head="choice", view_channels=(8, 8, 8), critic_channels=(8, 8), lidar_channels=4, hidden=32
)  # fmt: skip
STEPS, AGENTS = 8, 16


def learners():
    torch.manual_seed(0)
    actor, critic = Actor(SMALL, SPEC, 2), Critic(SMALL, SPEC)
    return actor, critic, Optimisers(actor, critic), torch.Generator().manual_seed(0)


def rollout_with_blind_rows(actor, blind, chosen=0.0, log_prob_off=0.0):
    """Return what is flown when the first frontier pays; the agents from `blind` on are shown none.

    `chosen` is what these are said to have chosen, `log_prob_off` how much more likely than they had it.
    """
    generator = torch.Generator().manual_seed(7)
    observations = {key: torch.rand((STEPS, AGENTS, *shape), generator=generator) for key, shape in SPEC.shapes.items()}
    observations["level"] = torch.rand((STEPS, AGENTS, 5, 32, 32), generator=generator)
    observations["frontiers"][..., 0] = 1.0
    observations["frontiers"][:, blind:] = 0.0
    seen = {key: value.flatten(0, 1) for key, value in observations.items()}
    with torch.no_grad():
        scores = actor.decide(seen).scores
        choice = draw_choice(scores, torch.rand(len(scores), generator=generator)).view(STEPS, AGENTS)
        choice[:, blind:] = int(chosen)
        log_probs = choice_log_probability(scores, choice.flatten()).view(STEPS, AGENTS)
    log_probs[:, blind:] += log_prob_off
    rewards = (choice == 0).float()
    return Rollout(
        observations, choice.unsqueeze(2).float(), log_probs, rewards, torch.ones((STEPS, AGENTS), dtype=torch.bool),
        {key: value[-1] for key, value in observations.items()}, torch.ones((STEPS, AGENTS), dtype=torch.bool),
    )  # fmt: skip


def test_where_none_is_shown_numbers_stay_finite_and_no_frontier_is_likelier():
    actor = learners()[0]
    rollout = rollout_with_blind_rows(actor, 8)
    seen = {key: value.flatten(0, 1) for key, value in rollout.observations.items()}
    scores = actor.decide(seen).scores
    blind = ~has_choice(seen["frontiers"])
    assert blind.view(STEPS, AGENTS)[:, 8:].all()
    assert blind.sum() == STEPS * 8
    every = torch.stack([choice_log_probability(scores, torch.full((len(scores),), k)) for k in range(4)])
    torch.testing.assert_close(every[:, blind], torch.full((4, int(blind.sum())), -math.log(4.0)))
    torch.testing.assert_close(choice_entropy(scores)[blind], torch.full((int(blind.sum()),), math.log(4.0)))
    (every.sum() + choice_entropy(scores).sum()).backward()
    assert all(weight.grad.isfinite().all() for weight in actor.choice.parameters())


def test_what_is_not_shown_is_never_drawn_and_leaves_entropy_and_gradients_as_they_are():
    actor = learners()[0]
    frontiers = torch.rand((64, 4, SPEC.shapes["frontiers"][1]), generator=torch.Generator().manual_seed(1))
    frontiers[..., 0] = torch.tensor([1.0, 1.0, 0.0, 0.0])
    features, velocity = torch.rand((64, actor.feature_size)), torch.rand((64, 2))
    all_scores = actor.choice(frontiers, features, velocity)
    shown = actor.choice(frontiers[:, :2], features, velocity)
    torch.testing.assert_close(choice_entropy(all_scores), choice_entropy(shown))
    assert set(draw_choice(all_scores, torch.linspace(0.0, 1.0 - 2**-24, 64)).tolist()) == {0, 1}
    weights = list(actor.choice.parameters())
    with_hidden = torch.autograd.grad(choice_entropy(all_scores).sum(), weights)
    without = torch.autograd.grad(choice_entropy(shown).sum(), weights)
    for one, other in zip(with_hidden, without, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("kl_stop", [None, 0.03])
def test_nothing_is_learned_from_rows_that_show_no_frontier(kl_stop):
    """Whatever is said to have been chosen there, and however likely: the policy and its numbers are the same."""
    settings = PpoSettings(minibatch=32, actor_lr=1e-3, precision="float32", kl_stop=kl_stop, epochs=1)
    learned = []
    for chosen, off in ((1, 0.0), (3, 2.0)):
        actor, critic, optimisers, generator = learners()
        rollout = rollout_with_blind_rows(actor, 8, chosen, off)
        numbers = update(actor, critic, optimisers, rollout, settings, generator)
        learned.append((actor.state_dict(), numbers))
    (weights, numbers), (other_weights, other_numbers) = learned
    assert all(torch.equal(value, other_weights[name]) for name, value in weights.items())
    for name in ("policy_loss", "kl", "clipped_share", "entropy", "actor_gradient", "policy_steps", "advantage_std"):
        assert numbers[name] == other_numbers[name], name
    assert not torch.equal(weights["choice.score.weight"], learners()[0].state_dict()["choice.score.weight"])


def test_entropy_is_that_of_choices():
    """Four frontiers that score about the same: log 4, however many rows show none, or fewer."""
    actor, critic, optimisers, generator = learners()
    rollout = rollout_with_blind_rows(actor, 8)
    rollout.observations["frontiers"][:, :8, 1:, 0] = 0.0  # one shown: nothing is uncertain
    numbers = update(actor, critic, optimisers, rollout, PpoSettings(minibatch=64, precision="float32"), generator)
    assert numbers["entropy"] == pytest.approx(0.0, abs=1e-6)


def test_a_rollout_that_shows_no_frontier_leaves_the_policy_as_it_is_and_teaches_the_critic():
    actor, critic, optimisers, generator = learners()
    rollout = rollout_with_blind_rows(actor, 0)
    before = {name: value.clone() for name, value in actor.state_dict().items()}
    value_before = critic.value.weight.detach().clone()
    numbers = update(actor, critic, optimisers, rollout, PpoSettings(minibatch=64, precision="float32"), generator)
    assert all(math.isfinite(number) for number in numbers.values())
    assert (numbers["kl"], numbers["entropy"], numbers["policy_loss"]) == (0.0, 0.0, 0.0)
    assert all(torch.equal(value, before[name]) for name, value in actor.state_dict().items())
    assert not torch.equal(critic.value.weight, value_before)


def test_a_policy_that_chooses_is_not_told_to_have_a_spread():
    actor, critic, optimisers, generator = learners()
    numbers = update(actor, critic, optimisers, rollout_with_blind_rows(actor, 8), PpoSettings(minibatch=64), generator)
    assert not [name for name in numbers if name.startswith(("action_std", "action_abs"))]
    assert "actor_lr" in numbers


def test_where_nothing_else_speaks_for_one_the_frontier_that_it_flies_to_already_is_kept():
    torch.manual_seed(0)
    actor = Actor(SMALL, SPEC, 2)
    actor.set_momentum(2.0)
    with torch.no_grad():
        actor.choice.score.weight.zero_()
    seen = {key: torch.zeros((3, *shape)) for key, shape in SPEC.shapes.items()}
    seen["frontiers"][:, :3, 0] = 1.0
    seen["frontiers"][:, :3, 1:3] = torch.tensor([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0]])
    seen["motion"][:, :2] = torch.tensor([[0.0, 1.0], [-0.5, 0.0], [0.0, 0.0]])
    scores = actor.decide(seen).scores
    assert scores.argmax(dim=1).tolist() == [1, 2, 0]
    torch.testing.assert_close(scores[1, 2] - scores[1, 0], torch.tensor(2.0))
    assert (scores[:, 3] < scores[:, :3].amin(dim=1)).all()


def test_of_what_the_reference_labelled_all_of_its_scores_are_learned():
    torch.manual_seed(3)
    reference = Actor(SMALL, SPEC, 2)
    with torch.no_grad():
        reference.choice.score.weight.mul_(8.0)
    seen = {key: torch.rand((400, *shape)) for key, shape in SPEC.shapes.items()}
    seen["frontiers"][..., 0] = 1.0
    seen["frontiers"][..., 1:3] = torch.nn.functional.normalize(torch.randn(400, 4, 2), dim=2)
    with torch.no_grad():
        wanted = reference.decide(seen)
    apart = {}
    for by_reference in (0.0, 1.0):
        torch.manual_seed(4)
        actor, generator = Actor(SMALL, SPEC, 2), torch.Generator().manual_seed(0)
        buffer = LabelBuffer(400)
        buffer.add({**seen, "by_reference": torch.full((400, 1), by_reference)}, wanted.mean)
        settings = RehearsalSettings(gradient_steps=150, minibatch=100, precision="float32")
        learn(actor, torch.optim.Adam(actor.parameters(), 3e-3), buffer, settings, generator, reference)
        with torch.no_grad():
            found = torch.log_softmax(actor.decide(seen).scores, dim=1)
        apart[by_reference] = float(
            torch.nn.functional.kl_div(found, torch.softmax(wanted.scores, dim=1), reduction="batchmean")
        )
    assert apart[1.0] < 0.5 * apart[0.0]
