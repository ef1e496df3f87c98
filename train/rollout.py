"""Fly the policy in all worlds for a while and keep what PPO learns from."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from imagine.sim.exploration import Exploration, Observation, Step
from imagine.sim.metrics import EpisodeMetrics
from imagine.train.networks import Actor, Critic, log_probability
from imagine.train.precision import Precision, at_precision

OBSERVATION_KEYS = ("views", "lidar", "motion", "frontiers")
"""Inputs of an actor, in the order of its `forward`; the last is there where the specification shows frontiers."""


@dataclass
class Rollout:
    """Steps of all drones of all worlds; tensors `[steps, agents, ...]`, agents = worlds x drones.

    `alive` tells which drones acted: what a dead one is said to have done counts for nothing. `dones[t]` tells that a
    drone's own episode ended with step t, by its death or with the world's, and `truncated[t]` that the clock ended it
    while it still flew. `last` holds the observation after the last step, `[agents, ...]`; `level` images are the
    critic's own; `env_s` is the time the environment took. Images are kept in half precision, channels last: they are
    what costs memory, and the policy acts by them as they are kept.
    """

    observations: dict[str, Tensor]
    actions: Tensor
    log_probs: Tensor
    rewards: Tensor
    dones: Tensor
    last: dict[str, Tensor]
    alive: Tensor
    episodes: list[EpisodeMetrics] = field(default_factory=list)
    env_s: float = 0.0
    truncated: Tensor | None = None

    @property
    def agent_steps(self) -> int:
        """Decisions taken, over all drones."""
        return int(self.alive.sum())


def policy_tensors(observation: Observation) -> dict[str, Tensor]:
    """Return what the policy sees, `[worlds, drones, ...]`, as tensors `[agents, ...]`, good as long as it is."""
    arrays = observation.policy
    return {key: torch.from_numpy(array.reshape(-1, *array.shape[2:])) for key, array in arrays.items()}


def agent_tensors(observation: Observation) -> dict[str, Tensor]:
    """Return `policy_tensors`, and the images of the critic's own as `level`."""
    level = observation.critic
    return {**policy_tensors(observation), "level": torch.from_numpy(level.reshape(-1, *level.shape[2:]))}


def actor_inputs(tensors: dict[str, Tensor]) -> tuple[Tensor, ...]:
    """Return the actor's inputs in the order of its `forward`."""
    return tuple(tensors[key] for key in OBSERVATION_KEYS if key in tensors)


def critic_inputs(tensors: dict[str, Tensor]) -> tuple[Tensor, ...]:
    """Return the critic's inputs in the order of its `forward`."""
    keys = ("views", "lidar", "motion", "level", "frontiers")
    return tuple(tensors[key] for key in keys if key in tensors)


def stored(tensors: dict[str, Tensor], dtype: torch.dtype, device: torch.device) -> dict[str, Tensor]:
    """Return an observation as rollouts keep it: on the device of the networks, images `dtype` and channels last."""
    return {
        key: value.to(device, dtype).contiguous(memory_format=torch.channels_last)
        if value.ndim == 4
        else value.to(device)
        for key, value in tensors.items()
    }


