"""Rollouts flown by workers of Ray, each with a part of the worlds and a copy of the policy.

A world's fate depends on the seed, its key and the actions alone, and the noise of the actions is drawn by whoever asks
for a rollout: how many workers share the worlds changes only how sums over a batch are rounded.
"""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import itertools
import os
import sys
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from imagine.core.errors import InputError, WorkError
from imagine.sim.exploration import Exploration
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.train.joined_rollouts import joined
from imagine.train.networks import Actor
from imagine.train.ppo_settings import PpoSettings
from imagine.train.rollout import Recall, Rollout
from imagine.train.rollout_source import OwnRollouts
from imagine.train.study.cluster import ray_connection

_START_S = 600.0  # the first worker on a machine may have to compile the kernels
_COLLECT_S = 1800.0


class RolloutWorkerLost(WorkError):
    """A worker died or hangs; the run can go on from its last checkpoint."""


class RolloutWorkers:
    """Rollouts flown by `workers` workers of the cluster that this process is connected to, one CPU each."""

    def __init__(
        self, settings: ExplorationSettings, seed: int, ppo: PpoSettings, actor: Actor, workers: int, state: Any = None
    ) -> None:
        """Start the workers; `state` is what `state_dict` gave, of as many workers.

        Raises InputError where there are more workers than worlds, or `state` is of another number of them;
        RolloutWorkerLost where they do not start.
        """
        import ray

        if not 1 <= workers <= settings.worlds:
            raise InputError(f"run.rollout_workers: {workers} workers cannot share {settings.worlds} worlds")
        states = [None] * workers if state is None else state.get("workers", [])
        if len(states) != workers:
            raise InputError(
                f"run.rollout_workers: the run was saved with {len(states)} workers, not {workers}: leave it as it was"
            )
        self._parts = _parts(settings.worlds, workers)
        self._drones, self._ppo = settings.drones, ppo
        remote = ray.remote(num_cpus=1, max_restarts=0)(_Worker)
        shared = ray.put(on_cpu(actor))
        self._workers: list[Any] = [
            remote.remote(settings.model_copy(update={"worlds": len(keys)}), seed, list(keys), ppo, shared, own)
            for keys, own in zip(self._parts, states, strict=True)
        ]
        try:
            self._ask("ready", _START_S)
        except BaseException:
            self.close()
            raise

    def collect(self, actor: Actor, generator: torch.Generator) -> Rollout:
        """Fly a rollout in all worlds by draws from the policy as it is now. Raises RolloutWorkerLost."""
        import ray

        bounds = np.cumsum([0, *(len(keys) * self._drones for keys in self._parts)]).tolist()
        noise = actor.noise(self._ppo.rollout_steps, bounds[-1], generator).cpu()  # as one process draws it
        weights = ray.put({name: value.cpu() for name, value in actor.state_dict().items()})
        draws = [noise[:, first:last].clone() for first, last in itertools.pairwise(bounds)]
        rollout = joined(self._ask("collect", _COLLECT_S, [(weights, own) for own in draws]))
        return rollout if actor.device.type == "cpu" else rollout.to(actor.device)

    def set_level_weights(self, weights: Sequence[float]) -> None:
        """Draw the levels of coming episodes by these shares. Raises RolloutWorkerLost."""
        self._ask("set_level_weights", _COLLECT_S, [(list(weights),)] * len(self._workers))

    def state_dict(self) -> dict[str, Any]:
        """Return how all worlds go on and what drones remember, worker by worker. Raises RolloutWorkerLost."""
        return {"workers": self._ask("state_dict", _COLLECT_S)}

    def close(self) -> None:
        """End the workers."""
        import ray

        for worker in self._workers:
            with contextlib.suppress(Exception):  # it may be dead already, or the cluster gone
                ray.kill(worker)

    def _ask(self, method: str, deadline_s: float, arguments: Sequence[tuple[Any, ...]] | None = None) -> list[Any]:
        """Call a method of every worker and return what they answer, in the worlds' order."""
        import ray

        calls = [
            getattr(worker, method).remote(*own)
            for worker, own in zip(self._workers, arguments or [()] * len(self._workers), strict=True)
        ]
        try:
            answers: list[Any] = ray.get(calls, timeout=deadline_s)
        except ray.exceptions.GetTimeoutError as error:
            raise RolloutWorkerLost(f"a rollout worker does not answer within {deadline_s:g} s") from error
        except ray.exceptions.RayActorError as error:
            raise RolloutWorkerLost(f"a rollout worker died: {str(error).splitlines()[0]}") from error
        return answers


@contextlib.contextmanager
def rollout_workers(
    settings: ExplorationSettings, seed: int, ppo: PpoSettings, actor: Actor, workers: int, state: Any = None
) -> Iterator[RolloutWorkers]:
    """Start rollout workers for a while: in the cluster this process is in already, or in one of its own."""
    with contextlib.ExitStack() as stack:
        ray = sys.modules.get("ray")  # to import it is to settle where it listens: that is ray_connection's to do
        if ray is None or not ray.is_initialized():
            stack.enter_context(ray_connection(cpus=workers))
        started = RolloutWorkers(settings, seed, ppo, actor, workers, state)
        stack.callback(started.close)
        yield started


def on_cpu(actor: Actor) -> Actor:
    """Return a copy for workers, which fly on processors; the actor that learns stays where it is."""
    return copy.deepcopy(actor).cpu()


def _parts(worlds: int, workers: int) -> list[range]:
    """Split worlds into contiguous parts whose sizes differ by one at most."""
    bounds = [worlds * part // workers for part in range(workers + 1)]
    return [range(first, last) for first, last in itertools.pairwise(bounds)]


class _Worker:
    """What runs in a worker's process."""

    def __init__(
        self,
        settings: ExplorationSettings,
        seed: int,
        keys: Sequence[int],
        ppo: PpoSettings,
        actor: Actor,
        state: dict[str, Any] | None,
    ) -> None:
        os.environ["IMAGINE_THREADS"] = "1"
        torch.set_num_threads(1)
        env = Exploration(settings, seed, world_keys=keys)
        recall = Recall.nothing(actor, env.worlds * env.drones)
        if state is None:
            observation = env.reset()
        else:
            observation, recall = env.load_state_dict(state["env"]), Recall.restored(state["recall"], actor)
        self._actor, self._source, self._keys = actor, OwnRollouts(env, observation, recall, ppo), list(keys)

    def ready(self) -> bool:
        """Answer, once everything is loaded."""
        return True

    def collect(self, weights: dict[str, Tensor], noise: Tensor) -> Rollout:
        """Fly as many steps as there is noise for, `[steps, agents, taken size]`; episodes name worlds by their keys.

        Places would not tell the worlds of several workers apart, which all have the same seed.
        """
        self._actor.load_state_dict(weights)
        rollout = self._source.collect(self._actor, torch.Generator(), noise)
        episodes = [dataclasses.replace(episode, world=self._keys[episode.world]) for episode in rollout.episodes]
        return dataclasses.replace(rollout, episodes=episodes)

    def set_level_weights(self, weights: list[float]) -> None:
        """Draw the levels of coming episodes by these shares."""
        self._source.set_level_weights(weights)

    def state_dict(self) -> dict[str, Any]:
        """Return the worlds' state and what drones remember."""
        return self._source.state_dict()
