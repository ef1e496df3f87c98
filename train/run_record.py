"""What a run was made with, so that it can be made again: settings, versions, code, machine, command."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import os
import platform
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

import imagine
from imagine.train.settings import TrainSettings
from imagine.train.tracking.code_state import own_code_state
from imagine.train.tracking.resources import machine

_PACKAGES = ("torch", "numpy", "numba", "scipy", "pymunk", "onnx", "onnxruntime", "tensorboard", "wandb")


def run_record(settings: TrainSettings) -> dict[str, Any]:
    """Return what a run was made with: seed, hash of the configuration, versions, git commit and branch.

    It goes into checkpoints and exported policies too, so there is nothing in it of who runs it and where.
    """
    state = own_code_state()
    return {
        "run": settings.run.name,
        "seed": settings.run.seed,
        "config_sha256": config_hash(settings),
        "imagine": imagine.__version__,
        "python": platform.python_version(),
        "packages": {name: version for name in _PACKAGES if (version := _version(name)) is not None},
        "git_commit": git_commit(),
        "git_branch": state.branch if state else None,
    }


def session_record() -> dict[str, Any]:
    """Return how this process was started and on what it runs, without host, user or absolute paths."""
    return {
        "command": shown_command(sys.argv),
        "machine": machine(),
        "threads": torch.get_num_threads(),
        "omp_num_threads": os.environ.get("OMP_NUM_THREADS"),
    }


def shown_command(arguments: Sequence[str]) -> list[str]:
    """Return a command line with absolute paths shortened: below the working folder relative, elsewhere the name."""

    def shown(text: str) -> str:
        key, equals, value = text.rpartition("=")
        if not value.startswith(("/", "~")):
            return text
        path = Path(value).expanduser()
        inside = path.is_relative_to(Path.cwd())
        return f"{key}{equals}{path.relative_to(Path.cwd()) if inside else path.name}"

    program = Path(arguments[0])
    name = program.parent.name if program.name == "__main__.py" else program.name  # of python -m
    return [name, *(shown(text) for text in arguments[1:])]


def config_hash(settings: TrainSettings) -> str:
    """Return the SHA-256 of the settings, whatever file or order they came in."""
    text = json.dumps(settings.model_dump(mode="json"), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def git_commit() -> str | None:
    """Return the commit of the checkout this runs from, `+` behind it with local changes; None outside a checkout."""
    state = own_code_state()
    return state.commit + ("+" if state.dirty else "") if state else None


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None
