"""Generalised advantage estimation (Schulman et al. 2016, eq. 16): how much better an action was than expected."""

from __future__ import annotations

import torch
from torch import Tensor


def advantages_and_returns(
    rewards: Tensor,
    values: Tensor,
    dones: Tensor,
    last_values: Tensor,
    gamma: float,
    lam: float,
    truncated: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Return (advantages, returns), both `[steps, agents]`, of a rollout.

    `rewards`, `values`, `dones` `[steps, agents]`; `dones[t]` tells that the episode ended with step t, so nothing
    after it counts. A drone that dies is done then; its steps until the world's end, which follow that `done` and end
    with another, reach no other step and are to be left out. `last_values` `[agents]` are the values of the state
    after the last step.

    `truncated` `[steps, agents]` tells which episodes the time limit cut off: a drone cannot see the clock, so what it
    would still have earned counts (Pardo et al. 2018); after all other ends nothing does. The state after such a step
    was never looked at; it is valued as the state before it, a decision away.
    """
    advantages = torch.empty_like(rewards)
    following = torch.zeros_like(last_values)
    next_values = last_values
    goes_on = 1.0 - dones.to(rewards.dtype)
    cut = torch.zeros_like(rewards) if truncated is None else (truncated & dones).to(rewards.dtype)
    for t in range(rewards.shape[0] - 1, -1, -1):
        ahead = goes_on[t] * next_values + cut[t] * values[t]
        following = rewards[t] + gamma * ahead - values[t] + gamma * lam * goes_on[t] * following
        advantages[t] = following
        next_values = values[t]
    return advantages, advantages + values
