"""What a central executive knows of a team: each drone's own features beside those of its teammates, of any number."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from imagine.train.networks.encoders import orthogonal


class TeamPooling(nn.Module):
    """A drone's features with the mean and the maximum of its living teammates' (after Zaheer et al. 2017)."""

    def __init__(self, hidden: int) -> None:
        super().__init__()
        self.trunk = nn.Sequential(orthogonal(nn.Linear(3 * hidden, hidden)), nn.ReLU())

    def forward(self, features: Tensor, alive: Tensor | None, drones: int) -> Tensor:
        """Return features `[rows, hidden]` of rows that are whole teams of `drones` in order.

        `alive` bool `[rows]` tells who counts as a teammate (None: everyone); features are zero or above.
        """
        team = features.reshape(-1, drones, features.shape[1])
        numbers = torch.arange(team.shape[1], device=features.device)
        mates = (numbers[:, None] != numbers).expand(team.shape[0], -1, -1)  # [teams, drone, mate]
        if alive is not None:
            mates = mates & alive.reshape(-1, 1, drones)
        weights = mates.to(features.dtype)
        mean = torch.bmm(weights, team) / weights.sum(dim=2, keepdim=True).clamp(min=1.0)
        largest = (team.unsqueeze(1) * weights.unsqueeze(3)).amax(dim=2)  # 0 where there is nobody: ReLU's least
        pooled: Tensor = self.trunk(torch.cat([team, mean.to(team.dtype), largest], dim=2).flatten(0, 1))
        return pooled
