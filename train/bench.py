"""How fast training goes here: agent-steps a second of rollout and update, and where an agent-step's time goes."""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import torch

from imagine.core.contract import LEVEL
from imagine.sim.exploration import Exploration
from imagine.sim.exploration_tick import STAGES
from imagine.train.curriculum import Curriculum
from imagine.train.learner import Learner
from imagine.train.networks import at_precision, compute_dtype
from imagine.train.ppo import update
from imagine.train.rollout import Recall, Rollout, collect, image_dtype, next_decisions, stored
from imagine.train.settings import TrainSettings
from imagine.train.values import values_of

Results = dict[str, dict[str, Any]]
_WARM_STEPS = 8


@dataclass
class _Watch:
    """Seconds that one thing took, round by round: by the wall clock, and of processor time of all threads."""

    wall_s: list[float] = field(default_factory=list)
    cpu_s: list[float] = field(default_factory=list)

    @contextmanager
    def running(self) -> Iterator[None]:
        """Count what happens within as a round."""
        wall, cpu = time.perf_counter(), time.process_time()
        yield
        if torch.cuda.is_available():  # what was begun there counts until it is done
            torch.cuda.synchronize()
        self.wall_s.append(time.perf_counter() - wall)
        self.cpu_s.append(time.process_time() - cpu)


class TrainingBench:
    """A run's environment and networks, without the run: flies rollouts, learns from them, and times the parts."""

    def __init__(self, settings: TrainSettings) -> None:
        """Get ready. Raises InputError where a level or the device is wrong."""
        self.settings = settings
        torch.set_num_threads(settings.run.threads or len(os.sched_getaffinity(0)))
        learner = Learner.create(settings)
        self.actor, self.critic = learner.actor, learner.critic
        self.optimisers, self.generator = learner.ppo, learner.generator
        self.env = Exploration(Curriculum(settings.curriculum, settings.practice).environment, settings.run.seed)
        self.observation = self.env.reset()
        self.recall = Recall.nothing(self.actor, self.env.worlds * self.env.drones)

    def run(self, rounds: int, progress: Callable[[str], None]) -> Results:
        """Fly and learn `rounds` times after a short warm-up; return medians over the rounds.

        `training` is the rate of rollout and update together, an agent-step being a decision, which may stand for
        several ticks of a drone; the other rows are microseconds an agent-step: `rollout`
        and its parts `env`, `acting` and `level_images` (which a critic or a centralised actor sees), `update` and its
        part `values`. Parts are measured apart from the whole, after it; but `env` within it, and so are the stages of
        its ticks, `env_fly` and so on: these are processor time, summed over threads, as all `cpu`.
        """
        progress("warm-up")
        rollout = self._collect(_WARM_STEPS)
        self._update(rollout)
        names = ("rollout", "update", "env", "level_images", "acting", "values")
        watches = {name: _Watch() for name in names}
        stages = {name: _Watch() for name in STAGES}
        self.env.time_stages()
        for number in range(rounds):
            progress(f"round {number + 1} of {rounds}")
            before = dict(self.env.stage_seconds)
            with watches["rollout"].running():
                rollout = self._collect(self.settings.ppo.rollout_steps)
            with watches["update"].running():
                self._update(rollout)
            watches["env"].wall_s.append(rollout.env_s)
            for name, stage in stages.items():
                stage.cpu_s.append(self.env.stage_seconds[name] - before[name])
            self._time_parts(rollout, watches)
        return self._results(rollout, watches, stages)

    def _collect(self, steps: int) -> Rollout:
        ppo = self.settings.ppo
        rollout, self.observation = collect(
            self.env, self.observation, self.actor, steps, self.generator, ppo.precision, self.recall,
            ppo.sequence_steps,
        )  # fmt: skip
        return rollout

    def _update(self, rollout: Rollout) -> None:
        update(self.actor, self.critic, self.optimisers, rollout, self.settings.ppo, self.generator)

    def _time_parts(self, rollout: Rollout, watches: dict[str, _Watch]) -> None:
        """Do again, each for itself, what a rollout and an update consist of, without the environment's steps."""
        ppo, recall = self.settings.ppo, self.recall.copy()
        steps = ppo.rollout_steps
        with torch.no_grad(), at_precision(ppo.precision, self.actor, self.critic):
            seen = [{key: value[t] for key, value in rollout.observations.items()} for t in range(steps)]
            with watches["acting"].running():
                for t in range(steps):
                    next_decisions(self.actor, {**seen[t], "alive": rollout.alive[t]}, recall, self.env.drones)
            with watches["level_images"].running():
                if LEVEL in seen[0]:
                    for _ in range(steps):
                        level = torch.from_numpy(self.observation.critic.reshape(-1, *seen[0][LEVEL].shape[1:]))
                        stored({LEVEL: level}, image_dtype(self.actor), self.actor.device)
            with watches["values"].running():
                values_of(self.actor, self.critic, rollout, ppo.minibatch)

    def _results(self, rollout: Rollout, watches: dict[str, _Watch], stages: dict[str, _Watch]) -> Results:
        per_round = rollout.alive.numel()
        both = (watches["rollout"], watches["update"])
        rates = [per_round / sum(pair) for pair in zip(*(watch.wall_s for watch in both), strict=True)]
        cpu_rates = [per_round / sum(pair) for pair in zip(*(watch.cpu_s for watch in both), strict=True)]
        results: Results = {
            "training": {
                "value": statistics.median(rates), "unit": "agent-steps/s", "low": min(rates), "high": max(rates),
                "per_cpu_s": statistics.median(cpu_rates),
                "drone_ticks_per_s": statistics.median(rates) * self.env.settings.action.decision_ticks,
                "rounds": len(rates), "worlds": self.env.worlds, "drones": self.env.drones,
                "precision": str(compute_dtype(self.settings.ppo.precision, self.actor.device)).removeprefix("torch."),
                "device": self.actor.device.type, "threads": torch.get_num_threads(),
            }
        }  # fmt: skip
        results |= {name: _microseconds(watch, per_round) for name, watch in watches.items()}
        results |= {
            f"env_{name}": {
                "value": 1e6 * statistics.median(stage.cpu_s) / per_round, "unit": "us an agent-step of CPU time",
            }
            for name, stage in stages.items()
        }  # fmt: skip
        results["parameters"] = {
            "value": sum(weight.numel() for weight in self.actor.parameters()),
            "critic": sum(weight.numel() for weight in self.critic.parameters()),
            "unit": "weights",
        }
        return results


def _microseconds(watch: _Watch, per_round: int) -> dict[str, Any]:
    row: dict[str, Any] = {"value": 1e6 * statistics.median(watch.wall_s) / per_round, "unit": "us an agent-step"}
    if watch.cpu_s:
        row["cpu"] = 1e6 * statistics.median(watch.cpu_s) / per_round
    return row


def bench_training(settings: TrainSettings, rounds: int, progress: Callable[[str], None]) -> Results:
    """Measure training as configured, see `TrainingBench.run`."""
    return TrainingBench(settings).run(rounds, progress)
