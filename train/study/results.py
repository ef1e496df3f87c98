"""What a study gives: a row for each trial, and a row for each condition over its repeats."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import t as student_t

from imagine.train.atomic_file import write_atomically
from imagine.train.study.outcome import read_attempts
from imagine.train.study.run import StudyResult
from imagine.train.study.settings import StudySettings
from imagine.train.study.trial import METRICS, mean_over_levels


def trial_rows(result: StudyResult) -> list[dict[str, Any]]:
    """Return a row for each trial, in their order: what it was, how it ended, its metrics by level and over levels.

    `status` of a trial that has not ended is `unfinished`. Metrics are None where no episode has ended. `resumed_from`
    holds the agent-steps at which workers after the first took it up.
    """
    rows = []
    for trial in result.trials:
        run = result.folder.run(trial.name)
        outcome = result.outcomes[trial.name]
        attempts = read_attempts(run)
        levels = {} if outcome is None else outcome.levels
        rows.append(
            {
                "trial": trial.name,
                "condition": trial.condition,
                "parameters": trial.parameters,
                "seed": trial.seed,
                "status": "unfinished" if outcome is None else outcome.status,
                "error": "" if outcome is None else outcome.error,
                "agent_steps": 0 if outcome is None else outcome.agent_steps,
                "wall_s": 0.0 if outcome is None else outcome.wall_s,
                "workers": len(attempts),
                "resumed_from": [attempt.resumed_from for attempt in attempts[1:]],
                "source": None if outcome is None else outcome.source,
                **{name: _number(mean_over_levels(levels, name)) for name in METRICS},
                "levels": levels,
                "folder": str(run),
            }
        )
    return rows


def condition_rows(study: StudySettings, rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return a row for each condition, the best by the study's metric first: means over repeats with intervals.

    Conditions of which ASHA stopped a trial come after the others: what they reached early tells of no end.
    """
    conditions = []
    for condition in dict.fromkeys(row["condition"] for row in rows):
        own = [row for row in rows if row["condition"] == condition]
        summary: dict[str, Any] = {
            "condition": condition,
            "parameters": own[0]["parameters"],
            "trials": len(own),
            "ended": sum(row["status"] not in ("unfinished", "failed") for row in own),
            "pruned": sum(row["status"] == "pruned" for row in own),
        }
        for name in METRICS:
            values = [row[name] for row in own if row[name] is not None]
            summary[name] = _number(float(np.mean(values))) if values else None
            summary[f"{name}_ci95"] = mean_interval(values)
        conditions.append(summary)
    sign = -1.0 if study.better == "max" else 1.0

    def rank(row: dict[str, Any]) -> tuple[bool, bool, float]:
        value = row[study.metric]
        return value is None, row["pruned"] > 0, 0.0 if value is None else sign * value

    return sorted(conditions, key=rank)


def mean_interval(values: Sequence[float]) -> tuple[float, float] | None:
    """Return Student's 95 % interval of the mean; None for fewer than two values, which tell nothing of spread."""
    if len(values) < 2:
        return None
    mean, half = float(np.mean(values)), float(np.std(values, ddof=1)) / math.sqrt(len(values))
    half *= float(student_t.ppf(0.975, len(values) - 1))
    return mean - half, mean + half


def study_data(study: StudySettings, result: StudyResult) -> dict[str, Any]:
    """Return all results as they stand in `results.json`."""
    rows = trial_rows(result)
    return {
        "study": study.name,
        "metric": study.metric,
        "mode": study.better,
        "finished": all(row["status"] not in ("unfinished", "failed") for row in rows),
        "conditions": condition_rows(study, rows),
        "trials": rows,
    }


def write_results(folder: Path, data: dict[str, Any]) -> None:
    """Write `results.json` and `results.csv` (a line for each trial). Raises WorkError where they cannot be written."""
    text = json.dumps(data, indent=1) + "\n"
    write_atomically(folder / "results.json", lambda file: file.write_text(text, encoding="utf-8"))
    table = io.StringIO()
    rows = [_flat(row) for row in data["trials"]]
    names = list(dict.fromkeys(name for row in rows for name in row))
    writer = csv.DictWriter(table, names, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    lines = table.getvalue()
    write_atomically(folder / "results.csv", lambda file: file.write_text(lines, encoding="utf-8"))


def _flat(row: dict[str, Any]) -> dict[str, Any]:
    """Return a trial's row without nesting: parameters by their keys, metrics of levels as level_L_metric."""
    flat = {key: value for key, value in row.items() if key not in ("parameters", "levels", "resumed_from")}
    flat |= {key: value if isinstance(value, str) else json.dumps(value) for key, value in row["parameters"].items()}
    flat["resumed_from"] = " ".join(map(str, row["resumed_from"]))
    for level, numbers in row["levels"].items():
        flat |= {f"level_{level}_{name}": value for name, value in numbers.items()}
    return flat


def _number(value: float) -> float | None:
    return None if math.isnan(value) else value
