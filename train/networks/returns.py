"""Returns, normalised: what a critic learns, and how it stands for the same values while the scale changes."""

from __future__ import annotations

import torch
from torch import Tensor, nn

RETURN_MEMORY = 0.05  # weight of the newest rollout's returns: 20 rollouts are remembered
MIN_RETURN_STD = 1e-4  # where no reward was seen yet, noise must not be blown up to be the signal


class ReturnScale(nn.Module):
    """Running mean and deviation of returns, so that a critic learns numbers near 1 whatever rewards and horizon are.

    After van Hasselt et al. 2016 (PopArt). The statistics forget exponentially, a rollout at a time, and without bias
    toward where they began (Kingma and Ba 2015, section 3). They are saved with the critic's weights.
    """

    mean: Tensor
    std: Tensor
    moments: Tensor
    weight: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(()))
        self.register_buffer("std", torch.ones(()))
        self.register_buffer("moments", torch.zeros(2, dtype=torch.float64))
        self.register_buffer("weight", torch.zeros((), dtype=torch.float64))

    def normalised(self, returns: Tensor) -> Tensor:
        """Return returns as the critic learns them."""
        return (returns - self.mean) / self.std

    def returns(self, normalised: Tensor) -> Tensor:
        """Undo `normalised`."""
        return normalised * self.std + self.mean

    @torch.no_grad()
    def take(self, returns: Tensor, head: nn.Linear) -> None:
        """Take new returns into the statistics, and change the head so that what it stands for stays the same.

        Not so the first time: an untrained head stands for nothing that is worth to be kept.
        """
        is_first = bool(self.weight == 0.0)
        new = torch.stack([returns.double().mean(), returns.double().square().mean()])
        self.moments.lerp_(new, RETURN_MEMORY)
        self.weight.lerp_(torch.ones_like(self.weight), RETURN_MEMORY)
        mean, square = self.moments / self.weight
        std = (square - mean.square()).clamp(min=MIN_RETURN_STD**2).sqrt().float()
        mean = mean.float()
        if not is_first:
            head.weight.mul_(self.std / std)
            head.bias.mul_(self.std).add_(self.mean - mean).div_(std)
        self.mean.copy_(mean)
        self.std.copy_(std)