def _room(steps: int, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return room for `steps` of what `stored` gave, `[steps, ...]`, images channels last."""
    room = {}
    for key, value in tensors.items():
        format = torch.channels_last if value.ndim == 4 else torch.contiguous_format
        flat = torch.empty(
            (steps * value.shape[0], *value.shape[1:]), dtype=value.dtype, device=value.device, memory_format=format
        )
        room[key] = flat.view(steps, value.shape[0], *value.shape[1:])
    return room


@torch.no_grad()
def collect(
    env: Exploration,
    observation: Observation,
    actor: Actor,
    steps: int,
    generator: torch.Generator,
    precision: Precision = "float32",
) -> tuple[Rollout, Observation]:
    """Act `steps` times by draws from the policy; return the rollout and the observation to go on from."""
    with at_precision(precision, actor):
        return _collect(env, observation, actor, steps, generator)


def _collect(
    env: Exploration, observation: Observation, actor: Actor, steps: int, generator: torch.Generator
) -> tuple[Rollout, Observation]:
    agents, device = env.worlds * env.drones, actor.device
    images = torch.bfloat16 if actor.dtype == torch.bfloat16 else torch.float16
    tensors = stored(agent_tensors(observation), images, device)
    kept = _room(steps, tensors)
    action_size = actor.log_std.shape[0]
    actions = torch.empty((steps, agents, action_size), device=device)
    log_probs, rewards = (torch.empty((steps, agents), device=device) for _ in range(2))
    dones, alive, truncated = (torch.empty((steps, agents), dtype=torch.bool, device=device) for _ in range(3))
    episodes: list[EpisodeMetrics] = []
    env_s = 0.0
    log_std = actor.spread()
    for t in range(steps):
        for key, value in tensors.items():
            kept[key][t] = value
        mean = actor(*actor_inputs(tensors))
        actions[t] = mean + log_std.exp() * torch.randn((agents, action_size), generator=generator).to(device)
        log_probs[t] = log_probability(actions[t], mean, log_std)
        flying = env.alive.copy()
        began = time.perf_counter()
        step = env.step(env_actions(actions[t], env))
        env_s += time.perf_counter() - began
        ended = step.done[:, None]
        died = flying & ~env.alive  # a world that starts anew has everyone alive again
        alive[t] = torch.from_numpy(flying.reshape(-1))
        rewards[t] = torch.from_numpy(step.reward.reshape(-1))
        dones[t] = torch.from_numpy((ended | died).reshape(-1))
        truncated[t] = torch.from_numpy((flying & late_worlds(step, env)[:, None]).reshape(-1))
        episodes.extend(step.episodes)
        observation = step.observation
        tensors = stored(agent_tensors(observation), images, device)
    return (
        Rollout(kept, actions, log_probs, rewards, dones, tensors, alive, episodes, env_s, truncated),
        observation,
    )


def late_worlds(step: Step, env: Exploration) -> NDArray[np.bool_]:
    """Tell which worlds the clock ended, bool `[worlds]`: neither was all covered nor had the last drone fallen."""
    late = np.zeros(env.worlds, bool)
    for episode in step.episodes:
        fell = (episode.alive_ticks < episode.ticks).all()
        late[episode.world] = episode.coverage < env.settings.stop_coverage and not fell
    return late


def env_actions(actions: Tensor, env: Exploration) -> NDArray[np.float32]:
    """Return actions `[agents, size]` as the environment takes them, `[worlds, drones, size]` in [-1, 1]."""
    wanted: NDArray[np.float32] = actions.clamp(-1.0, 1.0).reshape(env.worlds, env.drones, -1).cpu().numpy()
    return wanted


def flattened(rollout: Rollout) -> dict[str, Tensor]:
    """Return a rollout's observations as samples, `[steps * agents, ...]`, without a copy."""
    return {key: value.flatten(0, 1) for key, value in rollout.observations.items()}


def take(samples: dict[str, Tensor], at: Tensor) -> dict[str, Tensor]:
    """Return the samples at these indices; images stay channels last, gathered as whole rows."""
    return {
        key: value.permute(0, 2, 3, 1).index_select(0, at).permute(0, 3, 1, 2)
        if value.ndim == 4
        else value.index_select(0, at)
        for key, value in samples.items()
    }


@torch.no_grad()
def values_of(critic: Critic, rollout: Rollout, minibatch: int) -> tuple[Tensor, Tensor]:
    """Return the critic's values of all steps, `[steps, agents]`, and of the state after the last, `[agents]`."""
    flat = flattened(rollout)
    count = rollout.rewards.numel()
    pieces = [
        critic.values(*(piece[i : i + minibatch] for piece in critic_inputs(flat))) for i in range(0, count, minibatch)
    ]
    last = critic.values(*critic_inputs(rollout.last))
    return torch.cat(pieces).reshape(rollout.rewards.shape), last


def mean_of(records: Sequence[dict[str, float]]) -> dict[str, float]:
    """Return the mean of each number over the records that have it."""
    keys = dict.fromkeys(key for record in records for key in record)
    return {key: float(np.mean([record[key] for record in records if key in record])) for key in keys}
