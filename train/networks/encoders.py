"""From what a drone sees to features: convolutions over views, LiDAR sectors and images of the level."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from imagine.core.observation_spec import ObservationSpec
from imagine.train.networks.settings import LidarKind, ViewKind

LEVEL_CHANNELS, LEVEL_CELLS = 5, 32
"""Of the image of the whole level, as `sim.critic_images` draws it."""
_NOT_SHOWN = 1e4  # what a row without a frontier has its score lowered by
PATCH = 4  # cells along the side of a patch


def orthogonal(layer: nn.Module, gain: float = math.sqrt(2.0)) -> nn.Module:
    """Initialise a layer orthogonally with zero bias, as PPO implementations do (Engstrom et al. 2020)."""
    nn.init.orthogonal_(layer.weight, gain)  # type: ignore[arg-type]
    nn.init.zeros_(layer.bias)  # type: ignore[arg-type]
    return layer


class Patches(nn.Module):
    """A convolution of 4 x 4 patches that do not overlap, `[batch, channels, n, n]` to `[batch, width, n/4, n/4]`.

    It is a matrix product over the image's own numbers, which on processors is quicker than torch's convolution of few
    channels. What does not fill a patch, at the far edges, is not seen.
    """

    def __init__(self, channels: int, width: int) -> None:
        super().__init__()
        self.linear = orthogonal(nn.Linear(PATCH * PATCH * channels, width))

    def forward(self, image: Tensor) -> Tensor:
        """Return the features of each patch."""
        channels, rows, columns = image.shape[1], image.shape[2] // PATCH, image.shape[3] // PATCH
        whole = image[:, :, : rows * PATCH, : columns * PATCH].permute(0, 2, 3, 1)  # channels last is how they lie
        parts = whole.reshape(-1, rows, PATCH, columns, PATCH, channels).transpose(2, 3)
        features: Tensor = self.linear(parts.reshape(-1, rows, columns, PATCH * PATCH * channels))
        return features.permute(0, 3, 1, 2)


class ImageEncoder(nn.Module):
    """Convolutions that shrink an image about eightfold, and a linear layer: `[batch, channels, n, n]` to features.

    Given `frames`, images are `[batch, channels, frames, n, n]`: the first convolution spans two frames, the second
    what is left of the time.
    """

    def __init__(
        self, kind: ViewKind, channels: int, cells: int, widths: tuple[int, ...], features: int, frames: int = 1
    ) -> None:
        super().__init__()
        self.frames = frames
        timed = _timed_convolutions(kind, channels, widths[:2], frames) if frames > 1 else []
        flat = _convolutions(kind, channels, widths) if frames == 1 else _strided(widths[1], widths[2:])
        self.timed = nn.Sequential(*timed)
        self.convolutions = nn.Sequential(*flat).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        size = (1, channels, cells, cells) if frames == 1 else (1, channels, frames, cells, cells)
        with torch.no_grad():
            length = self._maps(torch.zeros(size)).numel()
        self.linear = orthogonal(nn.Linear(length, features))

    def forward(self, image: Tensor) -> Tensor:
        """Return the features of a batch of images, `[batch, features]`."""
        return torch.relu(self.linear(self._maps(image).flatten(1)))

    def _maps(self, image: Tensor) -> Tensor:
        if self.frames > 1:
            image = self.timed(image).squeeze(2)
        maps: Tensor = self.convolutions(image.contiguous(memory_format=torch.channels_last))
        return maps


def _convolutions(kind: ViewKind, channels: int, widths: tuple[int, ...]) -> list[nn.Module]:
    """`strided`: kernels that overlap, for directions near the drone must be read finely. `patch`: a third of that."""
    if kind == "strided":
        return _strided(channels, widths)
    return [Patches(channels, widths[0]), nn.ReLU(), *_strided(widths[0], widths[1:])]


def _strided(channels: int, widths: tuple[int, ...]) -> list[nn.Module]:
    layers: list[nn.Module] = []
    for width in widths:
        layers += [orthogonal(nn.Conv2d(channels, width, 3, stride=2, padding=1)), nn.ReLU()]
        channels = width
    return layers


def _timed_convolutions(kind: ViewKind, channels: int, widths: tuple[int, ...], frames: int) -> list[nn.Module]:
    """Two 3-D convolutions that take `frames` frames to one: what moved between two, then how that went on."""
    if kind == "strided":
        first: nn.Module = nn.Conv3d(channels, widths[0], (2, 3, 3), stride=(1, 2, 2), padding=(0, 1, 1))
    else:
        first = nn.Conv3d(channels, widths[0], (2, PATCH, PATCH), stride=(1, PATCH, PATCH))
    second = nn.Conv3d(widths[0], widths[1], (frames - 1, 3, 3), stride=(1, 2, 2), padding=(0, 1, 1))
    return [orthogonal(first), nn.ReLU(), orthogonal(second), nn.ReLU()]


class LidarEncoder(nn.Module):
    """Two, one or no circular 1-D convolutions of stride 2 around the turn, and a dense layer.

    Takes `[batch, sectors]`, returns `[batch, features]`. The convolutions have no seam: turning the scan turns what
    they see.
    """

    def __init__(self, kind: LidarKind, sectors: int, channels: int, features: int) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        width, length = 1, sectors
        for _ in range({"dense": 0, "conv1": 1, "conv2": 2}[kind]):
            layers += [
                orthogonal(nn.Conv1d(width, channels, 5, stride=2, padding=2, padding_mode="circular")),
                nn.ReLU(),
            ]
            width, length = channels, math.ceil(length / 2)
        self.convolutions = nn.Sequential(*layers)
        self.linear = orthogonal(nn.Linear(width * length, features))

    def forward(self, lidar: Tensor) -> Tensor:
        """Return the features of a batch of pooled scans, `[batch, features]`."""
        return torch.relu(self.linear(self.convolutions(lidar.unsqueeze(1)).flatten(1)))


class LevelEncoder(nn.Module):
    """Images of the whole level, `[batch, 5, 32, 32]`, to features: what is explored, what is not, who is where."""

    def __init__(self, widths: tuple[int, ...], features: int) -> None:
        super().__init__()
        self.image = ImageEncoder("patch", LEVEL_CHANNELS, LEVEL_CELLS, widths, features)

    def forward(self, level: Tensor) -> Tensor:
        """Return the features of a batch of images, `[batch, features]`."""
        features: Tensor = self.image(level)
        return features


class FrontierEncoder(nn.Module):
    """Scores the frontiers shown, `[batch, n, numbers]`, in the light of the rest, and mixes them by a softmax.

    Frontiers are a set: whatever their order, the same numbers score the same.
    """

    def __init__(self, numbers: int, context: int, features: int) -> None:
        super().__init__()
        self.context = orthogonal(nn.Linear(context, features))
        self.each = orthogonal(nn.Linear(numbers, features))
        self.mixed = orthogonal(nn.Linear(features, features))
        self.score = orthogonal(nn.Linear(features, 1), gain=1.0)

    def forward(self, frontiers: Tensor, context: Tensor) -> tuple[Tensor, Tensor]:
        """Return features `[batch, features]` and the mixed direction `[batch, 2]`; zeros where none is shown."""
        hidden = torch.relu(self.each(frontiers) + self.context(context).unsqueeze(1))
        hidden = torch.relu(self.mixed(hidden))
        shown = frontiers[..., :1]
        weights = torch.softmax(self.score(hidden).float() + (shown - 1.0) * _NOT_SHOWN, dim=1) * shown
        return (weights * hidden).sum(dim=1), (weights * frontiers[..., 1:3]).sum(dim=1)


class Encoder(nn.Module):
    """One drone's observation, and the level where `sees_level`, to features `[batch, hidden]`."""

    def __init__(
        self,
        spec: ObservationSpec,
        views: ViewKind,
        widths: tuple[int, ...],
        lidar: LidarKind,
        lidar_channels: int,
        sizes: tuple[int, int],
        sees_level: bool,
        level_widths: tuple[int, ...],
        frames: int = 1,
    ) -> None:
        """`sizes` are the numbers of features, of views and of all, and of the LiDAR."""
        super().__init__()
        channels, cells, _ = spec.shapes["views"]
        hidden, lidar_features = sizes
        self.views = ImageEncoder(views, channels, cells, widths, hidden, frames)
        self.lidar = LidarEncoder(lidar, spec.lidar_sectors, lidar_channels, lidar_features)
        self.level = LevelEncoder(level_widths, hidden) if sees_level else None
        width = hidden + lidar_features + spec.shapes["motion"][0] + (hidden if sees_level else 0)
        self.frontiers: FrontierEncoder | None = None
        if spec.frontiers:
            self.frontiers = FrontierEncoder(spec.shapes["frontiers"][1], width, hidden // 2)
            width += hidden // 2 + 2
        self.trunk = nn.Sequential(orthogonal(nn.Linear(width, hidden)), nn.ReLU())

    def forward(self, seen: dict[str, Tensor], views: Tensor, level: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return the features `[batch, hidden]`, and the direction to the frontiers chosen `[batch, 2]`, else zeros.

        `views` and `level` are as the network computes, stacked where it remembers; the rest is taken as `seen`.
        """
        images = [self.views(views)]
        if self.level is not None:
            assert level is not None, "an encoder that sees the level was not given it"
            images.append(self.level(level))
        parts = torch.cat([*images, self.lidar(seen["lidar"]), seen["motion"]], dim=1)
        direction = parts.new_zeros((parts.shape[0], 2))
        if self.frontiers is not None:
            chosen, direction = self.frontiers(seen["frontiers"], parts)
            parts = torch.cat([parts, chosen, direction], dim=1)
        features: Tensor = self.trunk(parts)
        return features, direction
