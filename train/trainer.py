"""A training run from start to end: imitation of the frontier planner, then PPO, saved as it goes."""

from __future__ import annotations

import copy
import json
import logging
import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import torch

from imagine.core.errors import InputError
from imagine.sim.exploration import Exploration
from imagine.train.atomic_file import write_atomically
from imagine.train.checkpoint import Checkpoint, Phase, load_checkpoint, load_weights
from imagine.train.curriculum import Curriculum
from imagine.train.evaluation import evaluate
from imagine.train.imitation import LabelBuffer, collect_labels, learn
from imagine.train.networks import Actor, Critic
from imagine.train.policies import policy_of
from imagine.train.ppo import Optimisers, update
from imagine.train.report import LogReporter, RecentEpisodes, Report, Reporter
from imagine.train.rollout import collect
from imagine.train.run_folder import RunFolder, run_record
from imagine.train.settings import TrainSettings, load_train_settings

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class RunResult:
    """How a run ended: finished, or stopped early by a signal and ready to be resumed."""

    folder: Path
    checkpoint: Path
    agent_steps: int
    finished: bool
    levels: dict[str, dict[str, float]]


def train(
    config: Path | None,
    overrides: tuple[str, ...] = (),
    resume: Path | None = None,
    report: Reporter | None = None,
) -> RunResult:
    """Run a training from a configuration, or go on with the run in the folder `resume`.

    SIGINT and SIGTERM end it cleanly after the update in progress, with a checkpoint. Raises InputError for bad
    settings or checkpoints, WorkError when training diverges or the disk is full.
    """
    checkpoint = None
    if resume is not None:
        if config is not None:
            raise InputError("a resumed run has its configuration already: give CONFIG or --resume, not both")
        checkpoint = load_checkpoint(resume)
        settings = load_train_settings(_run_path(resume) / "config.yaml", overrides)
    else:
        settings = load_train_settings(config, overrides)
    trainer = Trainer(settings, checkpoint)
    folder = (
        RunFolder.create(settings)
        if resume is None or checkpoint is None
        else RunFolder.reopen(_run_path(resume), sum(checkpoint.agent_steps.values()), settings)
    )
    try:
        with stop_requests() as stop:
            return trainer.run(folder, report or LogReporter(), stop)
    finally:
        folder.close()


def _run_path(resume: Path) -> Path:
    """Return the run folder of a folder or of a checkpoint file inside one."""
    return resume if resume.is_dir() else resume.parent.parent


@dataclass
class Learner:
    """All that learns and all that is random in a run, but for the environment."""

    actor: Actor
    critic: Critic
    ppo: Optimisers
    imitation: torch.optim.Optimizer
    generator: torch.Generator
    rng: np.random.Generator

    @staticmethod
    def create(settings: TrainSettings) -> Learner:
        """Return a fresh learner; the seed decides its weights and draws."""
        torch.manual_seed(settings.run.seed)  # layers initialise from the global generator
        observation, action = settings.env.observation, settings.env.action
        actor = Actor(settings.network, observation, action.size)
        critic = Critic(settings.network, observation)
        return Learner(
            actor,
            critic,
            Optimisers(actor, critic, settings.ppo.actor_lr, settings.ppo.critic_lr),
            torch.optim.Adam(actor.parameters(), lr=settings.imitation.lr),
            torch.Generator().manual_seed(settings.run.seed),
            np.random.default_rng(settings.run.seed),
        )

    def restore(self, checkpoint: Checkpoint) -> None:
        """Go on from a checkpoint. Raises InputError when it is of another network."""
        load_weights(self.actor, checkpoint.actor, "checkpoint: actor")
        load_weights(self.critic, checkpoint.critic, "checkpoint: critic")
        optimisers = copy.deepcopy(checkpoint.optimisers)  # Adam would go on in the checkpoint's own tensors
        self.ppo.actor.load_state_dict(optimisers["actor"])
        self.ppo.critic.load_state_dict(optimisers["critic"])
        self.imitation.load_state_dict(optimisers["imitation"])
        self.generator.set_state(checkpoint.rngs["torch"])
        self.rng.bit_generator.state = checkpoint.rngs["numpy"]


