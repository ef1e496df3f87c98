"""The value of a drone's state, which only training asks for: it may see what no drone can."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from imagine.core.contract import LEVEL
from imagine.core.observation_spec import ObservationSpec
from imagine.train.networks.actor import Seen
from imagine.train.networks.computing import Computing, autocast
from imagine.train.networks.encoders import Encoder, LevelEncoder, orthogonal
from imagine.train.networks.returns import ReturnScale
from imagine.train.networks.settings import NetworkSettings
from imagine.train.networks.team import TeamPooling


class Critic(Computing):
    """Values from the drone's own observation and, but for dtde, from the whole level's truth and coverage.

    With an encoder of its own it shares nothing with the actor: in a common one the value loss wrecks an imitated
    policy within 0.1 million steps. It has no memory then: the level's image tells what a memory would. With a shared
    encoder it reads the actor's features, memory and all, beside the level.
    """

    def __init__(self, settings: NetworkSettings, spec: ObservationSpec) -> None:
        super().__init__()
        hidden, widths = settings.hidden, settings.critic_channels
        self.sees_level = settings.paradigm != "dtde"
        self.is_shared = settings.encoder == "shared"
        central = settings.paradigm == "ctce"
        self.encoder = None
        if not self.is_shared:
            self.encoder = Encoder(
                spec, settings.critic_views, widths, settings.lidar, settings.critic_lidar_channels,
                (hidden, hidden // 4), self.sees_level, widths,
            )  # fmt: skip
        self.team = TeamPooling(hidden) if central and not self.is_shared else None
        self.level = LevelEncoder(widths, hidden) if self.is_shared and self.sees_level and not central else None
        features = settings.memory_size if settings.memory == "gru" else hidden
        width = features + (hidden if self.level is not None else 0)
        self.trunk = nn.Sequential(orthogonal(nn.Linear(width, hidden)), nn.ReLU()) if self.is_shared else None
        self.value = orthogonal(nn.Linear(hidden, 1), gain=0.1)  # begin near the mean
        self.scale = ReturnScale()

    def forward(self, seen: Seen, drones: int = 1, features: Tensor | None = None) -> Tensor:
        """Return normalised values, `[rows]`; `scale` turns them into returns and back.

        `features` are the actor's, needed where the encoder is shared. Under ctce rows are whole teams of `drones`.
        """
        level = seen[LEVEL].to(self.dtype) if self.sees_level else None
        with autocast(self.dtype, seen["views"].device):
            if self.encoder is not None:
                own, _ = self.encoder(seen, seen["views"].to(self.dtype), level)
                if self.team is not None:
                    own = self.team(own, seen.get("alive"), drones)
            else:
                assert features is not None, "a critic with a shared encoder needs the actor's features"
                assert self.trunk is not None
                parts = [features] if self.level is None else [features, self.level(level)]
                own = self.trunk(torch.cat(parts, dim=1))
        return self.value(own.float()).squeeze(1)  # type: ignore[no-any-return]

    def rescale(self, returns: Tensor) -> None:
        """Take the returns of a rollout into the normalisation; the values that the critic gives stay as they are."""
        self.scale.take(returns, self.value)  # type: ignore[arg-type]
