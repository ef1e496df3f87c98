"""Rollouts that were flown apart, put together to learn from."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from imagine.train.rollout import Recall, Rollout


def joined(rollouts: Sequence[Rollout]) -> Rollout:
    """Return rollouts of the same steps by the same network, flown in different worlds, as one, in the order given."""
    first = rollouts[0]
    recalls = [rollout.recall for rollout in rollouts if rollout.recall is not None]
    return Rollout(
        observations={key: _along(1, [r.observations[key] for r in rollouts]) for key in first.observations},
        actions=_along(1, [r.actions for r in rollouts]),
        log_probs=_along(1, [r.log_probs for r in rollouts]),
        rewards=_along(1, [r.rewards for r in rollouts]),
        dones=_along(1, [r.dones for r in rollouts]),
        last={key: _along(0, [r.last[key] for r in rollouts]) for key in first.last},
        alive=_along(1, [r.alive for r in rollouts]),
        episodes=[episode for rollout in rollouts for episode in rollout.episodes],
        env_s=max(rollout.env_s for rollout in rollouts),
        truncated=_along_all([r.truncated for r in rollouts]),
        drones=first.drones,
        starts=_along_all([r.starts for r in rollouts]),
        states=_along_all([r.states for r in rollouts]),
        recall=Recall(torch.cat([r.state for r in recalls]), torch.cat([r.starts for r in recalls]))
        if recalls
        else None,
    )


def _along_all(pieces: Sequence[Tensor | None]) -> Tensor | None:
    found = [piece for piece in pieces if piece is not None]
    return _along(1, found) if found else None


def _along(axis: int, pieces: Sequence[Tensor]) -> Tensor:
    """Join along an axis; images stay channels last."""
    whole = torch.cat(list(pieces), dim=axis)
    if whole.ndim < 4 + axis:
        return whole
    flat = whole.view(-1, *whole.shape[-3:]) if whole.is_contiguous() else whole.flatten(0, axis)
    return flat.contiguous(memory_format=torch.channels_last).view(whole.shape)
