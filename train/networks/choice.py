"""A policy that chooses among the frontiers it is shown and flies in the direction of its choice."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from imagine.core.frontier_choice import OFFSET_M, OFFSETS
from imagine.train.networks.coherent import gumbel_at
from imagine.train.networks.encoders import orthogonal

_NOT_SHOWN = 1e4  # what a row without a frontier has its score lowered by


class ChoiceHead(nn.Module):
    """Scores each frontier, `[rows, n, numbers]`, in the light of features `[rows, features]`.

    What is drawn while it learns is a frontier, not a direction: an exploring policy then tries what a planner would,
    going elsewhere, and not to tremble on its way. All in float32: differences of scores are what is learned from.
    `momentum` is what a frontier's score gains where the drone flies its way at full speed, and loses where it flies
    the other way: where nothing learned speaks for either of two, it does not turn to and fro between them.
    """

    def __init__(self, numbers: int, features: int, hidden: int, momentum: float = 0.0) -> None:
        super().__init__()
        self.momentum = momentum
        self.features = orthogonal(nn.Linear(features, hidden))
        self.each = orthogonal(nn.Linear(numbers + 1, hidden))
        self.mixed = orthogonal(nn.Linear(hidden, hidden))
        self.score = orthogonal(nn.Linear(hidden, 1), gain=0.1)  # begin undecided

    def forward(self, frontiers: Tensor, features: Tensor, velocity: Tensor) -> Tensor:
        """Return scores, `[rows, n]`, far below all others where no frontier is shown.

        `velocity` `[rows, 2]` along the observation's axes: a choice is held to by knowing what one is flying to.
        """
        along = (frontiers[..., 1:3] * velocity.unsqueeze(1)).sum(dim=2, keepdim=True)
        frontiers = torch.cat([frontiers, along], dim=2)
        hidden = torch.relu(self.each(frontiers) + self.features(features).unsqueeze(1))
        hidden = torch.relu(self.mixed(hidden))
        scores: Tensor = self.score(hidden).squeeze(2)
        return scores + self.momentum * along.squeeze(2) + (frontiers[..., 0] - 1.0) * _NOT_SHOWN


def direction_of(frontiers: Tensor, choice: Tensor) -> Tensor:
    """Return the directions, `[rows, 2]`, of chosen frontiers, `choice` int64 `[rows]`; zeros where none is shown."""
    at = choice.view(-1, 1, 1).expand(-1, 1, 2)
    return frontiers[..., 1:3].gather(1, at).squeeze(1)


def has_choice(frontiers: Tensor) -> Tensor:
    """Tell where any of the frontiers `[rows, n, numbers]` is shown, bool `[rows]`.

    Where none is, all scores are equally low: what is drawn there is no decision, and nothing is to be learned from it.
    """
    return (frontiers[..., 0] > 0.5).any(dim=1)


def draw_choice(scores: Tensor, uniform: Tensor) -> Tensor:
    """Return choices, int64 `[rows]`, by the softmax of scores, for numbers in [0, 1) `[rows]`."""
    reached = torch.softmax(scores, dim=1).cumsum(dim=1)
    below = (reached <= uniform.unsqueeze(1) * reached[:, -1:]).sum(dim=1)
    return below.clamp(max=scores.shape[1] - 1)


def draw_coherent(scores: Tensor, noise: Tensor, places: Tensor) -> Tensor:
    """Return choices, int64 `[rows]`, by scores and the drones' fields (`coherent_noise`) at the frontiers' places."""
    return (scores + gumbel_at(noise, places)).argmax(dim=1)


def places_of(frontiers: Tensor, poses: Tensor, along_heading: bool) -> Tensor:
    """Return where frontiers `[rows, n, numbers]` lie in the map, `[rows, n, 2]`, metres.

    `poses` `[rows, 3]` are where the drones that are shown them take themselves to be; `along_heading`: they are shown
    along the heading, not along the map's axes.
    """
    offsets = frontiers[..., OFFSETS : OFFSETS + 2] * OFFSET_M
    if along_heading:
        cosine, sine = poses[:, 2:].cos(), poses[:, 2:].sin()
        x, y = offsets.unbind(dim=2)
        offsets = torch.stack([cosine * x - sine * y, sine * x + cosine * y], dim=2)
    return poses[:, None, :2] + offsets


def choice_log_probability(scores: Tensor, choice: Tensor) -> Tensor:
    """Return the logarithm of the chance of choices int64 `[rows]`, `[rows]`."""
    return torch.log_softmax(scores, dim=1).gather(1, choice.unsqueeze(1)).squeeze(1)


def choice_entropy(scores: Tensor) -> Tensor:
    """Return the entropy of each choice, `[rows]`."""
    log = torch.log_softmax(scores, dim=1)
    return -(log.exp() * log).sum(dim=1)
