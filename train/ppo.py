"""Proximal policy optimisation (Schulman et al. 2017): the whole update, on one page.

Actor and critic have optimisers of their own and learn side by side, each on half of the threads. Only where they share
an encoder are their losses summed.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor, nn

from imagine.core.errors import WorkError
from imagine.train.batches import Batch, Cut
from imagine.train.gae import advantages_and_returns
from imagine.train.networks import LOG_STD_RANGE, Actor, Critic, Decisions, at_precision
from imagine.train.networks.choice import has_choice
from imagine.train.ppo_settings import PpoSettings
from imagine.train.rollout import Rollout, mean_of
from imagine.train.side_by_side import side_by_side
from imagine.train.values import values_of

__all__ = ["Optimisers", "PpoSettings", "update"]

Record = dict[str, float]


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
) -> Record:
    """Improve both networks by one rollout; return means of the losses, gradient norms, divergence and so on.

    With `policy_moves` False only the critic learns. `progress`, 0 to 1, is the share of the run that is done, which
    schedules go by; `number` names the update in errors. Raises WorkError when a loss or gradient is not finite, before
    it reaches the weights.
    """
    with at_precision(settings.precision, actor, critic):
        return _Update(actor, critic, optimisers, settings, progress, number).run(rollout, generator, policy_moves)


class _Update:
    """One update in progress."""

    def __init__(
        self,
        actor: Actor,
        critic: Critic,
        optimisers: Optimisers,
        settings: PpoSettings,
        progress: float,
        number: int | None,
    ) -> None:
        self.actor, self.critic, self.optimisers, self.settings = actor, critic, optimisers, settings
        self.progress, self.number = progress, number
        for optimiser, lr in ((optimisers.actor, settings.actor_lr), (optimisers.critic, settings.critic_lr)):
            for group in optimiser.param_groups:
                group["lr"] = lr.at(progress)
        self.entropy_weight = settings.entropy_weight.at(progress)
        actor.log_std.requires_grad_(settings.action_std is None)

    def run(self, rollout: Rollout, generator: torch.Generator, policy_moves: bool) -> Record:
        """Go over the rollout in minibatches, `epochs` times."""
        settings = self.settings
        if int(rollout.alive.sum()) < 2:
            raise WorkError("training needs living drones: all were dead through a whole rollout")
        judged, numbers = self._judge(rollout)
        samples = {key: value.flatten(0, 1) for key, value in rollout.observations.items()}
        samples |= {"actions": rollout.actions.flatten(0, 1), "log_probs": rollout.log_probs.flatten(), **judged}
        drones = rollout.drones if self.actor.is_central else 1
        cut = Cut(samples, rollout.alive, drones, rollout.sequence_steps, rollout.states, rollout.starts)
        pieces = [units for _ in range(settings.epochs) for units in cut.shuffled(settings.minibatch, generator)]
        if self.critic.is_shared:
            records = self._learn_together(cut, pieces, policy_moves)
        elif policy_moves:
            of_actor, of_critic = side_by_side(
                lambda: self._teach_actor(cut, pieces), lambda: self._teach_critic(cut, pieces)
            )
            records = of_actor + of_critic
        else:
            records = self._teach_critic(cut, pieces)
        if settings.action_std is not None:  # of the next rollout: within this one all ratios are of one spread
            with torch.no_grad():
                self.actor.log_std.fill_(math.log(settings.action_std.at(self.progress))).clamp_(*LOG_STD_RANGE)
        return {
            **mean_of(records),
            **numbers,
            **self._spread_numbers(),
            "policy_steps": float(sum("policy_loss" in record for record in records)),
        }

    def _judge(self, rollout: Rollout) -> tuple[dict[str, Tensor], Record]:
        """Return advantages, value targets and values, flat and normalised, of all samples; and what they are like."""
        settings, critic = self.settings, self.critic
        alive = rollout.alive.flatten()
        lived = alive.nonzero().squeeze(1)  # nothing is learned from the steps of the dead
        values, last_values = values_of(self.actor, critic, rollout, settings.minibatch)
        advantages, returns = advantages_and_returns(
            rollout.rewards, values, rollout.dones, last_values, settings.gamma, settings.gae_lambda, rollout.truncated
        )
        advantages, returns, values = advantages.flatten(), returns.flatten(), values.flatten()
        counted, targets = advantages[lived], returns[lived]
        if not bool(torch.isfinite(targets).all()):
            bad = "the critic's values" if bool(torch.isfinite(rollout.rewards).all()) else "the rewards"
            raise WorkError(f"{self._where()}: {bad} are not finite; {_REMEDY.format(key='ppo.critic_lr')}")
        if settings.value_normalisation:
            critic.rescale(targets)
        if self.actor.choice is not None:  # of those choices alone that the policy learns from
            decided = advantages[alive & has_choice(rollout.observations["frontiers"].flatten(0, 1))]
            counted = decided if len(decided) > 1 else counted
        judged = {
            "advantages": (advantages - counted.mean()) / (counted.std() + 1e-8),
            "targets": critic.scale.normalised(returns),
            "values": critic.scale.normalised(values),
        }
        # what is drawn by the head `choice` are numbers of frontiers, which have no size
        size = {} if self.actor.choice else {"action_abs": float(rollout.actions.flatten(0, 1)[lived].abs().mean())}
        return judged, {
            "explained_variance": 1.0 - float((targets - values[lived]).var() / (targets.var() + 1e-8)),
            "reward": float(rollout.rewards.flatten()[lived].mean()),
            "return": float(targets.mean()),
            "return_std": float(targets.std()),
            "value": float(values[lived].mean()),
            "advantage_std": float(counted.std()),
            **size,
        }

    def _teach_critic(self, cut: Cut, pieces: list[Tensor]) -> list[Record]:
        """Take a step with each piece."""
        records = []
        for units in pieces:
            batch = cut.batch(units)
            loss = self._value_loss(batch, batch.of_counted(self.critic(batch.samples, batch.drones)))
            norm = self._descend(loss, {"value": loss}, (self.critic,), "critic")
            records.append({"value_loss": loss.item(), "critic_gradient": norm})
        return records

    def _teach_actor(self, cut: Cut, pieces: list[Tensor]) -> list[Record]:
        """Take a step with each piece, until the policy has gone far enough."""
        records = []
        for units in pieces:
            batch = cut.batch(units)
            loss, record, is_near = self._policy_loss(batch, batch.decide(self.actor))
            records.append(record)
            if not is_near:
                break
            norm = self._descend(loss, {"policy": loss}, (self.actor,), "actor")
            record |= {"policy_loss": loss.item(), "actor_gradient": norm}
        return records

    def _learn_together(self, cut: Cut, pieces: list[Tensor], policy_moves: bool) -> list[Record]:
        """Improve both by the sum of their losses. While the policy rests, the encoder that they share does too."""
        records = []
        for units in pieces:
            batch = cut.batch(units)
            decisions = batch.decide(self.actor)
            policy_loss, record, is_near = self._policy_loss(batch, decisions)
            policy_moves = policy_moves and is_near
            features = decisions.features if policy_moves else decisions.features.detach()
            value_loss = self._value_loss(batch, batch.of_counted(self.critic(batch.samples, batch.drones, features)))
            record["value_loss"] = value_loss.item()
            if policy_moves:
                both = {"policy": policy_loss, "value": value_loss}
                total = policy_loss + self.settings.value_weight * value_loss
                norm = self._descend(total, both, (self.actor, self.critic), "actor")
                record |= {"policy_loss": policy_loss.item(), "actor_gradient": norm, "critic_gradient": norm}
            else:
                record["critic_gradient"] = self._descend(value_loss, {"value": value_loss}, (self.critic,), "critic")
            records.append(record)
        return records

    def _value_loss(self, batch: Batch, values: Tensor) -> Tensor:
        targets, clip = batch["targets"], self.settings.value_clip
        error = (values - targets).square()
        if clip is not None:
            before = batch["values"]
            error = torch.max(error, (before + (values - before).clamp(-clip, clip) - targets).square())
        return 0.5 * error.mean()

    def _policy_loss(self, batch: Batch, decisions: Decisions) -> tuple[Tensor, Record, bool]:
        """Return the loss, what the policy did since the rollout, and whether it is still near enough to go on."""
        settings, advantages = self.settings, batch["advantages"]
        scores = None if decisions.scores is None else batch.of_counted(decisions.scores)
        now = self.actor.log_probability(batch.of_counted(decisions.mean), scores, batch["actions"])
        log_ratio = now - batch["log_probs"]
        ratio = log_ratio.exp()
        mean = self._mean_of_decided(batch)
        with torch.no_grad():  # the low-variance estimator of http://joschu.net/blog/kl-approx.html
            kl = mean(ratio - 1.0 - log_ratio).item()
        clipped = ratio.clamp(1.0 - settings.clip, 1.0 + settings.clip)
        gain = mean(torch.min(ratio * advantages, clipped * advantages))
        uncertainty = self.actor.entropy(scores)
        uncertainty = uncertainty if scores is None else mean(uncertainty)
        record = {"kl": kl, "clipped_share": mean((ratio != clipped).float()).item(), "entropy": uncertainty.item()}
        far = settings.kl_stop is not None and kl > settings.kl_stop
        return -gain - self.entropy_weight * uncertainty, record, not far

    def _mean_of_decided(self, batch: Batch) -> Callable[[Tensor], Tensor]:
        """Return the mean over the rows `[rows]` in which there was something to decide; 0 where there is none."""
        if self.actor.choice is None:
            return torch.mean
        decided = has_choice(batch["frontiers"])
        count = decided.sum().clamp(min=1)
        return lambda rows: torch.where(decided, rows, 0.0).sum() / count

    def _descend(self, loss: Tensor, parts: dict[str, Tensor], networks: tuple[nn.Module, ...], of: str) -> float:
        """Take one gradient step and return the gradient's length, unless it or a loss is not finite."""
        optimisers = [self.optimisers.actor if n is self.actor else self.optimisers.critic for n in networks]
        for optimiser in optimisers:
            optimiser.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        weights = [weight for network in networks for weight in network.parameters()]
        length = float(nn.utils.clip_grad_norm_(weights, self.settings.gradient_norm))
        for name, part in parts.items():
            if not (math.isfinite(length) and math.isfinite(part.item())):
                raise WorkError(
                    f"{self._where()}: the {name} loss is {part.item()}, the gradient of the {of} {length} long; "
                    + _REMEDY.format(key=f"ppo.{of}_lr")
                )
        for optimiser in optimisers:
            optimiser.step()
        return length

    def _spread_numbers(self) -> Record:
        """Return how far actions are drawn from their means, where actions are drawn; and what was scheduled."""
        numbers = {}
        if self.actor.choice is None:
            std = self.actor.spread().detach().exp().cpu().tolist()
            numbers = {f"action_std_{i}": value for i, value in enumerate(std)} | {"action_std": sum(std) / len(std)}
        return {
            **numbers,
            "entropy_weight": self.entropy_weight,
            "actor_lr": self.optimisers.actor.param_groups[0]["lr"],
            "critic_lr": self.optimisers.critic.param_groups[0]["lr"],
        }

    def _where(self) -> str:
        return "training diverged" + ("" if self.number is None else f" in update {self.number}")


_REMEDY = "go on from the last checkpoint with a smaller step ({key}), or with ppo.precision float32"
