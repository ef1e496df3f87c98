"""The two networks: an actor that every drone shares, and a centralised critic with an encoder of its own.

The critic shares nothing with the actor: with a common encoder the value loss wrecks an imitated policy within
0.1 million steps.
"""

from __future__ import annotations

import math

import torch
from pydantic import Field
from torch import Tensor, nn

from imagine.core.config import Settings
from imagine.core.observation_spec import ObservationSpec
from imagine.train.precision import Computing, autocast

CRITIC_CHANNELS = 5
CRITIC_CELLS = 32
LOG_STD_RANGE = (-3.0, 0.0)
RETURN_MEMORY = 0.05  # weight of the newest rollout's returns: 20 rollouts are remembered
MIN_RETURN_STD = 1e-3  # where no reward was seen yet, noise must not be blown up to be the signal


class NetworkSettings(Settings):
    """Sizes of both networks, and how widely the untrained policy explores."""

    view_channels: tuple[int, int, int] = Field(default=(16, 32, 32), description="of the actor's image encoder")
    lidar_channels: int = Field(default=16, ge=1, le=256, description="of the actor's two circular convolutions")
    hidden: int = Field(default=128, ge=8, le=1024)
    critic_channels: tuple[int, int] = Field(default=(32, 32), description="of each of the critic's image encoders")
    critic_lidar_channels: int = Field(default=8, ge=1, le=256)
    log_std: float = Field(
        default=-1.2, ge=LOG_STD_RANGE[0], le=LOG_STD_RANGE[1], description="at the start, the same for all states"
    )


class ImageEncoder(nn.Module):
    """Convolutions that shrink an image about eightfold, and a linear layer: `[batch, channels, n, n]` to features."""

    def __init__(self, convolutions: nn.Sequential, channels: int, cells: int, features: int) -> None:
        super().__init__()
        self.convolutions = convolutions.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        with torch.no_grad():
            flat = convolutions(torch.zeros(1, channels, cells, cells)).numel()
        self.linear = _orthogonal(nn.Linear(flat, features))

    def forward(self, image: Tensor) -> Tensor:
        """Return the features of a batch of images, `[batch, features]`."""
        maps = self.convolutions(image.contiguous(memory_format=torch.channels_last))
        return torch.relu(self.linear(maps.flatten(1)))


def _view_convolutions(channels: int, widths: tuple[int, int, int]) -> nn.Sequential:
    """Three convolutions of stride 2: overlapping kernels, for directions near the drone must be read finely."""
    layers: list[nn.Module] = []
    for width in widths:
        layers += [_orthogonal(nn.Conv2d(channels, width, 3, stride=2, padding=1)), nn.ReLU()]
        channels = width
    return nn.Sequential(*layers)


def _patch_convolutions(channels: int, widths: tuple[int, int]) -> nn.Sequential:
    """Patches of 4 x 4 cells, then a convolution of stride 2: a third of the cost, enough to tell a value."""
    return nn.Sequential(
        _orthogonal(nn.Conv2d(channels, widths[0], 4, stride=4)),
        nn.ReLU(),
        _orthogonal(nn.Conv2d(widths[0], widths[1], 3, stride=2, padding=1)),
        nn.ReLU(),
    )


class LidarEncoder(nn.Module):
    """Two circular 1-D convolutions of stride 2 around the turn: `[batch, sectors]` to `[batch, features]`."""

    def __init__(self, sectors: int, channels: int, features: int) -> None:
        super().__init__()
        self.convolutions = nn.Sequential(
            _orthogonal(nn.Conv1d(1, channels, 5, stride=2, padding=2, padding_mode="circular")),
            nn.ReLU(),
            _orthogonal(nn.Conv1d(channels, channels, 5, stride=2, padding=2, padding_mode="circular")),
            nn.ReLU(),
        )
        length = math.ceil(math.ceil(sectors / 2) / 2)
        self.linear = _orthogonal(nn.Linear(channels * length, features))

    def forward(self, lidar: Tensor) -> Tensor:
        """Return the features of a batch of pooled scans."""
        return torch.relu(self.linear(self.convolutions(lidar.unsqueeze(1)).flatten(1)))


