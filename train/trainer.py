"""A training run from start to end: imitation of a planner, PPO, and rehearsal, saved as it goes."""

from __future__ import annotations

import copy
import logging
import math
import os
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from imagine.core.errors import InputError, WorkError
from imagine.sim.exploration import Exploration, Observation
from imagine.train.baselines import baseline
from imagine.train.checkpoint import PHASES, Checkpoint, Phase, check_same_network
from imagine.train.curriculum import Curriculum
from imagine.train.final_evaluation import write_final_evaluation
from imagine.train.imitation import LabelSettings, collect_labels, label_buffer, learn
from imagine.train.learner import Learner
from imagine.train.networks import Actor
from imagine.train.pilots import Pilot
from imagine.train.policies import PolicyPilot, policy_of
from imagine.train.ppo import update
from imagine.train.rehearsal import RehearsalPilot
from imagine.train.report import RecentEpisodes, Report, Reporter
from imagine.train.rollout import Recall
from imagine.train.rollout_source import OwnRollouts, RolloutSource
from imagine.train.run_folder import RunFolder, run_record
from imagine.train.settings import TrainSettings

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class RunResult:
    """How a run ended: finished, or stopped early by a signal and ready to be resumed."""

    folder: Path
    checkpoint: Path
    agent_steps: int
    finished: bool
    levels: dict[str, dict[str, float]]


_REHEARSAL_SEED = 7_000_003  # other worlds than PPO's


