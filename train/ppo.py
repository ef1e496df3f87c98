"""Proximal policy optimisation (Schulman et al. 2017): the whole update, on one page.

Actor and critic are separate networks with separate optimisers, so their losses are never summed.
"""

from __future__ import annotations

import torch
from pydantic import Field
from torch import Tensor, nn

from imagine.core.config import Settings
from imagine.core.errors import WorkError
from imagine.train.gae import advantages_and_returns
from imagine.train.networks import Actor, Critic, entropy, log_probability
from imagine.train.rollout import OBSERVATION_KEYS, Rollout, actor_inputs, mean_of, values_of


class PpoSettings(Settings):
    """Every hyperparameter of PPO."""

    agent_steps: int = Field(default=2_500_000, ge=0, description="decisions of all drones; where training ends")
    rollout_steps: int = Field(default=64, ge=2, description="steps of every world between two updates")
    epochs: int = Field(default=2, ge=1, description="passes over a rollout; more drift from the policy that flew it")
    minibatch: int = Field(default=1152, ge=2, description="samples a gradient step; a quarter of 24 x 64 x 3")
    actor_lr: float = Field(default=1e-4, gt=0.0, description="Adam's step; small, since imitation did the big ones")
    critic_lr: float = Field(default=5e-4, gt=0.0, description="Adam's step; larger, for values must follow the policy")
    clip: float = Field(default=0.15, gt=0.0, lt=1.0, description="how far a probability ratio may move with gain")
    gamma: float = Field(default=0.99, ge=0.0, le=1.0, description="discount a step: sees about 10 s ahead at 10 Hz")
    gae_lambda: float = Field(default=0.95, ge=0.0, le=1.0, description="0 trusts the critic, 1 only the rewards")
    critic_warmup_updates: int = Field(default=30, ge=0, description="updates before the policy moves: values first")
    gradient_norm: float = Field(default=0.5, gt=0.0, description="longer gradients are shortened to this, per network")
    entropy_weight: float = Field(default=0.0, ge=0.0, description="0: noise that imitation needs not must not grow")
    kl_stop: float | None = Field(default=0.03, gt=0.0, description="divergence that ends a rollout's policy steps")


class Optimisers:
    """Adam for each network."""

    def __init__(self, actor: Actor, critic: Critic, actor_lr: float, critic_lr: float) -> None:
        self.actor = torch.optim.Adam(actor.parameters(), lr=actor_lr, eps=1e-5)
        self.critic = torch.optim.Adam(critic.parameters(), lr=critic_lr, eps=1e-5)


def update(
    actor: Actor,
    critic: Critic,
    optimisers: Optimisers,
    rollout: Rollout,
    settings: PpoSettings,
    generator: torch.Generator,
    policy_moves: bool = True,
) -> dict[str, float]:
    """Improve both networks by one rollout; return means of the losses, the KL divergence and the clipped share.

    With `policy_moves` False only the critic learns. Raises WorkError when a loss or gradient is not finite, before
    it reaches the weights.
    """
    for optimiser, lr in ((optimisers.actor, settings.actor_lr), (optimisers.critic, settings.critic_lr)):
        for group in optimiser.param_groups:
            group["lr"] = lr
    values, last_values = values_of(critic, rollout, settings.minibatch)
    advantages, returns = advantages_and_returns(
        rollout.rewards, values, rollout.dones, last_values, settings.gamma, settings.gae_lambda
    )
    lived = rollout.alive.flatten().nonzero().squeeze(1)  # nothing is learned from the steps of the dead
    if len(lived) < 2:
        raise WorkError("training needs living drones: all were dead through a whole rollout")
    errors, targets = (returns - values).flatten()[lived], returns.flatten()[lived]
    explained = 1.0 - float(errors.var() / (targets.var() + 1e-8))
    counted = advantages.flatten()[lived]
    advantages = (advantages - counted.mean()) / (counted.std() + 1e-8)
    flat = {key: value.flatten(0, 1) for key, value in rollout.observations.items()}
    flat_actions, flat_log_probs = rollout.actions.flatten(0, 1), rollout.log_probs.flatten()
    flat_advantages, flat_returns = advantages.flatten(), returns.flatten()

    actor_records: list[dict[str, float]] = []
    critic_losses: list[dict[str, float]] = []
    for _ in range(settings.epochs):
        order = lived[torch.randperm(len(lived), generator=generator)]
        for batch in torch.split(order, settings.minibatch):
            sample = {key: value[batch] for key, value in flat.items()}

            value = critic(*(sample[key] for key in (*OBSERVATION_KEYS, "level")))
            value_loss = 0.5 * (value - flat_returns[batch]).square().mean()
            _descend(value_loss, critic, optimisers.critic, settings.gradient_norm, "value")
            critic_losses.append({"value_loss": value_loss.item()})

            if not policy_moves:
                continue
            mean, log_std = actor(*actor_inputs(sample)), actor.spread()
            log_ratio = log_probability(flat_actions[batch], mean, log_std) - flat_log_probs[batch]
            ratio = log_ratio.exp()
            with torch.no_grad():  # the low-variance estimator of http://joschu.net/blog/kl-approx.html
                kl = (ratio - 1.0 - log_ratio).mean().item()
            if settings.kl_stop is not None and kl > settings.kl_stop:
                policy_moves = False
                continue
            clipped = ratio.clamp(1.0 - settings.clip, 1.0 + settings.clip)
            gain = torch.min(ratio * flat_advantages[batch], clipped * flat_advantages[batch]).mean()
            policy_loss = -gain - settings.entropy_weight * entropy(log_std)
            _descend(policy_loss, actor, optimisers.actor, settings.gradient_norm, "policy")
            share = (ratio != clipped).float().mean().item()
            actor_records.append({"policy_loss": policy_loss.item(), "kl": kl, "clipped_share": share})
    return {
        **mean_of(critic_losses),
        **mean_of(actor_records),
        "explained_variance": explained,
        "action_std": actor.log_std.detach().exp().mean().item(),
        "reward": rollout.rewards.flatten()[lived].mean().item(),
    }


def _descend(loss: Tensor, network: nn.Module, optimiser: torch.optim.Optimizer, norm: float, name: str) -> None:
    """Take one gradient step, unless the loss or its gradient is not finite."""
    optimiser.zero_grad(set_to_none=True)
    loss.backward()  # type: ignore[no-untyped-call]
    length = nn.utils.clip_grad_norm_(network.parameters(), norm)
    if not (torch.isfinite(loss) and torch.isfinite(length)):
        raise WorkError(f"training diverged: the {name} loss is {loss.item()}, its gradient {length.item()} long")
    optimiser.step()