class FrontierEncoder(nn.Module):
    """Scores the frontiers shown, `[batch, n, numbers]`, in the light of the rest, and mixes them by a softmax.

    Frontiers are a set: whatever their order, the same numbers score the same.
    """

    def __init__(self, numbers: int, context: int, features: int) -> None:
        super().__init__()
        self.context = _orthogonal(nn.Linear(context, features))
        self.each = _orthogonal(nn.Linear(numbers, features))
        self.mixed = _orthogonal(nn.Linear(features, features))
        self.score = _orthogonal(nn.Linear(features, 1), gain=1.0)

    def forward(self, frontiers: Tensor, context: Tensor) -> Tensor:
        """Return features, and last the mixed direction (2), `[batch, features + 2]`; zeros where none is shown."""
        hidden = torch.relu(self.each(frontiers) + self.context(context).unsqueeze(1))
        hidden = torch.relu(self.mixed(hidden))
        shown = frontiers[..., :1]
        scores = self.score(hidden).float() + (shown - 1.0) * 1e4
        weights = torch.softmax(scores, dim=1) * shown
        return torch.cat([(weights * hidden).sum(dim=1), (weights * frontiers[..., 1:3]).sum(dim=1)], dim=1)


class Actor(Computing):
    """The policy: a drone's observation to the mean of its action; the spread is one number per action component."""

    def __init__(self, settings: NetworkSettings, spec: ObservationSpec, action_size: int) -> None:
        super().__init__()
        channels, cells, _ = spec.shapes["views"]
        hidden = settings.hidden
        widths = settings.view_channels
        self.views = ImageEncoder(_view_convolutions(channels, widths), channels, cells, hidden)
        self.lidar = LidarEncoder(spec.lidar_sectors, settings.lidar_channels, hidden // 2)
        seen = hidden + hidden // 2 + spec.shapes["motion"][0]
        self.frontiers: FrontierEncoder | None = None
        if spec.frontiers:
            self.frontiers = FrontierEncoder(spec.shapes["frontiers"][1], seen, hidden // 2)
            self.steering = nn.Parameter(torch.tensor(1.5))
            seen += hidden // 2 + 2
        self.trunk = nn.Sequential(_orthogonal(nn.Linear(seen, hidden)), nn.ReLU())
        self.mean = _orthogonal(nn.Linear(hidden, action_size), gain=0.01)  # begin near standing still
        self.log_std = nn.Parameter(torch.full((action_size,), settings.log_std))

    def forward(self, views: Tensor, lidar: Tensor, motion: Tensor, frontiers: Tensor | None = None) -> Tensor:
        """Return the action's mean, `[batch, action size]` in (-1, 1); this is what flies."""
        with autocast(self.dtype, views.device):
            seen = torch.cat([self.views(views.to(self.dtype)), self.lidar(lidar), motion], dim=1)
            if self.frontiers is None or frontiers is None:
                return torch.tanh(self.mean(self.trunk(seen).float()))
            chosen = self.frontiers(frontiers, seen)
            features = self.trunk(torch.cat([seen, chosen], dim=1))
        return torch.tanh(self.mean(features.float()) + self.steering * chosen[:, -2:].float())

    def spread(self) -> Tensor:
        """Return the logarithm of the standard deviation with which training draws actions, `[action size]`."""
        return self.log_std.clamp(*LOG_STD_RANGE)


def log_probability(actions: Tensor, mean: Tensor, log_std: Tensor) -> Tensor:
    """Return the log density of actions `[batch, size]` under independent Gaussians, `[batch]`."""
    scaled = (actions - mean) * torch.exp(-log_std)
    return -(0.5 * scaled.square() + log_std + 0.5 * math.log(2.0 * math.pi)).sum(dim=1)


def entropy(log_std: Tensor) -> Tensor:
    """Return the entropy of independent Gaussians, summed over the components of the action."""
    return (log_std + 0.5 * math.log(2.0 * math.pi * math.e)).sum()


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
        """Take new returns into the statistics, and change the head so that what it stands for stays the same."""
        new = torch.stack([returns.double().mean(), returns.double().square().mean()])
        self.moments.lerp_(new, RETURN_MEMORY)
        self.weight.lerp_(torch.ones_like(self.weight), RETURN_MEMORY)
        mean, square = self.moments / self.weight
        std = (square - mean.square()).clamp(min=MIN_RETURN_STD**2).sqrt().float()
        mean = mean.float()
        head.weight.mul_(self.std / std)
        head.bias.mul_(self.std).add_(self.mean - mean).div_(std)
        self.mean.copy_(mean)
        self.std.copy_(std)


class Critic(Computing):
    """The value of a drone's state, told from its own observation and from the whole level's truth and coverage."""

    def __init__(self, settings: NetworkSettings, spec: ObservationSpec) -> None:
        super().__init__()
        channels, cells, _ = spec.shapes["views"]
        hidden = settings.hidden
        widths = settings.critic_channels
        self.views = ImageEncoder(_patch_convolutions(channels, widths), channels, cells, hidden)
        self.level = ImageEncoder(_patch_convolutions(CRITIC_CHANNELS, widths), CRITIC_CHANNELS, CRITIC_CELLS, hidden)
        self.lidar = LidarEncoder(spec.lidar_sectors, settings.critic_lidar_channels, hidden // 4)
        seen = 2 * hidden + hidden // 4 + spec.shapes["motion"][0]
        self.frontiers: nn.Module | None = None
        if spec.frontiers:
            self.frontiers = nn.Sequential(
                nn.Flatten(), _orthogonal(nn.Linear(math.prod(spec.shapes["frontiers"]), hidden // 2)), nn.ReLU()
            )
            seen += hidden // 2
        self.trunk = nn.Sequential(_orthogonal(nn.Linear(seen, hidden)), nn.ReLU())
        self.value = _orthogonal(nn.Linear(hidden, 1), gain=1.0)
        self.scale = ReturnScale()

    def forward(
        self, views: Tensor, lidar: Tensor, motion: Tensor, level: Tensor, frontiers: Tensor | None = None
    ) -> Tensor:
        """Return normalised values, `[batch]`, of observations and images of the level `[batch, 5, 32, 32]`.

        `scale` turns them into returns and back.
        """
        with autocast(self.dtype, views.device):
            images = self.views(views.to(self.dtype)), self.level(level.to(self.dtype))
            seen = [*images, self.lidar(lidar), motion]
            if self.frontiers is not None and frontiers is not None:
                seen.append(self.frontiers(frontiers))
            features = self.trunk(torch.cat(seen, dim=1))
        return self.value(features.float()).squeeze(1)  # type: ignore[no-any-return]

    def values(self, *inputs: Tensor) -> Tensor:
        """Return the discounted returns that the critic expects, `[batch]`, by the inputs of `forward`."""
        normalised: Tensor = self(*inputs)
        return self.scale.returns(normalised)

    def rescale(self, returns: Tensor) -> None:
        """Take the returns of a rollout into the normalisation; the values that the critic gives stay as they are."""
        self.scale.take(returns, self.value)  # type: ignore[arg-type]


def _orthogonal(layer: nn.Module, gain: float = math.sqrt(2.0)) -> nn.Module:
    """Initialise a layer orthogonally with zero bias, as PPO implementations do (Engstrom et al. 2020)."""
    nn.init.orthogonal_(layer.weight, gain)  # type: ignore[arg-type]
    nn.init.zeros_(layer.bias)  # type: ignore[arg-type]
    return layer