@dataclass
class Trainer:
    """A run in memory. `run` goes through its phases; `checkpoint` is where it stands."""

    settings: TrainSettings
    resumed: Checkpoint | None = None
    agent_steps: dict[str, int] = field(default_factory=lambda: dict.fromkeys(PHASES, 0))
    updates: int = 0
    phase: Phase = "imitation"

    def __post_init__(self) -> None:
        if self.resumed is not None:
            check_same_network(self.resumed, self.settings, "checkpoint")
        self.curriculum = Curriculum(self.settings.curriculum, self.settings.practice)
        if self.resumed is not None:
            self.curriculum.load_state_dict(self.resumed.progress["curriculum"])
        self.env = Exploration(self.curriculum.environment, self.settings.run.seed)
        # Set here, whatever OMP_NUM_THREADS says: sums are split by thread, and equal settings must give equal runs.
        torch.set_num_threads(self.settings.run.threads or len(os.sched_getaffinity(0)))
        self.learner = Learner.create(self.settings)
        env = self.settings.env
        self.episodes = RecentEpisodes(env.episode_ticks, self.curriculum.levels, env.stop_coverage)
        self._began, self._wall_before_s = time.monotonic(), 0.0
        self._source: RolloutSource | None = None
        self._last: Checkpoint | None = None
        self._take_up(None if self.resumed is None else self.resumed.env)
        if self.resumed is not None:
            self.learner.restore(self.resumed)
            self.agent_steps |= self.resumed.agent_steps
            self.updates, self.phase = self.resumed.updates, self.resumed.phase
            longer = [phase for phase in ("ppo", "rehearsal") if self.agent_steps[phase] < self._total(phase)]
            if self.agent_steps["rehearsal"] and longer:
                raise InputError(
                    f"{longer[0]}.agent_steps: this checkpoint has been rehearsed; for more PPO, or rehearsal, resume "
                    "from checkpoints/improved.pt"
                )
            if self.phase == "rehearsal" and "ppo" in longer:
                self.phase = "ppo"
            self._wall_before_s = self.resumed.wall_s
            self.episodes.load_state_dict(self.resumed.progress["episodes"])

    def _total(self, phase: Phase) -> int:
        """Return the decisions of all drones that a phase is to come to."""
        return int(getattr(self.settings, phase).agent_steps)

    def _take_up(self, state: dict[str, Any] | None) -> None:
        """Let the environment of this process go on from a checkpoint's state, or begin."""
        workers, saved = self.settings.run.rollout_workers, len((state or {}).get("workers", []))
        if state is not None and saved != workers:
            raise InputError(f"run.rollout_workers: the run was saved with {saved} workers, not {workers}")
        self._recall = Recall.nothing(self.learner.actor, self.env.worlds * self.env.drones)
        if state is None or saved:
            self._observation = self.env.reset()
        else:
            self._observation = self.env.load_state_dict(state["env"])
            self._recall = Recall.restored(state["recall"], self.learner.actor)

    def run(self, folder: RunFolder, report: Reporter, stop: threading.Event) -> RunResult:
        """Train until all phases are done or `stop` is set; leave a checkpoint either way.

        But for a stop in the first phase: it takes minutes, its labels are many times the size of a checkpoint, and a
        run that is resumed there begins anew, and so comes to the same; likewise in the last phase. Raises WorkError
        where training diverges, naming the last good checkpoint.
        """
        self._folder, self._report, self._stop = folder, report, stop
        self._began = self._saved = time.monotonic()
        latest = folder.checkpoints / "latest.pt"
        try:
            if self.phase == "imitation":
                self._imitate()
            if self.phase == "ppo":
                self._improve()
            if self.phase == "rehearsal":
                self._rehearse()
        except WorkError as error:
            where = f"; the last good checkpoint is {latest}" if latest.exists() else ""
            raise WorkError(f"{error}{where}") from error
        finished = not stop.is_set()
        checkpoint = latest
        if self._last is not None:
            checkpoint = folder.save(self._last, "final" if finished else None)
        if finished and self.settings.run.final_episodes:
            self.learner.actor.set_momentum(self.settings.network.choice_momentum)
            policy = policy_of(self.learner.actor, self.settings.run.name, self.settings.env)
            told = {"checkpoint": checkpoint.name, "agent_steps": self.agent_steps}
            write_final_evaluation(folder.path, policy, self.settings, self.curriculum.levels, told, stop)
        return RunResult(folder.path, checkpoint, sum(self.agent_steps.values()), finished, self.episodes.means())

    def _imitate(self) -> None:
        """Let the student fly and learn from the planner's labels, round after round."""
        settings = self.settings.imitation
        teacher = baseline(settings.teacher, self.settings.run.seed)
        self._observation = self._learn_labels(self.env, self._observation, self._recall, teacher, settings)
        if not self._stop.is_set():
            self.phase, self.updates = "ppo", 0
            if not self.settings.run.rollout_workers:
                self._source = self._own_rollouts()
            self._folder.save(self.checkpoint(), "imitated")

    def _rehearse(self) -> None:
        """Let the policy learn levels by heart from their launch points, and itself elsewhere, in worlds of its own."""
        settings, run, learner = self.settings.rehearsal, self.settings.run, self.learner
        if self.agent_steps["rehearsal"] >= settings.agent_steps:
            return
        as_flown = self.curriculum.environment.model_copy(update={"action": self.settings.env.action})
        environment = settings.environment(as_flown)
        env = Exploration(environment, run.seed + _REHEARSAL_SEED)
        learner.actor.set_momentum(self.settings.network.choice_momentum)
        self.episodes = RecentEpisodes(environment.episode_ticks, self.curriculum.levels, environment.stop_coverage)
        before = copy.deepcopy(learner.actor)
        teacher = RehearsalPilot(
            PolicyPilot(policy_of(before, run.name, environment)),
            baseline(settings.launch_point_teacher, run.seed), baseline(settings.late_teacher, run.seed),
            settings.late_coverage,
        )  # fmt: skip
        learner.imitation.state.clear()
        recall = Recall.nothing(learner.actor, env.worlds * env.drones)
        self._learn_labels(env, env.reset(), recall, teacher, settings, before)
        self._source = None
        self._last = None if self._stop.is_set() else self.checkpoint()

    def _learn_labels(
        self, env: Exploration, observation: Observation, recall: Recall, teacher: Pilot, settings: LabelSettings,
        reference: Actor | None = None,
    ) -> Observation:  # fmt: skip
        """Gather labels and learn from them, round after round, until the phase is over; return what is seen then."""
        learner, phase, total = self.learner, self.phase, self._total(self.phase)
        every = 1 if learner.actor.state_size else settings.label_every
        buffer = label_buffer(learner.actor, settings.buffer_samples)
        teacher.begin(env)
        while self.agent_steps[phase] < total and not self._stop.is_set():
            done_share = self.agent_steps[phase] / total
            began = time.monotonic()
            until = max(settings.planner_share_until, 1e-9)
            planner_share = settings.planner_share * max(0.0, 1.0 - done_share / until)
            observation, episodes, labels = collect_labels(
                env, observation, learner.actor, teacher, buffer, settings.round_steps, planner_share, learner.rng,
                learner.generator, settings.precision, recall, settings.student_draws, every,
            )  # fmt: skip
            collected = time.monotonic()
            for group in learner.imitation.param_groups:
                group["lr"] = settings.lr * (1.0 - (1.0 - settings.final_lr_share) * done_share)
            loss = learn(learner.actor, learner.imitation, buffer, settings, learner.generator, reference)
            steps = settings.round_steps * env.worlds * env.drones
            asked = math.ceil(settings.round_steps / every) * env.worlds * env.drones
            numbers = {"loss": loss, "planner_share": planner_share, "labelled_share": labels / asked}
            seconds = {"collect": collected - began, "learn": time.monotonic() - collected}
            self._after_update(env, steps, total, numbers, seconds, episodes)
        return observation

    def _own_rollouts(self) -> OwnRollouts:
        return OwnRollouts(self.env, self._observation, self._recall, self.settings.ppo)

    @contextmanager
    def _rollouts(self) -> Iterator[RolloutSource]:
        """Give whoever flies rollouts, for as long as it takes."""
        run, learner = self.settings.run, self.learner
        with ExitStack() as stack:
            if run.rollout_workers:
                from imagine.train.rollout_workers import rollout_workers  # brings Ray

                state = None if self.resumed is None else self.resumed.env
                self._source = stack.enter_context(
                    rollout_workers(
                        self.curriculum.environment, run.seed, self.settings.ppo, learner.actor, run.rollout_workers,
                        state,
                    )
                )  # fmt: skip
            self._source = self._source or self._own_rollouts()
            yield self._source

    def _improve(self) -> None:
        """Fly rollouts and improve the policy by PPO; the critic alone learns during its warm-up."""
        settings, learner = self.settings.ppo, self.learner
        with self._rollouts() as source:
            while self.agent_steps["ppo"] < settings.agent_steps and not self._stop.is_set():
                began = time.monotonic()
                rollout = source.collect(learner.actor, learner.generator)
                collected = time.monotonic()
                numbers = update(
                    learner.actor, learner.critic, learner.ppo, rollout, settings, learner.generator,
                    policy_moves=self.updates >= settings.critic_warmup_updates,
                    progress=self.agent_steps["ppo"] / settings.agent_steps, number=self.updates,
                )  # fmt: skip
                seconds = {
                    "env": rollout.env_s,
                    "act": collected - began - rollout.env_s,
                    "update": time.monotonic() - collected,
                }
                self._after_update(
                    source, rollout.agent_steps, settings.agent_steps, numbers, seconds, rollout.episodes
                )
            if not self._stop.is_set() and self.settings.rehearsal.agent_steps:
                self.phase, self.updates = "rehearsal", 0
            self._last = self.checkpoint()  # while its workers live
        if self.phase == "rehearsal":
            self._folder.save(self._last, "improved")

    def _after_update(
        self, flown: Exploration | RolloutSource, steps: int, total: int, numbers: dict[str, float],
        seconds: dict[str, float], episodes: list[Any],
    ) -> None:  # fmt: skip
        """Count, report, and save when it is time; what the curriculum changes is for the worlds that are flown."""
        self.updates += 1
        self.agent_steps[self.phase] += steps
        self.episodes.add(episodes)
        events = []
        if self.phase != "rehearsal":  # whose worlds and ends are other ones
            events = self.curriculum.observe(episodes, sum(self.agent_steps.values()))
        for event in events:
            logger.log(logging.WARNING if event.kind == "given up" else logging.INFO, "%s", event)
        if events:
            flown.set_level_weights(self.curriculum.level_weights())
        report = Report(
            phase=self.phase,
            agent_steps=sum(self.agent_steps.values()),
            phase_steps=self.agent_steps[self.phase],
            phase_total=total,
            numbers=numbers,
            levels=self.episodes.means(),
            drones=self.episodes.drone_means(),
            paradigm=self.settings.network.paradigm,
            steps_per_s=steps / sum(seconds.values()),
            seconds=seconds,
            wall_s=self._wall_s(),
        )
        self._folder.log(report.agent_steps, {**report.scalars(), **self.curriculum.scalars()})
        self._report(report)
        if self.phase == "ppo" and time.monotonic() - self._saved >= self.settings.run.checkpoint_every_s:
            self._saved = time.monotonic()
            self._folder.save(self.checkpoint())

    def checkpoint(self) -> Checkpoint:
        """Return the state of the run."""
        learner = self.learner
        return Checkpoint(
            settings=self.settings,
            phase=self.phase,
            agent_steps=dict(self.agent_steps),
            updates=self.updates,
            wall_s=self._wall_s(),
            actor=learner.actor.state_dict(),
            critic=learner.critic.state_dict(),
            optimisers=learner.optimiser_states(),
            rngs=learner.draws(),
            env=None if self._source is None else self._source.state_dict(),
            progress={
                "episodes": self.episodes.state_dict(),
                "curriculum": self.curriculum.state_dict(),
            },
            record={**run_record(self.settings), "levels": self.episodes.summary()},
        )

    def _wall_s(self) -> float:
        return self._wall_before_s + time.monotonic() - self._began
