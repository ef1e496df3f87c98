"""Imitation of the frontier planner by DAgger (Ross et al. 2011): the student flies, the planner says what it would do.

Learning from the planner's own flights alone fails: the first error leads where no label was ever given.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from imagine.core.config import Settings
from imagine.core.errors import WorkError
from imagine.sim.exploration import Exploration, Observation
from imagine.sim.metrics import EpisodeMetrics
from imagine.train.networks import Actor
from imagine.train.pilots import Pilot
from imagine.train.rollout import actor_inputs, env_actions, policy_tensors


class ImitationSettings(Settings):
    """How long and how the planner is imitated."""

    teacher: Literal["frontier", "coordinated", "hungarian"] = Field(
        default="coordinated", description="the planner whose advice labels the states that are visited"
    )
    agent_steps: int = Field(default=250_000, ge=0, description="labelled decisions; 0 leaves imitation out")
    round_steps: int = Field(default=32, ge=1, description="steps of every world between two rounds of learning")
    gradient_steps: int = Field(default=24, ge=1, description="steps of Adam a round")
    minibatch: int = Field(default=512, ge=1)
    lr: float = Field(default=1e-3, gt=0.0)
    final_lr_share: float = Field(default=0.1, gt=0.0, le=1.0, description="the rate falls to this share, linearly")
    buffer_samples: int = Field(default=100_000, ge=1, description="newest labels kept; about 8.5 kB each")
    planner_share: float = Field(default=0.8, ge=0.0, le=1.0, description="drones the planner flies in round one")
    planner_share_until: float = Field(default=0.5, ge=0.0, le=1.0, description="share of imitation when it reaches 0")
    cosine_weight: float = Field(default=0.25, ge=0.0, description="of the direction's error, beside the square error")


@dataclass
class LabelBuffer:
    """The newest labelled observations, in a ring; images in half precision, they are what costs memory."""

    capacity: int
    arrays: dict[str, Tensor] = field(default_factory=dict)
    labels: Tensor = field(default_factory=lambda: torch.empty(0))
    written: int = 0

    def __len__(self) -> int:
        """Labels held."""
        return min(self.written, self.capacity)

    def add(self, observations: dict[str, Tensor], labels: Tensor) -> None:
        """Take labelled observations `[samples, ...]`; the oldest give way."""
        if not self.arrays:
            self.arrays = {
                key: torch.empty((self.capacity, *value.shape[1:]), dtype=torch.float16)
                for key, value in observations.items()
            }
            self.labels = torch.empty((self.capacity, labels.shape[1]))
        labels = labels[-self.capacity :]
        at = (self.written + torch.arange(len(labels))) % self.capacity
        for key, array in self.arrays.items():
            array[at] = observations[key][-self.capacity :].to(array.dtype)
        self.labels[at] = labels
        self.written += len(labels)

    def sample(self, count: int, generator: torch.Generator) -> tuple[dict[str, Tensor], Tensor]:
        """Return a random minibatch (with replacement) of observations and labels."""
        at = torch.randint(len(self), (count,), generator=generator)
        return {key: array[at].float() for key, array in self.arrays.items()}, self.labels[at]


@torch.no_grad()
def collect_labels(
    env: Exploration,
    observation: Observation,
    actor: Actor,
    teacher: Pilot,
    buffer: LabelBuffer,
    steps: int,
    planner_share: float,
    rng: np.random.Generator,
    generator: torch.Generator,
) -> tuple[Observation, list[EpisodeMetrics], int]:
    """Fly `steps` in all worlds and label every state; return the next observation, finished episodes and labels added.

    Which drones the planner flies is drawn once a call, so that the student's own mistakes have time to unfold.
    """
    planner_flies = torch.from_numpy(rng.random(env.worlds * env.drones) < planner_share)
    episodes: list[EpisodeMetrics] = []
    added = 0
    for _ in range(steps):
        tensors = policy_tensors(observation)
        labels = torch.from_numpy(teacher.act(env, observation).reshape(len(planner_flies), -1))
        labelled = torch.isfinite(labels).all(dim=1)
        buffer.add({key: tensor[labelled] for key, tensor in tensors.items()}, labels[labelled])
        added += int(labelled.sum())
        mean = actor(*actor_inputs(tensors))
        actions = mean + actor.spread().exp() * torch.randn(mean.shape, generator=generator)
        by_planner = planner_flies & labelled
        actions[by_planner] = labels[by_planner]
        step = env.step(env_actions(actions, env))
        teacher.forget(step.done)
        episodes.extend(step.episodes)
        observation = step.observation
    return observation, episodes, added


def imitation_loss(mean: Tensor, labels: Tensor, cosine_weight: float) -> Tensor:
    """Return the mean square error, plus the weighted mean of 1 - cos of the angle to labels longer than 0.1."""
    error = (mean - labels).square().sum(dim=1).mean()
    directed = labels.norm(dim=1) > 0.1
    if cosine_weight == 0.0 or not bool(directed.any()):
        return error
    cosine = torch.nn.functional.cosine_similarity(mean[directed], labels[directed], dim=1, eps=1e-3)
    return error + cosine_weight * (1.0 - cosine).mean()


def learn(
    actor: Actor,
    optimiser: torch.optim.Optimizer,
    buffer: LabelBuffer,
    settings: ImitationSettings,
    generator: torch.Generator,
) -> float:
    """Take a round's gradient steps toward the labels; return the mean loss. Raises WorkError when it is not finite."""
    losses = []
    for _ in range(settings.gradient_steps):
        tensors, labels = buffer.sample(settings.minibatch, generator)
        loss = imitation_loss(actor(*actor_inputs(tensors)), labels, settings.cosine_weight)
        if not torch.isfinite(loss):
            raise WorkError(f"imitation diverged: the loss is {loss.item()}; lower imitation.lr")
        optimiser.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(actor.parameters(), 1.0)
        optimiser.step()
        losses.append(loss.item())
    return float(np.mean(losses))
