"""Scalars in a file of one JSON object a line."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from imagine.train.atomic_file import append_whole, write_atomically


class JsonLinesTracker:
    """Appends `{"agent_steps": step, name: value, ...}` for every update, each number to its last bit.

    A number that is not finite is written as null, since JSON has none such.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def log(self, step: int, scalars: Mapping[str, float]) -> None:
        """Append a line. Raises WorkError when it cannot be written; the file then ends with the line before."""
        row = {"agent_steps": step} | {
            name: float(value) if math.isfinite(value) else None for name, value in scalars.items()
        }
        append_whole(self.path, (json.dumps(row) + "\n").encode())

    def config(self, config: Mapping[str, Any]) -> None:
        """Keep nothing: the settings are in `config.yaml` beside the file."""

    def close(self) -> None:
        """Do nothing: no file stays open between two lines."""


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Return the whole lines of such a file, in order; a line cut short, as by a crash, is left out."""
    rows = []
    for line in path.read_text("utf-8").splitlines():
        try:
            row = json.loads(line)
        except json.JSONDecodeError:
            continue
        if isinstance(row, dict) and isinstance(row.get("agent_steps"), int):
            rows.append(row)
    return rows


def drop_after(path: Path, step: int) -> None:
    """Take out of such a file what was written after `step`: a run goes on from there. Raises WorkError."""
    if path.exists():
        text = "".join(json.dumps(row) + "\n" for row in read_rows(path) if row["agent_steps"] <= step)
        write_atomically(path, lambda file: file.write_text(text, encoding="utf-8"))
