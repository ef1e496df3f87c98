"""Generalised advantage estimation (Schulman et al. 2016, eq. 16): how much better an action was than expected."""

from __future__ import annotations

import torch
from torch import Tensor


def advantages_and_returns(
    rewards: Tensor, values: Tensor, dones: Tensor, last_values: Tensor, gamma: float, lam: float
) -> tuple[Tensor, Tensor]:
    """Return (advantages, returns), both `[steps, agents]`, of a rollout.

    `rewards`, `values`, `dones` `[steps, agents]`; `dones[t]` tells that the episode ended with step t, so nothing
    after it counts. A drone that dies is done then; its steps until the world's end, which follow that `done` and end
    with another, reach no other step and are to be left out. `last_values` `[agents]` are the values of the state
    after the last step.
    """
    advantages = torch.empty_like(rewards)
    following = torch.zeros_like(last_values)
    next_values = last_values
    for t in range(rewards.shape[0] - 1, -1, -1):
        goes_on = 1.0 - dones[t].to(rewards.dtype)
        surprise = rewards[t] + gamma * next_values * goes_on - values[t]
        following = surprise + gamma * lam * goes_on * following
        advantages[t] = following
        next_values = values[t]
    return advantages, advantages + values
