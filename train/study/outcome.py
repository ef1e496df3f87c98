"""What a trial leaves in its run folder beside what every run leaves there.

attempts.jsonl   one line for every worker that took the trial up: process, host, the agent-steps it went on from
outcome.json     how the trial ended; without it, it has not ended
error.txt        the traceback of the newest failure
"""

from __future__ import annotations

import json
import os
import socket
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from imagine.core.errors import InputError
from imagine.train.atomic_file import write_atomically, write_failure

Status = Literal["finished", "time limit", "pruned", "failed"]


@dataclass(frozen=True)
class Outcome:
    """How a trial ended: `pruned` is stopped by ASHA, `failed` has an `error`.

    `levels` holds coverage, t90 (ticks) and contacts by level; `source` tells whether they were measured in the final
    evaluation or are means over the newest training episodes.
    """

    status: Status
    agent_steps: int
    wall_s: float
    levels: dict[str, dict[str, float]] = field(default_factory=dict)
    source: Literal["evaluation", "training"] = "training"
    error: str = ""

    @property
    def ended(self) -> bool:
        """Whether nothing is left to do; a failed trial is tried again when its study is resumed."""
        return self.status != "failed"


@dataclass(frozen=True)
class Attempt:
    """One worker's go at a trial."""

    pid: int
    host: str
    resumed_from: int


def write_outcome(folder: Path, outcome: Outcome) -> None:
    """Write how a trial ended. Raises WorkError when the disk is full."""
    text = json.dumps(asdict(outcome), indent=1) + "\n"
    write_atomically(folder / "outcome.json", lambda file: file.write_text(text, encoding="utf-8"))


def read_outcome(folder: Path) -> Outcome | None:
    """Return how a trial ended, None while it has not. Raises InputError on a file that is no outcome."""
    path = folder / "outcome.json"
    try:
        return Outcome(**json.loads(path.read_text("utf-8")))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, TypeError) as error:
        raise InputError(f"{path}: not an outcome of a trial; remove it to run the trial again") from error


def log_attempt(folder: Path, resumed_from: int) -> None:
    """Note that this process takes the trial up. Raises WorkError where the folder cannot be written."""
    attempt = Attempt(os.getpid(), socket.gethostname(), resumed_from)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with (folder / "attempts.jsonl").open("a", encoding="utf-8") as file:
            file.write(json.dumps(asdict(attempt)) + "\n")
    except OSError as error:
        raise write_failure(folder / "attempts.jsonl", error) from error


def read_attempts(folder: Path) -> list[Attempt]:
    """Return who took the trial up so far; a line cut short by a crash is left out."""
    path = folder / "attempts.jsonl"
    attempts = []
    for line in path.read_text("utf-8").splitlines() if path.exists() else ():
        try:
            attempts.append(Attempt(**json.loads(line)))
        except (ValueError, TypeError):
            continue
    return attempts


def read_metrics(folder: Path) -> list[dict[str, Any]]:
    """Return the rows of a run's metrics, oldest first; a line cut short by a crash is left out."""
    path = folder / "metrics.jsonl"
    rows = []
    for line in path.read_text("utf-8").splitlines() if path.exists() else ():
        try:
            row = json.loads(line)
        except ValueError:
            continue
        if isinstance(row, dict):
            rows.append(row)
    return rows
