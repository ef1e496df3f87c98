"""Whoever flies a run's rollouts: this process, or workers beside it (`rollout_workers`)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import torch

from imagine.sim.exploration import Exploration, Observation
from imagine.train.networks import Actor
from imagine.train.ppo_settings import PpoSettings
from imagine.train.rollout import Recall, Rollout, collect


class RolloutSource(Protocol):
    """Flies rollouts; each goes on where the one before ended."""

    def collect(self, actor: Actor, generator: torch.Generator) -> Rollout:
        """Fly a rollout in all worlds by draws from the policy as it is now."""

    def set_level_weights(self, weights: Sequence[float]) -> None:
        """Draw the levels of coming episodes by these shares."""

    def state_dict(self) -> dict[str, Any]:
        """Return what decides how all worlds go on, and what drones remember: plain containers and arrays."""


class OwnRollouts:
    """Rollouts flown by this process, in an environment that has begun."""

    def __init__(self, env: Exploration, observation: Observation, recall: Recall, ppo: PpoSettings) -> None:
        """Go on from `observation`, the newest of `env`, and from what is remembered then."""
        self._env, self._observation, self._recall, self._ppo = env, observation, recall, ppo

    def collect(self, actor: Actor, generator: torch.Generator, noise: torch.Tensor | None = None) -> Rollout:
        """Fly a rollout in all worlds by draws from the policy as it is now, or by given `noise`."""
        ppo = self._ppo
        rollout, self._observation = collect(
            self._env, self._observation, actor, ppo.rollout_steps, generator, ppo.precision, self._recall,
            ppo.sequence_steps, noise,
        )  # fmt: skip
        return rollout

    def set_level_weights(self, weights: Sequence[float]) -> None:
        """Draw the levels of coming episodes by these shares."""
        self._env.set_level_weights(weights)

    def state_dict(self) -> dict[str, Any]:
        """Return the environment's state, and what drones remember."""
        return {"env": self._env.state_dict(), "recall": self._recall.state_dict()}