@dataclass
class Trainer:
    """A run in memory. `run` goes through its phases; `checkpoint` is where it stands."""

    settings: TrainSettings
    resumed: Checkpoint | None = None
    agent_steps: dict[str, int] = field(default_factory=lambda: {"imitation": 0, "ppo": 0})
    updates: int = 0
    phase: Phase = "imitation"

    def __post_init__(self) -> None:
        self.curriculum = Curriculum(self.settings.curriculum, self.settings.env)
        if self.resumed is not None and "curriculum" in self.resumed.record:
            self.curriculum.load_state_dict(self.resumed.record["curriculum"])
        self.env = Exploration(self.curriculum.environment, self.settings.run.seed)
        if self.resumed is not None:
            self.env.load_state_dict(self.resumed.env)
        self._observation = self.env.reset()
        # Set here, whatever OMP_NUM_THREADS says: sums are split by thread, and equal settings must give equal runs.
        torch.set_num_threads(self.settings.run.threads or len(os.sched_getaffinity(0)))
        self.learner = Learner.create(self.settings)
        self.episodes = RecentEpisodes(self.settings.env.episode_ticks, self.settings.env.levels)
        self._wall_before_s = 0.0
        if self.resumed is not None:
            self.learner.restore(self.resumed)
            self.agent_steps = dict(self.resumed.agent_steps)
            self.updates, self.phase = self.resumed.updates, self.resumed.phase
            self._wall_before_s = self.resumed.wall_s

    def run(self, folder: RunFolder, report: Reporter, stop: threading.Event) -> RunResult:
        """Train until both phases are done or `stop` is set; leave a checkpoint either way."""
        self._folder, self._report, self._stop = folder, report, stop
        self._began = self._saved = time.monotonic()
        if self.phase == "imitation":
            self._imitate()
        if self.phase == "ppo":
            self._improve()
        finished = not stop.is_set()
        checkpoint = folder.save(self.checkpoint(), "final" if finished else None)
        if finished and self.settings.run.final_episodes:
            self._evaluate(checkpoint)
        return RunResult(folder.path, checkpoint, sum(self.agent_steps.values()), finished, self.episodes.means())

    def _imitate(self) -> None:
        """Let the student fly and learn from the planner's labels, round after round."""
        settings, learner = self.settings.imitation, self.learner
        buffer = LabelBuffer(settings.buffer_samples)
        while self.agent_steps["imitation"] < settings.agent_steps and not self._stop.is_set():
            done_share = self.agent_steps["imitation"] / settings.agent_steps
            began = time.monotonic()
            until = max(settings.planner_share_until, 1e-9)
            planner_share = settings.planner_share * max(0.0, 1.0 - done_share / until)
            self._observation, episodes, labels = collect_labels(
                self.env, self._observation, learner.actor, buffer, settings.round_steps, planner_share,
                learner.rng, learner.generator,
            )  # fmt: skip
            collected = time.monotonic()
            for group in learner.imitation.param_groups:
                group["lr"] = settings.lr * (1.0 - (1.0 - settings.final_lr_share) * done_share)
            loss = learn(learner.actor, learner.imitation, buffer, settings, learner.generator)
            steps = settings.round_steps * self.env.worlds * self.env.drones
            numbers = {"loss": loss, "planner_share": planner_share, "labelled_share": labels / steps}
            seconds = {"collect": collected - began, "learn": time.monotonic() - collected}
            self._after_update(steps, settings.agent_steps, numbers, seconds, episodes)
        if not self._stop.is_set():
            self.phase, self.updates = "ppo", 0
            self._folder.save(self.checkpoint(), "imitated")

    def _improve(self) -> None:
        """Fly rollouts and improve the policy by PPO; the critic alone learns during its warm-up."""
        settings, learner = self.settings.ppo, self.learner
        while self.agent_steps["ppo"] < settings.agent_steps and not self._stop.is_set():
            began = time.monotonic()
            rollout, self._observation = collect(
                self.env, self._observation, learner.actor, settings.rollout_steps, learner.generator
            )
            collected = time.monotonic()
            numbers = update(
                learner.actor, learner.critic, learner.ppo, rollout, settings, learner.generator,
                policy_moves=self.updates >= settings.critic_warmup_updates,
            )  # fmt: skip
            seconds = {
                "env": rollout.env_s,
                "act": collected - began - rollout.env_s,
                "update": time.monotonic() - collected,
            }
            self._after_update(rollout.agent_steps, settings.agent_steps, numbers, seconds, rollout.episodes)

    def _after_update(
        self, steps: int, total: int, numbers: dict[str, float], seconds: dict[str, float], episodes: list[Any]
    ) -> None:
        """Count, report, and save when it is time."""
        self.updates += 1
        self.agent_steps[self.phase] += steps
        self.episodes.add(episodes)
        events = self.curriculum.observe(episodes, sum(self.agent_steps.values()))
        for event in events:
            logger.log(logging.WARNING if event.kind == "given up" else logging.INFO, "%s", event)
        if events:
            self.env.set_level_weights(self.curriculum.level_weights())
        report = Report(
            phase=self.phase,
            agent_steps=sum(self.agent_steps.values()),
            phase_steps=self.agent_steps[self.phase],
            phase_total=total,
            numbers=numbers,
            levels=self.episodes.means(),
            drones=self.episodes.drone_means(),
            steps_per_s=steps / sum(seconds.values()),
            seconds=seconds,
            wall_s=self._wall_s(),
        )
        self._folder.log(report.agent_steps, {**report.scalars(), **self.curriculum.scalars()})
        self._report(report)
        if time.monotonic() - self._saved >= self.settings.run.checkpoint_every_s:
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
            optimisers={
                "actor": learner.ppo.actor.state_dict(),
                "critic": learner.ppo.critic.state_dict(),
                "imitation": learner.imitation.state_dict(),
            },
            rngs={"torch": learner.generator.get_state(), "numpy": learner.rng.bit_generator.state},
            env=self.env.state_dict(),
            record={
                **run_record(self.settings),
                "levels": self.episodes.summary(),
                "curriculum": self.curriculum.state_dict(),
            },
        )

    def _evaluate(self, checkpoint: Path) -> None:
        """Evaluate the finished policy on every level and write the rows beside the checkpoints."""
        settings = self.settings
        rows = evaluate(
            policy_of(self.learner.actor, settings.run.name),
            levels=sorted(set(self.curriculum.levels)),
            drones=(settings.env.drones,),
            protocol=settings.env.protocol,
            episodes=settings.run.final_episodes,
            seed=settings.run.seed + 1,
            env=settings.env,
        )
        text = json.dumps({"checkpoint": checkpoint.name, "agent_steps": self.agent_steps, "rows": rows}, indent=2)
        write_atomically(self._folder.path / "evaluation.json", lambda file: file.write_text(text + "\n", "utf-8"))

    def _wall_s(self) -> float:
        return self._wall_before_s + time.monotonic() - self._began


@contextmanager
def stop_requests() -> Iterator[threading.Event]:
    """Turn the first SIGINT or SIGTERM into an event, so that the work in progress ends well; the second one kills.

    Outside the main thread, where Python takes no signals, the event is simply never set.
    """
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return

    def ask(number: int, _frame: FrameType | None) -> None:
        stop.set()
        signal.signal(number, before[signal.Signals(number)])

    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    for number in before:
        signal.signal(number, ask)
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
