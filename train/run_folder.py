"""The folder of a run: its configuration, what it ran on, its metrics and its checkpoints.

runs/NAME/config.yaml      the settings, complete
runs/NAME/record.json      seed, versions, git commit
runs/NAME/metrics.jsonl    one line an update
runs/NAME/tensorboard/     the same for TensorBoard
runs/NAME/checkpoints/     latest.pt, the newest few by step, imitated.pt, final.pt
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import platform
import subprocess
from pathlib import Path
from typing import Any

import yaml
from torch.utils.tensorboard.writer import SummaryWriter

import imagine
from imagine.core.errors import InputError
from imagine.train.atomic_file import write_atomically, write_failure
from imagine.train.checkpoint import Checkpoint, save_checkpoint
from imagine.train.settings import TrainSettings

_PACKAGES = ("torch", "numpy", "numba", "pymunk", "onnx", "onnxruntime")


class RunFolder:
    """An open run folder; `close` it."""

    def __init__(self, path: Path, purge_step: int | None = None) -> None:
        self.path = path
        self.checkpoints = path / "checkpoints"
        self._tensorboard = SummaryWriter(str(path / "tensorboard"), purge_step=purge_step)

    @staticmethod
    def create(settings: TrainSettings) -> RunFolder:
        """Begin a new run's folder. Raises InputError when there is one of that name."""
        path = Path(settings.run.root) / settings.run.name
        if (path / "config.yaml").exists():
            raise InputError(f"{path}: there is a run of this name; resume it, or choose another with --set run.name=…")
        text = yaml.safe_dump(settings.model_dump(mode="json"), sort_keys=False)
        write_atomically(path / "config.yaml", lambda file: file.write_text(text, encoding="utf-8"))
        record = json.dumps(run_record(settings), indent=2)
        write_atomically(path / "record.json", lambda file: file.write_text(record + "\n", encoding="utf-8"))
        return RunFolder(path)

    @staticmethod
    def reopen(path: Path, agent_steps: int) -> RunFolder:
        """Open a run's folder to go on after `agent_steps`; metrics from after that point are dropped."""
        metrics = path / "metrics.jsonl"
        if metrics.exists():
            kept = [line for line in metrics.read_text("utf-8").splitlines() if _steps_of(line) <= agent_steps]
            text = "".join(f"{line}\n" for line in kept)
            write_atomically(metrics, lambda file: file.write_text(text, encoding="utf-8"))
        return RunFolder(path, purge_step=agent_steps + 1)

    def log(self, step: int, scalars: dict[str, float], row: dict[str, Any]) -> None:
        """Append one row to the metrics, and scalars to TensorBoard at `step`. Raises WorkError on a full disk."""
        try:
            with (self.path / "metrics.jsonl").open("a", encoding="utf-8") as file:
                file.write(json.dumps(row) + "\n")
            for name, value in scalars.items():
                self._tensorboard.add_scalar(name, value, step)
        except OSError as error:
            raise write_failure(self.path / "metrics.jsonl", error) from error

    def save(self, checkpoint: Checkpoint, name: str | None = None) -> Path:
        """Write `latest.pt` and a copy of it, called `name` or by its step; of the latter the newest few are kept."""
        latest = self.checkpoints / "latest.pt"
        save_checkpoint(checkpoint, latest)
        copy = f"{name}.pt" if name else f"step-{sum(checkpoint.agent_steps.values()):09d}.pt"
        save_checkpoint(checkpoint, self.checkpoints / copy)
        for old in sorted(self.checkpoints.glob("step-*.pt"))[: -checkpoint.settings.run.keep_checkpoints]:
            old.unlink()
        return latest

    def close(self) -> None:
        """Flush and close what is open."""
        self._tensorboard.close()


def _steps_of(line: str) -> int:
    """Return the step of a metrics line; a line cut short by a crash counts as beyond any step."""
    try:
        return int(json.loads(line)["agent_steps"])
    except (json.JSONDecodeError, KeyError, TypeError):
        return 2**62


def run_record(settings: TrainSettings) -> dict[str, Any]:
    """Return what a run was made with: seed, hash of the configuration, versions, git commit."""
    return {
        "run": settings.run.name,
        "seed": settings.run.seed,
        "config_sha256": config_hash(settings),
        "imagine": imagine.__version__,
        "python": platform.python_version(),
        "packages": {name: importlib.metadata.version(name) for name in _PACKAGES},
        "git_commit": git_commit(),
    }


def config_hash(settings: TrainSettings) -> str:
    """Return the SHA-256 of the settings, whatever file or order they came in."""
    text = json.dumps(settings.model_dump(mode="json"), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def git_commit() -> str | None:
    """Return the commit of the checkout this runs from, `+` behind it with local changes; None outside a checkout."""
    here = Path(__file__).resolve().parent
    try:
        commit = _git(here, "rev-parse", "HEAD")
        return commit + ("+" if _git(here, "status", "--porcelain", "--untracked-files=no") else "")
    except (OSError, subprocess.SubprocessError):
        return None


def _git(where: Path, *arguments: str) -> str:
    done = subprocess.run(["git", *arguments], cwd=where, capture_output=True, text=True, timeout=10, check=True)
    return done.stdout.strip()
