"""The folder of a run: its configuration, what it ran on, its metrics and its checkpoints.

runs/NAME/config.yaml      the settings, complete, as they are now
runs/NAME/record.json      seed, versions, machine, command, git state; with what it was resumed, and what that changed
runs/NAME/changes.patch    what the code had that its commit has not, where it differed
runs/NAME/metrics.jsonl    one line an update
runs/NAME/tensorboard/     the same for TensorBoard
runs/NAME/wandb/           the same for Weights & Biases, where asked for
runs/NAME/checkpoints/     latest.pt, the newest few by step, imitated.pt, final.pt
"""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from imagine.core.errors import InputError
from imagine.train.atomic_file import write_atomically
from imagine.train.checkpoint import Checkpoint, save_checkpoint
from imagine.train.run_record import config_hash, git_commit, run_record, session_record
from imagine.train.settings import TrainSettings, load_train_settings
from imagine.train.tracking.code_state import own_code_state
from imagine.train.tracking.json_lines import drop_after
from imagine.train.tracking.open import check_tracking, open_trackers
from imagine.train.tracking.tracker import Tracker

__all__ = ["RunFolder", "config_hash", "git_commit", "run_record"]

logger = logging.getLogger(__name__)


class RunFolder:
    """An open run folder; `close` it."""

    def __init__(self, path: Path, trackers: Tracker) -> None:
        self.path = path
        self.checkpoints = path / "checkpoints"
        self._trackers = trackers

    @staticmethod
    def create(settings: TrainSettings) -> RunFolder:
        """Begin a new run's folder.

        Raises InputError when there is one of that name or a tracker cannot be had, WorkError on a full disk.
        """
        path = Path(settings.run.root) / settings.run.name
        if (path / "config.yaml").exists():
            raise InputError(f"{path}: there is a run of this name; resume it, or choose another with --set run.name=…")
        check_tracking(settings.tracking)
        config = settings.model_dump(mode="json")
        _write(path / "config.yaml", yaml.safe_dump(config, sort_keys=False))
        record = run_record(settings) | session_record() | {"changes": _keep_changes(path / "changes.patch")}
        _write(path / "record.json", json.dumps(record, indent=2) + "\n")
        trackers = open_trackers(settings.tracking, path, settings.run.name)
        trackers.config(config | {"run": {key: value for key, value in config["run"].items() if key != "root"}})
        return RunFolder(path, trackers)

    @staticmethod
    def reopen(path: Path, agent_steps: int, settings: TrainSettings) -> RunFolder:
        """Open a run's folder to go on after `agent_steps`; metrics from after that point are dropped.

        From now on `settings` are the run's, and are what it is resumed with the next time. The record takes down with
        which code the run goes on, and as `changed` which settings were others before: `[before, now]` by key. Raises
        InputError when a tracker cannot be had, WorkError on a full disk.
        """
        check_tracking(settings.tracking)
        for half_written in (path / "checkpoints").glob(".*.tmp"):  # by a process that was killed
            half_written.unlink()
        drop_after(path / "metrics.jsonl", agent_steps)
        record = _read_record(path / "record.json")
        session = {"agent_steps": agent_steps, **run_record(settings), **session_record()}
        session["changes"] = _keep_changes(path / f"changes-{agent_steps}.patch")
        config = settings.model_dump(mode="json")
        before = load_train_settings(path / "config.yaml").model_dump(mode="json")
        session["changed"] = _differences(before, config)
        record.setdefault("resumed", []).append(session)
        _write(path / "record.json", json.dumps(record, indent=2) + "\n")
        if session["changed"]:
            _write(path / "config.yaml", yaml.safe_dump(config, sort_keys=False))
            logger.info("%s: keeps what was changed: %s", path / "config.yaml", ", ".join(session["changed"]))
        return RunFolder(path, open_trackers(settings.tracking, path, settings.run.name, agent_steps))

    def log(self, step: int, scalars: Mapping[str, float]) -> None:
        """Tell all trackers the scalars of an update. Raises WorkError, naming the file, on a full disk."""
        self._trackers.log(step, scalars)

    def save(self, checkpoint: Checkpoint, name: str | None = None) -> Path:
        """Write `latest.pt` and a copy of it, called `name` or by its step; of the latter the newest few are kept.

        Later ones, of a run that was taken up again at an earlier checkpoint, stay. Raises WorkError on a full disk;
        the checkpoints there are stay as they are.
        """
        latest = self.checkpoints / "latest.pt"
        save_checkpoint(checkpoint, latest)
        copy = f"{name}.pt" if name else f"step-{sum(checkpoint.agent_steps.values()):09d}.pt"
        save_checkpoint(checkpoint, self.checkpoints / copy)
        if name is None:
            until_now = sorted(path for path in self.checkpoints.glob("step-*.pt") if path.name <= copy)
            for old in until_now[: -checkpoint.settings.run.keep_checkpoints]:
                old.unlink()
        return latest

    def close(self) -> None:
        """Close the trackers."""
        self._trackers.close()


def _write(path: Path, text: str) -> None:
    write_atomically(path, lambda file: file.write_text(text, encoding="utf-8"))


def _differences(before: Mapping[str, Any], now: Mapping[str, Any], at: str = "") -> dict[str, list[Any]]:
    """Return `[before, now]` of every setting that differs, by its key; a mapping that came or went as one."""
    found: dict[str, list[Any]] = {}
    for key in dict.fromkeys((*before, *now)):
        old, new = before.get(key), now.get(key)
        if isinstance(old, Mapping) and isinstance(new, Mapping):
            found |= _differences(old, new, f"{at}{key}.")
        elif old != new:
            found[f"{at}{key}"] = [old, new]
    return found


def _keep_changes(path: Path) -> str | None:
    """Save what the code differs in from its commit; return the file's name, or why there is none."""
    state = own_code_state()
    if state is None or not state.dirty:
        return None
    if (patch := state.patch) is None:
        return "too long to keep"
    write_atomically(path, lambda file: file.write_bytes(patch))
    return path.name


def _read_record(path: Path) -> dict[str, Any]:
    """Return a run's record; an empty one where it is missing. Raises InputError where it is damaged."""
    try:
        record = json.loads(path.read_text("utf-8"))
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read as JSON: {error}; mend or delete it, then resume") from error
    if not isinstance(record, dict):
        raise InputError(f"{path}: not a run's record; delete it, then resume")
    return record
