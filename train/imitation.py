"""Imitation of the frontier planner by DAgger (Ross et al. 2011): the student flies, the planner says what it would do.

Learning from the planner's own flights alone fails: the first error leads where no label was ever given.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
import torch
from pydantic import Field
from torch import Tensor, nn

from imagine.core.config import Settings
from imagine.core.errors import WorkError
from imagine.sim.exploration import Exploration, Observation
from imagine.sim.metrics import EpisodeMetrics
from imagine.train.batches import Batch
from imagine.train.labels import LabelBuffer, Round, RoundBuffer
from imagine.train.networks import Actor, Precision, at_precision
from imagine.train.pilots import Pilot
from imagine.train.rollout import Recall, agent_tensors, env_actions, estimates, living, next_decisions, stored

_SAME_WAY = 0.03  # of 1 - cosine: directions up to about 10 degrees apart count as one
_BY_REFERENCE = "by_reference"
_ALONG = 0.7  # cosine from which on a label points at a frontier


Teacher = Literal["frontier", "coordinated", "hungarian", "clairvoyant"]


class LabelSettings(Settings):
    """How labels are gathered and learned from."""

    round_steps: int = Field(default=32, ge=1, description="steps of every world between two rounds of learning")
    label_every: int = Field(
        default=1, ge=1, le=100,
        description="steps from one label to the next: states that follow on one another are alike; a policy with a "
        "memory is labelled at every step",
    )  # fmt: skip
    gradient_steps: int = Field(default=24, ge=1, description="steps of Adam a round")
    minibatch: int = Field(default=512, ge=1)
    lr: float = Field(default=1e-3, gt=0.0)
    final_lr_share: float = Field(default=0.1, gt=0.0, le=1.0, description="the rate falls to this share, linearly")
    buffer_samples: int = Field(default=100_000, ge=1, description="newest labels kept; about 8.5 kB each")
    planner_share: float = Field(default=0.8, ge=0.0, le=1.0, description="drones the planner flies in round one")
    planner_share_until: float = Field(default=0.5, ge=0.0, le=1.0, description="share of the labels when it reaches 0")
    student_draws: bool = Field(default=True, description="the student flies what it draws, not its best")
    precision: Precision = Field(default="auto", description="of layers, while flying and learning")
    cosine_weight: float = Field(default=0.25, ge=0.0, description="of the direction's error, beside the square error")


class ImitationSettings(LabelSettings):
    """How long and how a planner is imitated."""

    teacher: Teacher = Field(
        default="coordinated", description="the planner whose advice labels the states that are visited"
    )
    agent_steps: int = Field(default=250_000, ge=0, description="decisions of all drones; 0 leaves imitation out")


def label_buffer(actor: Actor, samples: int) -> LabelBuffer | RoundBuffer:
    """Return a buffer for as many labels: single ones, or whole rounds where what is learned are sequences or teams."""
    return (
        RoundBuffer(samples, bool(actor.state_size)) if actor.state_size or actor.is_central else LabelBuffer(samples)
    )


@torch.no_grad()
def collect_labels(
    env: Exploration,
    observation: Observation,
    actor: Actor,
    teacher: Pilot,
    buffer: LabelBuffer | RoundBuffer,
    steps: int,
    planner_share: float,
    rng: np.random.Generator,
    generator: torch.Generator,
    precision: Precision = "float32",
    recall: Recall | None = None,
    student_draws: bool = True,
    label_every: int = 1,
) -> tuple[Observation, list[EpisodeMetrics], int]:
    """Fly `steps` in all worlds and label states; return the next observation, finished episodes and labels added.

    Every `label_every`-th state is labelled, and until the next what the planner flies repeats its action. Which drones
    it flies is drawn once a call, so that the student's own mistakes have time to unfold.
    `recall` is what the student remembers so far, and is brought up to date; without one everybody's episode begins.
    """
    agents = env.worlds * env.drones
    recall = recall or Recall.nothing(actor, agents)
    planner_flies = torch.from_numpy(rng.random(agents) < planner_share)
    episodes: list[EpisodeMetrics] = []
    added = 0
    flown = Round.empty(recall) if isinstance(buffer, RoundBuffer) else None
    labels = torch.full((agents, env.settings.action.size), math.nan)
    with at_precision(precision, actor):
        noise = actor.noise(steps, agents, generator)
        for t in range(steps):
            seen = stored(agent_tensors(observation, actor.is_central), torch.float16, actor.device)
            alive = living(env)
            if t % label_every == 0:
                labels = torch.from_numpy(teacher.act(env, observation).reshape(agents, -1))
            labelled = torch.isfinite(labels).all(dim=1)
            if t % label_every == 0:
                added += int(labelled.sum())
                if flown is not None:
                    flown.add(seen, labels, alive, recall.starts)
                elif isinstance(buffer, LabelBuffer):
                    known = {**seen, _BY_REFERENCE: _by_reference(teacher, env).to(actor.device)}
                    buffer.add({key: value[labelled] for key, value in known.items()}, labels[labelled])
            decisions = next_decisions(actor, {**seen, "alive": alive.to(actor.device)}, recall, env.drones)
            actions = decisions.mean.cpu()
            if student_draws:
                drawn, _ = actor.draw(decisions, noise[t], seen, estimates(env))
                actions = actor.flown(seen, drawn).cpu()
            by_planner = planner_flies & labelled
            actions[by_planner] = labels[by_planner]
            step = env.step(env_actions(actions, env))
            teacher.forget(step.done)
            episodes.extend(step.episodes)
            observation = step.observation
            begins = torch.from_numpy(np.repeat(step.done, env.drones))
            labels = labels.masked_fill(begins[:, None], math.nan)
            recall.starts = begins.to(actor.device)
    if flown is not None and isinstance(buffer, RoundBuffer):
        buffer.add_round(flown, env.drones if actor.is_central else 1)
    return observation, episodes, added


def _by_reference(teacher: Pilot, env: Exploration) -> Tensor:
    """Return 1 where a drone was labelled by the reference, `[agents, 1]`, as `by_reference` of the teacher tells."""
    told = getattr(teacher, "by_reference", np.zeros(env.worlds, np.bool_))
    return torch.from_numpy(np.repeat(told, env.drones)[:, None].astype(np.float32))


def imitation_loss(mean: Tensor, labels: Tensor, cosine_weight: float) -> Tensor:
    """Return the mean square error, plus the weighted mean of 1 - cos of the angle to labels longer than 0.1."""
    error = (mean - labels).square().sum(dim=1).mean()
    directed = labels.norm(dim=1) > 0.1
    if cosine_weight == 0.0 or not bool(directed.any()):
        return error
    cosine = torch.nn.functional.cosine_similarity(mean[directed], labels[directed], dim=1, eps=1e-3)
    return error + cosine_weight * (1.0 - cosine).mean()


def wanted_choices(frontiers: Tensor, labels: Tensor) -> Tensor:
    """Return which of the frontiers labels point at, `[rows, n]`: shares that add up to 1, or zeros where at none.

    `frontiers` `[rows, n, numbers]`, `labels` `[rows, action size]`. Frontiers that begin with the same way are one to
    a label, so its weight is shared among them.
    """
    frontiers, labels = frontiers.float(), labels[:, None, :2]
    cosine = nn.functional.cosine_similarity(frontiers[..., 1:3], labels, dim=2, eps=1e-3)
    cosine = torch.where(frontiers[..., 0] > 0.5, cosine, -1.0)
    return torch.softmax((cosine - 1.0) / _SAME_WAY, dim=1) * (cosine.amax(dim=1, keepdim=True) > _ALONG)


def choice_loss(scores: Tensor, wanted: Tensor) -> Tensor:
    """Return the cross-entropy of choices by `scores` to the `wanted` ones, `[rows, n]`; rows of zeros do not count."""
    loss = -(wanted * torch.log_softmax(scores, dim=1)).sum(dim=1)
    return loss.sum() / wanted.sum().clamp(min=1.0)


@torch.no_grad()
def _choices_of(guide: Actor, batch: Batch) -> Tensor:
    """Return how likely a guide would choose each frontier, `[rows, n]`."""
    scores = batch.decide(guide).scores
    assert scores is not None
    return torch.softmax(scores, dim=1)


def learn(
    actor: Actor,
    optimiser: torch.optim.Optimizer,
    buffer: LabelBuffer | RoundBuffer,
    settings: LabelSettings,
    generator: torch.Generator,
    reference: Actor | None = None,
) -> float:
    """Take a round's gradient steps toward the labels; return the mean loss, nan where there is no label yet.

    Of states that the teacher's `by_reference` told of, all scores of `reference` are learned, and not its best alone:
    how much lies between it and the next is what holds elsewhere. Policies that remember or are centralised learn the
    best alone. Raises WorkError where a loss or gradient is not finite, before it reaches the weights.
    """
    if not len(buffer):
        return math.nan
    losses = []
    guide = reference if isinstance(buffer, LabelBuffer) else None
    with at_precision(settings.precision, actor, *([] if guide is None else [guide])):
        for _ in range(settings.gradient_steps):
            batch = buffer.sample(settings.minibatch, generator)
            decisions, labels = batch.decide(actor), batch["labels"]
            if decisions.scores is None:
                loss = imitation_loss(batch.of_counted(decisions.mean), labels, settings.cosine_weight)
            else:
                wanted = wanted_choices(batch["frontiers"], labels)
                if guide is not None:
                    wanted = torch.where(batch[_BY_REFERENCE] > 0.5, _choices_of(guide, batch), wanted)
                loss = choice_loss(batch.of_counted(decisions.scores), wanted)
            optimiser.zero_grad(set_to_none=True)
            loss.backward()  # type: ignore[no-untyped-call]
            norm = float(nn.utils.clip_grad_norm_(actor.parameters(), 1.0))
            if not (math.isfinite(loss.item()) and math.isfinite(norm)):
                phase = "imitation" if isinstance(settings, ImitationSettings) else "rehearsal"
                raise WorkError(
                    f"{phase} diverged: the loss of the actor is {loss.item()}, its gradient {norm} long; "
                    f"begin anew, for {phase} leaves no checkpoint before its end: imagine train --resume RUN --set "
                    f"{phase}.lr=… with a smaller one, or --set {phase}.precision=float32"
                )
            optimiser.step()
            losses.append(loss.item())
    return float(np.mean(losses))
