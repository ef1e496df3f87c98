"""What a trial leaves in its run folder beside what every run leaves there.

attempts.jsonl   one line for every worker that took the trial up: process, host, the agent-steps it went on from
reports.jsonl    one line for every update: agent-steps, seconds, and coverage, t90 and contacts by level
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
    _append(folder / "attempts.jsonl", asdict(Attempt(os.getpid(), socket.gethostname(), resumed_from)))


def read_attempts(folder: Path) -> list[Attempt]:
    """Return who took the trial up so far."""
    return [Attempt(**line) for line in _lines(folder / "attempts.jsonl")]


@dataclass(frozen=True)
class Told:
    """What a trial reported of an update; `levels` as of `Outcome`."""

    agent_steps: int
    wall_s: float
    levels: dict[str, dict[str, float]]


def log_told(folder: Path, told: Told) -> None:
    """Keep what is reported. Raises WorkError where the folder cannot be written."""
    _append(folder / "reports.jsonl", asdict(told))


def read_told(folder: Path, until: int | None = None) -> list[Told]:
    """Return what was reported, oldest first; of a run that goes on after `until` agent-steps, what led there."""
    told = [Told(**line) for line in _lines(folder / "reports.jsonl")]
    return told if until is None else [one for one in told if one.agent_steps <= until]


def rewrite_told(folder: Path, told: list[Told]) -> None:
    """Keep these reports alone. Raises WorkError where the folder cannot be written."""
    text = "".join(json.dumps(asdict(one)) + "\n" for one in told)
    write_atomically(folder / "reports.jsonl", lambda file: file.write_text(text, encoding="utf-8"))


def _append(path: Path, record: dict[str, Any]) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(record) + "\n")
    except OSError as error:
        raise write_failure(path, error) from error


def _lines(path: Path) -> list[dict[str, Any]]:
    """Return the records of a file of lines; one cut short by a crash is left out."""
    records = []
    for line in path.read_text("utf-8").splitlines() if path.exists() else ():
        try:
            records.append(json.loads(line))
        except ValueError:
            continue
    return records
