"""What the critic expects of every state of a rollout."""

from __future__ import annotations

import torch
from torch import Tensor

from imagine.train.batches import Cut
from imagine.train.networks import Actor, Critic
from imagine.train.rollout import Rollout


@torch.no_grad()
def values_of(actor: Actor, critic: Critic, rollout: Rollout, rows: int) -> tuple[Tensor, Tensor]:
    """Return the values of all steps, `[steps, agents]`, and of the state after the last, `[agents]`.

    They are expected returns, not normalised; `rows` are looked at at a time. States of the dead are worth 0 or
    whatever is said of them: nothing is to be made of them.
    """
    drones = rollout.drones if actor.is_central else 1
    samples = {key: value.flatten(0, 1) for key, value in rollout.observations.items()}
    if critic.is_shared or actor.is_central:
        flat = torch.zeros(rollout.rewards.numel(), device=rollout.rewards.device)
        cut = Cut(samples, rollout.alive, drones, rollout.sequence_steps, rollout.states, rollout.starts)
        for at, batch in cut.in_order(rows):
            features = batch.decide(actor).features if critic.is_shared else None
            flat[at] = critic(batch.samples, batch.drones, features)
    else:  # every row for itself: no need to gather them
        count = rollout.rewards.numel()
        pieces = [critic({k: v[i : i + rows] for k, v in samples.items()}) for i in range(0, count, rows)]
        flat = torch.cat(pieces)
    last_features = None
    if critic.is_shared:
        recall = rollout.recall
        state, starts = (None, None) if recall is None else (recall.state, recall.starts[None])
        last_features = actor.decide(rollout.last, state, starts, drones).features
    last = critic(rollout.last, drones, last_features)
    return critic.scale.returns(flat).view(rollout.rewards.shape), critic.scale.returns(last)
