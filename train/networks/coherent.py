"""Chance that stays with a frontier for a while, so that a policy that explores flies there and does not dither.

Drawn anew in every decision, choices of several frontiers cancel out on the way: what is tried is to tremble. Here each
drone has a smooth random field over the map that changes slowly; a frontier's score is raised by the field's value at
its place. Where frontiers lie apart, each single choice is as likely as by the softmax of the scores (Gumbel 1954), but
one choice and the next go together. It is to choices what generalised state-dependent exploration (Raffin et al. 2022)
is to actions.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

WAVES = 24
"""Cosines that a field is the sum of (Rahimi and Recht 2007)."""
_REACH_M = 1.5  # where a field is much the same: frontiers are clusters of about a metre
_HELD_DECISIONS = 12.0  # for which it is much the same
_ALMOST = 1e-6


def coherent_noise(steps: int, agents: int, generator: torch.Generator) -> Tensor:
    """Return what `gumbel_at` needs of chance, `[steps, agents, 3 * WAVES]`, steps following on one another."""
    waves = torch.randn((agents, 2 * WAVES), generator=generator) / _REACH_M
    begins = torch.rand((agents, WAVES), generator=generator) * (2.0 * math.pi)
    turns = torch.randn((agents, WAVES), generator=generator) / _HELD_DECISIONS
    phases = begins + turns * torch.arange(steps).view(-1, 1, 1)
    return torch.cat([waves.expand(steps, -1, -1), phases], dim=2)


def gumbel_at(noise: Tensor, places: Tensor) -> Tensor:
    """Return the fields' values at `places` `[rows, n, 2]`, metres, as draws of Gumbel, `[rows, n]`."""
    across, up, phases = noise[:, :WAVES], noise[:, WAVES : 2 * WAVES], noise[:, 2 * WAVES :]
    angles = places[..., :1] * across.unsqueeze(1) + places[..., 1:] * up.unsqueeze(1) + phases.unsqueeze(1)
    normal = angles.cos().sum(dim=2) * math.sqrt(2.0 / WAVES)
    share = 0.5 * (1.0 + torch.erf(normal / math.sqrt(2.0)))
    return -(-share.clamp(_ALMOST, 1.0 - _ALMOST).log()).log()
