"""A study from start to end: Tune starts the trials, takes up those whose workers die, and stops the hopeless ones."""

from __future__ import annotations

import contextlib
import logging
import signal
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from types import FrameType
from typing import Any

from imagine.core.errors import InputError
from imagine.train.study.cluster import ray_connection
from imagine.train.study.events import Event, Tell
from imagine.train.study.folder import StudyFolder
from imagine.train.study.outcome import Outcome
from imagine.train.study.plan import Trial, plan_trials, total_steps
from imagine.train.study.settings import StudySettings
from imagine.train.study.trial import Task, outcome_of, run_trial


@dataclass(frozen=True)
class StudyResult:
    """How a study ended: outcomes by trial, None for those that have not ended; `stopped` says why, or is empty."""

    folder: StudyFolder
    trials: list[Trial]
    outcomes: dict[str, Outcome | None]
    stopped: str


def run_study(
    study: StudySettings,
    address: str | None = None,
    resume: bool = False,
    tell: Tell | None = None,
    cpus: int | None = None,
) -> StudyResult:
    """Run a study's trials in the cluster at `address`, or in one of this machine with `cpus` CPUs.

    With `resume` trials that ended are kept, and the others go on from their latest checkpoints. `tell` hears, in this
    thread, what happens to which trial. SIGINT and SIGTERM end the study so that it can be resumed. Raises InputError
    for settings, folders and addresses that are wrong, before any trial starts; WorkError where Ray does not start.
    """
    trials = plan_trials(study)
    folder = StudyFolder(study)
    with folder.locked():
        if resume:
            folder.check_known(trials)
        else:
            folder.check_new()
        left = [trial for trial in trials if not _ended(folder, trial)]
        again = trials if study.search == "asha" else left  # ASHA compares with those that ended, too
        stopped = ""
        with ray_connection(address, cpus) if left else contextlib.nullcontext():
            if left:
                _check_room(study, left)
            folder.write(study, trials)
            for trial in left:
                (folder.run(trial.name) / "outcome.json").unlink(missing_ok=True)  # it failed; a new try
            if left:
                stopped = _fit(study, folder, again, address, tell or _log)
    return StudyResult(folder, trials, {trial.name: folder.outcome(trial.name) for trial in trials}, stopped)


def _ended(folder: StudyFolder, trial: Trial) -> bool:
    outcome = folder.outcome(trial.name)
    return outcome is not None and outcome.ended


def _fit(study: StudySettings, folder: StudyFolder, trials: Sequence[Trial], address: str | None, tell: Tell) -> str:
    """Let Tune run the trials; return why it stopped before all had ended, empty where it did not."""
    from ray import tune

    from imagine.train.study.asha import Asha
    from imagine.train.study.lost_cluster import LostCluster
    from imagine.train.study.tune_events import Events

    tasks = [asdict(_task(study, folder, trial)) for trial in trials]
    bundles = {trial.name: _bundles(study, trial) for trial in trials}
    asha = Asha(study, {t.name: total_steps(t.settings) for t in trials}) if study.search == "asha" else None
    events = Events(tell, lambda name, error: _close(folder, name, error))
    tuner = tune.Tuner(
        tune.with_resources(run_trial, lambda config: tune.PlacementGroupFactory(bundles[config["task"]["name"]])),
        param_space={"task": tune.grid_search(tasks)},
        tune_config=tune.TuneConfig(
            scheduler=asha,
            max_concurrent_trials=study.max_concurrent,
            trial_name_creator=_name,
            trial_dirname_creator=_name,
            reuse_actors=True,  # a worker that has ended a trial has everything loaded for the next
        ),
        run_config=tune.RunConfig(
            name=folder.tune.name,
            storage_path=str(folder.path),
            failure_config=tune.FailureConfig(max_failures=study.max_failures),
            callbacks=[events],
            verbose=0,
        ),
    )
    logging.getLogger("ray.tune").setLevel(logging.CRITICAL)  # events tell what fails
    with _sigterm_as_sigint(), LostCluster(address, events, study.silent_s) as watch:
        try:
            tuner.fit()
        except tune.TuneError as error:
            logging.getLogger(__name__).info("Tune broke off", exc_info=error)
            return f"Tune broke off: {_last_line(error)}"
    unfinished = any(folder.outcome(trial.name) is None for trial in trials)
    return watch.reason or ("the study was stopped" if unfinished else "")


def _last_line(error: object) -> str:
    """Return what an error says, without the traceback that Ray puts before it."""
    lines = str(error).strip().splitlines()
    return lines[-1][:300] if lines else "it does not say why"


def _name(trial: Any) -> str:
    return str(trial.config["task"]["name"])


def _task(study: StudySettings, folder: StudyFolder, trial: Trial) -> Task:
    return Task(
        name=trial.name,
        config=str(folder.config(trial.name)),
        folder=str(folder.run(trial.name)),
        here=str(Path.cwd()),
        cpus=study.resources.cpus,
        time_limit_s=study.time_limit_s,
        silent_s=study.silent_s,
        retell=study.search == "asha",
    )


def _bundles(study: StudySettings, trial: Trial) -> list[dict[str, float]]:
    """Return what a trial takes: its own process, and one CPU for each of its rollout workers."""
    own: dict[str, float] = {"CPU": study.resources.cpus}
    if study.resources.gpus:
        own["GPU"] = study.resources.gpus
    workers = getattr(trial.settings.run, "rollout_workers", 0)
    return [own, *([{"CPU": 1.0}] * workers)]


def _check_room(study: StudySettings, trials: Sequence[Trial]) -> None:
    """Raise InputError where some trial would wait for ever."""
    import ray

    there: dict[str, float] = ray.cluster_resources()  # type: ignore[no-untyped-call]
    for trial in trials:
        bundles = _bundles(study, trial)
        for kind in ("CPU", "GPU"):
            wanted = sum(bundle.get(kind, 0.0) for bundle in bundles)
            if wanted > there.get(kind, 0.0):
                raise InputError(
                    f"study {study.name}: a trial takes {wanted:g} {kind}s, the cluster has {there.get(kind, 0.0):g}; "
                    "lower resources, or give it a larger cluster"
                )


def _close(folder: StudyFolder, name: str, error: str | None) -> None:
    """Write the outcome of a trial that Tune ended: stopped by ASHA, or given up."""
    if folder.outcome(name) is not None:
        return
    from imagine.train.study.outcome import write_outcome

    if error is None:
        write_outcome(folder.run(name), outcome_of(folder.run(name), "pruned"))
        return
    note = folder.run(name) / "error.txt"
    said = note.read_text("utf-8").strip().splitlines()[-1] if note.exists() else error
    write_outcome(folder.run(name), outcome_of(folder.run(name), "failed", said))


def _log(event: Event) -> None:
    if event.kind != "reported":
        logging.getLogger(__name__).info("%s %s %s", event.trial, event.kind, event.error)


@contextmanager
def _sigterm_as_sigint() -> Iterator[None]:
    """Let SIGTERM end Tune as SIGINT does: trials are stopped, their checkpoints stay."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def as_sigint(_number: int, _frame: FrameType | None) -> None:
        signal.raise_signal(signal.SIGINT)

    before = signal.signal(signal.SIGTERM, as_sigint)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
