"""The folder of a study.

runs/STUDY/study.yaml         the study's settings, complete
runs/STUDY/configs/TRIAL.yaml the settings of each trial, complete
runs/STUDY/trials/TRIAL/      its run folder
runs/STUDY/results.json       what came out, also as results.csv and summary.png
"""

from __future__ import annotations

import contextlib
import fcntl
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path

import yaml

from imagine.core.errors import InputError
from imagine.train.atomic_file import write_atomically
from imagine.train.settings import load_train_settings
from imagine.train.study.outcome import Outcome, read_outcome
from imagine.train.study.plan import Trial
from imagine.train.study.settings import StudySettings


class StudyFolder:
    """Where a study is kept. `create` begins it, `reopen` goes on with it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.tune = path / ".tune"
        """Tune's own scratch; what a study goes on from is in the trials' run folders."""

    @staticmethod
    def create(study: StudySettings, trials: Sequence[Trial]) -> StudyFolder:
        """Begin a study's folder. Raises InputError when there is one of that name."""
        folder = StudyFolder(study.folder)
        if (folder.path / "study.yaml").exists():
            raise InputError(
                f"{folder.path}: there is a study of this name; go on with --resume, or choose another with --set name=…"
            )
        folder._write(study, trials)
        return folder

    @staticmethod
    def reopen(study: StudySettings, trials: Sequence[Trial]) -> StudyFolder:
        """Open a study's folder to go on with it; a study may have got more trials, not others.

        Raises InputError when there is none, or a trial in it has other settings now.
        """
        folder = StudyFolder(study.folder)
        if not (folder.path / "study.yaml").exists():
            raise InputError(f"{folder.path}: no study to resume; start it without --resume")
        known = {path.stem for path in (folder.path / "configs").glob("*.yaml")}
        gone = sorted(known - {trial.name for trial in trials})
        changed = [
            trial.name
            for trial in trials
            if trial.name in known and load_train_settings(folder.config(trial.name)) != trial.settings
        ]
        if gone or changed:
            what = f"trial {gone[0]} is not in it any more" if gone else f"trial {changed[0]} has other settings now"
            raise InputError(f"{folder.path}: the study has changed: {what}; start it under another name, --set name=…")
        folder._write(study, [trial for trial in trials if trial.name not in known])
        return folder

    def _write(self, study: StudySettings, trials: Sequence[Trial]) -> None:
        """Write the study's settings and those of `trials`; the study's last, for it says that all are there."""
        for trial in trials:
            _write_yaml(self.config(trial.name), trial.settings.model_dump(mode="json"))
        _write_yaml(self.path / "study.yaml", study.model_dump(mode="json"))

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """Keep other processes from running the same study. Raises InputError where one does already."""
        with (self.path / ".lock").open("w") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise InputError(f"{self.path}: this study is running already; wait for it, or end it first") from error
            shutil.rmtree(self.tune, ignore_errors=True)
            try:
                yield
            finally:
                shutil.rmtree(self.tune, ignore_errors=True)

    def config(self, name: str) -> Path:
        """Return the file with a trial's settings."""
        return self.path / "configs" / f"{name}.yaml"

    def run(self, name: str) -> Path:
        """Return a trial's run folder."""
        return self.path / "trials" / name

    def outcome(self, name: str) -> Outcome | None:
        """Return how a trial ended, None while it has not."""
        return read_outcome(self.run(name))


def _write_yaml(path: Path, data: object) -> None:
    text = yaml.safe_dump(data, sort_keys=False, allow_unicode=True)
    write_atomically(path, lambda file: file.write_text(text, encoding="utf-8"))
