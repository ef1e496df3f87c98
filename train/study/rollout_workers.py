"""Rollouts flown by workers of Ray, each with a part of the worlds and a copy of the policy.

A world's fate depends on the seed, its key and the actions alone, and the noise of the actions is drawn by whoever asks
for a rollout: how many workers share the worlds changes only how sums over a batch are rounded.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import sys
from collections.abc import Iterator, Sequence
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from imagine.core.errors import InputError, WorkError
from imagine.sim.exploration import Exploration
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.train.networks import Actor
from imagine.train.rollout import Rollout, collect
from imagine.train.study.cluster import ray_connection

_STEPPED = ("actions", "log_probs", "rewards", "dones", "alive")  # tensors of a rollout, [steps, agents, ...]
_START_S = 600.0  # the first worker on a machine may have to compile the kernels
_COLLECT_S = 1800.0


class RolloutWorkerLost(WorkError):
    """A worker died or hangs; the run can go on from its last checkpoint."""


class RolloutSource(Protocol):
    """Whoever flies rollouts. Rollouts go on where the one before ended."""

    def collect(self, actor: Actor, steps: int, generator: torch.Generator) -> Rollout:
        """Fly `steps` steps in all worlds by draws from the policy as it is now."""

    def state_dict(self) -> Any:
        """Return what decides the next episodes, as the environments' own."""


class OwnRollouts:
    """Rollouts flown by this process."""

    def __init__(self, env: Exploration) -> None:
        self._env = env
        self._observation = env.reset()

    def collect(self, actor: Actor, steps: int, generator: torch.Generator) -> Rollout:
        """Fly `steps` steps in all worlds by draws from the policy as it is now."""
        rollout, self._observation = collect(self._env, self._observation, actor, steps, generator)
        return rollout

    def state_dict(self) -> Any:
        """Return what decides the next episodes, as the environment's own."""
        return self._env.state_dict()


class RolloutWorkers:
    """Rollouts flown by `workers` workers of the cluster that this process is connected to, one CPU each."""

    def __init__(self, settings: ExplorationSettings, seed: int, actor: Actor, workers: int, state: Any = None) -> None:
        """Start the workers; `state` is what `state_dict` gave, of as many workers.

        Raises InputError where there are more workers than worlds, or `state` is of another number of them;
        RolloutWorkerLost where they do not start.
        """
        import ray

        if not 1 <= workers <= settings.worlds:
            raise InputError(f"run.rollout_workers: {workers} workers cannot share {settings.worlds} worlds")
        states = [None] * workers if state is None else state["workers"]
        if len(states) != workers:
            raise InputError(f"run.rollout_workers: the run was saved with {len(states)} workers, not {workers}")
        self._parts = _parts(settings.worlds, workers)
        self._drones, self._action_size = settings.drones, settings.action.size
        remote = ray.remote(num_cpus=1, max_restarts=0)(_Worker)
        shared = ray.put(actor)
        self._workers: list[Any] = [
            remote.remote(settings.model_copy(update={"worlds": len(keys)}), seed, list(keys), shared, own)
            for keys, own in zip(self._parts, states, strict=True)
        ]
        try:
            self._ask("ready", _START_S)
        except BaseException:
            self.close()
            raise

    def collect(self, actor: Actor, steps: int, generator: torch.Generator) -> Rollout:
        """Fly `steps` steps in all worlds by draws from the policy as it is now. Raises RolloutWorkerLost."""
        import ray

        agents = sum(map(len, self._parts)) * self._drones
        # drawn step by step, as one process draws them
        noise = [torch.randn((agents, self._action_size), generator=generator).numpy() for _ in range(steps)]
        weights = ray.put({name: value.numpy() for name, value in actor.state_dict().items()})
        bounds = np.cumsum([0, *(len(keys) * self._drones for keys in self._parts)])
        draws = [np.stack([step[a:b] for step in noise]) for a, b in itertools.pairwise(bounds)]
        pieces = self._ask("collect", _COLLECT_S, [(weights, own) for own in draws])
        return _joined(pieces)

    def state_dict(self) -> Any:
        """Return what decides the next episodes, worker by worker."""
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
    settings: ExplorationSettings, seed: int, actor: Actor, workers: int, state: Any = None
) -> Iterator[RolloutWorkers]:
    """Start rollout workers for a while: in the cluster this process is in already, or in one of its own."""
    with contextlib.ExitStack() as stack:
        ray = sys.modules.get("ray")  # to import it is to settle where it listens: that is ray_connection's to do
        if ray is None or not ray.is_initialized():
            stack.enter_context(ray_connection(cpus=workers))
        started = RolloutWorkers(settings, seed, actor, workers, state)
        stack.callback(started.close)
        yield started


def _parts(worlds: int, workers: int) -> list[range]:
    """Split worlds into contiguous parts whose sizes differ by one at most."""
    bounds = [worlds * part // workers for part in range(workers + 1)]
    return [range(first, last) for first, last in itertools.pairwise(bounds)]


class _Worker:
    """What runs in a worker's process. Tensors travel as arrays, which Ray shares without copying."""

    def __init__(self, settings: ExplorationSettings, seed: int, keys: Sequence[int], actor: Actor, state: Any) -> None:
        os.environ["IMAGINE_THREADS"] = "1"
        torch.set_num_threads(1)
        self._env = Exploration(settings, seed, world_keys=keys)
        if state is not None:
            self._env.load_state_dict(state)
        self._observation = self._env.reset()
        self._actor = actor

    def ready(self) -> bool:
        """Answer, once everything is loaded."""
        return True

    def collect(self, weights: dict[str, NDArray[Any]], noise: NDArray[np.float32]) -> dict[str, Any]:
        """Fly as many steps as there is noise for, `[steps, agents, action size]`."""
        self._actor.load_state_dict({name: torch.from_numpy(value.copy()) for name, value in weights.items()})
        draws = torch.from_numpy(noise.copy())
        rollout, self._observation = collect(
            self._env, self._observation, self._actor, len(draws), torch.Generator(), draws
        )
        return {
            **{name: getattr(rollout, name).numpy() for name in _STEPPED},
            "observations": {name: value.numpy() for name, value in rollout.observations.items()},
            "last": {name: value.numpy() for name, value in rollout.last.items()},
            "episodes": rollout.episodes,
            "env_s": rollout.env_s,
        }

    def state_dict(self) -> Any:
        """Return the environment's state."""
        return self._env.state_dict()


def _joined(pieces: Sequence[dict[str, Any]]) -> Rollout:
    """Put the workers' parts of a rollout together; they worked at the same time, so the longest counts."""

    def stepped(arrays: Sequence[NDArray[Any]]) -> Tensor:
        return torch.from_numpy(np.concatenate(arrays, axis=1))

    observations, last = pieces[0]["observations"], pieces[0]["last"]
    return Rollout(
        observations={name: stepped([piece["observations"][name] for piece in pieces]) for name in observations},
        **{name: stepped([piece[name] for piece in pieces]) for name in _STEPPED},
        last={name: torch.from_numpy(np.concatenate([piece["last"][name] for piece in pieces])) for name in last},
        episodes=[episode for piece in pieces for episode in piece["episodes"]],
        env_s=max(piece["env_s"] for piece in pieces),
    )
