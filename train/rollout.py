"""Fly the policy in all worlds for a while and keep what PPO learns from."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from imagine.sim.exploration import Exploration, Observation
from imagine.sim.metrics import EpisodeMetrics
from imagine.train.networks import Actor, Critic, log_probability

OBSERVATION_KEYS = ("views", "lidar", "motion")


@dataclass
class Rollout:
    """Steps of all drones of all worlds; tensors `[steps, agents, ...]`, agents = worlds x drones.

    `alive` tells which drones acted: what a dead one is said to have done counts for nothing. `dones[t]` tells that a
    drone's own episode ended with step t, by its death or with the world's. `last` holds the observation after the last
    step, `[agents, ...]`; `level` images are the critic's own; `env_s` is the time the environment took.
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

    @property
    def agent_steps(self) -> int:
        """Decisions taken, over all drones."""
        return int(self.alive.sum())


def policy_tensors(observation: Observation) -> dict[str, Tensor]:
    """Return what the policy sees, `[worlds, drones, ...]`, as tensors `[agents, ...]`, good as long as it is."""
    arrays = {key: observation.policy[key] for key in OBSERVATION_KEYS}
    return {key: torch.from_numpy(array.reshape(-1, *array.shape[2:])) for key, array in arrays.items()}


def agent_tensors(observation: Observation) -> dict[str, Tensor]:
    """Return `policy_tensors`, and the images of the critic's own as `level`."""
    level = observation.critic
    return {**policy_tensors(observation), "level": torch.from_numpy(level.reshape(-1, *level.shape[2:]))}


def actor_inputs(tensors: dict[str, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """Return the actor's inputs in the order of its `forward`."""
    return tensors["views"], tensors["lidar"], tensors["motion"]


@torch.no_grad()
def collect(
    env: Exploration,
    observation: Observation,
    actor: Actor,
    steps: int,
    generator: torch.Generator,
    noise: Tensor | None = None,
) -> tuple[Rollout, Observation]:
    """Act `steps` times by draws from the policy; return the rollout and the observation to go on from.

    `noise` `[steps, agents, action size]`, standard normal, is taken instead of draws from `generator`.
    """
    agents = env.worlds * env.drones
    tensors = agent_tensors(observation)
    kept = {key: torch.empty((steps, *value.shape), dtype=value.dtype) for key, value in tensors.items()}
    action_size = actor.log_std.shape[0]
    actions = torch.empty((steps, agents, action_size))
    log_probs, rewards = torch.empty((steps, agents)), torch.empty((steps, agents))
    dones, alive = (torch.empty((steps, agents), dtype=torch.bool) for _ in range(2))
    episodes: list[EpisodeMetrics] = []
    env_s = 0.0
    for t in range(steps):
        for key, value in tensors.items():
            kept[key][t] = value
        mean, log_std = actor(*actor_inputs(tensors)), actor.spread()
        draws = torch.randn((agents, action_size), generator=generator) if noise is None else noise[t]
        actions[t] = mean + log_std.exp() * draws
        log_probs[t] = log_probability(actions[t], mean, log_std)
        alive[t] = torch.from_numpy(env.alive.reshape(-1))
        began = time.perf_counter()
        step = env.step(env_actions(actions[t], env))
        env_s += time.perf_counter() - began
        rewards[t] = torch.from_numpy(step.reward.reshape(-1))
        died = alive[t] & ~torch.from_numpy(env.alive.reshape(-1))  # a world that starts anew has everyone alive again
        dones[t] = torch.from_numpy(np.repeat(step.done, env.drones)) | died
        episodes.extend(step.episodes)
        observation = step.observation
        tensors = agent_tensors(observation)
    last = {key: value.clone() for key, value in tensors.items()}
    return Rollout(kept, actions, log_probs, rewards, dones, last, alive, episodes, env_s), observation


def env_actions(actions: Tensor, env: Exploration) -> np.ndarray[Any, np.dtype[np.float32]]:
    """Return actions `[agents, size]` as the environment takes them, `[worlds, drones, size]` in [-1, 1]."""
    return actions.clamp(-1.0, 1.0).reshape(env.worlds, env.drones, -1).numpy()


@torch.no_grad()
def values_of(critic: Critic, rollout: Rollout, minibatch: int) -> tuple[Tensor, Tensor]:
    """Return the critic's values of all steps, `[steps, agents]`, and of the state after the last, `[agents]`."""
    flat = {key: value.flatten(0, 1) for key, value in rollout.observations.items()}
    count = rollout.rewards.numel()
    pieces = [
        critic(*(flat[key][i : i + minibatch] for key in (*OBSERVATION_KEYS, "level")))
        for i in range(0, count, minibatch)
    ]
    last = critic(*(rollout.last[key] for key in (*OBSERVATION_KEYS, "level")))
    return torch.cat(pieces).reshape(rollout.rewards.shape), last


def mean_of(records: Sequence[dict[str, float]]) -> dict[str, float]:
    """Return the mean of each number over records with the same keys."""
    return {key: float(np.mean([record[key] for record in records])) for key in records[0]} if records else {}
