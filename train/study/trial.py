"""A trial as a worker of Ray runs it: the real training, reported to Tune, taken up again where a checkpoint is."""

from __future__ import annotations

import json
import math
import os
import shutil
import signal
import threading
import time
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from imagine.core.errors import ImagineError, InputError
from imagine.train.atomic_file import write_atomically
from imagine.train.checkpoint import load_checkpoint
from imagine.train.report import Report
from imagine.train.rollout_workers import RolloutWorkerLost
from imagine.train.run import train
from imagine.train.study.outcome import (
    Outcome,
    Status,
    Told,
    log_attempt,
    log_told,
    read_outcome,
    read_told,
    rewrite_told,
    write_outcome,
)

METRICS = ("coverage", "t90", "contacts")
"""What trials are compared by: of episodes, means by level."""


@dataclass(frozen=True)
class Task:
    """What a worker is told of its trial; paths are absolute.

    `here` is the working folder of whoever started the study: relative paths in settings count from there. With
    `retell` Tune is told again what it was told by earlier workers, for ASHA compares trials at their milestones.
    """

    name: str
    config: str
    folder: str
    here: str
    cpus: int
    time_limit_s: float | None
    silent_s: float
    retell: bool


class _TimeIsUp(Exception):
    """The trial has had its time."""


def run_trial(config: dict[str, Any]) -> None:
    """Train one trial to its end: from its latest checkpoint, or from the start where there is none.

    Called by Tune in a process of the trial's own. What the settings or the training make wrong is the trial's outcome;
    anything else is raised, and Tune has it tried again.
    """
    task = Task(**config["task"])
    folder = Path(task.folder)
    if not Path(task.config).exists():
        raise InputError(f"{task.config}: not to be seen from this node; a study's folder must be on a shared disk")
    if Path(task.here).is_dir():
        os.chdir(task.here)
    os.environ["IMAGINE_THREADS"] = str(task.cpus)
    reporter = _TuneReporter(task, folder)
    try:
        with Watchdog(task.silent_s, folder / "error.txt") as reporter.watchdog:
            if _ended(folder):
                if task.retell:
                    reporter.retell(read_told(folder))
                return
            status = _train(task, folder, reporter)
            write_outcome(folder, outcome_of(folder, status))
    except RolloutWorkerLost:
        raise
    except ImagineError as error:
        _write_error(folder)
        write_outcome(folder, outcome_of(folder, "failed", str(error)))
    except Exception:
        _write_error(folder)
        raise


def _ended(folder: Path) -> bool:
    outcome = read_outcome(folder)
    return outcome is not None and outcome.ended


def _train(task: Task, folder: Path, reporter: _TuneReporter) -> Status:
    """Train and return the status to end with."""
    latest = folder / "checkpoints" / "latest.pt"
    try:
        if latest.exists():
            steps = sum(load_checkpoint(latest).agent_steps.values())
            log_attempt(folder, steps)
            told = read_told(folder, until=steps)
            rewrite_told(folder, told)
            if task.retell:
                reporter.retell(told)
            train(None, resume=folder, report=reporter)
        else:
            _clear(folder)
            log_attempt(folder, 0)
            train(Path(task.config), report=reporter)
    except _TimeIsUp:
        return "time limit"
    return "finished"


def _clear(folder: Path) -> None:
    """Remove what a worker that never came to a checkpoint left behind."""
    for path in folder.iterdir() if folder.exists() else ():
        if path.is_dir():
            shutil.rmtree(path)
        elif path.name != "attempts.jsonl":
            path.unlink()


def outcome_of(folder: Path, status: Status, error: str = "") -> Outcome:
    """Return how a trial stands by what lies in its run folder: its final evaluation, or else its newest reports."""
    told = read_told(folder)
    evaluated = _evaluated(folder) if status == "finished" else {}
    trained: dict[str, dict[str, float]] = next((one.levels for one in reversed(told) if one.levels), {})
    return Outcome(
        status=status,
        agent_steps=told[-1].agent_steps if told else 0,
        wall_s=told[-1].wall_s if told else 0.0,
        levels=evaluated or trained,
        source="evaluation" if evaluated else "training",
        error=error,
    )


def _evaluated(folder: Path) -> dict[str, dict[str, float]]:
    """Return the final evaluation's numbers by level, empty where there was none."""
    path = folder / "evaluation.json"
    if not path.exists():
        return {}
    names = {"coverage": "coverage_mean", "t90": "t90_mean", "contacts": "collisions_per_episode"}
    rows = json.loads(path.read_text("utf-8"))["rows"]
    return {str(row["level"]): {name: float(row[key]) for name, key in names.items()} for row in rows}


def mean_over_levels(levels: Mapping[str, Mapping[str, float]], metric: str) -> float:
    """Return a metric's mean over levels, nan where no episode has ended yet."""
    values = [numbers[metric] for numbers in levels.values() if metric in numbers]
    return float(np.mean(values)) if values else float("nan")


def _write_error(folder: Path) -> None:
    text = traceback.format_exc()
    write_atomically(folder / "error.txt", lambda file: file.write_text(text, encoding="utf-8"))


class _TuneReporter:
    """Tells Tune of every update, feeds the watchdog, and ends the trial when its time is up."""

    def __init__(self, task: Task, folder: Path) -> None:
        self._limit_s, self._folder = task.time_limit_s, folder
        self.watchdog: Watchdog | None = None

    def __call__(self, report: Report) -> None:
        """Take one report. Tune ends the thread in here (SystemExit) when it stops the trial."""
        levels = {
            level: {name: numbers[name] for name in METRICS if name in numbers}
            for level, numbers in report.levels.items()
        }
        told = Told(report.agent_steps, report.wall_s, levels)
        log_told(self._folder, told)
        self._tell(told)
        if self._limit_s is not None and report.wall_s >= self._limit_s:
            raise _TimeIsUp

    def retell(self, told: Sequence[Told]) -> None:
        """Tell Tune again what it was told."""
        for one in told:
            self._tell(one)

    def _tell(self, told: Told) -> None:
        from ray import tune

        if self.watchdog is not None:
            self.watchdog.feed()
        means = {name: mean_over_levels(told.levels, name) for name in METRICS}
        known = {name: value for name, value in means.items() if not math.isnan(value)}  # ASHA passes over the rest
        tune.report({"agent_steps": told.agent_steps, "train_s": told.wall_s, **known})


class Watchdog:
    """Ends this process when it is not fed for so long: a hung trial would otherwise hold its CPUs for ever."""

    def __init__(self, silent_s: float, note: Path) -> None:
        self._silent_s, self._note = silent_s, note
        self._fed = time.monotonic()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="watchdog", daemon=True)

    def __enter__(self) -> Watchdog:
        """Begin to watch."""
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """End watching."""
        self._over.set()
        self._thread.join(5.0)

    def feed(self) -> None:
        """Say that all is well."""
        self._fed = time.monotonic()

    def _watch(self) -> None:
        while not self._over.wait(max(0.1, self._fed + self._silent_s - time.monotonic())):
            if time.monotonic() - self._fed >= self._silent_s:
                self._note.write_text(
                    f"nothing was reported for {self._silent_s:g} s: the worker ended itself\n", "utf-8"
                )
                os.kill(os.getpid(), signal.SIGKILL)  # nothing gentler ends a thread that hangs in compiled code
