"""The folder of a study.

runs/STUDY/study.yaml         the study's settings, complete
runs/STUDY/configs/TRIAL.yaml the settings of each trial, complete
runs/STUDY/trials/TRIAL/      its run folder
runs/STUDY/results.json       what came out, also as results.csv and summary.png
"""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path

import yaml

from imagine.core.errors import InputError
from imagine.train.atomic_file import write_atomically
from imagine.train.folder_lock import locked
from imagine.train.settings import load_train_settings
from imagine.train.study.outcome import Outcome, read_outcome
from imagine.train.study.plan import Trial
from imagine.train.study.settings import StudySettings


class StudyFolder:
    """Where a study is kept: look whether it may run there (`check_new`, `check_known`), then `write` it."""

    def __init__(self, study: StudySettings) -> None:
        self.path = study.folder
        self.tune = self.path / ".tune"
        """Tune's own scratch; what a study goes on from is in the trials' run folders."""

    def check_new(self) -> None:
        """Raise InputError when there is a study of that name."""
        if (self.path / "study.yaml").exists():
            raise InputError(
                f"{self.path}: there is a study of this name; go on with --resume, or choose another with --set name=…"
            )

    def check_known(self, trials: Sequence[Trial]) -> None:
        """Raise InputError when there is no study, or one with other trials; it may have got more of them."""
        if not (self.path / "study.yaml").exists():
            raise InputError(f"{self.path}: no study to resume; start it without --resume")
        known = {path.stem for path in (self.path / "configs").glob("*.yaml")}
        gone = sorted(known - {trial.name for trial in trials})
        changed = [
            trial.name
            for trial in trials
            if trial.name in known and load_train_settings(self.config(trial.name)) != trial.settings
        ]
        if gone or changed:
            what = f"trial {gone[0]} is not in it any more" if gone else f"trial {changed[0]} has other settings now"
            raise InputError(f"{self.path}: the study has changed: {what}; start it under another name, --set name=…")

    def write(self, study: StudySettings, trials: Sequence[Trial]) -> None:
        """Write the settings of the trials, and the study's last, for it says that all are there."""
        for trial in trials:
            _write_yaml(self.config(trial.name), trial.settings.model_dump(mode="json"))
        _write_yaml(self.path / "study.yaml", study.model_dump(mode="json"))

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """Keep other processes from running the same study. Raises InputError where one does already."""
        with locked(self.path, "runs this study; wait for it, or end it first"):
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
