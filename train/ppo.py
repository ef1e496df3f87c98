"""Proximal policy optimisation (Schulman et al. 2017): the whole update, on one page.

Actor and critic are separate networks with separate optimisers, so their losses are never summed.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from imagine.core.errors import WorkError
from imagine.train.gae import advantages_and_returns
from imagine.train.networks import LOG_STD_RANGE, Actor, Critic, entropy, log_probability
from imagine.train.ppo_settings import PpoSettings
from imagine.train.precision import at_precision
from imagine.train.rollout import Rollout, actor_inputs, critic_inputs, flattened, mean_of, take, values_of

__all__ = ["Optimisers", "PpoSettings", "update"]


class Optimisers:
    """Adam for each network; `update` sets the step sizes."""

    def __init__(self, actor: Actor, critic: Critic) -> None:
        self.actor = torch.optim.Adam(actor.parameters(), eps=1e-5, fused=True)
        self.critic = torch.optim.Adam(critic.parameters(), eps=1e-5, fused=True)


def update(
    actor: Actor,
    critic: Critic,
    optimisers: Optimisers,
    rollout: Rollout,
    settings: PpoSettings,
    generator: torch.Generator,
    policy_moves: bool = True,
    progress: float = 0.0,
    number: int | None = None,
) -> dict[str, float]:
    """Improve both networks by one rollout; return means of the losses, gradient norms, divergence and so on.

    With `policy_moves` False only the critic learns. `progress`, 0 to 1, is the share of the run that is done, which
    schedules go by; `number` names the update in errors. Raises WorkError when a loss or gradient is not finite, before
    it reaches the weights.
    """
    with at_precision(settings.precision, actor, critic):
        return _Update(actor, critic, optimisers, rollout, settings, progress, number).run(generator, policy_moves)


_REMEDY = "go on from the last checkpoint, with a smaller step ({key}) or precision: float32"


class _Update:
    """One update in progress: what the rollout says, and what the gradient steps report."""

    def __init__(
        self,
        actor: Actor,
        critic: Critic,
        optimisers: Optimisers,
        rollout: Rollout,
        settings: PpoSettings,
        progress: float,
        number: int | None,
    ) -> None:
        self.actor, self.critic, self.optimisers, self.settings = actor, critic, optimisers, settings
        self.rollout, self.progress, self.number = rollout, progress, number
        for optimiser, lr in ((optimisers.actor, settings.actor_lr), (optimisers.critic, settings.critic_lr)):
            for group in optimiser.param_groups:
                group["lr"] = lr.at(progress)
        self.entropy_weight = settings.entropy_weight.at(progress)
        actor.log_std.requires_grad_(settings.action_std is None)

    def run(self, generator: torch.Generator, policy_moves: bool) -> dict[str, float]:
        """Go over the rollout in minibatches, `epochs` times."""
        settings, rollout = self.settings, self.rollout
        lived = rollout.alive.flatten().nonzero().squeeze(1)  # nothing is learned from the steps of the dead
        if len(lived) < 2:
            raise WorkError("training needs living drones: all were dead through a whole rollout")
        numbers = self._judge(lived)
        samples = flattened(rollout)
        samples |= {"actions": rollout.actions.flatten(0, 1), "log_probs": rollout.log_probs.flatten()}
        samples |= {"advantages": self.advantages, "targets": self.targets, "values": self.values}
        critic_records: list[dict[str, float]] = []
        actor_records: list[dict[str, float]] = []
        for _ in range(settings.epochs):
            order = lived[torch.randperm(len(lived), generator=generator).to(lived.device)]
            for batch in torch.tensor_split(order, max(1, round(len(order) / settings.minibatch))):
                sample = take(samples, batch)
                critic_records.append(self._improve_critic(sample))
                if policy_moves:
                    record, policy_moves = self._improve_actor(sample)
                    actor_records.append(record)
        if settings.action_std is not None:  # of the next rollout: within this one all ratios are of one spread
            with torch.no_grad():
                self.actor.log_std.fill_(math.log(settings.action_std.at(self.progress))).clamp_(*LOG_STD_RANGE)
        std = self.actor.spread().detach().exp().tolist()
        return {
            **mean_of(critic_records),
            **mean_of(actor_records),
            **numbers,
            **{f"action_std_{i}": value for i, value in enumerate(std)},
            "action_std": sum(std) / len(std),
            "entropy": entropy(self.actor.spread()).item(),
            "entropy_weight": self.entropy_weight,
            "actor_lr": self.optimisers.actor.param_groups[0]["lr"],
            "critic_lr": self.optimisers.critic.param_groups[0]["lr"],
            "policy_steps": float(len(actor_records)),
        }

    def _judge(self, lived: Tensor) -> dict[str, float]:
        """Set advantages, value targets and values, flat and normalised, of all samples; return what they are like."""
        settings, rollout, critic = self.settings, self.rollout, self.critic
        values, last_values = values_of(critic, rollout, settings.minibatch)
        advantages, returns = advantages_and_returns(
            rollout.rewards, values, rollout.dones, last_values, settings.gamma, settings.gae_lambda, rollout.truncated
        )
        advantages, returns, values = advantages.flatten(), returns.flatten(), values.flatten()
        counted, targets = advantages[lived], returns[lived]
        if not bool(torch.isfinite(targets).all()):
            bad = "the rewards" if not bool(torch.isfinite(rollout.rewards).all()) else "the critic's values"
            raise WorkError(f"{self._where()}: {bad} are not finite; {_REMEDY.format(key='ppo.critic_lr')}")
        if settings.value_normalisation:
            critic.rescale(targets)
        self.advantages = (advantages - counted.mean()) / (counted.std() + 1e-8)
        self.targets, self.values = critic.scale.normalised(returns), critic.scale.normalised(values)
        return {
            "explained_variance": 1.0 - float((targets - values[lived]).var() / (targets.var() + 1e-8)),
            "reward": float(rollout.rewards.flatten()[lived].mean()),
            "return": float(targets.mean()),
            "return_std": float(targets.std()),
            "value": float(values[lived].mean()),
            "advantage_std": float(counted.std()),
            "action_abs": float(rollout.actions.flatten(0, 1)[lived].abs().mean()),
        }

    def _improve_critic(self, sample: dict[str, Tensor]) -> dict[str, float]:
        value, target = self.critic(*critic_inputs(sample)), sample["targets"]
        error = (value - target).square()
        if self.settings.value_clip is not None:
            near = sample["values"] + (value - sample["values"]).clamp(
                -self.settings.value_clip, self.settings.value_clip
            )
            error = torch.max(error, (near - target).square())
        loss = 0.5 * error.mean()
        norm = self._descend(loss, self.critic, self.optimisers.critic, "value", "critic")
        return {"value_loss": loss.item(), "critic_gradient": norm}

    def _improve_actor(self, sample: dict[str, Tensor]) -> tuple[dict[str, float], bool]:
        """Take a step of the policy, unless it has gone far enough; return the record, and whether it may go on."""
        settings, advantages = self.settings, sample["advantages"]
        mean, log_std = self.actor(*actor_inputs(sample)), self.actor.spread()
        log_ratio = log_probability(sample["actions"], mean, log_std) - sample["log_probs"]
        ratio = log_ratio.exp()
        with torch.no_grad():  # the low-variance estimator of http://joschu.net/blog/kl-approx.html
            kl = (ratio - 1.0 - log_ratio).mean().item()
        clipped = ratio.clamp(1.0 - settings.clip, 1.0 + settings.clip)
        record = {"kl": kl, "clipped_share": (ratio != clipped).float().mean().item()}
        if settings.kl_stop is not None and kl > settings.kl_stop:
            return record, False
        gain = torch.min(ratio * advantages, clipped * advantages).mean()
        loss = -gain - self.entropy_weight * entropy(log_std)
        norm = self._descend(loss, self.actor, self.optimisers.actor, "policy", "actor")
        return {**record, "policy_loss": loss.item(), "actor_gradient": norm}, True

    def _descend(self, loss: Tensor, network: nn.Module, optimiser: torch.optim.Optimizer, what: str, of: str) -> float:
        """Take one gradient step and return the gradient's length, unless it or the loss is not finite."""
        optimiser.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        length = float(nn.utils.clip_grad_norm_(network.parameters(), self.settings.gradient_norm))
        if not (math.isfinite(length) and math.isfinite(loss.item())):
            raise WorkError(
                f"{self._where()}: the {what} loss of the {of} is {loss.item()}, its gradient {length} long; "
                + _REMEDY.format(key=f"ppo.{of}_lr")
            )
        optimiser.step()
        return length

    def _where(self) -> str:
        return "training diverged" + ("" if self.number is None else f" in update {self.number}")
