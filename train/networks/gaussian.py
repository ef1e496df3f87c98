"""The distribution that actions are drawn from in training: independent Gaussians around the network's mean."""

from __future__ import annotations

import math

import torch
from torch import Tensor

LOG_STD_RANGE = (-3.0, 0.0)


def log_probability(actions: Tensor, mean: Tensor, log_std: Tensor) -> Tensor:
    """Return the log density of actions `[batch, size]` under independent Gaussians, `[batch]`."""
    scaled = (actions - mean) * torch.exp(-log_std)
    return -(0.5 * scaled.square() + log_std + 0.5 * math.log(2.0 * math.pi)).sum(dim=-1)


def entropy(log_std: Tensor) -> Tensor:
    """Return the entropy of independent Gaussians, summed over the components of the action."""
    return (log_std + 0.5 * math.log(2.0 * math.pi * math.e)).sum()
