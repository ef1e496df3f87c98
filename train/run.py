"""Training as it is asked for: a new run from its settings, or on with one that was stopped."""

from __future__ import annotations

from pathlib import Path

from imagine.core.errors import InputError
from imagine.train.checkpoint import load_checkpoint
from imagine.train.folder_lock import locked
from imagine.train.report import LogReporter, Reporter
from imagine.train.run_folder import RunFolder
from imagine.train.settings import load_train_settings
from imagine.train.stopping import stop_requests
from imagine.train.trainer import RunResult, Trainer

_BUSY = "is training in this folder; wait for it, end it, or take another name with --set run.name=…"


def train(
    config: Path | None,
    overrides: tuple[str, ...] = (),
    resume: Path | None = None,
    report: Reporter | None = None,
) -> RunResult:
    """Run a training from a configuration, or go on with the run in the folder `resume`.

    SIGINT and SIGTERM end it cleanly after the update in progress, with a checkpoint. Raises InputError for bad
    settings or checkpoints and where another process trains in the folder, WorkError when training diverges or the disk
    is full.
    """
    if resume is None:
        settings = load_train_settings(config, overrides)
        trainer = Trainer(settings)
        with locked(Path(settings.run.root) / settings.run.name, _BUSY):
            return _run(trainer, RunFolder.create(settings), report)
    if config is not None:
        raise InputError("a resumed run has its configuration already: give CONFIG or --resume, not both")
    run = resume if resume.is_dir() else resume.parent.parent
    if not (resume.exists() and (run / "config.yaml").exists()):
        raise InputError(f"--resume {resume}: no run to go on with: give a run's folder, or a checkpoint in one")
    with locked(run, _BUSY):  # before the checkpoint is read: whoever trained here until now may have left a newer one
        settings = load_train_settings(run / "config.yaml", overrides)
        checkpoint = None if _is_before_its_first_checkpoint(resume) else load_checkpoint(resume)
        trainer = Trainer(settings, checkpoint)
        steps = 0 if checkpoint is None else sum(checkpoint.agent_steps.values())
        return _run(trainer, RunFolder.reopen(run, steps, settings), report)


def _run(trainer: Trainer, folder: RunFolder, report: Reporter | None) -> RunResult:
    """Train until the end, or until the process is told to stop."""
    try:
        with stop_requests() as stop:
            return trainer.run(folder, report or LogReporter(), stop)
    finally:
        folder.close()


def _is_before_its_first_checkpoint(resume: Path) -> bool:
    """Tell whether a run's folder holds no checkpoint yet: it was stopped while it imitated, and begins anew."""
    return (resume / "config.yaml").exists() and not (resume / "checkpoints" / "latest.pt").exists()
