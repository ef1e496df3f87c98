"""Fly the policy in all worlds for a while and keep what PPO learns from."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from imagine.core.contract import LEVEL
from imagine.sim.exploration import Exploration, Observation, Step
from imagine.sim.metrics import EpisodeMetrics
from imagine.train.networks import Actor, Decisions, Precision, at_precision
from imagine.train.networks.actor import Seen


@dataclass
class Recall:
    """What the drones of a batch of worlds remember between two decisions; whoever flies them carries it along.

    `state` `[agents, state size]`; `starts` bool `[agents]` tells whose episode begins with the next decision, so that
    its state no longer counts.
    """

    state: Tensor
    starts: Tensor

    @staticmethod
    def nothing(actor: Actor, agents: int) -> Recall:
        """Return what is remembered where all episodes begin."""
        device = actor.device
        return Recall(
            torch.zeros((agents, actor.state_size), device=device), torch.ones(agents, dtype=torch.bool, device=device)
        )

    @staticmethod
    def restored(state: dict[str, NDArray[Any]], actor: Actor) -> Recall:
        """Return what `state_dict` gave, where the actor is."""
        return Recall(*(torch.from_numpy(state[name]).to(actor.device) for name in ("state", "starts")))

    def state_dict(self) -> dict[str, NDArray[Any]]:
        """Return it as arrays, to be saved."""
        return {"state": self.state.cpu().numpy(), "starts": self.starts.cpu().numpy()}

    def copy(self) -> Recall:
        """Return it as it is now."""
        return Recall(self.state.clone(), self.starts.clone())

    def to(self, device: torch.device) -> Recall:
        """Return it on another device."""
        return Recall(self.state.to(device), self.starts.to(device))


@dataclass
class Rollout:
    """Steps of all drones of all worlds; tensors `[steps, agents, ...]`, agents = worlds x drones, in that order.

    `alive` tells which drones acted: what a dead one is said to have done counts for nothing. `dones[t]` tells that a
    drone's own episode ended with step t, by its death or with the world's, and `truncated[t]` that only the time limit
    ended it, while it still flew (`cut_off`). `last` holds the observation after the last step, `[agents, ...]`, and
    `recall` what was remembered then; `level` images are the critic's own (and a centralised actor's); `env_s` is the
    time the environment took. Images are kept in half precision, channels last: they are what costs memory, and the
    policy acts by them as they are kept.

    `actions` are what was drawn: actions, or the numbers of frontiers (`Actor.flown`).

    For actors with a memory, `starts[t]` tells whose episode began with step t, and `states` `[chunks, agents, size]`
    what was remembered before each `sequence_steps` steps.
    """

    observations: Seen
    actions: Tensor
    log_probs: Tensor
    rewards: Tensor
    dones: Tensor
    last: Seen
    alive: Tensor
    episodes: list[EpisodeMetrics] = field(default_factory=list)
    env_s: float = 0.0
    truncated: Tensor | None = None
    drones: int = 1
    starts: Tensor | None = None
    states: Tensor | None = None
    recall: Recall | None = None

    @property
    def agent_steps(self) -> int:
        """Decisions taken, over all drones."""
        return int(self.alive.sum())

    @property
    def sequence_steps(self) -> int:
        """Steps that are learned from together; 1 without memory."""
        return 1 if self.states is None else self.actions.shape[0] // self.states.shape[0]

    def to(self, device: torch.device) -> Rollout:
        """Return the rollout on another device."""
        moved: dict[str, Any] = {}
        for key in fields(self):
            value = getattr(self, key.name)
            if isinstance(value, Tensor | Recall):
                moved[key.name] = value.to(device)
            elif key.name in ("observations", "last"):
                moved[key.name] = {name: part.to(device) for name, part in value.items()}
        return replace(self, **moved)


def policy_tensors(observation: Observation) -> Seen:
    """Return what the policy sees, `[worlds, drones, ...]`, as tensors `[agents, ...]`, good as long as it is."""
    return {key: torch.from_numpy(array.reshape(-1, *array.shape[2:])) for key, array in observation.policy.items()}


def agent_tensors(observation: Observation, sees_level: bool = True) -> Seen:
    """Return `policy_tensors`, and the images of the whole level as `level` where anybody sees them."""
    tensors = policy_tensors(observation)
    if sees_level:
        level = observation.critic
        tensors[LEVEL] = torch.from_numpy(level.reshape(-1, *level.shape[2:]))
    return tensors


def living(env: Exploration) -> Tensor:
    """Return who still flies, bool `[agents]`."""
    return torch.from_numpy(env.alive.reshape(-1).copy())


def estimates(env: Exploration) -> Tensor:
    """Return where drones take themselves to be, `[agents, 3]`."""
    return torch.from_numpy(env.estimates.reshape(-1, 3))


def stored(tensors: Seen, dtype: torch.dtype, device: torch.device) -> Seen:
    """Return an observation as rollouts keep it: on the device of the networks, images `dtype` and channels last."""
    return {
        key: value.to(device, dtype).contiguous(memory_format=torch.channels_last)
        if value.ndim == 4
        else value.to(device, copy=True)
        for key, value in tensors.items()
    }


def store(tensors: Seen, room: Seen, t: int) -> Seen:
    """Write an observation into step t of `room`, and return it as it is kept there."""
    for key, value in tensors.items():
        kept = room[key][t]
        kept.copy_(value.to(kept.device, kept.dtype))  # first the numbers, then the layout: the quickest order
    return {key: value[t] for key, value in room.items()}


def room_for(steps: int, tensors: Seen) -> Seen:
    """Return room for `steps` of what `stored` gives, `[steps, ...]`, images channels last."""
    room = {}
    for key, value in tensors.items():
        layout = torch.channels_last if value.ndim == 4 else torch.contiguous_format
        size = (steps * value.shape[0], *value.shape[1:])
        flat = torch.empty(size, dtype=value.dtype, device=value.device, memory_format=layout)
        room[key] = flat.view(steps, value.shape[0], *value.shape[1:])
    return room


def image_dtype(actor: Actor) -> torch.dtype:
    """Return how images are kept: as the network computes, or in half the space where that is float32."""
    return torch.bfloat16 if actor.dtype == torch.bfloat16 else torch.float16


def chunk_steps(steps: int, wanted: int) -> int:
    """Return the largest number of steps, at most `wanted`, that a rollout of `steps` is a multiple of."""
    return next(length for length in range(min(wanted, steps), 0, -1) if steps % length == 0)


@torch.no_grad()
def collect(
    env: Exploration,
    observation: Observation,
    actor: Actor,
    steps: int,
    generator: torch.Generator,
    precision: Precision = "float32",
    recall: Recall | None = None,
    sequence_steps: int = 16,
    noise: Tensor | None = None,
) -> tuple[Rollout, Observation]:
    """Act `steps` times by draws from the policy; return the rollout and the observation to go on from.

    `noise`, as `Actor.noise` gives it, is taken instead of draws from `generator`. `recall` is what is remembered so
    far, and is brought up to date; without one everybody's episode begins. What is learned from together are
    `sequence_steps` steps, or as many fewer as divide `steps`.
    """
    with at_precision(precision, actor):
        recall = recall or Recall.nothing(actor, env.worlds * env.drones)
        if noise is None:
            noise = actor.noise(steps, env.worlds * env.drones, generator)
        return _collect(env, observation, actor, noise, recall, chunk_steps(steps, sequence_steps))


def _collect(
    env: Exploration,
    observation: Observation,
    actor: Actor,
    noise: Tensor,
    recall: Recall,
    chunk: int,
) -> tuple[Rollout, Observation]:
    steps, agents, device = len(noise), env.worlds * env.drones, actor.device
    images, sees_level = image_dtype(actor), actor.paradigm != "dtde"
    kept = room_for(steps, stored(agent_tensors(observation, sees_level), images, device))
    actions = torch.empty((steps, agents, actor.taken_size), device=device)
    log_probs, rewards = (torch.empty((steps, agents), device=device) for _ in range(2))
    dones, alive, truncated = (torch.empty((steps, agents), dtype=torch.bool, device=device) for _ in range(3))
    starts, states = (
        (torch.empty((steps, agents), dtype=torch.bool, device=device), []) if actor.state_size else (None, [])
    )
    episodes: list[EpisodeMetrics] = []
    env_s = 0.0
    for t in range(steps):
        seen = store(agent_tensors(observation, sees_level), kept, t)
        flying = env.alive.copy()
        alive[t] = torch.from_numpy(flying.reshape(-1))
        if starts is not None:
            starts[t] = recall.starts
            if t % chunk == 0:
                states.append(recall.state.clone())
        decisions = next_decisions(actor, {**seen, "alive": alive[t]}, recall, env.drones)
        actions[t], log_probs[t] = actor.draw(decisions, noise[t], seen, estimates(env))
        began = time.perf_counter()
        step = env.step(env_actions(actor.flown(seen, actions[t]), env))
        env_s += time.perf_counter() - began
        ended = np.broadcast_to(step.done[:, None], flying.shape)
        died = flying & ~env.alive  # a world that starts anew has everyone alive again
        rewards[t] = torch.from_numpy(step.reward.reshape(-1))
        dones[t] = torch.from_numpy((ended | died).reshape(-1))
        truncated[t] = torch.from_numpy((flying & cut_off(step)).reshape(-1))
        recall.starts = torch.from_numpy(ended.reshape(-1).copy()).to(device)
        episodes.extend(step.episodes)
        observation = step.observation
    last = stored(agent_tensors(observation, sees_level), images, device)
    rollout = Rollout(
        kept, actions, log_probs, rewards, dones, {**last, "alive": living(env).to(device)}, alive, episodes, env_s,
        truncated, env.drones, starts, torch.stack(states) if states else None, recall.copy(),
    )  # fmt: skip
    return rollout, observation


def next_decisions(actor: Actor, seen: Seen, recall: Recall, drones: int) -> Decisions:
    """Return the next decisions of all agents, and take what they leave to remember into `recall`."""
    if not actor.state_size:
        return actor.decide(seen, drones=drones)
    decisions = actor.decide(seen, recall.state, recall.starts[None], drones)
    recall.state = decisions.state
    return decisions


def cut_off(step: Step) -> NDArray[np.bool_]:
    """Tell whose episode the time limit cut off, bool `[worlds, drones]`.

    Any other end is the end: a level covered, no frontier left, everyone down, or the drone's own death, even where the
    limit comes with the same step. Only what the limit cut off would have gone on to earn (Pardo et al. 2018).
    """
    cut = np.zeros(step.reward.shape, np.bool_)
    for episode in step.episodes:
        cut[episode.world] = step.late[episode.world] & (episode.alive_ticks == episode.ticks)
    return cut


def env_actions(actions: Tensor, env: Exploration) -> NDArray[np.float32]:
    """Return actions `[agents, size]` as the environment takes them, `[worlds, drones, size]` in [-1, 1]."""
    wanted: NDArray[np.float32] = actions.clamp(-1.0, 1.0).reshape(env.worlds, env.drones, -1).cpu().numpy()
    return wanted


def mean_of(records: Sequence[dict[str, float]]) -> dict[str, float]:
    """Return the mean of each number over the records that have it."""
    keys = dict.fromkeys(key for record in records for key in record)
    return {key: float(np.mean([record[key] for record in records if key in record])) for key in keys}
